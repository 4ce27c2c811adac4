"""A mesh fitted to a dense point cloud: vertices move along their normals to where the points around them lie.

What moves is found as a field of displacements d over the mesh: at each point, d should be the point's distance from
the mesh, and between the points d should change slowly, and go back to nothing where they end,

    sum_i w_i (d(q_i) - r_i)^2 + STIFFNESS (sum_edges (d_a - d_b)^2 + sum_vertices d_a^2 / REST^2),

with q_i the place on the mesh next to point i and r_i its signed distance from there, in cells. The middle term has no
unit of length, so the same number of points outweighs it on a fine mesh and on a coarse one. Points that disagree with
their surroundings lose their weight w_i (iteratively reweighted least squares, Geman and McClure 1987), and so do
surroundings where points scatter. Where they scatter much, where they are few, or where few photos say the same, the
displacement is not believed: what a point is off by falls from 0.5 % of a helmet's extent, where one photo says it, to
0.1 %, where 13 do.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from stages.compiling import njit
from stages.geometry.point_cloud import PointCloud
from stages.geometry.vectors import unit
from stages.surface.moving import Rings, directions_of, rings_of, within_gaps, without_folds
from stages.surface.triangle_mesh import raycaster

if TYPE_CHECKING:
    from jaxtyping import Float, Int

# Points farther than this from the mesh, in cells, are of something else.
REACH = 6.0
# So are those whose normals lean more than this (cosine) from the mesh's: of noise, too.
MIN_COSINE = 0.9
STIFFNESS = 0.1
# Edges over which the displacement goes back to nothing, where points end.
REST = 7.0
# The weights are found anew so often, and sweeps of Gauss-Seidel for each: places a few edges apart agree.
ROUNDS = 4
SWEEPS = 12
# A point this many of the local standard deviations off has a quarter of its weight.
OUTLIER = 2.0
# Scatter, in cells, that is never undercut: what SGBM rounds to, and poses are off by.
LEAST_SCATTER = 0.3
# Where fewer points than this are to a vertex, or photos to a point, most of the displacement is not believed.
FEW_POINTS = 0.1
FEW_PHOTOS = 3.0
# Nor where they scatter by more cells than this, outliers aside: on plain walls they are off together.
WIDE_SCATTER = 0.3
# Rings over which scatter, photos and the displacements themselves are averaged.
SMOOTHING_RINGS = 3
_TINY = 1e-12


@dataclass(frozen=True)
class Fit:
    """A fitted mesh.

    Attributes:
        vertices: float32; the faces are as they were.
        used: points that had a say.
        folds: faces that would have folded, and were held back.
    """

    vertices: Float[np.ndarray, "v 3"]
    used: int
    folds: int


@dataclass(frozen=True)
class _Evidence:
    """Points beside the mesh.

    Attributes:
        corners: vertices of the faces next to them.
        shares: weights of these at the place next to the point.
        distances: signed, in cells.
        photos: that say the same.
        weights: how far points are believed, each by itself.
    """

    corners: Int[np.ndarray, "n 3"]
    shares: Float[np.ndarray, "n 3"]
    distances: Float[np.ndarray, " n"]
    photos: Float[np.ndarray, " n"]
    weights: Float[np.ndarray, " n"]

    def at_points(self, values: Float[np.ndarray, " v"]) -> Float[np.ndarray, " n"]:
        """What is known at the vertices, at the places next to the points."""
        return np.einsum("nk,nk->n", self.shares, values[self.corners])


def fit_to_points(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], cloud: PointCloud, cell: float
) -> Fit:
    """Move the vertices along their normals to where the trusted points lie.

    Where no points are nothing moves; no face folds that did not before, and the two sides of a wall stay apart.

    Args:
        vertices, faces: counter-clockwise seen from outside.
        cloud: in the mesh's frame.
        cell: side of the grid that the mesh was extracted on, about a pixel of the photos.

    Raises:
        ValueError: `cell` is not positive.
    """
    if not cell > 0:
        raise ValueError(f"expected a positive cell, got {cell}")
    same = Fit(vertices.astype(np.float32), 0, 0)
    if not len(faces) or not (cloud.trust > 0).any():
        return same
    rings = rings_of(faces, len(vertices))
    directions = directions_of(vertices, faces, rings)
    evidence = _beside(vertices, faces, directions, cloud.chosen(_about(vertices, cloud, cell)), cell)
    if not len(evidence.weights):
        return same
    moves = cell * _displacements(evidence, rings)[:, None] * directions
    moved = vertices + within_gaps(vertices, faces, directions, moves, cell)
    moved, folds = without_folds(vertices, faces, directions, moved, rings)
    return Fit(moved.astype(np.float32), len(evidence.weights), folds)


def _about(vertices: np.ndarray, cloud: PointCloud, cell: float) -> np.ndarray:
    """Which points [n] have trust and lie within reach of the mesh's bounding box."""
    low, high = vertices.min(0) - REACH * cell, vertices.max(0) + REACH * cell
    rows: np.ndarray = (cloud.trust > 0) & ((cloud.points >= low) & (cloud.points <= high)).all(1)
    return rows


def _beside(
    vertices: np.ndarray, faces: np.ndarray, directions: np.ndarray, cloud: PointCloud, cell: float
) -> _Evidence:
    """The points within reach of the mesh that face the same way."""
    import open3d as o3d

    scene = raycaster(vertices, faces)
    answers = scene.compute_closest_points(o3d.core.Tensor(np.ascontiguousarray(cloud.points, dtype=np.float32)))
    corners = faces[answers["primitive_ids"].numpy()]
    second, third = answers["primitive_uvs"].numpy().T
    shares = np.stack([1 - second - third, second, third], axis=1)
    there = unit(np.einsum("nk,nkc->nc", shares, directions[corners]))
    off = (cloud.points - answers["points"].numpy()) / cell
    distances = np.einsum("nc,nc->n", off, there)
    cosines = np.einsum("nc,nc->n", cloud.normals, there)
    # Beside a border, or around a sharp edge, the nearest place is not the one that the normal leads to.
    aside = np.linalg.norm(off - distances[:, None] * there, axis=1)
    near = (np.abs(distances) < REACH) & (aside <= np.maximum(0.5 * np.abs(distances), 0.1 * REACH))
    rows = np.flatnonzero(near & (cosines > MIN_COSINE))
    photos = np.diff(cloud.starts)[rows].astype(np.float64)
    agreement = (cosines[rows] - MIN_COSINE) / (1 - MIN_COSINE)
    return _Evidence(corners[rows], shares[rows], distances[rows], photos, photos * cloud.trust[rows] ** 2 * agreement)


def _displacements(evidence: _Evidence, rings: Rings) -> np.ndarray:
    """Displacement [V] in cells that the points ask for, see the top of this file."""
    moves = np.zeros(len(rings.starts) - 1)
    _, photos = _around(evidence, evidence.photos, evidence.weights, rings)
    weights, inliers = evidence.weights, np.ones(len(evidence.weights))
    for _ in range(ROUNDS):
        pull, aim = _gathered(evidence.corners, evidence.shares, evidence.distances, weights, len(moves))
        _relax(moves, pull, aim, rings.starts, rings.others, STIFFNESS, STIFFNESS / REST**2, SWEEPS)
        off = (evidence.distances - evidence.at_points(moves)) ** 2
        _, variance = _around(evidence, off, inliers * evidence.weights, rings)
        inliers = 1 / (1 + off / (OUTLIER**2 * (LEAST_SCATTER**2 + evidence.at_points(variance)))) ** 2
        # What is off for a reason, and not by chance, does not average out: so the variance squared.
        local = 1 / (LEAST_SCATTER**2 + variance) ** 2
        weights = inliers * evidence.weights * evidence.at_points(local)
    density, _ = _around(evidence, evidence.photos, np.ones(len(weights)), rings)
    support = density**2 / (density**2 + FEW_POINTS**2) * photos**4 / (photos**4 + FEW_PHOTOS**4)
    support /= 1 + (variance / WIDE_SCATTER**2) ** 4
    return rings.mean((support * moves)[:, None], SMOOTHING_RINGS)[:, 0]


def _around(
    evidence: _Evidence, values: np.ndarray, weights: np.ndarray, rings: Rings
) -> tuple[np.ndarray, np.ndarray]:
    """Weight of the points in the surroundings of each vertex [V], a vertex; and mean [V] of their values [n]."""
    sums = _gathered(evidence.corners, evidence.shares, values, weights, len(rings.starts) - 1)
    weight, total = rings.mean(np.stack(sums, axis=1), SMOOTHING_RINGS).T
    return weight, total / np.maximum(weight, _TINY)


@njit(cache=True, nogil=True)
def _gathered(
    corners: np.ndarray, shares: np.ndarray, values: np.ndarray, weights: np.ndarray, count: int
) -> tuple[np.ndarray, np.ndarray]:
    """Weight [count] and weighted value [count] that points bring to the corners of their faces."""
    pull, aim = np.zeros(count), np.zeros(count)
    for i in range(len(weights)):
        for k in range(3):
            part = weights[i] * shares[i, k]
            pull[corners[i, k]] += part
            aim[corners[i, k]] += part * values[i]
    return pull, aim


@njit(cache=True, nogil=True)
def _relax(
    moves: np.ndarray, pull: np.ndarray, aim: np.ndarray, starts: np.ndarray, others: np.ndarray, stiffness: float,
    rest: float, sweeps: int,
) -> None:  # fmt: skip
    """Gauss-Seidel, in place, for the minimum at the top of this file; points count at their corners (lumped)."""
    for _ in range(sweeps):
        for v in range(len(moves)):
            total, weight = aim[v], pull[v] + rest
            for k in range(starts[v], starts[v + 1]):
                total += stiffness * moves[others[k]]
                weight += stiffness
            moves[v] = total / weight
