"""How much of what is to be reconstructed dense points explain already.

What their lines of sight pass through is free, what lies behind them is solid; what is left has a surface, and points
cover some of it. On polished metal they cover a sixth, on a plain part with bores three fifths, on a helmet nine
tenths.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from stages.geometry.hull import DISTANCE_CELLS, cube
from stages.geometry.plane import Plane
from stages.geometry.point_cloud import PointCloud

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

# Points with less trust than this say nothing of the first shape.
MIN_TRUST = 0.5
# No more of them than this are asked, evenly chosen.
MAX_POINTS = 150_000
# So many cells behind a point are solid; what several lines say of a cell counts no more than so many.
BEHIND, ENOUGH = 3, 4.0
# Cells of which no line says anything are, weakly, a ball of this radius: of metal, stereo says next to nothing, but
# carves what is around it. They follow the cells within sqrt(1 / PRIOR) of them.
BALL, PRIOR = 0.7, 0.1
# What is asked whether points cover it: the surface within this radius, and so many cells off the ground.
WITHIN, OFF_GROUND = 0.9, 2.0
# It is covered with this part of the points of what is covered best.
COVERED = 0.1


def explained_share(
    cloud: PointCloud, centers: Float[np.ndarray, "i 3"], ground: Plane | None, cells: int = DISTANCE_CELLS
) -> float:
    """Share of the surface in the unit sphere, where photos see it and off the ground, that dense points cover.

    The surface is that of what the points' lines of sight leave: cells of a grid that none passes. Cells that no line
    says anything of follow those around them, and weakly a ball.

    Args:
        cloud, centers: in the scene frame; centres of the photos that saw the points.
        ground: in the scene frame, where there is one.
    """
    from stages.stereo import depth_kernels

    trusted = cloud.chosen((cloud.trust >= MIN_TRUST) & (np.linalg.norm(cloud.points, axis=1) < 1))
    if not len(trusted):
        return 0.0
    trusted = trusted.chosen(np.arange(len(trusted)) % max(1, len(trusted) // MAX_POINTS) == 0)
    votes = np.zeros((2, cells, cells, cells), np.float32)
    depth_kernels.line_votes(trusted.points, trusted.starts, trusted.photos, centers, BEHIND, votes)
    ball = np.where(np.linalg.norm(cube(cells), axis=-1) < BALL, -1.0, 1.0)
    return _covered(_solved(votes, ball) < 0, votes[0] > 0, trusted, ground)


def _covered(
    inside: Bool[np.ndarray, "g g g"], free: Bool[np.ndarray, "g g g"], trusted: PointCloud, ground: Plane | None
) -> float:
    """Share of the cells at the surface that hold points enough, those around them included."""
    from scipy.ndimage import binary_dilation, uniform_filter

    cells = len(inside)
    grid = cube(cells)
    seen = inside & binary_dilation(free & ~inside)
    asked = seen & (np.linalg.norm(grid, axis=-1) < WITHIN)
    if ground is not None:
        heights = ground.heights(grid.reshape(-1, 3)).reshape(inside.shape)
        asked &= np.abs(heights) > OFF_GROUND * 2 / cells
    if not asked.any():
        return 0.0
    counts = np.zeros(inside.shape)
    rows = np.clip(((trusted.points + 1) * cells / 2).astype(int), 0, cells - 1)
    np.add.at(counts, tuple(rows.T), trusted.trust)
    counts = uniform_filter(counts, 3)
    return float((counts[asked] > COVERED * np.quantile(counts[seen], 0.9)).mean())


def _solved(votes: Float[np.ndarray, "2 g g g"], ball: Float[np.ndarray, "g g g"]) -> np.ndarray:
    """Free (1) to solid (-1): the smoothest that follows the votes, by conjugate gradients."""
    from scipy.sparse.linalg import LinearOperator, cg

    free, solid = votes
    total = free + solid
    weight = np.minimum(total, ENOUGH) + PRIOR
    known = np.minimum(total, ENOUGH) * (free - solid) / np.maximum(total, 1)
    shape = ball.shape

    def apply(x: np.ndarray) -> np.ndarray:
        grid = x.reshape(shape)
        result = weight * grid
        for axis in range(3):
            change = np.diff(grid, axis=axis)
            result[_part(axis, slice(1, None))] += change
            result[_part(axis, slice(None, -1))] -= change
        return result.ravel()

    operator = LinearOperator((ball.size, ball.size), matvec=apply, dtype=np.float64)
    solution, _ = cg(operator, (known + PRIOR * ball).ravel(), x0=ball.ravel(), rtol=1e-2, maxiter=100)
    result: np.ndarray = solution.reshape(shape)
    return result


def _part(axis: int, of: slice) -> tuple[slice, ...]:
    return tuple(of if k == axis else slice(None) for k in range(3))
