"""A mesh without the noise of its normals: planes flat, edges sharp.

Bilateral normal filtering (Zheng, Fu, Au and Tai, "Bilateral normal filtering for mesh denoising", 2011), and vertices
that follow the filtered normals (Sun, Rosin, Martin and Langbein, "Fast and effective feature-preserving mesh
denoising", 2007).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from stages.compiling import njit
from stages.surface.moving import directions_of, rings_of, within_gaps, without_folds
from stages.surface.triangle_mesh import face_normals

if TYPE_CHECKING:
    from jaxtyping import Float, Int

# Normals this far apart (length of the difference, about 14 degrees) have 0.6 of their say in each other.
NORMAL_SPREAD = 0.25
# Rounds in which vertices follow the normals, for each round of the filter.
FOLLOWING = 2


def denoised(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], rounds: int
) -> Float[np.ndarray, "v 3"]:
    """Vertices moved so that the faces' normals vary less, but across edges.

    No face folds that did not before, and the two sides of a wall stay apart.

    Args:
        rounds: of the filter, each over the faces around a face; 0 changes nothing.

    Returns:
        The vertices, float32.

    Raises:
        ValueError: negative `rounds`.
    """
    if rounds < 0:
        raise ValueError(f"expected rounds >= 0, got {rounds}")
    if not rounds or not len(faces):
        return vertices.astype(np.float32)
    order = np.argsort(faces.ravel(), kind="stable")
    around = order // 3
    starts = np.concatenate([[0], np.cumsum(np.bincount(faces.ravel(), minlength=len(vertices)))])
    crosses = face_normals(vertices, faces)
    areas = np.linalg.norm(crosses, axis=1)
    normals = crosses / np.maximum(areas, np.finfo(np.float64).tiny)[:, None]
    places = vertices.astype(np.float64)
    reach = float(np.sqrt(np.median(areas)))
    for _ in range(rounds):
        normals = _filtered(normals, places[faces].mean(1), areas, faces, starts, around, reach, NORMAL_SPREAD)
    _follow(places, faces, normals, areas, starts, around, FOLLOWING * rounds)
    rings = rings_of(faces, len(vertices))
    directions = directions_of(vertices, faces, rings)
    places = vertices + within_gaps(vertices, faces, directions, places - vertices, reach)
    places, _ = without_folds(vertices, faces, directions, places, rings)
    return places.astype(np.float32)


@njit(cache=True, nogil=True)
def _filtered(
    normals: np.ndarray, centers: np.ndarray, areas: np.ndarray, faces: np.ndarray, starts: np.ndarray,
    around: np.ndarray, reach: float, spread: float,
) -> np.ndarray:  # fmt: skip
    """Mean normal [F, 3] of the faces that share a corner with each face; near and alike ones count most."""
    filtered = np.zeros_like(normals)
    for f in range(len(normals)):
        for corner in range(3):
            v = faces[f, corner]
            for j in range(starts[v], starts[v + 1]):
                g = around[j]
                away, unlike = 0.0, 0.0
                for c in range(3):
                    away += (centers[f, c] - centers[g, c]) ** 2
                    unlike += (normals[f, c] - normals[g, c]) ** 2
                weight = areas[g] * np.exp(-away / (2 * reach**2) - unlike / (2 * spread**2))
                for c in range(3):
                    filtered[f, c] += weight * normals[g, c]
        length = np.sqrt((filtered[f] ** 2).sum())
        if length > 0:
            filtered[f] /= length
    return filtered


@njit(cache=True, nogil=True)
def _follow(
    places: np.ndarray, faces: np.ndarray, normals: np.ndarray, areas: np.ndarray, starts: np.ndarray,
    around: np.ndarray, rounds: int,
) -> None:  # fmt: skip
    """Move vertices, in place, into the planes that the normals [F, 3] span through the faces' centres."""
    for _ in range(rounds):
        for v in range(len(places)):
            x, y, z, total = 0.0, 0.0, 0.0, 0.0
            for j in range(starts[v], starts[v + 1]):
                f = around[j]
                height = 0.0
                for c in range(3):
                    center = (places[faces[f, 0], c] + places[faces[f, 1], c] + places[faces[f, 2], c]) / 3
                    height += normals[f, c] * (center - places[v, c])
                x += areas[f] * height * normals[f, 0]
                y += areas[f] * height * normals[f, 1]
                z += areas[f] * height * normals[f, 2]
                total += areas[f]
            if total > 0:
                places[v, 0] += x / total
                places[v, 1] += y / total
                places[v, 2] += z / total
