"""A shape as a few convex pieces, as physics engines want it. Arrays in, arrays out.

CoACD rather than VHACD: in about the same time it needs half as many pieces for a union that is as tight.
"""

from __future__ import annotations

import numpy as np

from stages.surface.decimation import decimate
from stages.surface.triangle_mesh import edge_use, label_pieces, unique_positions

# The pieces are found on a mesh of so many faces: they are as good as with ten times as many, at a tenth of the time.
WORKING_FACES = 2000
# CoACD's bound on the concavity of a piece, in its own unit, 0.01 to 1. At half of it, pieces run out first.
CONCAVITY = 0.1
# Corners of a piece; engines take 64 to 256.
MAX_CORNERS = 64
# CoACD's search for the next cut: rounds and candidates. A third of its own, for a third of the time and like pieces.
ROUNDS, CANDIDATES = 60, 10


def convex_pieces(vertices: np.ndarray, faces: np.ndarray, count: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """Convex pieces that together are about the shape (CoACD; Wei et al., SIGGRAPH 2022).

    Thin parts may stick out of them by the error of the decimation, some hundredths of the extent at most.

    Args:
        vertices: [V, 3]; those at one position are joined.
        faces: [F, 3]. Holes are closed first.
        count: at most this many pieces, >= 1.

    Returns:
        Vertices [C, 3] float64 and faces [D, 3] int32 of each, counter-clockwise seen from outside.

    Raises:
        ImportError: there is no coacd.
    """
    # Open3D cannot be imported after coacd in one process (1.0.14 and 0.20.0).
    import open3d  # noqa: F401, I001
    import coacd

    joined, index = unique_positions(vertices)
    solid = _without_holes(*decimate(joined, index[faces], WORKING_FACES))
    coacd.set_log_level("error")
    pieces = coacd.run_coacd(
        coacd.Mesh(solid[0].astype(np.float64), solid[1]),
        threshold=CONCAVITY,
        max_convex_hull=count,
        preprocess_mode="off",  # it is a closed manifold
        mcts_iterations=ROUNDS,
        mcts_nodes=CANDIDATES,
        decimate=True,
        max_ch_vertex=MAX_CORNERS,
        seed=0,
    )
    return [hull(np.asarray(corners, dtype=np.float64)) for corners, _ in pieces]


def hull(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The convex hull of points [P, 3]: its corners [C, 3] and faces [D, 3], counter-clockwise seen from outside."""
    import trimesh

    found = trimesh.convex.convex_hull(points, qhull_options="Qt")
    return np.asarray(found.vertices), np.asarray(found.faces, dtype=np.int32)


def _without_holes(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A 2-manifold closed by a fan around the middle of each hole's rim: rough, but it never fails."""
    use = edge_use(faces)
    single = use.counts[use.edge] == 1
    start = faces[use.face[single], use.slot[single]]
    end = faces[use.face[single], (use.slot[single] + 1) % 3]
    if not len(start):
        return vertices, faces
    rims = label_pieces(len(vertices), np.stack([start, end], axis=1))[start]
    _, rims = np.unique(rims, return_inverse=True)
    weights = np.bincount(rims)[:, None]
    middles = np.stack([np.bincount(rims, vertices[start, axis]) for axis in range(3)], axis=1) / weights
    lids = np.stack([end, start, len(vertices) + rims.reshape(-1)], axis=1)
    return np.concatenate([vertices, middles]), np.concatenate([faces, lids]).astype(np.int32)
