"""The normalised frame: the region of interest is the unit sphere, +z is up.

Cameras of the world frame are `PinholeCameras` whose "scene" is the world.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from stages.geometry.cameras import PinholeCameras
from stages.geometry.similarity import Similarity

if TYPE_CHECKING:
    from jaxtyping import Float


def rotation_onto(source: Float[np.ndarray, " 3"], target: Float[np.ndarray, " 3"]) -> Float[np.ndarray, "3 3"]:
    """The smallest rotation that takes unit vector `source` to unit vector `target`."""
    cross, cosine = np.cross(source, target), float(source @ target)
    if cosine < -1 + 1e-9:  # opposite: half a turn about any axis perpendicular to it
        axis = np.cross(source, np.eye(3)[np.argmin(np.abs(source))])
        axis /= np.linalg.norm(axis)
        return 2 * np.outer(axis, axis) - np.eye(3)
    K = np.array([[0, -cross[2], cross[1]], [cross[2], 0, -cross[0]], [-cross[1], cross[0], 0]])
    return np.eye(3) + K + K @ K / (1 + cosine)


def scene_frame(center: Float[np.ndarray, " 3"], radius: float, up: Float[np.ndarray, " 3"]) -> Similarity:
    """world_from_scene: the unit sphere to the sphere (center, radius), scene +z to `up`."""
    if not radius > 0:
        raise ValueError(f"got radius {radius}, expected a positive one")
    return Similarity(float(radius), rotation_onto(np.array([0.0, 0.0, 1.0]), up / np.linalg.norm(up)), center)


def into_scene(cameras: PinholeCameras, world_from_scene: Similarity) -> PinholeCameras:
    """Cameras of the world frame, moved to the scene frame. The camera frames shrink with the scene."""
    rotation, translation = cameras.cam_from_scene[:, :, :3], cameras.cam_from_scene[:, :, 3]
    in_scene = np.empty_like(cameras.cam_from_scene)
    in_scene[:, :, :3] = rotation @ world_from_scene.rotation
    in_scene[:, :, 3] = (rotation @ world_from_scene.translation + translation) / world_from_scene.scale
    return PinholeCameras(cameras.names, cameras.sizes, cameras.intrinsics, in_scene)
