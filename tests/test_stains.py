"""Light and shade taken out of base colours, and paint left in them."""

from __future__ import annotations

import numpy as np
import pytest

from stages.geometry.vectors import unit
from stages.shading import few_materials
from stages.shading.stains import FINE_OF_METAL, paints, shading, without_stains

BEIGE, BLUE = np.array([0.6, 0.5, 0.4]), np.array([0.1, 0.3, 0.6])


def sphere(count: int = 500) -> np.ndarray:
    """[count, 3] points on the unit sphere, evenly (a Fibonacci spiral)."""
    heights = 1 - 2 * (np.arange(count) + 0.5) / count
    turns = np.arange(count) * np.pi * (3 - np.sqrt(5))
    radii = np.sqrt(1 - heights**2)
    return np.stack([radii * np.cos(turns), heights, radii * np.sin(turns)], axis=1)


def shade(normals: np.ndarray) -> np.ndarray:
    """[S, 3] factors: dark and bluish on one side, as what the sun does not reach."""
    towards = normals @ unit(np.array([1.0, 2.0, 0.5]))
    return np.exp(0.5 * towards[:, None] * np.array([1.2, 1.0, 0.8]))


def cleaned(colors: np.ndarray, normals: np.ndarray, metallic: float = 0.0) -> np.ndarray:
    shown = np.clip(colors, 0, 1) ** (1 / 2.2)
    metal = np.full(len(colors), metallic)
    return without_stains(colors, normals, normals, shown, metal, np.arange(len(colors)))


def contrast(colors: np.ndarray) -> float:
    """Standard deviation of logarithms, mean of the channels."""
    return float(np.log(colors).std(0).mean())


def test_the_shade_of_one_paint_is_taken_out():
    normals = sphere()
    shaded = BEIGE * shade(normals)
    assert contrast(paints(shaded, normals)) < 0.05
    after = cleaned(shaded, normals)
    assert contrast(after) < 0.2 * contrast(shaded)
    np.testing.assert_allclose(np.median(after, axis=0), BEIGE, rtol=0.1)


def test_shading_is_what_goes_with_the_normals_and_no_more():
    normals = sphere()
    smooth = np.log(shade(normals))
    patches = np.where(np.random.default_rng(0).random(len(normals)) < 0.2, 2.0, 0.0)[:, None]
    np.testing.assert_allclose(shading(smooth, normals), smooth, atol=0.03)
    np.testing.assert_allclose(shading(smooth + patches, normals), smooth, atol=0.1)
    np.testing.assert_allclose(shading(np.zeros((50, 3)), normals[:50]), 0, atol=1e-12)


def test_paints_stay_apart_in_the_same_shade():
    normals = sphere()
    which = (np.floor(3 * normals + 0.5).sum(1) % 2).astype(int)
    true = np.stack([BEIGE, BLUE])[which]
    shaded = true * shade(normals)
    after = cleaned(shaded, normals)
    assert np.abs(np.log(after / true)).mean() < 0.85 * np.abs(np.log(shaded / true)).mean()
    ratio = np.median(after[which == 0], axis=0) / np.median(after[which == 1], axis=0)
    np.testing.assert_allclose(ratio, BEIGE / BLUE, rtol=0.2)


@pytest.mark.parametrize("grey", [0.12, 0.3])
def test_light_and_dark_grey_in_the_same_places_stay_apart(grey):
    normals = sphere()
    dark = np.floor(3 * normals + 0.5).sum(1) % 2 > 0
    true = np.where(dark, grey, 0.7)[:, None] * np.ones(3)
    after = cleaned(true, normals)
    ratio = np.median(after[~dark]) / np.median(after[dark])
    assert ratio == pytest.approx(0.7 / grey, rel=0.15)


def test_fine_differences_stay_and_metal_loses_a_part_of_them():
    normals = sphere()
    fine = BEIGE * np.exp(0.1 * np.random.default_rng(0).choice([-1, 1], (len(normals), 1)))
    of_paint, of_metal = (contrast(cleaned(fine, normals, metallic)) for metallic in (0.0, 1.0))
    assert of_paint > 0.6 * contrast(fine)
    assert of_metal == pytest.approx((1 - FINE_OF_METAL) * of_paint, rel=0.2)


def test_a_slow_change_of_colour_does_not_become_steps():
    heights = np.linspace(0, 1, 400)
    normals = np.tile([0.0, 0.0, 1.0], (400, 1))
    fade = BEIGE * (BLUE / BEIGE) ** heights[:, None]
    steps = np.diff(np.log(paints(fade, normals)), axis=0)
    assert np.abs(steps).max() < 8 * np.abs(np.log(BLUE / BEIGE)).max() / 400


def test_a_small_decal_that_is_none_of_the_paints_keeps_its_colour(monkeypatch):
    monkeypatch.setattr(few_materials, "MOST_PAINTS", 1)
    normals = sphere()
    decal = np.linalg.norm(normals - normals[200], axis=1) < 0.2
    assert 3 < decal.sum() < 0.02 * len(normals)
    true = np.where(decal[:, None], [0.1, 0.7, 0.8], BEIGE)
    after = cleaned(true, normals)
    np.testing.assert_allclose(np.median(after[decal], axis=0), [0.1, 0.7, 0.8], rtol=0.1)


def test_few_points_and_black_ones_give_colours():
    normals = sphere(5)
    after = cleaned(np.zeros((5, 3)), normals)
    assert after.shape == (5, 3)
    assert (after == 0).all()
