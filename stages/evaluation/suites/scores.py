"""Scores of one benchmark result, by the protocol of its suite: the mesh against the truth, drawings against photos."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from stages import artifacts
from stages.drawing.rendering import render_together
from stages.drawing.view_scores import SUPERSAMPLE, silhouette
from stages.engine.workspace import Workspace
from stages.evaluation.photos.images import find_lpips
from stages.evaluation.photos.novel_views import NovelPhotos, NovelViews
from stages.evaluation.photos.regions import judge_surface
from stages.evaluation.photos.scoring import mean_scores, score_photos
from stages.evaluation.protocols.blendedmvs import evaluate_blended
from stages.evaluation.protocols.dtu import evaluate_dtu
from stages.evaluation.protocols.glossy import evaluate_glossy
from stages.evaluation.protocols.known_object import score_mesh
from stages.evaluation.reading import read_mesh
from stages.evaluation.suites.scene import SuiteScene, Truth
from stages.gaussians.keeping import read_gaussians
from stages.geometry.similarity import Similarity
from stages.surface.placing import placed

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Part:
    """A workspace that holds the result, or a block of it.

    Attributes:
        poses_from_own: from the frame of its poses to that of the poses of the whole.
    """

    workspace: Workspace
    poses_from_own: Similarity

    @property
    def poses_from_scene(self) -> Similarity:
        """From the frame that was trained in to the frame of the whole's poses."""
        trained = artifacts.SCENE.load(self.workspace.stage_folder("train"))
        return self.poses_from_own.compose(trained.poses_from_scene)


def score_result(
    scene: SuiteScene, workspace: Workspace, parts: Sequence[Part], mesh: Path | None, fresh: set[str], device: str
) -> dict[str, Any]:
    """All that can be scored of a scene: {"mesh": ..., "views": ...}, each only where there is something to score by.

    Args:
        workspace: where the poses are.
        parts: where the results are: it, or its blocks, of which no field and no splats are drawn.
        mesh: in the frame of the poses; None: there is none.
        fresh: stages of the parts that are up to date; what a peer made has none.
        device: to draw on.

    Raises:
        InputError: the truth cannot be read, or the mesh not be scored.
    """
    scores = {}
    if scene.truth is not None and mesh is not None:
        scores["mesh"] = score_surface(scene.truth, mesh, workspace)
    if scene.views is not None and len(parts) > 1 and "bake" in fresh:
        scores["views"] = score_tiles(scene.views, scene.masks, parts)
    elif scene.views is not None and "train" in fresh:
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


def score_tiles(views: NovelViews, masks: Path | None, parts: Sequence[Part]) -> dict[str, Any]:
    """Test photos against drawings of the textured tiles of a scene in blocks, as `score_photos` has scores of "mesh".

    Raises:
        InputError: see `NovelPhotos`.
    """
    tiles = []
    for part in parts:
        mesh = placed(artifacts.ATLAS_MESH.load(part.workspace.stage_folder("atlas")), part.poses_from_scene)
        tiles.append((mesh, artifacts.read_texture(artifacts.BASE_COLOR.load(part.workspace.stage_folder("bake")))))
    one = artifacts.SCENE.load(parts[0].workspace.stage_folder("train"))
    photos = NovelPhotos(views, replace(one, poses_from_scene=Similarity.identity()), masks)
    lpips, scored = find_lpips()[0], list[dict[str, Any]]()
    for index, name in enumerate(photos.cameras.names):
        photo, mask = photos.load(index)
        drawing = render_together(tiles, photos.cameras.select([index]), supersample=SUPERSAMPLE)
        covered = [silhouette(mesh.vertices, mesh.faces, photos.cameras, index) for mesh, _ in tiles]
        scored.append({"name": name, "mesh": asdict(judge_surface(photo, mask, drawing, np.any(covered, 0), lpips))})
        log.info("%s: %d of %d photos", name, len(scored), len(photos.cameras))
    return {"counted": len(scored), "photos": scored, "mean": {"mesh": mean_scores([s["mesh"] for s in scored])}}


# ---------------------------------------------------------------- the mesh
def result_mesh(parts: Sequence[Part], fresh: set[str], out: Path) -> Path | None:
    """Write the clean meshes of all parts, in the frame of the whole's poses, to `out`; None where that stage was not
    run.

    Args:
        fresh: stages that are up to date.
    """
    if "cleanup" not in fresh:
        return None
    import trimesh

    trimesh.Trimesh(*joined_mesh(parts), process=False).export(out)
    return out


def joined_mesh(parts: Sequence[Part]) -> tuple[np.ndarray, np.ndarray]:
    """Vertices [V, 3] and faces [F, 3] of the clean meshes of all parts, in the frame of the whole's poses."""
    vertices, faces, count = [], [], 0
    for part in parts:
        own, corners = artifacts.CLEAN_MESH.load(part.workspace.stage_folder("cleanup"))
        vertices.append(part.poses_from_scene.apply(own.astype(np.float64)))
        faces.append(corners + count)
        count += len(own)
    return np.concatenate(vertices), np.concatenate(faces)


def posed_mesh(workspace: Workspace, mesh: Path, out: Path) -> Path:
    """Write a mesh that is in the world frame of a workspace, in the frame of its poses, to `out`."""
    place = artifacts.WORLD_PLACE.load(workspace.stage_folder("place"))
    import trimesh

    vertices, faces = read_mesh(mesh)
    in_poses = place.world_from_poses.inverse().apply(vertices.astype(np.float64))
    trimesh.Trimesh(in_poses, faces, process=False).export(out)
    return out


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
