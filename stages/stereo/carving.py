"""A first shape from dense points: what their lines of sight pass through is free, what lies behind them is solid."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from stages.geometry.hull import DISTANCE_CELLS, cube
from stages.geometry.point_cloud import PointCloud

if TYPE_CHECKING:
    from jaxtyping import Float, Float32

# Points with less trust than this say nothing of the first shape.
MIN_TRUST = 0.5
# So many cells behind a point are solid; what several lines say of a cell counts no more than so many.
BEHIND, ENOUGH = 3, 4.0
# Cells of which no line says anything are, weakly, a ball of this radius: of metal, stereo says next to nothing, but
# carves what is around it. They follow the cells within sqrt(1 / PRIOR) of them.
SPHERE, PRIOR = 0.7, 0.1


def carved_distances(
    cloud: PointCloud, centers: Float[np.ndarray, "i 3"], cells: int = DISTANCE_CELLS
) -> Float32[np.ndarray, "{cells} {cells} {cells}"] | None:
    """Signed distances at the centres of a grid over [-1, 1]^3, negative inside; axes x, y, z.

    Cells that no line of sight says anything of follow those around them, and weakly a sphere.

    Args:
        cloud, centers: in the scene frame; centres of the photos that saw the points.

    Returns:
        None where there are no trusted points.
    """
    from scipy.ndimage import distance_transform_edt

    from stages.stereo import depth_kernels

    trusted = cloud.chosen((cloud.trust >= MIN_TRUST) & (np.linalg.norm(cloud.points, axis=1) < 1))
    if not len(trusted):
        return None
    votes = np.zeros((2, cells, cells, cells), np.float32)
    depth_kernels.line_votes(trusted.points, trusted.starts, trusted.photos, centers, BEHIND, votes)
    sphere = np.where(np.linalg.norm(cube(cells), axis=-1) < SPHERE, -1.0, 1.0)
    inside = _solved(votes, sphere) < 0
    if not inside.any() or inside.all():
        return None
    outside_by = np.maximum(distance_transform_edt(~inside) - 0.5, 0)
    inside_by = np.maximum(distance_transform_edt(inside) - 0.5, 0)
    return (2.0 / cells * (outside_by - inside_by)).astype(np.float32)


def _solved(votes: Float[np.ndarray, "2 g g g"], sphere: Float[np.ndarray, "g g g"]) -> np.ndarray:
    """Free (1) to solid (-1): the smoothest that follows the votes, by conjugate gradients."""
    from scipy.sparse.linalg import LinearOperator, cg

    free, solid = votes
    total = free + solid
    weight = np.minimum(total, ENOUGH) + PRIOR
    known = np.minimum(total, ENOUGH) * (free - solid) / np.maximum(total, 1)
    shape = sphere.shape

    def apply(x: np.ndarray) -> np.ndarray:
        grid = x.reshape(shape)
        result = weight * grid
        for axis in range(3):
            change = np.diff(grid, axis=axis)
            result[_part(axis, slice(1, None))] += change
            result[_part(axis, slice(None, -1))] -= change
        return result.ravel()

    operator = LinearOperator((sphere.size, sphere.size), matvec=apply, dtype=np.float64)
    solution, _ = cg(operator, (known + PRIOR * sphere).ravel(), x0=sphere.ravel(), rtol=1e-3, maxiter=200)
    result: np.ndarray = solution.reshape(shape)
    return result


def _part(axis: int, of: slice) -> tuple[slice, ...]:
    return tuple(of if k == axis else slice(None) for k in range(3))
