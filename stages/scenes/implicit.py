"""Shapes as functions: roughly the signed distance [P] at points [P, 3], positive outside; and their meshes."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

Shape = Callable[[np.ndarray], np.ndarray]

MAP_CELLS = 400  # of the table of distances to a profile, along its longer side


def ellipsoid(points: np.ndarray, center: Sequence[float], radii: Sequence[float]) -> np.ndarray:
    return (np.linalg.norm((points - np.array(center)) / np.array(radii), axis=1) - 1) * min(radii)


def tube(points: np.ndarray, path: Sequence[Sequence[float]], radii: Sequence[float]) -> np.ndarray:
    """Straight pieces through the points of `path`, as thick there as `radii` says."""
    distance = np.full(len(points), np.inf)
    for start, end, radius_a, radius_b in zip(path, path[1:], radii, radii[1:], strict=False):
        a, b = np.array(start, float), np.array(end, float)
        along = np.clip((points - a) @ (b - a) / ((b - a) @ (b - a)), 0, 1)
        thickness = radius_a + along * (radius_b - radius_a)
        distance = np.minimum(distance, np.linalg.norm(points - a - along[:, None] * (b - a), axis=1) - thickness)
    return distance


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


def union(*distances: np.ndarray, width: float = 0.0) -> np.ndarray:
    """The nearest; edges between them are filled over `width`."""
    whole = distances[0]
    for distance in distances[1:]:
        blend = np.maximum(width - np.abs(whole - distance), 0) / max(width, 1e-9)
        whole = np.minimum(whole, distance) - blend * blend * width / 4
    return whole


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


def march(shape: Shape, axes: Sequence[np.ndarray], cell: float) -> tuple[np.ndarray, np.ndarray]:
    """Vertices [V, 3] and outward faces [F, 3] of `shape` = 0 on a grid of `axes`, whose places are `cell` apart."""
    import open3d as o3d

    y, z = (side.ravel() for side in np.meshgrid(axes[1], axes[2], indexing="ij"))
    values = np.empty([len(axis) for axis in axes], np.float32)
    for i, x in enumerate(axes[0]):  # slab by slab keeps the temporaries small
        values[i] = shape(np.stack([np.full(y.size, x), y, z], 1)).reshape(values.shape[1:])
    surface = o3d.t.geometry.TriangleMesh.create_isosurfaces(
        o3d.core.Tensor(np.ascontiguousarray(values.transpose(2, 1, 0))), [0.0]
    )
    vertices = surface.vertex.positions.numpy().astype(np.float64) * cell + [axis[0] for axis in axes]
    faces = surface.triangle.indices.numpy().astype(np.int32)
    corners = vertices[faces]
    if np.einsum("ij,ij->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) < 0:  # the volume, six times
        faces = np.ascontiguousarray(faces[:, ::-1])
    return vertices, faces


def differences(shape: Shape, points: np.ndarray, step: float) -> np.ndarray:
    """[P, 3] by how much `shape` grows from `step` before points [P, 3] to `step` behind them, along each axis."""
    return np.stack([shape(points + offset) - shape(points - offset) for offset in step * np.eye(3)], 1)
