"""Spherical harmonics against quadrature, Legendre polynomials and integrals."""

from __future__ import annotations

import numpy as np
import pytest

from stages.geometry.vectors import unit
from stages.light.environment import directions, solid_angles
from stages.light.harmonics import basis, irradiance, project

NORMALS = unit(np.random.default_rng(0).normal(size=(20, 3)))


def test_the_basis_is_orthonormal():
    values = basis(directions(128)).reshape(-1, 16)
    gram = values.T @ (values * solid_angles(128).reshape(-1, 1))
    np.testing.assert_allclose(gram, np.eye(16), atol=2e-3)


@pytest.mark.parametrize("degree", [-1, 4])
def test_other_degrees_are_refused(degree: int):
    with pytest.raises(ValueError, match="expected a degree of 0 to 3"):
        basis(NORMALS, degree)


@pytest.mark.parametrize("degree", [0, 2, 3])
def test_uniform_light_gives_an_irradiance_of_pi(degree: int):
    coefficients = project(np.ones((32, 64, 3), np.float32), degree)
    assert coefficients.shape == ((degree + 1) ** 2, 3)
    np.testing.assert_allclose(irradiance(coefficients, NORMALS), np.pi, rtol=1e-3)


def test_light_from_one_direction_is_the_cosine_of_degree_two():
    # sum over l of A_l (2 l + 1) / (4 pi) P_l, with the paper's A = pi, 2 pi / 3, pi / 4
    source = unit(np.array([0.3, 0.8, -0.5]))
    cosine = NORMALS @ source
    expected = 1 / 4 + cosine / 2 + 5 / 16 * (3 * cosine**2 - 1) / 2
    found = irradiance(basis(source)[:, None] * np.ones(3), NORMALS)
    np.testing.assert_allclose(found, np.maximum(expected, 0)[:, None] * np.ones(3), atol=1e-4)


def test_smooth_light_gives_the_irradiance_of_an_integral():
    towards = directions(64).astype(np.float64)
    light = 1 + 0.5 * towards[..., [1, 0, 2]] + 0.4 * towards[..., :1] * towards[..., 2:]
    cosine = np.maximum(np.einsum("hwc,nc->nhw", towards, NORMALS), 0)
    expected = np.einsum("nhw,hwc,hw->nc", cosine, light, solid_angles(64))
    np.testing.assert_allclose(irradiance(project(light), NORMALS), expected, rtol=3e-3)


def test_light_from_above_reaches_what_faces_up():
    towards = directions(32)
    up = irradiance(project(np.maximum(towards[..., 1:2], 0) * np.ones(3)), np.array([[0, 1.0, 0], [0, -1.0, 0]]))
    assert up[0, 0] == pytest.approx(2 * np.pi / 3, rel=0.03)  # the integral of cos²
    assert up[1, 0] < 0.1
