"""The normalised frame, and the way of cameras into it: the region of interest is the unit sphere, +z is up."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from stages.geometry.cameras import PinholeCameras, PosedScene
from stages.geometry.similarity import Similarity

if TYPE_CHECKING:
    from jaxtyping import Float


# A region that was found before stays where the new one reaches no further beyond it than this, in its radii, fills so
# much of it, and has the same up within so many degrees.
MAX_REACH, MIN_FILLED, MAX_TILT_DEG = 1.1, 0.8, 5.0


def rotation_onto(source: Float[np.ndarray, " 3"], target: Float[np.ndarray, " 3"]) -> Float[np.ndarray, "3 3"]:
    """The smallest rotation that takes unit vector `source` to unit vector `target`."""
    cross, half = np.cross(source, target), source + target
    one_and_cosine = float(half @ half) / 2  # which keeps its digits where they are nearly opposite
    if one_and_cosine < 1e-14:  # opposite: half a turn about any axis perpendicular to it
        axis = perpendicular(source)
        return 2 * np.outer(axis, axis) - np.eye(3)
    K = np.array([[0, -cross[2], cross[1]], [cross[2], 0, -cross[0]], [-cross[1], cross[0], 0]])
    return np.eye(3) + K + K @ K / one_and_cosine


def perpendicular(direction: Float[np.ndarray, " 3"]) -> Float[np.ndarray, " 3"]:
    """A unit vector at right angles to a direction; any will do."""
    side = np.cross(direction, np.eye(3)[np.argmin(np.abs(direction))])
    return side / np.linalg.norm(side)


def scene_frame(center: Float[np.ndarray, " 3"], radius: float, up: Float[np.ndarray, " 3"]) -> Similarity:
    """poses_from_scene: the unit sphere to the sphere (center, radius), scene +z to `up`."""
    if not radius > 0:
        raise ValueError(f"got radius {radius}, expected a positive one")
    return Similarity(float(radius), rotation_onto(np.array([0.0, 0.0, 1.0]), up / np.linalg.norm(up)), center)


def still_fits(frame: Similarity, found: Similarity) -> bool:
    """Whether the region of a frame can stay where another was found: it holds that, is not much larger, and upright.

    Both from the normalised frame to that of the poses, see `scene_frame`.
    """
    frame_from_found = frame.inverse().compose(found)
    reach = float(np.linalg.norm(frame_from_found.translation)) + frame_from_found.scale
    upright = float(frame_from_found.rotation[2, 2]) > math.cos(math.radians(MAX_TILT_DEG))
    return reach < MAX_REACH and frame_from_found.scale > MIN_FILLED and upright


def into_frame(cameras: PinholeCameras, old_from_new: Similarity) -> PinholeCameras:
    """The same cameras in another frame, as from the poses' to the scene's. The camera frames shrink with it."""
    rotation, translation = cameras.extrinsics[:, :, :3], cameras.extrinsics[:, :, 3]
    extrinsics = np.empty_like(cameras.extrinsics)
    extrinsics[:, :, :3] = rotation @ old_from_new.rotation
    extrinsics[:, :, 3] = (rotation @ old_from_new.translation + translation) / old_from_new.scale
    return replace(cameras, extrinsics=extrinsics)


def regrown(scene: PosedScene, center: Float[np.ndarray, " 3"], radius: float) -> PosedScene:
    """The same capture with another region, a sphere given in the frame of `scene`; it grows no more."""
    old_from_new = Similarity(radius, np.eye(3), center)
    return replace(
        scene,
        cameras=into_frame(scene.cameras, old_from_new),
        poses_from_scene=scene.poses_from_scene.compose(old_from_new),
        points=old_from_new.inverse().apply(scene.points).astype(np.float32),
        ground=scene.ground and scene.ground.within(old_from_new),
        growable=False,
        roi_scale=scene.roi_scale * (float(np.linalg.norm(center)) + radius),
    )
