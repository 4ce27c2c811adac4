"""Where made-up photos are taken from, as [4, 4] world-to-camera matrices: OpenCV axes, world up +z."""

from __future__ import annotations

import numpy as np

from stages.drawing.rendering import look_at

UP = np.array([0, 0, 1.0])


def viewpoint(center: np.ndarray, target: np.ndarray, roll: float = 0.0, up: np.ndarray = UP) -> np.ndarray:
    """[4, 4] of a camera at `center` that looks at `target`, turned by `roll` radians about the way it looks."""
    right, down, forward = look_at(center, target, up, 1, 1).extrinsics[0, :, :3]
    right, down = np.cos(roll) * right + np.sin(roll) * down, np.cos(roll) * down - np.sin(roll) * right
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, down, forward])
    pose[:3, 3] = -pose[:3, :3] @ center
    return pose


def camera_ring(num_photos: int, rng: np.random.Generator) -> np.ndarray:
    """[N, 4, 4] world-to-camera matrices: three rings of hand-held photographs around an object of extent 1."""
    rings = np.array([0.5, 0.33, 0.17]) * num_photos
    counts = np.floor(rings).astype(int)
    counts[0] += num_photos - counts.sum()
    poses = []
    for ring, (count, elevation, distance) in enumerate(zip(counts, (24, 42, 62), (2.45, 2.5, 2.6), strict=True)):
        for i in range(count):
            azimuth = 2 * np.pi * (i + 0.37 * ring + rng.uniform(-0.08, 0.08)) / count
            tilt = np.radians(elevation + rng.uniform(-2.5, 2.5))
            radius = distance + rng.uniform(-0.12, 0.12)
            center = radius * np.array([np.cos(tilt) * np.cos(azimuth), np.cos(tilt) * np.sin(azimuth), np.sin(tilt)])
            target = np.array([0, 0, 0.38]) + rng.uniform(-0.03, 0.03, 3)
            poses.append(viewpoint(center, target, roll=np.radians(rng.uniform(-3, 3))))
    return np.array(poses)
