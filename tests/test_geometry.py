"""Cameras and similarities: the conventions everything else leans on."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stages.geometry.cameras import PinholeCameras
from stages.geometry.similarity import Similarity


def one_camera(seed: int = 0) -> PinholeCameras:
    rotation = random_rotation(seed)
    return PinholeCameras(
        names=("a.png",),
        sizes=np.array([[640, 480]]),
        intrinsics=np.array([[[500.0, 0.0, 310.0], [0.0, 510.0, 250.0], [0.0, 0.0, 1.0]]]),
        extrinsics=np.concatenate([rotation, [[0.1], [-0.2], [3.0]]], 1)[None],
    )


def random_rotation(seed: int) -> np.ndarray:
    rotation, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    return rotation * np.sign(np.linalg.det(rotation))


def similarity(seed: int, scale: float) -> Similarity:
    return Similarity(scale, random_rotation(seed), np.random.default_rng(seed + 1).normal(size=3))


def test_point_on_the_optical_axis_projects_to_the_principal_point():
    camera = one_camera()
    pixels, depth = camera.project(0, camera.centers + 2.0 * camera.forward)
    np.testing.assert_allclose(pixels, [[310.0, 250.0]], atol=1e-9)
    np.testing.assert_allclose(depth, [2.0])


def test_y_points_down_and_x_right():
    camera = PinholeCameras(
        ("a.png",), np.array([[64, 48]]), np.array([np.diag([50.0, 50.0, 1.0])]), np.eye(4)[None, :3]
    )
    pixels, _ = camera.project(0, np.array([[0.1, 0.2, 1.0]]))
    np.testing.assert_allclose(pixels, [[5.0, 10.0]])


@given(st.integers(0, 50), st.floats(0, 640), st.floats(0, 480), st.floats(0.1, 50))
@settings(max_examples=50, deadline=None)
def test_rays_and_projection_undo_each_other(seed: int, u: float, v: float, distance: float):
    camera = one_camera(seed)
    origins, directions = camera.rays(0, np.array([[u, v]]))
    pixels, depth = camera.project(0, origins + distance * directions)
    np.testing.assert_allclose(pixels, [[u, v]], atol=1e-6)
    assert depth[0] > 0
    assert np.linalg.norm(directions) == pytest.approx(1.0)
    np.testing.assert_allclose(camera.unproject(0, pixels, depth), origins + distance * directions, atol=1e-6)


def test_points_behind_have_negative_depth():
    camera = one_camera()
    _, depth = camera.project(0, camera.centers - camera.forward)
    np.testing.assert_allclose(depth, [-1.0])


@given(st.integers(0, 50), st.floats(0.01, 100))
@settings(max_examples=50, deadline=None)
def test_similarity_inverse_compose_and_matrix_agree(seed: int, scale: float):
    first, second = similarity(seed, scale), similarity(seed + 100, 0.7)
    points = np.random.default_rng(seed).normal(size=(5, 3))
    np.testing.assert_allclose(first.inverse().apply(first.apply(points)), points, atol=1e-8)
    np.testing.assert_allclose(first.compose(second).apply(points), first.apply(second.apply(points)), atol=1e-8)
    homogeneous = np.concatenate([points, np.ones((5, 1))], 1) @ first.matrix().T
    np.testing.assert_allclose(homogeneous[:, :3], first.apply(points), atol=1e-8)
