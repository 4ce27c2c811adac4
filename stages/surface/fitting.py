"""A mesh fitted to a dense point cloud: vertices move along their normals to where the points around them lie.

What moves is found as a field of displacements d over the mesh: at each point, d should be the point's distance from the
mesh, and between the points d should change slowly and go back to nothing where they end,

    sum_i w_i (d(q_i) - r_i)^2 + STIFFNESS sum_edges (d_a - d_b)^2 + STIFFNESS / REST^2 sum_vertices d_a^2,

with q_i the place on the mesh next to point i, r_i its signed distance from there and w_i its trust. The middle term
has no unit of length, so the same number of points outweighs it on a fine mesh and on a coarse one. Points that
disagree with their surroundings lose their weight (iteratively reweighted least squares, Geman and McClure 1987).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from stages.compiling import njit
from stages.geometry.point_cloud import PointCloud
from stages.surface.triangle_mesh import MAX_RAYS, face_normals, raycaster, vertex_normals

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int

# Points whose normals lean more than this (cosine) from the mesh's are of another surface.
MIN_COSINE = 0.5
STIFFNESS = 1.0
# Edges over which the displacement goes back to nothing, where points end.
REST = 7.0
# Sweeps of Gauss-Seidel for each set of weights: enough for places a few edges apart to agree.
SWEEPS = 12
# Scales of the reweighting in turn, in medians of what the points are off.
SCALES = (8.0, 4.0, 2.0, 2.0)
# Normals along which vertices move are means over this many rings: neighbours move side by side, and nothing folds.
NORMAL_RINGS = 3
# A vertex moves by no more than this part of the way to the next surface, so two sides of a wall never meet.
GAP_PART = 0.4
RAY_START = 0.05
# Where faces would fold, the vertices around them slide apart this many times; then the move is halved so often.
SLIDES = 6
HALVINGS = 12


@dataclass(frozen=True)
class Fit:
    """A fitted mesh.

    Attributes:
        vertices: float32, the faces are as they were.
        used: which points had a say.
        held: faces that would have folded.
    """

    vertices: Float[np.ndarray, "v 3"]
    used: Bool[np.ndarray, " n"]
    held: int


@dataclass(frozen=True)
class _Bound:
    """Points on the mesh: corner vertices [n, 3] of their faces, weights of these [n, 3], and signed distances [n]."""

    corners: Int[np.ndarray, "n 3"]
    shares: Float[np.ndarray, "n 3"]
    distances: Float[np.ndarray, " n"]
    trust: Float[np.ndarray, " n"]
    used: Bool[np.ndarray, " m"]


@dataclass(frozen=True)
class _Rings:
    """The neighbours of vertex v: `others[starts[v] : starts[v + 1]]`."""

    starts: Int[np.ndarray, " v+1"]
    others: Int[np.ndarray, " e"]

    def mean(self, values: Float[np.ndarray, "v c"]) -> Float[np.ndarray, "v c"]:
        """Each vertex and its neighbours, averaged."""
        return _ring_means(self.starts, self.others, values)


def fit_to_points(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], cloud: PointCloud, reach: float
) -> Fit:
    """Move the vertices along their normals to where the trusted points lie.

    Where no points are nothing moves; no face folds that did not before, and the two sides of a wall stay apart.

    Args:
        vertices, faces: counter-clockwise seen from outside.
        cloud: in the mesh's frame.
        reach: points farther than this from the mesh have no say.

    Raises:
        ValueError: `reach` is not positive.
    """
    if not reach > 0:
        raise ValueError(f"expected a positive reach, got {reach}")
    nothing = Fit(vertices.astype(np.float32), np.zeros(len(cloud), dtype=bool), 0)
    if not len(faces) or not len(cloud):
        return nothing
    rings = _rings(faces, len(vertices))
    normals = vertex_normals(vertices, faces)
    for _ in range(NORMAL_RINGS):
        normals = rings.mean(normals)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), np.finfo(np.float64).tiny)
    bound = _bind(vertices, faces, normals, cloud, reach)
    if not len(bound.trust):
        return nothing
    moves = _displacements(bound, rings)
    limit = GAP_PART * _gaps(vertices, faces, normals, moves, reach)
    moved = vertices + np.clip(moves, -limit, limit)[:, None] * normals
    moved, held = _without_folds(vertices, faces, normals, moved, rings)
    return Fit(moved.astype(np.float32), bound.used, held)


def _bind(
    vertices: np.ndarray, faces: np.ndarray, normals: np.ndarray, cloud: PointCloud, reach: float
) -> _Bound:
    """The points within `reach` of the mesh that face the same way, each at the place on it that is next to it."""
    import open3d as o3d

    scene = raycaster(vertices, faces)
    used = np.flatnonzero(cloud.trust > 0)
    answers = scene.compute_closest_points(o3d.core.Tensor(np.ascontiguousarray(cloud.points[used], dtype=np.float32)))
    corners = faces[answers["primitive_ids"].numpy()]
    second, third = answers["primitive_uvs"].numpy().T
    shares = np.stack([1 - second - third, second, third], axis=1)
    there = np.einsum("nk,nkc->nc", shares, normals[corners])
    there /= np.maximum(np.linalg.norm(there, axis=1, keepdims=True), np.finfo(np.float64).tiny)
    off = cloud.points[used] - answers["points"].numpy()
    distances = np.einsum("nc,nc->n", off, there)
    cosines = np.einsum("nc,nc->n", cloud.normals[used], there)
    # Beside a border, or around a sharp edge, the nearest place is not the one that the normal leads to.
    aside = np.linalg.norm(off - distances[:, None] * there, axis=1)
    near = (np.abs(distances) < reach) & (aside <= np.maximum(0.5 * np.abs(distances), 0.1 * reach))
    rows = np.flatnonzero(near & (cosines > MIN_COSINE))
    trust = cloud.trust[used[rows]] * (cosines[rows] - MIN_COSINE) / (1 - MIN_COSINE)
    chosen = np.zeros(len(cloud), dtype=bool)
    chosen[used[rows]] = True
    return _Bound(corners[rows], shares[rows], distances[rows], trust, chosen)


def _displacements(bound: _Bound, rings: _Rings) -> np.ndarray:
    """Displacement [V] that the points ask for, see the top of this file."""
    moves = np.zeros(len(rings.starts) - 1)
    weights = bound.trust
    for scale in SCALES:
        pull, aim = _gathered(bound.corners, bound.shares, bound.distances, weights, len(moves))
        _relax(moves, pull, aim, rings.starts, rings.others, STIFFNESS, STIFFNESS / REST**2, SWEEPS)
        off = bound.distances - np.einsum("nk,nk->n", bound.shares, moves[bound.corners])
        spread = max(scale * float(np.median(np.abs(off))), np.finfo(np.float32).tiny)
        weights = bound.trust / (1 + (off / spread) ** 2) ** 2
    return moves


def _gaps(
    vertices: np.ndarray, faces: np.ndarray, normals: np.ndarray, moves: np.ndarray, reach: float
) -> np.ndarray:
    """How far [V] each vertex may move before it meets another surface, which faces it or turns its back on it."""
    import open3d as o3d

    scene = raycaster(vertices, faces)
    gaps = np.full(len(vertices), np.inf)
    moving = np.flatnonzero(moves)
    for first in range(0, len(moving), MAX_RAYS):
        part = moving[first : first + MAX_RAYS]
        directions = normals[part] * np.sign(moves[part])[:, None]
        # A ray that starts on the surface would meet it at once.
        rays = np.concatenate([vertices[part] + RAY_START * reach * directions, directions], axis=1)
        answers = scene.cast_rays(o3d.core.Tensor(rays.astype(np.float32)))
        ways = answers["t_hit"].numpy() + RAY_START * reach
        met = np.isfinite(ways)
        there = normals[faces[answers["primitive_ids"].numpy()[met]]].sum(1)
        other = np.einsum("nc,nc->n", there, normals[part[met]]) < 0
        gaps[part[met][other]] = ways[met][other]
    return gaps


def _without_folds(
    vertices: np.ndarray, faces: np.ndarray, normals: np.ndarray, moved: np.ndarray, rings: _Rings
) -> tuple[np.ndarray, int]:
    """The moved vertices [V, 3] so that no face turns over that did not before; and how many would have.

    Vertices of slivers slide apart, within the surface. What still folds then goes back towards where it came from.
    """
    towards = normals[faces].sum(1)

    def folded(moved: np.ndarray) -> np.ndarray:
        return np.einsum("fc,fc->f", face_normals(moved, faces), towards) <= 0

    before, held = folded(vertices), 0
    moved = moved.copy()
    for attempt in range(SLIDES + HALVINGS):
        new = folded(moved) & ~before
        held = held or int(np.count_nonzero(new))
        if not new.any():
            break
        around = np.zeros((len(vertices), 1))
        around[faces[new]] = 1
        rows = np.flatnonzero(rings.mean(around)[:, 0])
        if attempt < SLIDES:
            slide = (rings.mean(moved) - moved)[rows]
            moved[rows] += slide - np.einsum("nc,nc->n", slide, normals[rows])[:, None] * normals[rows]
        else:
            part = 0.5 if attempt < SLIDES + HALVINGS - 1 else 0.0
            moved[rows] = vertices[rows] + part * (moved[rows] - vertices[rows])
    return moved, held


def _rings(faces: np.ndarray, count: int) -> _Rings:
    """The neighbours of each of `count` vertices."""
    from scipy.sparse import coo_matrix

    rows = np.concatenate([faces.ravel(), np.roll(faces, -1, axis=1).ravel()])
    columns = np.concatenate([np.roll(faces, -1, axis=1).ravel(), faces.ravel()])
    graph = coo_matrix((np.ones(len(rows), dtype=np.int8), (rows, columns)), shape=(count, count)).tocsr()
    return _Rings(graph.indptr, graph.indices)


@njit(cache=True, nogil=True)
def _ring_means(starts: np.ndarray, others: np.ndarray, values: np.ndarray) -> np.ndarray:
    """See `_Rings.mean`."""
    means = values.copy()
    for v in range(len(starts) - 1):
        for k in range(starts[v], starts[v + 1]):
            means[v] += values[others[k]]
        means[v] /= 1 + starts[v + 1] - starts[v]
    return means


@njit(cache=True, nogil=True)
def _gathered(
    corners: np.ndarray, shares: np.ndarray, distances: np.ndarray, weights: np.ndarray, count: int
) -> tuple[np.ndarray, np.ndarray]:
    """Weight [count] and weighted distance [count] that points bring to the corners of their faces."""
    pull, aim = np.zeros(count), np.zeros(count)
    for i in range(len(weights)):
        for k in range(3):
            part = weights[i] * shares[i, k]
            pull[corners[i, k]] += part
            aim[corners[i, k]] += part * distances[i]
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
