"""The one scorer of photos that nothing was learned from: what a result looks like from there, and how near that is."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from configs.renames import section_with_new_names
from configs.training import TrainParams
from stages import artifacts
from stages.drawing.view_scores import draw_view, silhouette
from stages.engine.workspace import Workspace
from stages.evaluation.photos.images import Lpips
from stages.evaluation.photos.regions import WHITE, judge
from stages.gaussians.gaussians import Gaussians
from stages.gaussians.pictures import draw_picture
from stages.geometry.cameras import PinholeCameras
from stages.neural.drawing import FieldDrawer
from stages.neural.trained_field import load_field

log = logging.getLogger(__name__)

# camera -> photo [H, W, 3] uint8 and mask [H, W] bool or None
LoadPhoto = Callable[[int], tuple[np.ndarray, np.ndarray | None]]


def score_photos(
    workspace: Workspace,
    cameras: PinholeCameras,
    indices: Sequence[int],
    load: LoadPhoto,
    device: str,
    textured: bool = True,
    lpips: Lpips | None = None,
    renders: Path | None = None,
    splats: Gaussians | None = None,
) -> dict[str, Any]:
    """Photos against drawings of a workspace's field, of its textured mesh and of splats; its stages are there.

    Args:
        cameras: in the workspace's scene frame.
        indices: of the cameras that are scored.
        textured: whether there is a textured mesh; without one there are no scores of "mesh".
        renders: folder for the pictures, `photo/`, `field/`, `mesh/` and `splats/`; None: none are written.
        splats: in the scene frame; without them there are no scores of "splats".

    Returns:
        {"photos": [{"name", "field": {"object": {"psnr", "ssim", "lpips", "pixels"} or None, "whole": ..}, "mesh":
        {..}, "splats": {..}}], "mean": the same without names, over the photos}; regions as in
        `stages.evaluation.photos.regions`.
    """
    drawer = field_drawer(workspace, device)
    if textured:
        atlas = artifacts.ATLAS_MESH.load(workspace.stage_folder("atlas"))
        texture = artifacts.read_texture(artifacts.BASE_COLOR.load(workspace.stage_folder("bake")))
    kinds = ("field", *(("mesh",) if textured else ()), *(("splats",) if splats is not None else ()))
    everywhere = splats is not None and not splats.anchored.all()
    photos: list[dict[str, Any]] = []
    for index in indices:
        name = cameras.names[index]
        photo, mask = load(index)
        if textured:
            drawing = draw_view(atlas, texture, cameras, index)
            covered = silhouette(atlas.vertices, atlas.faces, cameras, index)
        else:
            drawing, covered = np.full_like(photo, WHITE), np.zeros(photo.shape[:2], bool)
        of_splats = None if splats is None else draw_picture(splats, cameras, index)
        judged = judge(photo, mask, drawer.draw(cameras, index), drawing, covered, lpips, of_splats, everywhere)
        if renders is not None:
            for what, picture in judged.pictures.items():
                artifacts.write_png((renders / what / name).with_suffix(".png"), picture)
        photos.append({"name": name, **{kind: asdict(getattr(judged, kind)) for kind in kinds}})
        log.info("%s: %d of %d photos", name, len(photos), len(indices))
    return {"photos": photos, "mean": {kind: mean_scores([photo[kind] for photo in photos]) for kind in kinds}}


def field_drawer(workspace: Workspace, device: str) -> FieldDrawer:
    """What draws the trained field of a workspace, with the settings it was trained with."""
    manifest = workspace.published("train")
    assert manifest is not None  # callers have made sure
    field = load_field(artifacts.FIELD.load(workspace.stage_folder("train")), device)
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
