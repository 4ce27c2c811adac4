"""Shapes as functions: roughly the signed distance [P] at points [P, 3], positive outside; and their meshes."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

Shape = Callable[[np.ndarray], np.ndarray]


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


def union(*distances: np.ndarray, width: float = 0.0) -> np.ndarray:
    """The nearest; edges between them are filled over `width`."""
    whole = distances[0]
    for distance in distances[1:]:
        blend = np.maximum(width - np.abs(whole - distance), 0) / max(width, 1e-9)
        whole = np.minimum(whole, distance) - blend * blend * width / 4
    return whole


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
