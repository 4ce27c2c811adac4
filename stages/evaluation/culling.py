"""Which points of a surface count: those that cameras see, that lie inside masks, that lie in a box."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from stages.geometry.cameras import PinholeCameras
from stages.surface.selection import outside_hull, widened
from stages.surface.triangle_mesh import raycaster

# The way from a point to a camera starts this part of it off the point, whose own surface would hide it.
CLEAR = 1e-5


def seen(
    points: np.ndarray, cameras: PinholeCameras, occluder: tuple[np.ndarray, np.ndarray] | None = None
) -> np.ndarray:
    """Which of points [P, 3] some camera sees, [P] bool: in its image, in front of it, with nothing in between.

    Args:
        occluder: vertices [V, 3] and faces [F, 3] of a mesh that hides what lies behind it; None: nothing does.
    """
    import open3d as o3d

    found = np.zeros(len(points), dtype=bool)
    middle = points.mean(0)  # single precision in the ray caster
    scene = None if occluder is None else raycaster(occluder[0] - middle, occluder[1])
    for i, center in enumerate(cameras.centers):
        open_points = np.flatnonzero(~found)
        open_points = open_points[cameras.in_frame(i, points[open_points])]
        if scene is not None and len(open_points):
            # Not normalised: the camera is at distance 1, whatever lies before it hides the point.
            ways = np.concatenate([points[open_points] - middle, center - points[open_points]], 1).astype(np.float32)
            hidden = scene.test_occlusions(o3d.core.Tensor(ways), tnear=CLEAR, tfar=1 - CLEAR).numpy()
            open_points = open_points[~hidden]
        found[open_points] = True
    return found


def inside_masks(
    points: np.ndarray, cameras: PinholeCameras, masks: Iterable[tuple[int, np.ndarray]], grow: int = 0
) -> np.ndarray:
    """Which of points [P, 3] no photo shows off its mask, [P] bool. Points out of all images count.

    Args:
        masks: camera and [H, W] bool.
        grow: pixels by which masks are widened first.
    """
    grown = ((i, widened(mask, grow)) for i, mask in masks)
    return ~outside_hull(points, cameras, grown, max_part=0.0, min_views=1)


def inside_box(points: np.ndarray, box: np.ndarray) -> np.ndarray:
    """Which of points [P, 3] lie in a box [2, 3] of lowest and highest corner, [P] bool."""
    return ((points >= box[0]) & (points <= box[1])).all(1)
