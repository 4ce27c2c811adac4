"""A workspace that holds a textured ball, as the pipeline would leave it, without running any of it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from rigs import scene_without_points

from configs.params import Config
from stages import artifacts
from stages.artifacts import AtlasMesh, write_png
from stages.engine.runner import run_pipeline
from stages.engine.stage import Stage, StageContext
from stages.engine.workspace import Workspace
from stages.files.light_files import write_exr, write_hdr
from stages.gaussians.gaussians import Gaussians
from stages.gaussians.harmonics import C0
from stages.gaussians.keeping import write_gaussians
from stages.geometry.cameras import PinholeCameras
from stages.geometry.place import Place
from stages.geometry.similarity import Similarity
from stages.pipeline import PIPELINE

GREY = 188
BASE = (60, 120, 220)


def ball() -> AtlasMesh:
    """In the scene frame, whose up is +Z."""
    made = trimesh.creation.icosphere(3)
    points = made.vertices.astype(np.float32)
    uvs = (0.5 + 0.3 * points[:, :2]).astype(np.float32)
    return AtlasMesh(points, points.copy(), uvs, made.faces.astype(np.int32), 16)


def lamp_above(height: int = 32) -> np.ndarray:
    """The light [H, 2 H, 3] in the frame of the GLB: bright around +Y."""
    light = np.full((height, 2 * height, 3), 0.02, np.float32)
    light[: height // 6] = 5
    return light


def make_workspace(root: Path, materials: bool, until: str = "materials") -> Path:
    """`root`, with the stages up to `until` published; splats, where it is theirs, are a red ball."""
    photos = root.parent / f"{root.name}_photos"
    photos.mkdir()
    run_pipeline(
        [replace(stage, run=_left_by(stage, materials)) for stage in PIPELINE],
        Workspace.open(root, create=True),
        Config(),
        {"photos": photos},
        until=until,
    )
    return root


def _left_by(stage: Stage, materials: bool) -> Any:
    def run(context: StageContext) -> dict[str, Any]:
        leave = {"train": _scene, "place": _place, "atlas": _atlas, "bake": _texture, "splats": _splats}
        if materials:
            leave["materials"] = _materials
        if stage.name in leave:
            leave[stage.name](context)
        for pattern in (pattern for artifact in stage.writes if not artifact.optional for pattern in artifact.files):
            place = context.out / pattern.replace("*", "x")
            place.parent.mkdir(parents=True, exist_ok=True)
            place.touch()
        return {}

    return run


def _scene(context: StageContext) -> None:
    pose = np.concatenate([np.eye(3), [[0], [0], [3]]], 1)[None]
    K = np.array([[24.0, 0, 8], [0, 24, 8], [0, 0, 1]])
    context.write(
        artifacts.SCENE, scene_without_points(PinholeCameras(("a.png",), np.array([[16, 16]]), K[None], pose))
    )


def _place(context: StageContext) -> None:
    context.write(artifacts.WORLD_PLACE, Place(Similarity.identity()))


def _atlas(context: StageContext) -> None:
    context.write(artifacts.ATLAS_MESH, ball())


def _texture(context: StageContext) -> None:
    write_png(context.to_write(artifacts.BASE_COLOR), np.full((16, 16, 3), GREY, np.uint8))
    write_png(context.to_write(artifacts.OCCLUSION), np.full((16, 16), 255, np.uint8))
    write_png(context.to_write(artifacts.NORMAL_MAP), np.full((16, 16, 3), (128, 128, 255), np.uint8))


def _materials(context: StageContext) -> None:
    write_png(context.to_write(artifacts.MATERIAL_COLOR), np.full((16, 16, 3), BASE, np.uint8))
    write_png(context.to_write(artifacts.ORM), np.full((16, 16, 3), (255, 255, 0), np.uint8))
    write_exr(context.to_write(artifacts.LIGHT), lamp_above())
    write_hdr(context.to_write(artifacts.LIGHT_HDR), lamp_above())


def _splats(context: StageContext) -> None:
    write_gaussians(context.to_write(artifacts.SPLATS), red_ball())


def red_ball() -> Gaussians:
    """Opaque Gaussians at the vertices of the ball, as large as their distances."""
    points = ball().vertices
    one = np.ones(len(points), np.float32)
    red = (np.array([1.0, 0, 0]) - 0.5) / C0
    return Gaussians(
        centers=points,
        rotations=np.eye(4, dtype=np.float32)[:1].repeat(len(points), 0),
        log_scales=np.log(0.06) * np.ones((len(points), 3), np.float32),
        opacity_logits=4 * one,
        harmonics=np.tile(red.astype(np.float32), (len(points), 1, 1)),
        anchored=one > 0,
    )
