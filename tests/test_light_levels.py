"""The built-in lights, and lights blurred for every roughness."""

from __future__ import annotations

import numpy as np
import pytest

from stages.light import ggx
from stages.light.built_in import LIGHTS, MEAN, mean_radiance
from stages.light.environment import directions, look_up, resized, solid_angles
from stages.light.harmonics import irradiance, project
from stages.light.levels import ROWS, levels_of, matte


@pytest.mark.parametrize("name", LIGHTS)
def test_built_in_lights_are_lights_of_one_brightness_at_any_size(name: str) -> None:
    small, large = LIGHTS[name](16), LIGHTS[name](64)
    for light in (small, large):
        assert light.shape == (len(light), 2 * len(light), 3)
        assert light.dtype == np.float32
        assert light.min() >= 0
        assert mean_radiance(light) == pytest.approx(MEAN, rel=1e-4)
    np.testing.assert_allclose(project(small, 1), project(large, 1), atol=0.15)


@pytest.mark.parametrize(("name", "brightest"), [("studio", (-0.6, 0.6, 0.5)), ("sun", (-0.45, 0.7, 0.54))])
def test_main_lights_come_from_the_upper_left_of_the_viewer(name: str, brightest: tuple[float, ...]) -> None:
    light = LIGHTS[name](64)
    weighted = np.where(light >= 0.5 * light.max(), light, 0).mean(2) * solid_angles(64)
    middle = np.einsum("hw,hwc->c", weighted, directions(64))
    assert middle @ np.asarray(brightest) > 0.75 * np.linalg.norm(middle) * np.linalg.norm(brightest)


def test_the_window_is_on_the_left_and_the_floor_below_is_wood() -> None:
    light = LIGHTS["window"](64)
    assert directions(64)[np.unravel_index(light.sum(2).argmax(), (64, 128))][0] < -0.85
    below = look_up(light, np.array([[0, -1.0, 0]]))[0]
    assert below[0] > 1.3 * below[2]


def test_a_uniform_light_stays_what_it_is_at_all_roughnesses() -> None:
    levels = levels_of(np.full((16, 32, 3), (1, 2, 3), np.float32))
    assert len(levels.maps) == len(levels.roughnesses) == 1 + len(ggx.ROUGHNESSES)
    for level in (*levels.maps, levels.matte):
        np.testing.assert_allclose(level, np.broadcast_to((1, 2, 3), level.shape), rtol=1e-5)


def test_the_sampled_level_is_the_lobe_of_its_roughness() -> None:
    """Against the sum over all pixels, at a size where that is possible."""
    light = resized(LIGHTS["window"](64), 32)
    level = levels_of(light).maps[2]
    assert len(level) == ROWS[1]
    exact = (ggx.lobe_matrix(ggx.ROUGHNESSES[1], 32, 32) @ light.reshape(-1, 3)).reshape(32, 64, 3)
    coarse = resized(level, 32)
    assert np.abs(coarse - exact).mean() < 0.05 * exact.mean()
    assert np.corrcoef(coarse.ravel(), exact.ravel())[0, 1] > 0.99


def test_rougher_levels_are_more_even_and_keep_the_mean() -> None:
    levels = levels_of(LIGHTS["studio"](64))
    spreads = [float(level.std()) for level in levels.maps[2:]]
    assert spreads == sorted(spreads, reverse=True)
    for level in levels.maps:
        assert mean_radiance(level) == pytest.approx(MEAN, rel=0.12)


def test_a_matte_surface_shows_the_irradiance_of_the_harmonics() -> None:
    light = resized(LIGHTS["studio"](64), 32)
    by_harmonics = irradiance(project(light), directions(32)) / np.pi
    assert np.abs(matte(light) - by_harmonics).mean() < 0.03
