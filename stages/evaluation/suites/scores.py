"""Scores of one benchmark result, by the protocol of its suite: the mesh against the truth, drawings against photos."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from stages import artifacts
from stages.engine.workspace import Workspace
from stages.evaluation.photos.images import find_lpips
from stages.evaluation.photos.novel_views import NovelPhotos
from stages.evaluation.photos.scoring import score_photos
from stages.evaluation.protocols.blendedmvs import evaluate_blended
from stages.evaluation.protocols.dtu import evaluate_dtu
from stages.evaluation.protocols.glossy import evaluate_glossy
from stages.evaluation.protocols.known_object import score_mesh
from stages.evaluation.reading import read_mesh
from stages.evaluation.suites.scene import SuiteScene, Truth
from stages.gaussians.keeping import read_gaussians
from stages.geometry.similarity import Similarity


def score_result(
    scene: SuiteScene, workspace: Workspace, mesh: Path | None, fresh: set[str], device: str
) -> dict[str, Any]:
    """All that can be scored of a scene: {"mesh": ..., "views": ...}, each only where there is something to score by.

    Args:
        mesh: in the frame of the poses; None: there is none.
        fresh: stages of the workspace that are up to date; what a peer made has none.
        device: to draw on.

    Raises:
        InputError: the truth cannot be read, or the mesh not be scored.
    """
    scores = {}
    if scene.truth is not None and mesh is not None:
        scores["mesh"] = score_surface(scene.truth, mesh, workspace)
    if scene.views is not None and "train" in fresh:
        trained = artifacts.SCENE.load(workspace.stage_folder("train"))
        photos = NovelPhotos(scene.views, trained, scene.masks)
        indices = range(len(photos.cameras))
        file = artifacts.SPLATS.load(workspace.stage_folder("splats"))
        found = score_photos(
            workspace, photos.cameras, indices, photos.load, device, textured="bake" in fresh, lpips=find_lpips()[0],
            splats=read_gaussians(file) if "splats" in fresh and file.exists() else None,
        )  # fmt: skip
        scores["views"] = {"counted": len(indices), **found}
    return scores


# ---------------------------------------------------------------- the mesh
def result_mesh(workspace: Workspace, fresh: set[str], out: Path) -> Path | None:
    """Write the clean mesh of a workspace, in the frame of its poses, to `out`; None where that stage was not run.

    Args:
        fresh: stages that are up to date.
    """
    if "cleanup" not in fresh:
        return None
    vertices, faces = artifacts.CLEAN_MESH.load(workspace.stage_folder("cleanup"))
    scene = artifacts.SCENE.load(workspace.stage_folder("train"))
    _write(scene.poses_from_scene, (vertices, faces), out)
    return out


def posed_mesh(workspace: Workspace, mesh: Path, out: Path) -> Path:
    """Write a mesh that is in the world frame of a workspace, in the frame of its poses, to `out`."""
    place = artifacts.WORLD_PLACE.load(workspace.stage_folder("place"))
    _write(place.world_from_poses.inverse(), read_mesh(mesh), out)
    return out


def _write(poses_from_mesh: Similarity, mesh: tuple[np.ndarray, np.ndarray], out: Path) -> None:
    import trimesh

    trimesh.Trimesh(poses_from_mesh.apply(mesh[0].astype(np.float64)), mesh[1], process=False).export(out)


def score_surface(truth: Truth, mesh: Path, workspace: Workspace) -> dict[str, Any]:
    """The numbers of a mesh (in the frame of the poses) by the protocol of `truth`.

    Raises:
        InputError: the truth cannot be read, or the mesh not be scored.
    """
    if truth.protocol == "known":
        return dict(score_mesh(mesh, artifacts.MODEL.load(workspace.stage_folder("sfm")), truth.folder))
    if truth.protocol == "dtu":
        return _without_paths(evaluate_dtu(mesh, truth.folder, truth.scan))
    if truth.protocol == "glossy":
        return _without_paths(evaluate_glossy(mesh, truth.folder, truth.split))
    return evaluate_blended(mesh, truth.folder)


def _without_paths(found: dict[str, Any]) -> dict[str, Any]:
    """Only what was measured: results are passed on, and folders here mean nothing elsewhere."""
    return {key: value for key, value in found.items() if key not in ("predicted", "truth", "done")}
