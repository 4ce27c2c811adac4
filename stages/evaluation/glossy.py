"""GlossySynthetic's evaluation, as NeRO's `eval_synthetic_shape.py` has it (Liu et al. 2023).

Truth and prediction are both what the test cameras see: depth maps turned into points, thinned to one a cube of
`VOXEL`. The number is the mean of the mean distances both ways; the object lies in the unit sphere.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from stages.drawing.rasterizing import depth_map
from stages.evaluation.surfaces import Surface, Target
from stages.evaluation.thinning import one_a_cube
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
    found = []
    for i, depth in enumerate(depths):
        rows, columns = np.nonzero(np.isfinite(depth) & (depth > 0))
        pixels = np.stack([columns, rows, np.ones(len(rows))], 1)
        in_cam = depth[rows, columns, None] * (pixels @ np.linalg.inv(cameras.intrinsics[i]).T)
        rotation, translation = cameras.cam_from_scene[i, :, :3], cameras.cam_from_scene[i, :, 3]
        found.append((in_cam - translation) @ rotation)
    points = np.concatenate(found)
    return one_a_cube(points, VOXEL)


def glossy_score(predicted: Surface, cameras: PinholeCameras, true_points: np.ndarray) -> GlossyScore:
    """Hold a mesh against the true points [P, 3] of `visible_points`.

    Args:
        predicted: a mesh in the data set's frame; its depth is drawn from the cameras.

    Raises:
        ValueError: it has no faces, or no camera sees it.
    """
    if predicted.faces is None:
        raise ValueError(f"a mesh is expected, got {len(predicted.points)} points and no faces")
    vertices, faces = predicted.points, predicted.faces
    points = visible_points(cameras, (drawn_depth(cameras, i, vertices, faces) for i in range(len(cameras))))
    if not len(points):
        raise ValueError(f"none of {len(cameras)} cameras sees the mesh; is it in their frame?")
    accuracy = float(Target(Surface(true_points)).nearest(points).distances.mean())
    completeness = float(Target(Surface(points)).nearest(true_points).distances.mean())
    return GlossyScore(accuracy, completeness, 0.5 * (accuracy + completeness), len(points), len(true_points))


def drawn_depth(cameras: PinholeCameras, index: int, vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Depth [H, W] of a mesh along a camera's axis, infinite where there is none."""
    _, inverse = depth_map(cameras, index, vertices, faces)
    return np.divide(1.0, inverse, out=np.full(inverse.shape, np.inf), where=inverse > 0)
