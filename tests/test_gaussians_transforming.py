"""Gaussians in another frame: the basis of their colours, and colours, shapes and places that go along."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from made_up_gaussians import some_gaussians
from scipy.spatial.transform import Rotation
from tetrahedron import rotation_about

from stages.drawing.rendering import look_at
from stages.gaussians.drawing import draw
from stages.gaussians.gaussians import Gaussians
from stages.gaussians.harmonics import basis
from stages.gaussians.transforming import transformed, turned_harmonics
from stages.geometry.normalisation import into_frame
from stages.geometry.similarity import Similarity
from stages.geometry.vectors import unit
from stages.light import harmonics as of_light

PLACE = Similarity(2.5, rotation_about(np.array([1.0, 2, -1]), 0.8), np.array([10.0, -4, 3]))
AROUND = unit(np.random.default_rng(1).normal(size=(50, 3)))


def covariances(gaussians: Gaussians) -> np.ndarray:
    axes = Rotation.from_quat(np.roll(gaussians.rotations, -1, axis=1)).as_matrix()
    axes = axes * np.exp(gaussians.log_scales)[:, None]
    return axes @ axes.transpose(0, 2, 1)


def colors(gaussians: Gaussians, directions: np.ndarray) -> np.ndarray:
    return np.einsum("pk,nkc->npc", basis(directions, gaussians.degree), gaussians.harmonics)


def test_the_basis_is_that_of_lights_with_their_axes_named_otherwise_and_odd_orders_negated():
    orders = np.concatenate([np.arange(-l, l + 1) for l in range(4)])
    expected = of_light.basis(np.roll(AROUND, -1, axis=1)) * (-1.0) ** orders
    np.testing.assert_allclose(basis(AROUND, 3), expected, atol=2e-6)


def test_the_basis_ends_at_degree_3():
    assert [basis(AROUND, degree).shape[-1] for degree in range(4)] == [1, 4, 9, 16]
    with pytest.raises(ValueError, match="got 4"):
        basis(AROUND, 4)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 3), st.tuples(*[st.floats(-1, 1)] * 3), st.floats(0, np.pi))
def test_turned_harmonics_say_at_a_turned_direction_what_they_said(degree, axis, angle):
    rotation = rotation_about(np.add(axis, [0, 0, 2]), angle)
    before = some_gaussians(20, degree).harmonics
    turned = turned_harmonics(before, rotation)
    expected = np.einsum("pk,nkc->npc", basis(AROUND, degree), before)
    found = np.einsum("pk,nkc->npc", basis(AROUND @ rotation.T, degree), turned)
    np.testing.assert_allclose(found, expected, atol=2e-6)
    assert degree == 0 or angle < 1e-3 or np.abs(turned - before).max() > 1e-5


def test_a_camera_that_moves_along_sees_the_same():
    before = some_gaussians()
    after = transformed(before, PLACE)
    np.testing.assert_allclose(after.centers, PLACE.apply(before.centers), rtol=1e-6)
    spread = PLACE.scale * PLACE.rotation
    np.testing.assert_allclose(covariances(after), spread @ covariances(before) @ spread.T, atol=1e-5)
    np.testing.assert_allclose(colors(after, AROUND @ PLACE.rotation.T), colors(before, AROUND), atol=2e-6)
    np.testing.assert_allclose(np.linalg.norm(after.rotations, axis=1), 1, atol=1e-6)
    assert (after.opacity_logits == before.opacity_logits).all()
    assert (after.anchored == before.anchored).all()


@pytest.mark.slow
def test_the_picture_stays_as_it_was_where_the_camera_moves_along():
    before = some_gaussians(60)
    camera = look_at(np.array([1.0, -2, 1.5]), np.zeros(3), np.array([0.0, 0, 1]), 48, 40)
    image, alpha = draw(before, camera, 0)
    moved, moved_alpha = draw(transformed(before, PLACE), into_frame(camera, PLACE.inverse()), 0)
    assert np.ptp(image, axis=(0, 1)).min() > 0.3
    np.testing.assert_allclose(moved, image, atol=2e-3)
    np.testing.assert_allclose(moved_alpha, alpha, atol=2e-3)


def test_there_and_back_is_where_it_was():
    before = some_gaussians()
    back = transformed(transformed(before, PLACE), PLACE.inverse())
    np.testing.assert_allclose(back.centers, before.centers, atol=2e-6)
    np.testing.assert_allclose(back.log_scales, before.log_scales, atol=1e-6)
    np.testing.assert_allclose(back.harmonics, before.harmonics, atol=1e-6)
    np.testing.assert_allclose(np.abs((back.rotations * before.rotations).sum(1)), 1, atol=1e-6)
    assert back.centers.dtype == back.rotations.dtype == back.harmonics.dtype == np.float32
