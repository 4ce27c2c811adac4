"""Colours for what no photo saw: the colour field's answer, shifted to meet the photos where the two
touch."""

from __future__ import annotations

import numpy as np

from stages.surface.triangle_mesh import face_adjacency, sum_around, unique_positions

# Pull of the offset back to the average one, for each step between faces: it is local to ~1/sqrt(this) faces.
PULL = 2e-3
_ITERATIONS = 300


def face_neighbors(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Pairs [E, 2] of faces that share an edge. Vertices at one position count as one: UV seams do not part faces."""
    return face_adjacency(unique_positions(vertices)[1][faces])


def harmonic_offsets(known: np.ndarray, offsets: np.ndarray, neighbors: np.ndarray) -> np.ndarray:
    """Carry offsets from known faces to the others, smoothly: a screened Laplace equation on the face graph.

    Args:
        known: [F] bool.
        offsets: [F, 3] float, read where known.
        neighbors: [E, 2] pairs of faces that share an edge.

    Returns:
        [F, 3] float32; known faces keep theirs; faces far from any known one get the known ones' median.
    """
    from scipy.sparse import coo_matrix

    num_faces = len(known)
    if not known.any():
        return np.zeros((num_faces, 3), dtype=np.float32)
    average = np.median(offsets[known], axis=0)
    field = np.where(known[:, None], offsets, average).astype(np.float32)
    if known.all():
        return field
    # Only unknown faces move: rows of the graph for them alone.
    unknown = np.flatnonzero(~known)
    row_of = np.full(num_faces, -1)
    row_of[unknown] = np.arange(len(unknown))
    pairs = np.concatenate([neighbors, neighbors[:, ::-1]])
    pairs = pairs[row_of[pairs[:, 0]] >= 0]
    graph = coo_matrix(
        (np.ones(len(pairs), dtype=np.float32), (row_of[pairs[:, 0]], pairs[:, 1])),
        shape=(len(unknown), num_faces),
    ).tocsr()
    degree = np.asarray(graph.sum(1)).reshape(-1, 1) + PULL
    pulled = (PULL * average).astype(np.float32)
    for _ in range(_ITERATIONS):
        field[unknown] = (graph @ field + pulled) / degree
    return field


def vertex_means(values: np.ndarray, vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """[V, 3] mean of face values [F, 3] around each vertex; vertices at one position share their faces."""
    positions, index = unique_positions(vertices)
    count = np.bincount(index[faces].ravel(), minlength=len(positions))
    means = sum_around(index[faces], values, len(positions)) / np.maximum(count, 1)[:, None]
    return means[index].astype(np.float32)
