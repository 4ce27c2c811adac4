"""Convex pieces: each convex, together the shape."""

from __future__ import annotations

import numpy as np
import pytest

from stages.surface.collision import _without_holes, convex_pieces, hull
from stages.surface.isosurface import extract_isosurface
from stages.surface.triangle_mesh import MeshState, mesh_state, repair_manifold

RADIUS = 0.15


def dumbbell(resolution: int = 20) -> tuple[np.ndarray, np.ndarray]:
    """Two balls and the bar between them: not convex, best told by three pieces."""

    def distance(p: np.ndarray) -> np.ndarray:
        along = np.clip(p[:, 0], -0.5, 0.5)
        bar = np.linalg.norm(p - np.stack([along, 0 * along, 0 * along], axis=1), axis=1) - 0.5 * RADIUS
        balls = [np.linalg.norm(p - np.array([x, 0, 0]), axis=1) - 2 * RADIUS for x in (-0.5, 0.5)]
        return np.minimum(bar, np.minimum(*balls))

    surface = extract_isosurface(distance, resolution)
    return surface.vertices, surface.faces


def heights(points: np.ndarray, piece: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """How far points [P, 3] lie outside a convex piece, at most over its faces: below 0 inside."""
    corners, faces = piece
    a, b, c = corners[faces].transpose(1, 0, 2)
    normals = np.cross(b - a, c - a)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return (points @ normals.T - (a * normals).sum(1)).max(1)


def test_a_hull_is_turned_outwards_and_has_no_spare_corners():
    box = np.array(np.meshgrid([0, 1], [0, 1], [0, 1])).reshape(3, -1).T.astype(float)
    corners, faces = hull(np.concatenate([box, [[0.5, 0.5, 0.5]]]))
    assert len(corners) == 8
    a, b, c = corners[faces].transpose(1, 0, 2)
    assert (a * np.cross(b, c)).sum() / 6 == pytest.approx(1)
    np.testing.assert_allclose(heights(np.array([[0.5, 0.5, 0.5], [2, 0.5, 0.5]]), (corners, faces)), [-0.5, 1])


def test_holes_are_closed():
    vertices, faces = dumbbell()
    solid = (vertices[faces].mean(1)[:, 0] > -0.6) & (np.arange(len(faces)) != 7)  # two holes
    open_mesh = repair_manifold(vertices, faces[solid])
    assert mesh_state(open_mesh[1]).open_edges > 10
    closed, filled = _without_holes(*open_mesh)
    assert mesh_state(filled) == MeshState(0, 0, 0)
    np.testing.assert_array_equal(filled[: solid.sum()], open_mesh[1])
    a, b, c = closed[filled].transpose(1, 0, 2)
    assert (a * np.cross(b, c)).sum() > 0
    np.testing.assert_array_equal(_without_holes(vertices, faces)[1], faces)


def test_pieces_are_convex_few_and_cover_the_shape():
    pytest.importorskip("coacd")
    vertices, faces = dumbbell()
    pieces = convex_pieces(vertices, faces[10:], 8)  # with a hole
    assert 2 <= len(pieces) <= 8
    for piece in pieces:
        assert heights(piece[0], piece).max() < 1e-6  # no corner lies outside any face's plane
    outside = np.min([heights(vertices, piece) for piece in pieces], axis=0)
    assert outside.max() < 0.02 * np.ptp(vertices, axis=0).max()
    beside_the_bar = np.array([[0.0, 0.3, 0.0], [0.0, 0.0, -0.3]])
    assert np.min([heights(beside_the_bar, piece) for piece in pieces], axis=0).min() > 0.05  # one hull would hold them
