"""Environment maps: where their pixels look, how large they are, and what survives resizing and turning."""

from __future__ import annotations

import numpy as np
import pytest

from stages.geometry.vectors import unit
from stages.light.environment import bilinear, directions, look_up, resized, solid_angles, turned


def some_light(height: int = 8) -> np.ndarray:
    return np.random.default_rng(0).random((height, 2 * height, 3)).astype(np.float32)


def direction_of(u: float, v: float) -> np.ndarray:
    """The equation in the module's docstring."""
    theta, phi = np.pi * v, 2 * np.pi * (u - 0.5)
    return np.array([np.sin(theta) * np.cos(phi), np.cos(theta), np.sin(theta) * np.sin(phi)])


def test_pixels_look_where_the_convention_says():
    height = 6
    towards = directions(height)
    assert towards.shape == (6, 12, 3)
    assert towards.dtype == np.float32
    for row in range(height):
        for column in range(2 * height):
            expected = direction_of((column + 0.5) / (2 * height), (row + 0.5) / height)
            np.testing.assert_allclose(towards[row, column], expected, atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(towards, axis=2), 1, atol=1e-6)


def test_rows_start_above_and_the_middle_looks_along_x():
    towards = directions(64)
    assert towards[0, :, 1].min() > 0.999
    np.testing.assert_allclose(towards[31:33, 63:65].mean((0, 1)), [1, 0, 0], atol=1e-3)
    np.testing.assert_allclose(towards[31:33, 95:97].mean((0, 1)), [0, 0, 1], atol=1e-3)


@pytest.mark.parametrize("height", [2, 7, 32])
def test_solid_angles_make_a_sphere(height: int):
    assert solid_angles(height).astype(np.float64).sum() == pytest.approx(4 * np.pi, rel=1e-6)


def test_the_size_of_a_pixel_is_its_integral():
    fine = directions(400)[..., 1]
    height = np.arccos(fine[:, 0].astype(np.float64))
    rows = np.sin(height) * (np.pi / 400) * (np.pi / 4)  # of rings cut to a pixel's width
    assert solid_angles(4)[1, 0] == pytest.approx(rows[100:200].sum(), rel=1e-4)


def test_a_pixel_s_own_direction_gives_the_pixel():
    light = some_light()
    np.testing.assert_allclose(look_up(light, directions(8)), light, atol=1e-5)


def test_the_map_closes_around_behind():
    light = some_light()
    behind = direction_of(0.0, 2.5 / 8)  # between the last column and the first
    np.testing.assert_allclose(look_up(light, behind[None])[0], (light[2, 0] + light[2, -1]) / 2, atol=1e-5)


def test_beyond_the_last_row_the_row_answers():
    light = some_light()
    below = look_up(light, np.array([[0, -1.0, 0], [0, 1.0, 0]]))
    assert light[7].min() <= below[0].min()
    assert below[0].max() <= light[7].max()
    assert light[0].min() <= below[1].min()
    assert below[1].max() <= light[0].max()


def test_weights_sum_to_one_in_any_direction():
    pixels, weights = bilinear(unit(np.random.default_rng(1).normal(size=(500, 3))), 5)
    np.testing.assert_allclose(weights.sum(1), 1, atol=1e-6)
    assert weights.min() >= 0
    assert pixels.min() >= 0
    assert pixels.max() < 50


@pytest.mark.parametrize("height", [1, 3, 4, 5, 8, 11])
@pytest.mark.parametrize("place", [(0, 0), (11, 23), (5, 7)])
def test_a_smaller_map_holds_as_much_light(height: int, place: tuple[int, int]):
    light = some_light(12)
    light[place] = 1000
    small = resized(light, height)
    assert small.shape == (height, 2 * height, 3)
    assert small.dtype == np.float32
    held = (small * solid_angles(height)[..., None]).sum((0, 1))
    np.testing.assert_allclose(held, (light * solid_angles(12)[..., None]).sum((0, 1)), rtol=1e-5)


def test_a_smaller_map_of_an_even_light_is_as_even():
    np.testing.assert_allclose(resized(np.full((12, 24, 3), 0.7, np.float32), 5), 0.7, rtol=1e-6)


def test_a_larger_map_shows_the_same():
    light = some_light()
    np.testing.assert_allclose(look_up(resized(light, 24), directions(8)), light, atol=1e-4)


@pytest.mark.parametrize("columns", [1, 5, -3])
def test_a_turn_by_whole_pixels_is_a_roll(columns: int):
    light = some_light()
    np.testing.assert_allclose(turned(light, columns * 360 / 16), np.roll(light, columns, axis=1), atol=1e-4)
