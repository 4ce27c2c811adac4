"""Rough reflection against the microfacet model of glTF 2.0, integrated point by point."""

from __future__ import annotations

import numpy as np
import pytest

from stages.geometry.vectors import unit
from stages.light.environment import directions, look_up, solid_angles
from stages.light.ggx import ROUGHNESSES, blurred, lobe_matrices, lobe_matrix, split_sum, split_sum_table


def gltf_specular(normal: np.ndarray, view: np.ndarray, light: np.ndarray, roughness: float) -> tuple:
    """D · V [P] and V·H [P] of glTF 2.0, appendix B.3.2, as it is written there."""
    alpha = roughness**2
    half = unit(light + view)
    nh, nl, nv = half @ normal, np.maximum(light @ normal, 0), view @ normal
    distribution = alpha**2 / (np.pi * (nh**2 * (alpha**2 - 1) + 1) ** 2)
    visibility = 0.5 / np.maximum(
        nl * np.sqrt(nv**2 * (1 - alpha**2) + alpha**2) + nv * np.sqrt(nl**2 * (1 - alpha**2) + alpha**2), 1e-12
    )
    return distribution * visibility, half @ view


def integrated(cosine: float, roughness: float) -> tuple[float, float]:
    """Scale and bias by a sum over the hemisphere in small steps, float64."""
    mu = (np.arange(600) + 0.5) / 600
    phi = 2 * np.pi * (np.arange(600) + 0.5) / 600
    sine = np.sqrt(1 - mu**2)[:, None]
    light = np.stack([sine * np.cos(phi), sine * np.sin(phi), mu[:, None] * np.ones(600)], 2).reshape(-1, 3)
    normal, view = np.array([0, 0, 1.0]), np.array([np.sqrt(1 - cosine**2), 0, cosine])
    value, vh = gltf_specular(normal, view, light, roughness)
    each = value * light[:, 2] * 2 * np.pi / len(light)
    fresnel = (1 - np.clip(vh, 0, 1)) ** 5
    return float(((1 - fresnel) * each).sum()), float((fresnel * each).sum())


@pytest.mark.parametrize("roughness", [0.3, 0.6, 1.0])
@pytest.mark.parametrize("cosine", [0.2, 0.5, 0.95])
def test_the_split_sum_is_the_integral_of_the_reflection(roughness: float, cosine: float):
    scale, bias = split_sum(np.array([cosine]), roughness)
    expected = integrated(cosine, roughness)
    assert scale[0] == pytest.approx(expected[0], abs=0.01)
    assert bias[0] == pytest.approx(expected[1], abs=0.01)


def test_a_surface_sends_back_no_more_than_it_gets():
    total = split_sum_table().sum(2)
    assert total.max() <= 1.0 + 1e-3
    assert total.min() > 0.3
    assert split_sum_table().min() >= 0


def test_a_mirror_keeps_all_and_follows_fresnel():
    cosine = np.array([0.1, 0.4, 0.9])
    scale, bias = split_sum(cosine, 0.0)
    np.testing.assert_allclose(scale + bias, 1, atol=0.02)
    np.testing.assert_allclose(bias, (1 - cosine) ** 5, atol=0.02)


def test_lookups_broadcast_and_stay_inside_the_table():
    scale, bias = split_sum(np.array([[0.0], [1.0]]), np.array([0.1, 0.5, 1.0]))
    assert scale.shape == bias.shape == (2, 3)
    assert np.isfinite(scale).all()


def test_lobes_are_means():
    matrices = lobe_matrices(4, 8)
    assert matrices.shape == (len(ROUGHNESSES), 32, 128)
    np.testing.assert_allclose(matrices.sum(2), 1, atol=1e-5)
    assert matrices.min() >= 0


def test_a_lobe_is_the_slow_loop():
    matrix = lobe_matrix(0.5, 4, 8)
    incoming, sizes = directions(8).reshape(-1, 3).astype(np.float64), solid_angles(8).reshape(-1)
    pixel2 = (0.5 / np.sqrt(12) * np.sqrt(2) * np.pi / 8) ** 2
    for row in (0, 13, 31):
        ahead = directions(4).reshape(-1, 3)[row].astype(np.float64)
        each = []
        for light, size in zip(incoming, sizes, strict=True):
            nh, nl = float(unit(light + ahead) @ ahead), float(light @ ahead)
            each.append(max(nl, 0) * size / (nh**2 * (0.5**4 + pixel2 - 1) + 1) ** 2)
        np.testing.assert_allclose(matrix[row], np.array(each) / sum(each), atol=1e-5)


def test_rougher_lobes_are_wider_and_the_narrowest_is_almost_a_mirror():
    light = np.zeros((16, 32, 3), np.float32)
    light[5, 10] = 100
    levels = np.stack([blurred(light, roughness) for roughness in ROUGHNESSES])
    assert (np.diff(levels[:, 5, 10, 0]) < 0).all()
    assert levels[0, 5, 10, 0] > 40
    smooth = (1 + directions(16)).astype(np.float32)
    np.testing.assert_allclose(blurred(smooth, ROUGHNESSES[0]), smooth, atol=0.1)


def test_blurs_stay_on_their_side():
    light = np.maximum(directions(16)[..., :1], 0) * np.ones(3, np.float32)
    for roughness in ROUGHNESSES:
        level = blurred(light.astype(np.float32), roughness)
        sides = look_up(level, np.array([[1.0, 0, 0], [-1.0, 0, 0]]))
        assert sides[0, 0] > 5 * sides[1, 0]
