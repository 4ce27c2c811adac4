"""A posed scene as files: its cameras, sparse points, and frame."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from stages.artifacts.artifact import Artifact
from stages.artifacts.json_files import Array, Record, read_record, write_record
from stages.artifacts.place import SimilarityRecord
from stages.geometry.cameras import PinholeCameras, PosedScene
from stages.geometry.plane import Plane

_CAMERAS = "cameras.json"
_SCENE = "scene.json"
_POINTS = "points.npz"


class _CameraRecord(Record):
    """One pinhole camera in the scene frame."""

    name: str
    size: tuple[int, int]
    intrinsics: Array
    extrinsics: Array


class _CamerasRecord(Record):
    cameras: tuple[_CameraRecord, ...]


class _PlaneRecord(Record):
    normal: Array
    offset: float
    rms: float
    share: float


class _SceneRecord(Record):
    kind: str
    growable: bool
    roi_scale: float
    up: Array
    poses_from_scene: SimilarityRecord
    ground: _PlaneRecord | None
    contents: tuple[str, ...] = ()
    lineage: str = ""


def _save_cameras(folder: Path, cameras: PinholeCameras) -> None:
    rows = zip(cameras.names, cameras.sizes.tolist(), cameras.intrinsics, cameras.extrinsics, strict=True)
    records = (
        _CameraRecord(name=name, size=tuple(size), intrinsics=intrinsics, extrinsics=pose)
        for name, size, intrinsics, pose in rows
    )
    write_record(folder / _CAMERAS, _CamerasRecord(cameras=tuple(records)))


def _load_cameras(folder: Path) -> PinholeCameras:
    records = read_record(folder / _CAMERAS, _CamerasRecord).cameras
    return PinholeCameras(
        names=tuple(record.name for record in records),
        sizes=np.array([record.size for record in records], dtype=np.int64),
        intrinsics=np.array([record.intrinsics for record in records]),
        extrinsics=np.array([record.extrinsics for record in records]),
    )


def _save_scene(folder: Path, scene: PosedScene) -> None:
    _save_cameras(folder, scene.cameras)
    write_record(folder / _SCENE, _SceneRecord.model_validate(scene))
    np.savez(
        folder / _POINTS,
        points=scene.points.astype(np.float32),
        point_errors=scene.point_errors.astype(np.float32),
        observations=scene.observations.astype(np.int32),
    )


def _load_scene(folder: Path) -> PosedScene:
    record = read_record(folder / _SCENE, _SceneRecord)
    with np.load(folder / _POINTS) as points:
        sparse = {key: points[key] for key in ("points", "point_errors", "observations")}
    return PosedScene(
        cameras=_load_cameras(folder),
        poses_from_scene=record.poses_from_scene.similarity(),
        up=record.up,
        kind=record.kind,
        growable=record.growable,
        roi_scale=record.roi_scale,
        contents=record.contents,
        lineage=record.lineage,
        ground=None if record.ground is None else Plane(**dict(record.ground)),
        **sparse,
    )


def cameras_of(stage: str) -> Artifact[PinholeCameras]:
    """The scene's cameras alone."""
    return Artifact(stage, (_CAMERAS,), _load_cameras, _save_cameras)


def scene_of(stage: str) -> Artifact[PosedScene]:
    return Artifact(stage, (_CAMERAS, _SCENE, _POINTS), _load_scene, _save_scene)
