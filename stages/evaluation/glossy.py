"""GlossySynthetic's evaluation, as NeRO's `eval_synthetic_shape.py` has it (Liu et al. 2023).

Truth and prediction are both what the test cameras see: depth maps turned into points, thinned to one a cube of
`VOXEL`. The number is the mean of the mean distances both ways; the object lies in the unit sphere.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from stages.evaluation.surfaces import Surface
from stages.geometry.cameras import PinholeCameras

VOXEL = 0.01


@dataclass(frozen=True)
class GlossyScore:
    """In the data set's unit: the object lies in the unit sphere.

    Attributes:
        accuracy: mean distance from the predicted to the true points.
        completeness: mean distance from the true to the predicted points.
        chamfer: mean of the two, the number in papers' tables.
        predicted_points, true_points: how many.
    """

    accuracy: float
    completeness: float
    chamfer: float
    predicted_points: int
    true_points: int


def visible_points(cameras: PinholeCameras, depths: Iterable[np.ndarray]) -> np.ndarray:
    """Points [P, 3] of depth maps [H, W] (along the axis; 0 or infinite: nothing there), one a camera, thinned.

    As NeRO does, pixel (x, y) stands for the place (x, y) and not for its centre (x + .5, y + .5): half a pixel off,
    the same for truth and prediction.
    """
    raise NotImplementedError


def glossy_score(predicted: Surface, cameras: PinholeCameras, true_points: np.ndarray) -> GlossyScore:
    """Hold a mesh against the true points [P, 3] of `visible_points`.

    Args:
        predicted: a mesh in the data set's frame; its depth is drawn from the cameras.

    Raises:
        ValueError: it has no faces, or no camera sees it.
    """
    raise NotImplementedError
