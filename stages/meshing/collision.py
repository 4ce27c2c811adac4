"""A shape as a few convex pieces, as physics engines want it. Arrays in, arrays out."""

from __future__ import annotations

import numpy as np

from stages.meshing.cleaning import mesh_state
from stages.meshing.simplify import decimate

# The pieces are found on a mesh of so many faces: they are as good as with ten times as many, at a tenth of the time.
WORKING_FACES = 2000
# CoACD's bound on the concavity of a piece, in its own unit, 0.01 to 1. At half of it, pieces run out first.
CONCAVITY = 0.1
# Corners of a piece; engines take 64 to 256.
MAX_CORNERS = 64
# CoACD's search for the next cut: rounds and candidates. A third of its own, for a third of the time and like pieces.
ROUNDS, CANDIDATES = 60, 10
# Voxels along a side where a mesh that cannot be closed is made solid.
VOXELS = 30


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

    joined, index = np.unique(vertices, axis=0, return_inverse=True)
    solid = _without_holes(*decimate(joined, index.reshape(-1)[faces], WORKING_FACES))
    coacd.set_log_level("error")
    pieces = coacd.run_coacd(
        coacd.Mesh(solid[0].astype(np.float64), solid[1]),
        threshold=CONCAVITY,
        max_convex_hull=count,
        preprocess_mode="off" if mesh_state(solid[1]).watertight else "on",
        preprocess_resolution=VOXELS,
        mcts_iterations=ROUNDS,
        mcts_nodes=CANDIDATES,
        decimate=True,
        max_ch_vertex=MAX_CORNERS,
        seed=0,
    )
    return [hull(np.asarray(corners, dtype=np.float64)) for corners, _ in pieces]


def hull(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The convex hull of points [P, 3]: its corners [C, 3] and faces [D, 3], counter-clockwise seen from outside."""
    from scipy.spatial import ConvexHull

    found = ConvexHull(points)
    a, b, c = points[found.simplices].transpose(1, 0, 2)
    inwards = (np.cross(b - a, c - a) * found.equations[:, :3]).sum(1) < 0
    faces = np.where(inwards[:, None], found.simplices[:, ::-1], found.simplices)
    corners, index = np.unique(faces, return_inverse=True)
    return points[corners], index.reshape(-1, 3).astype(np.int32)


def _without_holes(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    import pymeshlab

    if mesh_state(faces).watertight:
        return vertices, faces
    meshes = pymeshlab.MeshSet()
    meshes.add_mesh(pymeshlab.Mesh(vertices.astype(np.float64), faces))
    meshes.meshing_close_holes(maxholesize=len(faces), selfintersection=False)
    return meshes.current_mesh().vertex_matrix(), meshes.current_mesh().face_matrix()
