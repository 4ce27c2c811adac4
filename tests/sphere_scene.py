"""A ball seen by a ring of cameras, rendered in closed form: the smallest capture that can be trained on."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image

from stages import artifacts
from stages.geometry.cameras import PinholeCameras, PosedScene
from stages.geometry.point_cloud import PointCloud
from stages.geometry.similarity import Similarity

RADIUS = 0.45


def ring_of_cameras(count: int = 8, width: int = 48, height: int = 40) -> PinholeCameras:
    """Cameras on two rings of radius 2.5, all looking at the origin, z up."""
    poses = []
    for i in range(count):
        angle, height_above = 2 * np.pi * i / count, 0.9 if i % 2 else -0.4
        center = np.array([2.5 * np.cos(angle), 2.5 * np.sin(angle), height_above])
        forward = -center / np.linalg.norm(center)
        right = np.cross(forward, [0, 0, 1])
        right /= np.linalg.norm(right)
        rotation = np.stack([right, np.cross(forward, right), forward])
        poses.append(np.concatenate([rotation, -rotation @ center[:, None]], 1))
    K = np.array([[60.0, 0, width / 2], [0, 60, height / 2], [0, 0, 1]])
    return PinholeCameras(
        tuple(f"view_{i:02d}.png" for i in range(count)),
        np.tile([width, height], (count, 1)),
        np.tile(K, (count, 1, 1)),
        np.stack(poses),
    )


def sphere_scene(cameras: PinholeCameras) -> PosedScene:
    """The ball's scene with sparse points exactly on it."""
    rng = np.random.default_rng(0)
    points = rng.normal(size=(200, 3))
    points *= RADIUS / np.linalg.norm(points, axis=1, keepdims=True)
    return PosedScene(
        cameras,
        Similarity(2.0, np.eye(3), np.array([1.0, 2, 3])),
        points.astype(np.float32),
        np.full(200, 0.3, np.float32),
        np.argwhere(cameras.centers @ points.T > RADIUS**2).astype(np.int32),
        np.array([0.0, 0, 1]),
    )


def sphere_cloud(cameras: PinholeCameras) -> PointCloud:
    """Dense points exactly on the ball, in the scene frame: the left half's are trusted half as much."""
    rng = np.random.default_rng(1)
    normals = rng.normal(size=(500, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    points = RADIUS * normals
    point, photo = np.nonzero(points @ cameras.centers.T > RADIUS**2)
    starts = np.searchsorted(point, np.arange(len(points) + 1))
    colors = np.uint8(127.5 + 127.5 * normals)
    trust = np.where(points[:, 0] < 0, 0.5, 1.0).astype(np.float32)
    return PointCloud(points.astype(np.float32), normals.astype(np.float32), colors, trust, starts, photo)


def render(cameras: PinholeCameras, index: int) -> tuple[np.ndarray, np.ndarray]:
    """Photo [H, W, 3] uint8 and mask [H, W] uint8: a ball with smooth colours on a grey ground."""
    width, height = cameras.sizes[index]
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    origins, directions = cameras.rays(index, np.stack([x.ravel(), y.ravel()], 1))
    middle = -(origins * directions).sum(1)
    half_squared = RADIUS**2 - ((origins + middle[:, None] * directions) ** 2).sum(1)
    hit = half_squared > 0
    points = origins + (middle - np.sqrt(np.maximum(half_squared, 0)))[:, None] * directions
    colors = np.where(hit[:, None], 0.5 + 0.4 * np.sin(9 * points), 0.5)
    return np.uint8(255 * colors).reshape(height, width, 3), np.uint8(255 * hit).reshape(height, width)


def write_undistorted(folder: Path, cameras: PinholeCameras, masks: bool = False) -> None:
    """The folder that the undistort stage would have published."""
    (folder / artifacts.IMAGES).mkdir(parents=True)
    (folder / artifacts.MASKS).mkdir()
    artifacts.FIRST_SCENE.save(folder, sphere_scene(cameras))
    for i, name in enumerate(cameras.names):
        photo, mask = render(cameras, i)
        Image.fromarray(photo).save(artifacts.Pictures(folder).path(name))
        if masks:
            Image.fromarray(mask).save(artifacts.Pictures(folder).mask_path(name))


def write_densified(folder: Path, cloud: PointCloud | None = None) -> Path:
    """The folder that the densify stage would have published of these points in the frame of the poses, or of none."""
    folder.mkdir(parents=True, exist_ok=True)
    artifacts.POINT_CLOUD.save(folder, cloud if cloud is not None else PointCloud.empty())
    return folder
