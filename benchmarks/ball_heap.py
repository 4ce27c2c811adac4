"""A heap of glossy balls seen by a dome of cameras, rendered in closed form: a capture for timing, without downloads.

As many photos as the usual sets have, the share of rays that meet the object as well, and balls that hide and mirror
each other, so that every part of the method has its work to do.
"""

from __future__ import annotations

import numpy as np

from stages.geometry.cameras import PinholeCameras, PosedScene
from stages.geometry.point_cloud import PointCloud
from stages.geometry.similarity import Similarity
from stages.neural.sightings import Sightings

WIDTH, HEIGHT, FOCAL = 600, 450, 620.0  # pixels; the unit sphere fills the frame
NUM_PHOTOS = 47
NUM_POINTS, NUM_DENSE = 2000, 20_000
DISTANCE = 3.0
GLOSS = 0.3
_AROUND = 2 * np.pi * np.arange(5) / 5
CENTERS = np.concatenate([[[0, 0, 0]], 0.6 * np.stack([np.cos(_AROUND), np.sin(_AROUND), 0 * _AROUND - 0.3], 1)])
RADII = np.array([0.45, 0.3, 0.22, 0.28, 0.2, 0.25])


def dome_of_cameras() -> PinholeCameras:
    """Cameras on a spiral from just above the horizon to 65 degrees, all looking at the origin, z up."""
    poses = []
    for i in range(NUM_PHOTOS):
        angle, elevation = i * np.pi * (3 - np.sqrt(5)), np.radians(5 + 60 * i / NUM_PHOTOS)
        around = np.array([np.cos(angle), np.sin(angle), 0])
        forward = -np.cos(elevation) * around - [0, 0, np.sin(elevation)]
        right = np.cross(forward, [0, 0, 1])
        right /= np.linalg.norm(right)
        rotation = np.stack([right, np.cross(forward, right), forward])
        poses.append(np.concatenate([rotation, rotation @ (DISTANCE * forward)[:, None]], 1))
    K = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
    return PinholeCameras(
        tuple(f"{i:03d}.png" for i in range(NUM_PHOTOS)),
        np.tile([WIDTH, HEIGHT], (NUM_PHOTOS, 1)),
        np.tile(K, (NUM_PHOTOS, 1, 1)),
        np.stack(poses),
    )


def first_hit(origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distance [P] to the first ball on rays [P, 3] from outside, inf without one, and that ball's index [P]."""
    nearest, ball = np.full(len(origins), np.inf), np.zeros(len(origins), int)
    for i, (center, radius) in enumerate(zip(CENTERS, RADII, strict=True)):
        offsets = origins - center
        middle = -(offsets * directions).sum(1)
        half_squared = radius**2 - ((offsets + middle[:, None] * directions) ** 2).sum(1)
        distance = np.where(half_squared > 0, middle - np.sqrt(np.maximum(half_squared, 0)), np.inf)
        closer = (distance > 0) & (distance < nearest)
        nearest[closer], ball[closer] = distance[closer], i
    return nearest, ball


def _sky(directions: np.ndarray) -> np.ndarray:
    """Colour [P, 3] of what lies behind and around, along unit directions [P, 3]."""
    return 0.5 + 0.3 * np.sin(5 * directions + [0, 1, 2])


def render(cameras: PinholeCameras, index: int) -> np.ndarray:
    """Photo [H, W, 3] uint8: a paint that varies over the surface, and the sky mirrored in it."""
    x, y = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    origins, directions = cameras.rays(index, np.stack([x.ravel(), y.ravel()], 1))
    distance, ball = first_hit(origins, directions)
    colors = _sky(directions)
    hit = np.isfinite(distance)
    views, ball = directions[hit], ball[hit]
    points = origins[hit] + distance[hit, None] * views
    normals = (points - CENTERS[ball]) / RADII[ball, None]
    mirrored = views - 2 * (views * normals).sum(1, keepdims=True) * normals
    colors[hit] = (1 - GLOSS) * (0.5 + 0.4 * np.sin(15 * points)) + GLOSS * _sky(mirrored)
    return np.uint8(255 * colors).reshape(HEIGHT, WIDTH, 3)


def posed_scene(cameras: PinholeCameras) -> PosedScene:
    """The heap's scene, with sparse points exactly on it and the photos that see them."""
    points, _ = _on_balls(NUM_POINTS)
    return PosedScene(
        cameras, Similarity.identity(), points.astype(np.float32), np.full(NUM_POINTS, 0.5, np.float32),
        _observed(cameras, points).astype(np.int32), np.array([0.0, 0, 1]),
    )  # fmt: skip


def sightings(cameras: PinholeCameras, device: str) -> tuple[Sightings, Sightings]:
    """Of sparse points and of dense ones, all trusted."""
    points, normals = _on_balls(NUM_DENSE)
    photo, point = _observed(cameras, points).T
    order = np.argsort(point, kind="stable")
    starts = np.searchsorted(point[order], np.arange(NUM_DENSE + 1))
    grey, trust = np.full((NUM_DENSE, 3), 128, np.uint8), np.ones(NUM_DENSE)
    cloud = PointCloud(points, normals, grey, trust, starts, photo[order])
    dense = Sightings.from_cloud(cloud, cameras.centers, device)
    return Sightings.from_scene(posed_scene(cameras), device), dense


def _on_balls(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Places [N, 3] on the heap, hidden ones among them, and their normals."""
    rng = np.random.default_rng(0)
    normals = rng.normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    ball = rng.choice(len(RADII), count, p=RADII**2 / (RADII**2).sum())
    return CENTERS[ball] + RADII[ball, None] * normals, normals


def _observed(cameras: PinholeCameras, points: np.ndarray) -> np.ndarray:
    """Photo and point [M, 2] where a point [P, 3] is seen."""
    observations = []
    for i, center in enumerate(cameras.centers):
        offsets = points - center
        distance = np.linalg.norm(offsets, axis=1)
        seen, _ = first_hit(np.broadcast_to(center, points.shape), offsets / distance[:, None])
        rows = np.flatnonzero(np.abs(seen - distance) < 1e-6)
        observations.append(np.stack([np.full_like(rows, i), rows], 1))
    return np.concatenate(observations)
