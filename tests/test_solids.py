"""Closed meshes: what leaves the ball, booleans with ball and planes, and the stages that make them."""

from __future__ import annotations

import numpy as np
import pytest

from stages.surface import selection, triangle_mesh
from stages.surface.isosurface import extract_isosurface
from stages.surface.solids import cut_at_plane, cut_to_ball, extract_solid

CLOSED = triangle_mesh.MeshState(0, 0, 0)


def beam(points: np.ndarray) -> np.ndarray:
    """A round bar of radius 0.3 along z: it leaves the ball on two sides."""
    return np.linalg.norm(points[:, :2], axis=1) - 0.3


def pipe(points: np.ndarray) -> np.ndarray:
    """A tube along z with walls from 0.3 to 0.5: what cuts it across leaves rings."""
    return np.abs(np.linalg.norm(points[:, :2], axis=1) - 0.4) - 0.1


def volume(vertices: np.ndarray, faces: np.ndarray) -> float:
    a, b, c = vertices.astype(np.float64)[faces].transpose(1, 0, 2)
    return float((a * np.cross(b, c)).sum() / 6)


def pipe_in_ball(radius: float) -> float:
    """Volume of the pipe inside a ball: the integral of 2 pi r times 2 sqrt(radius^2 - r^2)."""
    return float(4 / 3 * np.pi * ((radius**2 - 0.3**2) ** 1.5 - (radius**2 - 0.5**2) ** 1.5))


def test_a_surface_that_leaves_the_ball_is_closed_beyond_it():
    surface = extract_solid(beam, 48, block=16)
    assert triangle_mesh.mesh_state(surface.faces) == CLOSED
    assert volume(surface.vertices, surface.faces) > 0
    inside = selection.inside_ball(surface.vertices, surface.faces, 1.0)
    open_one = extract_isosurface(beam, 48, block=16)
    middles = lambda vertices, faces: np.sort(vertices[faces].mean(1), axis=0)  # noqa: E731
    np.testing.assert_allclose(
        middles(surface.vertices, surface.faces[inside]), middles(open_one.vertices, open_one.faces), atol=1e-6
    )


def test_the_field_is_asked_inside_the_ball_only():
    def field(points: np.ndarray) -> np.ndarray:
        assert np.linalg.norm(points, axis=1).max(initial=0) < 1 + 1e-6
        return beam(points)

    assert len(extract_solid(field, 24).faces) > 0


@pytest.mark.parametrize("radius", [0.98, 0.7])
def test_a_solid_cut_to_a_ball_is_a_solid(radius):
    vertices, faces = cut_to_ball(*solid(pipe), radius)
    assert triangle_mesh.mesh_state(faces) == CLOSED
    assert np.linalg.norm(vertices, axis=1).max() < radius + 1e-5
    assert volume(vertices, faces) == pytest.approx(pipe_in_ball(radius), rel=0.01)


def solid(field) -> tuple[np.ndarray, np.ndarray]:
    surface = extract_solid(field, 64)
    return surface.vertices, surface.faces


def test_a_cut_across_a_pipe_ends_in_a_ring():
    vertices, faces = cut_to_ball(*solid(pipe), 0.9)
    normal = np.array([0.0, 0.0, 1.0])
    above, kept = cut_at_plane(vertices, faces, normal, 0.1)
    below, rest = cut_at_plane(vertices, faces, -normal, -0.1)
    assert triangle_mesh.mesh_state(kept) == triangle_mesh.mesh_state(rest) == CLOSED
    assert above[:, 2].min() == pytest.approx(0.1, abs=1e-5)
    assert volume(above, kept) + volume(below, rest) == pytest.approx(volume(vertices, faces), rel=1e-4)
    lid = above[kept][(np.abs(above[kept][:, :, 2] - 0.1) < 1e-5).all(1)]
    sides = np.cross(lid[:, 1] - lid[:, 0], lid[:, 2] - lid[:, 0])
    assert sides[:, 2].max() <= 1e-9  # faces down
    assert np.abs(sides[:, 2]).sum() / 2 == pytest.approx(np.pi * (0.25 - 0.09), rel=0.01)


def test_a_cut_that_misses_leaves_all_or_nothing():
    vertices, faces = cut_to_ball(*solid(beam), 0.9)
    up = np.array([0.0, 0.0, 1.0])
    assert volume(*cut_at_plane(vertices, faces, up, -0.95)) == pytest.approx(volume(vertices, faces), rel=1e-5)
    assert len(cut_at_plane(vertices, faces, up, 0.95)[1]) == 0


def test_an_open_mesh_is_no_solid():
    vertices, faces = solid(beam)
    with pytest.raises(ValueError, match="closed"):
        cut_to_ball(vertices, faces[1:], 0.9)
