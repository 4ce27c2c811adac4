"""The region's border cuts what photos are about; a table, a wall or a hidden end go on beyond it and are not cut."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from rigs import capture, ring
from skimage.measure import marching_cubes

from stages.geometry.cameras import PinholeCameras
from stages.geometry.plane import Plane
from stages.surface.border import GROWTH, BorderCut, border_cut, region_without_cut

Sdf = Callable[[np.ndarray], np.ndarray]
CELLS = 96  # along an edge of the cube, as in training


def surface(sdf: Sdf) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and faces of a surface within the unit sphere."""
    axis = np.linspace(-1, 1, CELLS)
    values = sdf(np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1))
    vertices, faces, _, _ = marching_cubes(values, 0.0, gradient_direction="descent")
    vertices = vertices * (2 / (CELLS - 1)) - 1
    return vertices, faces[(np.linalg.norm(vertices, axis=1) < 1)[faces].all(1)]


def ball(p: np.ndarray) -> np.ndarray:
    return np.linalg.norm(p, axis=-1) - 0.4


def rod(p: np.ndarray) -> np.ndarray:
    """Upright, from the middle on without end."""
    return np.maximum(np.linalg.norm(p[..., :2], axis=-1) - 0.15, -p[..., 2])


def table(p: np.ndarray) -> np.ndarray:
    return p[..., 2] + 0.4


def wall(p: np.ndarray) -> np.ndarray:
    """Behind the ball, for who stands towards -y."""
    return 0.4 - p[..., 1]


def both(one: Sdf, other: Sdf) -> Sdf:
    return lambda p: np.minimum(one(p), other(p))


def around(*target: float, pitch_deg: float = 15.0, span_deg: float = 360.0, count: int = 12) -> PinholeCameras:
    """Photos from around a place, half an orbit from -y, that show of it whole what the region is found from."""
    turn = np.radians(-90 - span_deg / 2)
    turned = np.array([[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1]])
    poses = ring(np.zeros(3), count=count, distance=2.25, pitch_deg=pitch_deg, span_deg=span_deg)
    rotations = [pose[:, :3] @ turned.T for pose in poses]
    pairs = zip(rotations, poses, strict=True)
    return capture([np.column_stack([rotation, pose[:, 3] - rotation @ target]) for rotation, pose in pairs])


GROUND = Plane(np.array([0.0, 0, 1]), 0.4, 0.0, 0.5)


def test_a_rod_that_ends_in_the_middle_of_the_photos_is_cut_and_the_region_goes_on_with_it():
    cut = border_cut(*surface(rod), around(0, 0, 0.7), None)
    assert cut is not None
    assert cut.photos >= 10
    assert (np.linalg.norm(cut.places - [0, 0, 1], axis=1) < 0.25).all()
    center, radius = region_without_cut(cut)
    for held in ([0, 0, 1 + 0.9 * GROWTH], [0, 0, -1], [1, 0, 0]):
        assert np.linalg.norm(center - held) < radius + 1e-6
    assert radius < 1.5


def test_what_is_whole_is_not_cut():
    assert border_cut(*surface(ball), around(0, 0, 0), None) is None
    assert border_cut(*surface(rod), around(0, 0, -0.2), None) is None  # the photos are about its lower end


def test_a_table_under_a_subject_is_not_cut():
    scene = surface(both(ball, table))
    assert border_cut(*scene, around(0, 0, 0), GROUND) is None
    beside = around(0.9, 0, -0.4)  # photos of the table's border; with a ground it is one
    assert border_cut(*scene, beside, None) is not None
    assert border_cut(*scene, beside, GROUND) is None


def test_a_wall_behind_a_subject_is_not_cut():
    assert border_cut(*surface(both(ball, wall)), around(0, 0, 0, span_deg=140), None) is None


def test_a_cut_that_no_photo_sees_does_not_count():
    def screen(p: np.ndarray) -> np.ndarray:
        """Between the rod and the cameras."""
        return np.maximum(np.abs(p[..., 1] + 0.35) - 0.05, np.abs(p[..., 0]) - 0.5)

    front = around(0, 0, 0.7, span_deg=60, pitch_deg=-15)
    bare, hidden = border_cut(*surface(rod), front, None), border_cut(*surface(both(rod, screen)), front, None)
    assert bare is not None
    assert hidden is not None  # the screen itself is cut,
    assert (bare.places[:, 1] > -0.2).all()
    assert (hidden.places[:, 1] < -0.2).all()  # and not the rod behind it


def test_vertices_without_faces_are_no_surface():
    vertices, faces = surface(ball)
    stray = np.random.default_rng(0).normal(size=(400, 3)) * [0.05, 0.05, 0.01] + [0, 0, 0.97]
    assert border_cut(np.concatenate([vertices, stray]), faces, around(0, 0, 0.7), None) is None


def test_a_few_photos_of_something_else_do_not_count():
    few, many = around(0, 0, 0.7, count=2), around(0, 0, -0.2, count=20)
    mixed = capture([*few.extrinsics, *many.extrinsics])
    assert border_cut(*surface(rod), mixed, None) is None
    assert border_cut(*surface(rod), few, None) is None


def test_an_empty_mesh_is_not_cut():
    assert border_cut(np.zeros((0, 3)), np.zeros((0, 3), int), around(0, 0, 0), None) is None


@pytest.mark.parametrize("count", [1, 1500])
def test_the_grown_region_holds_each_place_and_what_follows(count):
    places = np.random.default_rng(0).normal((0, 0, 4), size=(count, 3))
    places *= 0.95 / np.linalg.norm(places, axis=1, keepdims=True)
    center, radius = region_without_cut(BorderCut(places, 5))
    assert np.linalg.norm(center) + 1 <= radius + 1e-6
    assert (np.linalg.norm(places - center, axis=1) < radius - 0.3).all()
