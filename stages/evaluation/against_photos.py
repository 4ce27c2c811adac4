"""`hineus evaluate views`: photos that a workspace held back, against drawings of its field and of its final mesh."""

from __future__ import annotations

import logging
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from stages.errors import InputError

if TYPE_CHECKING:
    from stages.engine.workspace import Workspace
    from stages.neural.drawing import FieldDrawer

log = logging.getLogger(__name__)

# The stages that drawings are made from, in order.
DRAWN_FROM = ("undistort", "train", "atlas", "bake")


def evaluate_views(workspace: Path, renders: Path | None = None, device: str = "auto") -> dict[str, Any]:
    """The photos that a workspace held back, against drawings of its field and of its final mesh.

    Args:
        renders: folder for the pictures, `photo/`, `field/` and `mesh/`; None: none are written.
        device: auto, cpu or cuda.

    Returns:
        {"photos": [{"name", "field": {"object": {"psnr", "ssim", "lpips", "pixels"} or None, "whole": ..}, "mesh":
        {..}}], "mean": the same without names, over the photos, "done"}; regions as in `stages.evaluation.views`.

    Raises:
        InputError: the workspace holds no photos back.
        WorkspaceError: a stage is missing, or is of another run than those after it.
    """
    from stages import artifacts
    from stages.drawing.view_scores import draw_view, silhouette
    from stages.evaluation.images import find_lpips
    from stages.evaluation.views import judge
    from stages.reconstruct import choose_device
    from stages.reporting.pictures import read_rgb

    opened = _whole(workspace)
    folders = {stage: opened.stage_folder(stage) for stage in DRAWN_FROM}
    held_out = artifacts.load_held_out(folders["train"])
    if not held_out:
        raise InputError(
            f"{workspace} holds no photos back: all were trained on.",
            f"Train without every 8th: `hineus run --workspace {workspace} --set train.hold_out=8`.",
        )
    cameras = artifacts.load_scene(folders["undistort"]).cameras
    atlas = artifacts.load_atlas(folders["atlas"])
    texture = read_rgb(artifacts.base_color_path(folders["bake"]))
    drawer = field_drawer(opened, choose_device(device))
    lpips, about_lpips = find_lpips()
    photos: list[dict[str, Any]] = []
    masked = 0
    for name in held_out:
        index = cameras.names.index(name)
        mask = artifacts.load_mask(folders["undistort"], name)
        masked += mask is not None
        judged = judge(
            artifacts.load_image(folders["undistort"], name),
            None if mask is None else mask > 127,
            drawer.draw(cameras, index),
            draw_view(atlas, texture, cameras, index),
            silhouette(atlas.vertices, atlas.faces, cameras, index),
            lpips,
        )
        if renders is not None:
            for what, picture in judged.pictures.items():
                artifacts.write_png((renders / what / name).with_suffix(".png"), picture)
        photos.append({"name": name, "field": asdict(judged.field), "mesh": asdict(judged.mesh)})
        log.info("%s: %d of %d photos", name, len(photos), len(held_out))
    return {
        "workspace": str(workspace),
        "photos": photos,
        "mean": {what: mean_scores([photo[what] for photo in photos]) for what in ("field", "mesh")},
        "renders": None if renders is None else str(renders),
        "done": [
            f"photos: {len(held_out)} of {len(cameras)}, held back from training and texture by `train.hold_out`",
            f"object: the photo's mask in {masked} photos, the mesh's silhouette in {len(held_out) - masked}",
            "whole: the photo as it is for a field with a background; else masked photo and drawing on white",
            f"lpips: {about_lpips}",
        ],
    }


def _whole(workspace: Path) -> Workspace:
    """A workspace whose stages that drawings are made from are all there, and of one run."""
    from stages.atlas import ATLAS_STAGE
    from stages.bake import BAKE
    from stages.engine.status import replaced_inputs
    from stages.engine.workspace import Workspace
    from stages.errors import WorkspaceError
    from stages.train import TRAIN
    from stages.undistort import UNDISTORT

    opened = Workspace.open(workspace)
    hint = f"Make it: `hineus run --workspace {workspace}`."
    for stage in (UNDISTORT, TRAIN, ATLAS_STAGE, BAKE):
        if opened.published(stage.name) is None:
            raise WorkspaceError(f"{workspace} has no result of the stage {stage.name}.", hint)
        made_from = (artifact.partition("/")[0] for artifact in replaced_inputs(stage, opened))
        if before := next((name for name in made_from if name in DRAWN_FROM), None):
            raise WorkspaceError(
                f"The stage {stage.name} of {workspace} is of another {before} than the one there.", hint
            )
    return opened


def field_drawer(workspace: Workspace, device: str) -> FieldDrawer:
    """What draws the trained field of a workspace, with the settings it was trained with."""
    from configs.renames import section_with_new_names
    from configs.training import TrainParams
    from stages import artifacts
    from stages.neural.drawing import FieldDrawer
    from stages.neural.trained_field import load_field

    manifest = workspace.published("train")
    assert manifest is not None  # callers have made sure
    field = load_field(artifacts.field_path(workspace.stage_folder("train")), device)
    params = TrainParams.model_validate(section_with_new_names("train", manifest.identity.params))
    return FieldDrawer(field.fields, params, device)


def mean_scores(photos: list[dict[str, Any]]) -> dict[str, Any]:
    """Of each number over the photos that have it, by region; None where none has."""
    means: dict[str, Any] = {}
    for region in ("object", "whole"):
        scored = [photo[region] for photo in photos if photo[region] is not None]
        means[region] = None
        if scored:
            means[region] = {"photos": len(scored)}
            for key in ("psnr", "ssim", "lpips"):
                values = [score[key] for score in scored if score[key] is not None]
                means[region][key] = sum(values) / len(values) if values else None
    return means
