"""What the report is made from, as earlier stages may leave it: the bare minimum, and all there can be."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
from rigs import scene_without_points, shell

from configs.params import ReportParams
from stages import artifacts
from stages.artifacts import (
    AtlasMesh,
    ImageRecord,
    ImageSet,
    PoseError,
    Registration,
    SkippedImage,
    Unregistered,
    VertexQuality,
    write_png,
)
from stages.engine.fingerprint import Identity
from stages.engine.manifest import Manifest
from stages.engine.stage import StageContext
from stages.geometry.cameras import PinholeCameras
from stages.geometry.place import Place, given_region
from stages.geometry.plane import Plane
from stages.geometry.similarity import Similarity
from stages.report import REPORT

UP = np.array([0.0, 0, 1])
BOX = np.array([[-0.5, -0.5, -0.2], [0.5, 0.5, 0.6]])


def pyramid() -> AtlasMesh:
    vertices = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0], [0, 0, 1.5]]) * 0.5
    faces = np.array([[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]], np.int32)
    normals = vertices / np.linalg.norm(vertices, axis=1, keepdims=True)
    uvs = np.array([[0.1, 0.1], [0.9, 0.1], [0.9, 0.9], [0.1, 0.9], [0.5, 0.5]])
    return AtlasMesh(vertices.astype(np.float32), normals.astype(np.float32), uvs.astype(np.float32), faces, 16)


def quality() -> VertexQuality:
    """The pyramid's tip was seen by one photo, its foot by none."""
    tip = np.array([0, 0, 0, 0, 1.0])
    return VertexQuality(tip.astype(np.uint16), 0.9 * tip, 0 * tip, 50 * tip, 100 + 0 * tip, 1 - tip)


def manifest(stage: str, **numbers) -> Manifest:
    return Manifest(
        Identity(stage, 1, {"speed": 3}), {}, numbers, wall_s=75.0, cpu_s=100.5, peak_rss=2**30,
        versions={"hineus": "0.1.0"}, created="2024-01-01T00:00:00+00:00",
    )  # fmt: skip


def bare_inputs(root: Path) -> StageContext:
    """The bare minimum: a scene, an atlas and a texture."""
    folders = {name: root / name for name in (*REPORT.needs, "out", "scratch")}
    for folder in folders.values():
        folder.mkdir()
    pose = np.concatenate([np.eye(3), [[0], [0], [3]]], 1)[None]
    K = np.array([[24.0, 0, 8], [0, 24, 8], [0, 0, 1]])
    cameras = PinholeCameras(("a.png",), np.array([[16, 16]]), K[None], pose)
    artifacts.SCENE.save(folders["train"], scene_without_points(cameras))
    artifacts.WORLD_PLACE.save(folders["place"], Place(Similarity.identity()))
    artifacts.GIVEN_REGION.save(folders["place"], None)
    artifacts.ATLAS_MESH.save(folders["atlas"], pyramid())
    texture = np.zeros((16, 16, 3), np.uint8)
    texture[:8], texture[8:] = (230, 40, 40), (40, 70, 220)
    write_png(artifacts.BASE_COLOR.load(folders["bake"]), texture)
    return StageContext(
        inputs={name: folders[name] for name in REPORT.needs},
        sources={},
        out=folders["out"],
        scratch=folders["scratch"],
        params=ReportParams(),
    )


def full_inputs(context: StageContext) -> StageContext:
    """Every stage left all it can."""
    inputs = context.inputs
    records = []
    for name in ("a.png", "b <odd>.png", "c.png"):
        path = artifacts.Pictures(inputs["ingest"]).path(name)
        path.parent.mkdir(exist_ok=True)
        write_png(path, np.full((30, 40, 3), 120, np.uint8))
        records.append(ImageRecord(name, name, 40, 30, None, "0", 5.0, False, "00"))
    skipped = (SkippedImage("notes.txt", "not an image"),)
    artifacts.IMAGE_SET.save(inputs["ingest"], ImageSet(tuple(records), skipped))
    artifacts.REGISTRATION.save(
        inputs["sfm"],
        Registration(
            registered=("a.png", "c.png"),
            unregistered=(Unregistered(name="b <odd>.png", reason="only 3 matches"),),
            pose_error=PoseError(residual_px=0.5, center=0.002, distance=4.0),
        ),
    )
    lines = [{"step": 10 * i, "psnr": 10 + i, "loss": 0.5 / (i + 1), "rgb": None, "mask": 0.0} for i in range(50)]
    text = "\n".join(json.dumps(line) for line in lines) + '\n{"step": 500, "psn'
    artifacts.METRICS.load(inputs["train"]).write_text(text)
    preview = artifacts.preview_path(inputs["train"], 100)
    preview.parent.mkdir()
    write_png(preview, np.full((20, 20, 3), 90, np.uint8))
    kinds = np.zeros((16, 16), np.uint8)
    kinds[:4, :12], kinds[4:8, :4] = 255, 128
    write_png(artifacts.PROVENANCE.load(inputs["bake"]), kinds)
    random = np.random.default_rng(0)
    scene = replace(
        artifacts.SCENE.load(inputs["train"]),
        points=random.normal(size=(300, 3)).astype(np.float32),
        point_errors=np.full(300, 0.5, np.float32),
        ground=Plane(UP, -0.2, 0.01, 0.5),
    )
    artifacts.SCENE.save(inputs["train"], scene)
    still = Similarity.identity()
    artifacts.WORLD_PLACE.save(inputs["place"], Place(still, True, "2 markers (8 sides)", 0.0042))
    region = given_region("box", BOX.ravel().tolist(), still)
    artifacts.GIVEN_REGION.save(inputs["place"], region)
    artifacts.POINT_CLOUD.save(inputs["densify"], shell())
    artifacts.QUALITY.save(inputs["bake"], quality())
    artifacts.HELD_OUT.save(inputs["train"], ["a.png"])
    write_png(artifacts.Pictures(inputs["undistort"]).path("a.png"), np.full((16, 16, 3), 77, np.uint8))
    manifests = {name: manifest(name, faces=1234, share=0.123456) for name in REPORT.needs}
    manifests["densify"] = manifest("densify", points=400, explained={"a.png": 0.42})
    return replace(context, manifests=manifests)


def page(context: StageContext) -> str:
    numbers = REPORT.run(context)
    path = artifacts.PAGE.load(context.out)
    assert numbers["bytes"] == path.stat().st_size
    return path.read_text(encoding="utf-8")
