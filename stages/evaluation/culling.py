"""Which points of a surface count: those that cameras see, that lie inside masks, that lie in a box."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from stages.evaluation.surfaces import Surface
from stages.geometry.cameras import PinholeCameras


def seen(points: np.ndarray, cameras: PinholeCameras, occluder: Surface | None = None) -> np.ndarray:
    """Which of points [P, 3] some camera sees, [P] bool: in its image, in front of it, with nothing in between.

    Args:
        occluder: a mesh that hides what lies behind it; None: nothing hides anything.
    """
    raise NotImplementedError


def inside_masks(
    points: np.ndarray, cameras: PinholeCameras, masks: Iterable[tuple[int, np.ndarray]], grow: int = 0
) -> np.ndarray:
    """Which of points [P, 3] no photo shows off its mask, [P] bool. Points out of all images count.

    Args:
        masks: camera and [H, W] bool.
        grow: pixels by which masks are widened first.
    """
    raise NotImplementedError


def inside_box(points: np.ndarray, box: np.ndarray) -> np.ndarray:
    """Which of points [P, 3] lie in a box [2, 3] of lowest and highest corner, [P] bool."""
    return ((points >= box[0]) & (points <= box[1])).all(1)
