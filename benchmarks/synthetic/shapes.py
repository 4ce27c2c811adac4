"""More shapes as functions, as `stages.scenes.implicit` has them, and their meshes with normals."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from stages.scenes.implicit import Shape, differences, march

MAP_CELLS = 400  # of the table of distances to a profile, along its longer side


def box(points: np.ndarray, center: Sequence[float], sides: Sequence[float], rounding: float = 0.0) -> np.ndarray:
    outside = np.abs(points - np.array(center)) - np.array(sides) / 2 + rounding
    return np.linalg.norm(np.maximum(outside, 0), axis=1) + np.minimum(outside.max(1), 0) - rounding


def cylinder(points: np.ndarray, center: Sequence[float], axis: int, radius: float, length: float) -> np.ndarray:
    offset = points - np.array(center)
    radial = np.linalg.norm(np.delete(offset, axis, 1), axis=1) - radius
    along = np.abs(offset[:, axis]) - length / 2
    return np.maximum(radial, along)


def profile(curve: np.ndarray) -> Shape:
    """Distance to the surface that `curve` [K, 2] (radius, height) makes when it turns around the z axis."""
    from scipy.interpolate import CubicSpline
    from scipy.ndimage import map_coordinates
    from scipy.spatial import cKDTree

    length = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(curve, axis=0), axis=1))])
    line = CubicSpline(length, curve)(np.linspace(0, length[-1], 4000))
    low, high = line.min(0) - 0.2, line.max(0) + 0.2
    low[0] = 0.0
    cell = (high - low).max() / MAP_CELLS
    axes = [np.arange(low[i], high[i] + cell, cell) for i in (0, 1)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), -1)
    table = cKDTree(line).query(grid.reshape(-1, 2))[0].reshape(grid.shape[:2])

    def distance(points: np.ndarray) -> np.ndarray:
        flat = np.stack([np.hypot(points[:, 0], points[:, 1]), points[:, 2]])
        return map_coordinates(table, (flat - low[:, None]) / cell, order=1, mode="nearest")

    return distance


def without(distance: np.ndarray, *holes: np.ndarray) -> np.ndarray:
    """A shape with others cut out of it."""
    return np.max([distance, *(-hole for hole in holes)], axis=0)


def mesh_of(
    shape: Shape, low: Sequence[float], high: Sequence[float], cell: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices [V, 3], outward faces [F, 3] and unit normals [V, 3] of `shape` = 0 in a box, from a grid of `cell`."""
    vertices, faces = march(shape, [np.arange(low[i], high[i] + cell, cell) for i in range(3)], cell)
    # Smoother than those of the mesh, which a mirror would show.
    gradient = differences(shape, vertices, 2e-3)
    return vertices, faces, gradient / np.maximum(np.linalg.norm(gradient, axis=1, keepdims=True), 1e-12)
