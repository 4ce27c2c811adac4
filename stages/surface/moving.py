"""What moves vertices shares: who is beside whom, smooth directions, that no face folds and no wall's sides meet."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from stages.blocks import in_blocks
from stages.compiling import njit
from stages.geometry.vectors import unit
from stages.surface.triangle_mesh import MAX_RAYS, RAYS, face_normals, raycaster, vertex_normals

if TYPE_CHECKING:
    from jaxtyping import Float, Int

# Directions are means over this many rings: neighbours move side by side, and hardly a face folds.
DIRECTION_RINGS = 3
# Faces that lean more than this (cosine) from the directions around them are as good as folded: dark specks.
FOLD_COSINE = 0.3
# Where faces would fold, the vertices around them slide apart this many times; then the move is halved so often.
SLIDES = 6
HALVINGS = 12
# A vertex moves by no more than this part of the way to the next surface, so two sides of a wall never meet.
GAP_PART = 0.4
# Rays start so many cells off: on the surface they would meet it at once.
RAY_START = 0.03
# So often they are cast, to go on beyond what is turned the same way.
PASSES = 4


@dataclass(frozen=True)
class Rings:
    """The neighbours of vertex v: `others[starts[v] : starts[v + 1]]`."""

    starts: Int[np.ndarray, " v+1"]
    others: Int[np.ndarray, " e"]

    def mean(self, values: Float[np.ndarray, "v c"], times: int = 1) -> Float[np.ndarray, "v c"]:
        """Each vertex averaged with its neighbours, so many times over."""
        everywhere = np.arange(len(values))
        for _ in range(times):
            values = _ring_means(self.starts, self.others, values, everywhere)
        return values

    def mean_at(self, rows: Int[np.ndarray, " n"], values: Float[np.ndarray, "v c"]) -> Float[np.ndarray, "n c"]:
        """Only these vertices, each averaged with its neighbours."""
        return _ring_means(self.starts, self.others, values, rows)


def rings_of(faces: Int[np.ndarray, "f 3"], num_vertices: int) -> Rings:
    """The neighbours of each vertex."""
    from scipy.sparse import coo_matrix

    first, second = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    rows, columns = np.concatenate([first, second]), np.concatenate([second, first])
    graph = coo_matrix((np.ones(len(rows), dtype=np.int8), (rows, columns)), shape=(num_vertices, num_vertices)).tocsr()
    return Rings(graph.indptr, graph.indices)


def directions_of(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], rings: Rings
) -> Float[np.ndarray, "v 3"]:
    """Unit normals, averaged over the surroundings."""
    return unit(rings.mean(vertex_normals(vertices, faces), DIRECTION_RINGS))


def within_gaps(
    vertices: Float[np.ndarray, "v 3"],
    faces: Int[np.ndarray, "f 3"],
    directions: Float[np.ndarray, "v 3"],
    moves: Float[np.ndarray, "v 3"],
    cell: float,
) -> Float[np.ndarray, "v 3"]:
    """The moves, shortened to `GAP_PART` of the way to the next surface that is turned the other way."""
    scene, moves = raycaster(vertices, faces), moves.copy()
    moving = np.flatnonzero(moves.any(1))

    def shorten(some: slice) -> None:
        part = moving[some]
        gaps = _gaps(scene, vertices, faces, directions, moves, part, RAY_START * cell)
        moves[part] *= np.minimum(1, GAP_PART * gaps / np.linalg.norm(moves[part], axis=1))[:, None]

    in_blocks(shorten, len(moving), MAX_RAYS, RAYS)
    return moves


def _gaps(
    scene: Any, vertices: np.ndarray, faces: np.ndarray, directions: np.ndarray, moves: np.ndarray,
    rows: np.ndarray, start: float,
) -> np.ndarray:  # fmt: skip
    """How far [n] vertices may move before they meet a surface that is turned the other way."""
    import open3d as o3d

    gaps, starts, left = np.full(len(rows), np.inf), np.full(len(rows), start), np.arange(len(rows))
    ways = directions[rows] * np.sign(np.einsum("nc,nc->n", moves[rows], directions[rows]))[:, None]
    for _ in range(PASSES):
        rays = np.concatenate([vertices[rows[left]] + starts[left, None] * ways[left], ways[left]], axis=1)
        answers = scene.cast_rays(o3d.core.Tensor(rays.astype(np.float32)))
        lengths = answers["t_hit"].numpy()
        met = np.isfinite(lengths)
        left = left[met]
        starts[left] += lengths[met]
        there = directions[faces[answers["primitive_ids"].numpy()[met]]].sum(1)
        other = np.einsum("nc,nc->n", there, directions[rows[left]]) < 0
        gaps[left[other]] = starts[left[other]]
        left = left[~other]
        starts[left] += start
        if not len(left):
            break
    return gaps


def without_folds(
    vertices: Float[np.ndarray, "v 3"],
    faces: Int[np.ndarray, "f 3"],
    directions: Float[np.ndarray, "v 3"],
    moved: Float[np.ndarray, "v 3"],
    rings: Rings,
) -> tuple[Float[np.ndarray, "v 3"], int]:
    """The moved vertices so that no face turns over that did not before; and how many would have.

    A face is turned over where it stands on edge, or worse, beside the directions at its corners. Corners of slivers
    slide apart, within the surface; what still folds then goes back towards where it came from.
    """
    towards = unit(directions[faces].sum(1))

    def folded(places: np.ndarray, beside: np.ndarray) -> np.ndarray:
        """Which of the faces `beside` are turned over."""
        crosses = face_normals(places, faces[beside])
        return np.einsum("fc,fc->f", crosses, towards[beside]) <= FOLD_COSINE * np.linalg.norm(crosses, axis=1)

    beside, moved = np.arange(len(faces)), moved.copy()
    before = folded(vertices, beside)
    new = np.flatnonzero(folded(moved, beside) & ~before)
    would = len(new)
    for attempt in range(SLIDES + HALVINGS):
        if not len(new):
            break
        rows = np.unique(faces[_with_corners(faces, faces[new], len(vertices))])
        if attempt < SLIDES:
            slide = rings.mean_at(rows, moved) - moved[rows]
            moved[rows] += slide - np.einsum("nc,nc->n", slide, directions[rows])[:, None] * directions[rows]
        else:
            part = 0.5 if attempt < SLIDES + HALVINGS - 1 else 0.0
            moved[rows] = vertices[rows] + part * (moved[rows] - vertices[rows])
        beside = _with_corners(faces, rows, len(vertices))  # no others can have changed
        new = beside[folded(moved, beside) & ~before[beside]]
    return moved, would


def _with_corners(faces: np.ndarray, vertices: np.ndarray, num_vertices: int) -> np.ndarray:
    """Indices of the faces that have one of these vertices as a corner."""
    chosen = np.zeros(num_vertices, bool)
    chosen[vertices] = True
    first, second, third = chosen[faces].T
    return np.flatnonzero(first | second | third)


@njit(cache=True, nogil=True)
def _ring_means(starts: np.ndarray, others: np.ndarray, values: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """See `Rings.mean_at`."""
    means = np.empty((len(rows), values.shape[1]))
    for i in range(len(rows)):
        v = rows[i]
        for c in range(values.shape[1]):
            total = np.float64(values[v, c])
            for k in range(starts[v], starts[v + 1]):
                total += values[others[k], c]
            means[i, c] = total / (1 + starts[v + 1] - starts[v])
    return means
