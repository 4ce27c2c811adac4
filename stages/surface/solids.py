"""Closed meshes: extracting them from a field, and cutting them so that they stay closed.

The cuts are manifold3d's: its booleans give a closed, oriented 2-manifold for every such input, where closing the loops
of a cut one by one would lay lids over each other.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from stages.surface.isosurface import Isosurface, SignedDistance, extract_isosurface

# Cells that the grid goes on beyond the ball: a cell that the ball's border crosses reaches sqrt(3) beyond it.
MARGIN_CELLS = 2
# Distance that points beyond the ball are given. So small that the closing surface lies beyond the ball, too, if only
# by rounding: whoever does not want it drops what lies outside.
BEYOND = 1e-6
# Corners of the polygon that stands for a great circle. 512 are 4e-5 radii off.
CIRCLE_CORNERS = 512


def extract_solid(
    sdf: SignedDistance, resolution: int, block: int = 64, progress: Callable[[int, int], None] | None = None
) -> Isosurface:
    """`extract_isosurface` in the unit ball, but closed: what leaves the ball ends in faces just beyond its border.

    Its cells are those of that function, and `sdf` is asked inside the ball only.
    """

    def in_ball(points: np.ndarray) -> np.ndarray:
        inside = np.einsum("ni,ni->n", points, points) <= 1
        values = np.full(len(points), BEYOND, dtype=np.float32)
        values[inside] = sdf(points[inside])
        return values

    return extract_isosurface(
        in_ball,
        resolution + 2 * MARGIN_CELLS,
        block,
        radius=1 + 2 * MARGIN_CELLS / resolution,
        progress=progress,
    )


def cut_to_ball(vertices: np.ndarray, faces: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray]:
    """The part of a solid within `radius` of the origin, closed along the sphere.

    Raises:
        ValueError: the mesh is not closed.
    """
    from manifold3d import Manifold

    return _arrays(_solid(vertices, faces) ^ Manifold.sphere(radius, CIRCLE_CORNERS))


def cut_at_plane(
    vertices: np.ndarray, faces: np.ndarray, normal: np.ndarray, offset: float
) -> tuple[np.ndarray, np.ndarray]:
    """The part of a solid with normal . x >= offset, closed along the plane; `normal` [3] is of length 1.

    Raises:
        ValueError: the mesh is not closed.
    """
    return _arrays(_solid(vertices, faces).trim_by_plane(tuple(normal), offset))


def _solid(vertices: np.ndarray, faces: np.ndarray) -> Any:
    from manifold3d import Error, Manifold, Mesh

    solid = Manifold(Mesh(vertices.astype(np.float32), faces.astype(np.uint32)))
    if solid.status() != Error.NoError:
        raise ValueError(f"expected a closed, oriented mesh, got one that manifold3d calls {solid.status().name}")
    return solid


def _arrays(solid: Any) -> tuple[np.ndarray, np.ndarray]:
    mesh = solid.to_mesh()
    return np.array(mesh.vert_properties[:, :3], dtype=np.float32), np.array(mesh.tri_verts, dtype=np.int32)
