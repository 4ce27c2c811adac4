"""The light that reaches observations, against loops over all directions."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from lit_sphere import PLASTIC, ROWS, LitSphere, lamps, lit_sphere, nothing_around, use_small_maps

from stages.geometry.vectors import unit
from stages.light import ggx
from stages.light.environment import directions, look_up, solid_angles
from stages.light.ggx import blur, blur_back
from stages.shading.observations import Observations
from stages.shading.reflection import Reflection, reflection
from stages.shading.surroundings import Surroundings

TURN = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # from z up to y up


@pytest.fixture(autouse=True)
def _small(monkeypatch):
    use_small_maps(monkeypatch)


def few_points(around: Surroundings | None = None) -> tuple[Reflection, Observations, np.ndarray]:
    rng = np.random.default_rng(3)
    normals = unit(rng.normal(size=(4, 3)))
    towards = unit(normals[:, None] + 0.5 * rng.normal(size=(4, 5, 3))).astype(np.float32)
    seen = Observations(np.zeros((4, 5, 3), np.float32), np.ones((4, 5), np.float32), towards, np.zeros((4, 5), int))
    return reflection(seen, normals, around or nothing_around(4), TURN), seen, normals


def test_matte_points_show_the_sum_over_all_directions():
    found, _, normals = few_points()
    light = lamps().reshape(-1, 3)
    for point, normal in enumerate(normals):
        expected = np.zeros(3)
        for towards, size, radiance in zip(
            directions(ROWS).reshape(-1, 3), solid_angles(ROWS).reshape(-1), light, strict=True
        ):
            expected += max(float(TURN @ normal @ towards), 0) * size / np.pi * radiance
        np.testing.assert_allclose(found.diffuse(torch.from_numpy(light))[point], expected, rtol=1e-4)


def test_lobes_look_where_a_mirror_would():
    found, seen, normals = few_points()
    mirrored = found.mirrored(torch.from_numpy(lamps().reshape(-1, 3))).numpy()
    levels = [ggx.blurred(lamps(), roughness) for roughness in ggx.ROUGHNESSES]
    for point, normal in enumerate(normals):
        for photo, towards in enumerate(seen.towards[point]):
            facing = max(float(normal @ towards), 1e-3)
            ahead = TURN @ (2 * facing * normal - towards)
            for level in (0, 4, 9):
                expected = look_up(levels[level], ahead[None])[0]
                np.testing.assert_allclose(mirrored[point, photo, level], expected, rtol=1e-3, atol=1e-4)
            scale, bias = ggx.split_sum(np.array([facing]), 0.5)
            assert float(found.scale[point, photo, 4]) == pytest.approx(scale[0], abs=1e-5)
            assert float(found.bias[point, photo, 4]) == pytest.approx(bias[0], abs=1e-5)


def test_hidden_directions_give_nothing():
    sides = nothing_around(4).open.shape[1]
    dark = Surroundings(np.zeros((4, sides), np.float32), np.zeros((4, sides, 3), np.float32))
    found, _, _ = few_points(dark)
    light = torch.from_numpy(lamps().reshape(-1, 3))
    assert found.diffuse(light).abs().max() == 0
    assert found.mirrored(light).abs().max() == 0


def test_what_hides_one_side_takes_that_side_s_light():
    towards = directions(ROWS).reshape(-1, 3)
    half = np.tile((towards[:, 0] > 0).astype(np.float32), (4, 1))
    found, _, _ = few_points(Surroundings(half, nothing_around(4).bounced))
    everywhere, _, _ = few_points()
    shadowed = torch.from_numpy((lamps().reshape(-1, 3) * (towards[:, :1] > 0)).astype(np.float32))
    whole = torch.from_numpy(lamps().reshape(-1, 3))
    np.testing.assert_allclose(found.diffuse(whole), everywhere.diffuse(shadowed), rtol=1e-4)


def test_a_surface_around_lights_as_a_sky_of_its_colour_would():
    sides = nothing_around(4).open.shape[1]
    glow = np.array([0.3, 0.2, 0.1], np.float32)
    closed = Surroundings(np.zeros((4, sides), np.float32), np.tile(glow, (4, sides, 1)))
    found, _, _ = few_points(closed)
    outside = torch.from_numpy(lamps().reshape(-1, 3))
    np.testing.assert_allclose(found.mirrored(outside), np.broadcast_to(glow, (4, 5, 10, 3)), rtol=1e-4)
    np.testing.assert_allclose(found.diffuse(outside), np.broadcast_to(glow, (4, 3)), rtol=0.02)


def test_blur_back_is_the_transpose():
    rng = np.random.default_rng(0)
    lobes, light, values = rng.random((3, 8, 8)), rng.random((8, 3)), rng.random((3, 8, 3))
    assert (blur(lobes, light) * values).sum() == pytest.approx((light * blur_back(lobes, values)).sum())


def test_a_selection_is_of_those_points():
    sphere: LitSphere = lit_sphere((PLASTIC,), count=12, views=4)
    rows = torch.tensor([7, 2])
    some, light = sphere.reflection.select(rows), sphere.light
    torch.testing.assert_close(some.diffuse(light), sphere.reflection.diffuse(light)[rows])
    torch.testing.assert_close(some.mirrored(light), sphere.reflection.mirrored(light)[rows])
