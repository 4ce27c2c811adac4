"""`hineus evaluate views`: photos that a workspace held out, against drawings of its field, of its final mesh and
of its splats."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from stages import artifacts
from stages.atlas import ATLAS
from stages.bake import BAKE
from stages.engine.damage import damage_named
from stages.engine.status import replaced_inputs
from stages.engine.workspace import Workspace
from stages.errors import InputError, WorkspaceError
from stages.evaluation.photos.images import find_lpips
from stages.evaluation.photos.scoring import score_photos
from stages.gaussians.gaussians import Gaussians
from stages.gaussians.keeping import read_gaussians
from stages.reconstruct import choose_device
from stages.splats import SPLATTING
from stages.train import TRAIN
from stages.undistort import UNDISTORT

# The stages that drawings are made from, in order.
DRAWN_FROM = (UNDISTORT, TRAIN, ATLAS, BAKE)


def evaluate_views(workspace: Path, renders: Path | None = None, device: str = "auto") -> dict[str, Any]:
    """The photos that a workspace held out, against drawings of its field, of its final mesh and, where
    they are of that mesh, of its splats.

    Args:
        renders: folder for the pictures, `photo/`, `field/`, `mesh/` and `splats/`; None: none are written.
        device: auto, cpu or cuda.

    Returns:
        Photos and means as of `score_photos`, and under "done" how they were scored.

    Raises:
        InputError: the workspace holds out no photos.
        WorkspaceError: a stage is missing, damaged, or of another run than those after it.
    """
    opened = _whole(workspace)
    made = [stage.name for stage in (*DRAWN_FROM, SPLATTING) if opened.published(stage.name)]
    with damage_named(opened, made):
        return _scored(opened, workspace, renders, device)


def _scored(opened: Workspace, workspace: Path, renders: Path | None, device: str) -> dict[str, Any]:
    undistort, train = opened.stage_folder("undistort"), opened.stage_folder("train")
    held_out = artifacts.HELD_OUT.load(train)
    if not held_out:
        raise InputError(
            f"{workspace} holds out no photos: all were trained on.",
            f"Train without every 8th: `hineus run --workspace {workspace} --hold-out 8`.",
        )
    cameras = artifacts.CAMERAS.load(train)
    pinholes = artifacts.PINHOLE_PHOTOS.load(undistort)
    outlines = artifacts.OUTLINES.load(undistort)

    def of(name: str) -> artifacts.Pictures:
        return artifacts.given_mask_of(name, pinholes, outlines)

    def load(index: int) -> tuple[np.ndarray, np.ndarray | None]:
        name = cameras.names[index]
        return of(name).masked(name)

    masked = sum(of(name).mask_path(name).exists() for name in held_out)

    lpips, about_lpips = find_lpips()
    indices = [cameras.names.index(name) for name in held_out]
    splats, about_splats = _splats(opened)
    found = score_photos(
        opened, cameras, indices, load, choose_device(device), lpips=lpips, renders=renders, splats=splats
    )
    return {
        "workspace": str(workspace),
        **found,
        "renders": None if renders is None else str(renders),
        "done": [
            f"photos: {len(held_out)} of {len(cameras)}, held out from training and texture by `--hold-out`",
            f"object: the photo's mask in {masked} photos, the mesh's silhouette in {len(held_out) - masked}",
            "whole: the photo as it is for a field with a background; else masked photo and drawing on white",
            *([f"splats: {about_splats}"] if about_splats else []),
            f"lpips: {about_lpips}",
        ],
    }


def _splats(opened: Workspace) -> tuple[Gaussians | None, str]:
    """The splats of the workspace's mesh, and in words how many or why none; no words where none were made."""
    file = artifacts.SPLATS.load(opened.stage_folder(SPLATTING.name))
    if not file.exists():
        return None, ""
    if replaced_inputs(SPLATTING, opened):
        return None, "left out: they are of another mesh than the one there"
    splats = read_gaussians(file)
    return splats, f"{len(splats):,} Gaussians, on white"


def _whole(workspace: Path) -> Workspace:
    """A workspace whose stages that drawings are made from are all there, and of one run."""
    opened = Workspace.open(workspace)
    hint = f"Make it: `hineus run --workspace {workspace}`."
    for stage in DRAWN_FROM:
        if opened.published(stage.name) is None:
            raise WorkspaceError(f"{workspace} has no result of the stage {stage.name}.", hint)
        made_from = {artifact.partition("/")[0] for artifact in replaced_inputs(stage, opened)}
        if before := next((each.name for each in DRAWN_FROM if each.name in made_from), None):
            raise WorkspaceError(
                f"The stage {stage.name} of {workspace} is of another {before} than the one there.", hint
            )
    return opened
