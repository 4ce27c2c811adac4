"""Base colours of texels, from photos of a ball drawn by the model itself."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from lit_sphere import ROWS, lamps, nothing_around, use_small_maps
from rigs import look_at

from stages.geometry.vectors import unit
from stages.light import ggx
from stages.light.environment import directions, look_up, solid_angles
from stages.light.srgb import as_bytes, coded
from stages.shading.learning import Learned, Material
from stages.shading.texels import Points, Told, _look, base_colors
from stages.texture.photo_views import View

TURN = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # from z up to y up
COLOR = np.array([0.5, 0.3, 0.15])
SIZE, FOCAL = 96, 130.0
GAINS = (1.0, 0.8, 1.25)


@pytest.fixture(autouse=True)
def _small(monkeypatch):
    use_small_maps(monkeypatch)


def shown(normals: np.ndarray, towards: np.ndarray, metallic: int, roughness: float) -> np.ndarray:
    """Linear radiance [P, 3] of a ball of one material."""
    cosine = np.maximum(normals @ TURN.T @ directions(ROWS).reshape(-1, 3).T, 0) * solid_angles(ROWS).reshape(-1)
    matte = cosine @ lamps().reshape(-1, 3) / np.pi
    facing = (normals * towards).sum(1, keepdims=True)
    lobe = look_up(ggx.blurred(lamps(), roughness), (2 * facing * normals - towards) @ TURN.T)
    scale, bias = ggx.split_sum(facing, roughness)
    if metallic:
        return (COLOR * scale + bias) * lobe
    return (1 - 0.04 * scale - bias) * COLOR * matte + (0.04 * scale + bias) * lobe


def photo(center: np.ndarray, gain: float, metallic: int, roughness: float) -> View:
    """The unit ball, seen from a place."""
    pose = look_at(center, np.zeros(3))
    K = np.array([[FOCAL, 0, SIZE / 2], [0, FOCAL, SIZE / 2], [0, 0, 1]])
    x, y = np.meshgrid(np.arange(SIZE) + 0.5, np.arange(SIZE) + 0.5)
    rays = unit(np.stack([x.ravel(), y.ravel(), np.ones(SIZE**2)], 1) @ np.linalg.inv(K).T @ pose[:, :3])
    middle = -rays @ center
    under = 1 - (center @ center - middle**2)
    hit = under > 0
    normals = (center + (middle - np.sqrt(np.maximum(under, 0)))[:, None] * rays)[hit]
    depths = normals @ pose[2, :3] + pose[2, 3]
    inverse, image = np.zeros(SIZE**2, np.float32), np.zeros((SIZE**2, 3), np.uint8)
    inverse[hit] = 1 / depths
    image[hit] = as_bytes(np.clip(shown(normals, -rays[hit], metallic, roughness) / gain, 0, 1))
    inverse, image = inverse.reshape(SIZE, SIZE), image.reshape(SIZE, SIZE, 3)
    confidence = np.uint8(255 * (inverse > 0))
    return View(K @ pose, center, FOCAL, inverse, confidence, np.zeros((SIZE, SIZE, 3), np.uint16), image, image)


def found_on_a_ball(metallic: int, roughness: float) -> tuple[np.ndarray, object]:
    """Normals of texels and what is found there; no photo shows the ball from below."""
    normals = unit(np.random.default_rng(0).normal(size=(1500, 3)))
    centers = np.array([[3.0, 0, 1.5], [-1.5, 2.6, 2], [-1.5, -2.6, 2.5]])
    photos = [photo(center, gain, metallic, roughness) for center, gain in zip(centers, GAINS, strict=True)]
    some = normals[:300].astype(np.float32)
    grey = 0.6
    points = Points(some, some, np.full((300, 3), grey, np.float32), nothing_around(300))
    learned = Learned(
        light=lamps(),
        materials=(Material(metallic, int(10 * roughness) - 1, roughness, told=True),),
        which=np.zeros(300, int),
        color=np.tile(COLOR, (300, 1)).astype(np.float32),
        gains=np.array(GAINS, np.float32),
        cost=0.0,
    )

    def views() -> Iterator[View]:
        return iter(photos)

    baked = np.full((1500, 3), round(255 * grey), np.uint8)
    return normals, base_colors(normals, normals, baked, points, learned, TURN, views)


@pytest.mark.parametrize(("metallic", "roughness"), [(0, 0.4), (1, 0.5), (1, 0.25)])
def test_the_planted_colour_comes_back_under_light_that_is_not_even(metallic: int, roughness: float):
    normals, found = found_on_a_ball(metallic, roughness)
    known = found.told == Told.ALL
    assert known[normals[:, 2] > 0.3].mean() > 0.9
    off = coded(found.color[known]) - coded(COLOR)
    assert np.abs(off).mean() < 0.005
    assert np.quantile(np.abs(off), 0.95) < 0.03


def test_what_no_photo_shows_has_the_texture_s_colour_with_the_light_off():
    normals, found = found_on_a_ball(0, 0.4)
    below = normals[:, 2] < -0.8
    assert (found.told[below] == Told.NOTHING).all()
    np.testing.assert_allclose(found.color[below], np.tile(COLOR, (below.sum(), 1)), rtol=0.02)
    assert (found.which == 0).all()


def test_the_compiled_look_up_is_the_other_one():
    image = np.random.default_rng(0).random((6, 12, 3)).astype(np.float32)
    towards = unit(np.random.default_rng(1).normal(size=(200, 3)))
    found = np.empty((200, 3))
    for row, (x, y, z) in zip(found, towards, strict=True):
        _look(image, x, y, z, row)
    np.testing.assert_allclose(found, look_up(image, towards), atol=1e-5)
