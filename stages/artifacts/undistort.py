"""What undistort publishes: pinhole images and masks, their cameras, sparse points, and the scene's frame."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from stages.artifacts.artifact import Artifact, place_artifact
from stages.artifacts.json_files import Array, Record, read_record, write_record
from stages.artifacts.pictures import pictures_of
from stages.artifacts.place import SimilarityRecord
from stages.geometry.cameras import PinholeCameras, PosedScene
from stages.geometry.plane import Plane

CAMERAS_FILE = "cameras.json"
SCENE_FILE = "scene.json"
POINTS_FILE = "points.npz"
OVERVIEW_FILE = "overview.svg"


class _CameraRecord(Record):
    """One pinhole camera in the scene frame."""

    name: str
    size: tuple[int, int]
    intrinsics: Array
    cam_from_scene: Array


class _CamerasRecord(Record):
    cameras: tuple[_CameraRecord, ...]


class _PlaneRecord(Record):
    normal: Array
    offset: float
    rms: float
    share: float


class _SceneRecord(Record):
    kind: str
    up: Array
    poses_from_scene: SimilarityRecord
    ground: _PlaneRecord | None


def save_cameras(folder: Path, cameras: PinholeCameras) -> None:
    rows = zip(cameras.names, cameras.sizes.tolist(), cameras.intrinsics, cameras.cam_from_scene, strict=True)
    records = (
        _CameraRecord(name=name, size=tuple(size), intrinsics=intrinsics, cam_from_scene=pose)
        for name, size, intrinsics, pose in rows
    )
    write_record(folder / CAMERAS_FILE, _CamerasRecord(cameras=tuple(records)))


def load_cameras(folder: Path) -> PinholeCameras:
    records = read_record(folder / CAMERAS_FILE, _CamerasRecord).cameras
    return PinholeCameras(
        names=tuple(record.name for record in records),
        sizes=np.array([record.size for record in records], dtype=np.int64),
        intrinsics=np.array([record.intrinsics for record in records]),
        cam_from_scene=np.array([record.cam_from_scene for record in records]),
    )


def save_scene(folder: Path, scene: PosedScene) -> None:
    save_cameras(folder, scene.cameras)
    write_record(folder / SCENE_FILE, _SceneRecord.model_validate(scene))
    np.savez(
        folder / POINTS_FILE,
        points=scene.points.astype(np.float32),
        point_errors=scene.point_errors.astype(np.float32),
        observations=scene.observations.astype(np.int32),
    )


def load_scene(folder: Path) -> PosedScene:
    record = read_record(folder / SCENE_FILE, _SceneRecord)
    with np.load(folder / POINTS_FILE) as points:
        sparse = {key: points[key] for key in ("points", "point_errors", "observations")}
    return PosedScene(
        cameras=load_cameras(folder),
        poses_from_scene=record.poses_from_scene.similarity(),
        up=record.up,
        kind=record.kind,
        ground=None if record.ground is None else Plane(**dict(record.ground)),
        **sparse,
    )


def overview_path(folder: Path) -> Path:
    """Drawing of cameras, sparse points and the region of interest."""
    return folder / OVERVIEW_FILE


PINHOLE_PHOTOS = pictures_of("undistort")
CAMERAS = Artifact("undistort", (CAMERAS_FILE,), load_cameras, save_cameras)
SCENE = Artifact("undistort", (CAMERAS_FILE, SCENE_FILE, POINTS_FILE), load_scene, save_scene)
OVERVIEW = place_artifact("undistort", OVERVIEW_FILE)
