"""Which way is up: from the ground's plane, or from how the cameras are held. GPS tells it better, see `place`. And
turning the world for file formats and screens that want +Y on top.

EXIF carries no gravity that could be trusted: its orientation flag is a multiple of 90 degrees. Ingest turns the
photos by it, and that is what makes the cameras' own up worth something.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from stages.geometry.cameras import PinholeCameras, PosedScene
from stages.geometry.normalisation import rotation_onto
from stages.geometry.place import Place
from stages.geometry.similarity import Similarity

if TYPE_CHECKING:
    from jaxtyping import Float

IRLS_STEPS = 30
TINY = 1e-12  # keeps divisions finite; far below any length that occurs
# Where the cameras' up directions cancel to less than this, they look down (or up), and say nothing of up.
MIN_MEAN_UP = 0.3
# The ground is level where it agrees with the cameras to this; beyond it is a slope, and the cameras are believed.
MAX_SLOPE_DEG = 10.0


@dataclass(frozen=True)
class Up:
    """Which way is up.

    Attributes:
        direction: unit.
        source: what it was found from, in words.
        sure: whether the cameras were held level in enough directions to tell (of the cameras' estimate).
    """

    direction: Float[np.ndarray, " 3"]
    source: str
    sure: bool = True


def estimate_up(cameras: PinholeCameras) -> Up:
    """Up in the frame of the poses, from how cameras are held.

    People hold cameras level: image rows are horizontal, so up is perpendicular to all camera x axes whatever
    the pitch. Where the x axes do not span a plane (photos from one side) it is the mean of the cameras' up, or,
    where those cancel (a drone that looks down and flies to and fro), against the mean viewing direction.
    """
    right, mean_up = cameras.extrinsics[:, 0, :3], -cameras.extrinsics[:, 1, :3].mean(0)
    if np.linalg.norm(mean_up) < MIN_MEAN_UP:
        mean_up = -cameras.forward.mean(0)
    mean_up /= max(np.linalg.norm(mean_up), TINY)
    weights = np.ones(len(right))
    for _ in range(IRLS_STEPS):
        spread, axes = np.linalg.eigh((weights[:, None] * right).T @ right / weights.sum())
        up = axes[:, 0]
        weights = 1.0 / np.maximum(np.abs(right @ up), 0.02)
    if spread[1] < 0.05 or spread[1] < 4 * spread[0] or abs(up @ mean_up) < 0.5:
        return Up(mean_up, "the mean of the cameras' up", sure=False)
    return Up(up if up @ mean_up > 0 else -up, "level cameras")


def choose_up(cameras: Up, ground: Float[np.ndarray, " 3"] | None) -> Up:
    """Which to believe: level ground, then the cameras.

    Args:
        cameras: see `estimate_up`.
        ground: unit normal of the ground's plane, or None.
    """
    if ground is not None and (not cameras.sure or angle_deg(ground, cameras.direction) <= MAX_SLOPE_DEG):
        return Up(ground, "the ground's plane")
    return cameras


def y_up_rotation(up: Float[np.ndarray, " 3"]) -> Float[np.ndarray, "3 3"]:
    """The smallest rotation that turns `up` to +Y (glTF's up); what is upside down makes half a turn about X."""
    up = up / np.linalg.norm(up)
    if up[1] < -1 + 1e-14:
        return np.diag([1.0, -1.0, -1.0])
    return rotation_onto(up, np.array([0.0, 1.0, 0.0]))


def gltf_from_scene(scene: PosedScene, place: Place) -> Similarity:
    """From the scene's frame to that of the exported GLB: the world, turned +Y up."""
    world_from_scene = scene.world_from_scene(place)
    turn = y_up_rotation(world_from_scene.rotation @ scene.up_in(place))
    return Similarity(1.0, turn, np.zeros(3)).compose(world_from_scene)


def angle_deg(a: Float[np.ndarray, " 3"], b: Float[np.ndarray, " 3"]) -> float:
    """Angle in degrees between unit vectors."""
    return float(np.degrees(np.arccos(np.clip(a @ b, -1, 1))))
