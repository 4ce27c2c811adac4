"""Which photo gives each face its detail: a labelling of the face graph."""

from __future__ import annotations

import numpy as np

UNSEEN = -1


def face_neighbors(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Pairs [E, 2] of faces that share an edge. Vertices at one position count as one: UV seams do not part
    faces."""
    _, merged = np.unique(np.ascontiguousarray(vertices), axis=0, return_inverse=True)
    corners = merged.reshape(-1)[faces].astype(np.int64)
    edges = np.sort(np.concatenate([corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [2, 0]]]), axis=1)
    face_ids = np.tile(np.arange(len(faces)), 3)
    key = edges[:, 0] * (len(vertices) + 1) + edges[:, 1]
    order = np.argsort(key, kind="stable")
    same = key[order][1:] == key[order][:-1]
    return np.stack([face_ids[order[:-1][same]], face_ids[order[1:][same]]], 1)


def choose_labels(
    cost: np.ndarray, neighbors: np.ndarray, smoothness: float, passes: int = 6, seed: int = 0
) -> np.ndarray:
    """Labels that lower Σ_f cost[f, l_f] + smoothness · #(neighbours with different labels).

    Iterated conditional modes; a pass lets a random half of the faces move, then the other half, so that
    neighbours do not swap labels back and forth. Starts from the best label of each face.

    Args:
        cost: [F, N], inf where photo n does not see face f.
        neighbors: [E, 2] face pairs.
        smoothness: price of an edge between labels.

    Returns:
        [F] int32, `UNSEEN` where no photo sees the face.
    """
    num_faces, _ = cost.shape
    seen = np.isfinite(cost).any(1)
    labels: np.ndarray = np.where(seen, np.argmin(cost, 1), UNSEEN).astype(np.int32)
    pairs = np.concatenate([neighbors, neighbors[:, ::-1]])
    pairs = pairs[seen[pairs[:, 0]] & seen[pairs[:, 1]]]
    rng = np.random.default_rng(seed)
    for _ in range(passes):
        first: np.ndarray = rng.random((num_faces,)) < 0.5
        changed = 0
        for moving in (first, ~first):
            active = pairs[moving[pairs[:, 0]]]
            rows = np.flatnonzero(moving & seen)
            row_of = np.full(num_faces, -1)
            row_of[rows] = np.arange(len(rows))
            energy = cost[rows]
            np.subtract.at(energy, (row_of[active[:, 0]], labels[active[:, 1]]), smoothness)
            best: np.ndarray = np.argmin(energy, 1).astype(np.int32)
            changed += int((best != labels[rows]).sum())
            labels[rows] = best
        if not changed:
            break
    return labels
