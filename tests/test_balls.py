"""The light from balls: exact geometry on balls of known places, and known lights got back from drawn photos."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from ball_photos import LAMPS, Drawn, apart_deg, drawn, edge_of, lamps, lens, main_source, matte, rays_through
from scipy.spatial.transform import Rotation

from stages.geometry.vectors import unit
from stages.light.environment import directions, mean_radiance, resized, solid_angles
from stages.shading.ball_light import BallLight, filled, light_of
from stages.shading.balls import (
    BallPhoto,
    Cone,
    MatteBall,
    MirrorBall,
    fitted_cone,
    mirroring_normals,
    normals_on,
    seen_in_chrome,
    seen_on_grey,
)

# From a camera's frame to the light's, for two photos from different sides.
TURNS = [Rotation.from_euler("xyz", angles, degrees=True).as_matrix() for angles in ([200, 30, 20], [170, -70, 10])]
PLACE, RADIUS = np.array([0.2, 0.1, 1.0]), 0.13


def photo(kind: str, light: np.ndarray, exposure: float, turn: int = 0, k: float = 0.0) -> BallPhoto:
    camera = lens(k)
    return as_ball(drawn(kind, light, TURNS[turn], PLACE, RADIUS, camera, exposure), camera, TURNS[turn])


def as_ball(taken: Drawn, camera: Any, turn: np.ndarray) -> BallPhoto:
    return BallPhoto(taken.center, taken.radius, taken.pixels, rays_through(camera), camera.img_from_cam, turn)


def chrome(light: np.ndarray, exposure: float, turn: int = 0, k: float = 0.0) -> MirrorBall:
    return seen_in_chrome(photo("chrome", light, exposure, turn, k))


def grey(light: np.ndarray, exposure: float, turn: int = 0) -> MatteBall:
    return seen_on_grey(photo("grey", light, exposure, turn))


def error(found: BallLight, truth: np.ndarray, exposure: float, rows: int = 8) -> float:
    """Of a coarse map, part of the light."""
    off = np.abs(resized(found.radiance / exposure, rows) - resized(truth, rows)) * solid_angles(rows)[..., None]
    return float(off.sum() / (resized(truth, rows) * solid_angles(rows)[..., None]).sum())


def matte_error(found: BallLight, truth: np.ndarray) -> float:
    """Of what white matte surfaces show, after one scale for all."""
    normals = directions(8).reshape(-1, 3)
    expected, shown = matte(truth, normals), matte(found.radiance, normals)
    scale = (expected * shown).sum() / (shown**2).sum()
    return float(np.abs(scale * shown - expected).mean() / expected.mean())


# ---------------------------------------------------------------- geometry
@pytest.mark.parametrize("center", [[0, 0, 1.0], [0.4, -0.3, 1.0]])
def test_a_cone_is_found_from_its_sides(center: Sequence[float]) -> None:
    cone = fitted_cone(edge_of(np.array(center), 0.15))
    np.testing.assert_allclose(cone.axis, unit(np.array(center)), atol=1e-9)
    assert np.sin(cone.angle) == pytest.approx(0.15 / np.linalg.norm(center), rel=1e-9)


@pytest.mark.parametrize(("place", "k"), [((0.0, 0.0), 0.0), ((0.35, 0.2), 0.0), ((0.3, -0.2), -0.15)])
def test_the_cone_of_a_circle_is_that_of_the_ball(place: tuple[float, float], k: float) -> None:
    """However far from the middle, and through a lens that distorts."""
    center = np.array([*place, 1.0])
    camera = lens(k)
    cone = as_ball(drawn("grey", lamps(1), np.eye(3), center, 0.05, camera, 1.0), camera, np.eye(3)).cone
    sine = 0.05 / np.linalg.norm(center)
    assert np.radians(apart_deg(cone.axis, center)) < 0.02 * sine
    assert np.sin(cone.angle) == pytest.approx(sine, rel=0.01)


def test_normals_are_those_of_the_ball_at_any_distance() -> None:
    center, radius = np.array([0.3, -0.2, 2.0]), 0.4
    cone = fitted_cone(edge_of(center, radius))
    normals = unit(np.random.default_rng(0).normal(size=(200, 3)))
    points = center + radius * normals
    seen = (normals * points).sum(1) < 0
    np.testing.assert_allclose(normals_on(cone, unit(points[seen])), normals[seen], atol=1e-6)


def test_mirroring_normals_mirror() -> None:
    cone = Cone(unit(np.array([0.2, 0.1, 1.0])), 0.2)
    towards = directions(16).reshape(-1, 3).astype(np.float64)
    normals, rays = mirroring_normals(cone, towards)
    seen = -(normals * rays).sum(1) > 0.2
    assert 0.9 < (solid_angles(16).reshape(-1)[seen]).sum() / (4 * np.pi) < 0.99
    np.testing.assert_allclose(normals_on(cone, rays[seen]), normals[seen], atol=1e-3)
    mirrored = rays - 2 * (rays * normals).sum(1, keepdims=True) * normals
    np.testing.assert_allclose(mirrored[seen], towards[seen], atol=1e-3)


# ---------------------------------------------------------------- chrome
@pytest.mark.parametrize("k", [0.0, -0.15])
def test_a_chrome_ball_gives_the_light_back(k: float) -> None:
    light, exposure = lamps(2.5), 0.3
    found = light_of([chrome(light, exposure, k=k)], [])
    assert found.clipped == 0
    assert 0.03 < found.unseen < 0.15  # behind it
    assert apart_deg(main_source(found.radiance), LAMPS[0]) < 6
    assert error(found, light, exposure) < 0.03
    assert mean_radiance(found.radiance) == pytest.approx(exposure * mean_radiance(light), rel=0.03)


def test_what_lies_behind_one_photo_s_ball_another_shows() -> None:
    light = lamps(2.5)
    balls = [chrome(light, 0.3, turn) for turn in (0, 1)]
    both = light_of(balls, [])
    assert both.unseen == 0
    assert error(both, light, 0.3) < 0.02


def test_exposures_are_merged_so_that_nothing_is_clipped() -> None:
    light = lamps(20)
    bright, dark = chrome(light, 0.8), chrome(light, 0.04, turn=1)
    alone = light_of([bright], [])
    assert alone.clipped > 0.01
    assert error(alone, light, 0.8) > 0.2
    assert (alone.radiance <= 1).all()
    for balls, exposure in (([bright, dark], 0.8), ([dark, bright], 0.04)):
        merged = light_of(balls, [])
        assert merged.clipped < 1e-4
        assert error(merged, light, exposure) < 0.05
        assert apart_deg(main_source(merged.radiance), LAMPS[0]) < 6


def test_exposures_too_far_apart_are_refused() -> None:
    height = 16
    shape = (height, 2 * height)
    balls = [
        MirrorBall(np.full((*shape, 3), value, np.float32), np.ones(shape, bool), np.zeros((*shape, 3), bool))
        for value in (0.5, 0.001)
    ]
    with pytest.raises(ValueError, match="exposures so far apart"):
        light_of(balls, [])


def test_what_is_not_seen_is_filled_smoothly() -> None:
    towards = directions(32)
    light = (1 + 0.5 * towards).astype(np.float32)
    seen = towards @ unit(np.array([0.3, 0.2, 1.0])) < 0.9
    found = filled(np.where(seen[..., None], light, 0), seen)
    assert (found[seen] == light[seen]).all()
    np.testing.assert_allclose(found[~seen], light[~seen], atol=0.25)


# ---------------------------------------------------------------- grey
@pytest.mark.slow
def test_a_grey_ball_gives_the_main_source_and_what_matte_surfaces_show() -> None:
    light = lamps(20)
    found = light_of([], [grey(light, 0.8)])
    assert 0.2 < found.unseen < 0.5  # from behind it little falls on what is seen
    assert apart_deg(main_source(found.radiance), LAMPS[0]) < 11.25  # a pixel of its map
    assert matte_error(found, light) < 0.08


@pytest.mark.slow
def test_two_sides_of_a_grey_ball_tell_more_whatever_their_exposures() -> None:
    light = lamps(20)
    found = light_of([], [grey(light, 0.8), grey(light, 0.4, turn=1)])
    assert found.unseen < 0.1
    assert apart_deg(main_source(found.radiance), LAMPS[0]) < 11.25
    assert matte_error(found, light) < 0.03


@pytest.mark.slow
def test_a_grey_ball_tells_how_bright_is_what_is_clipped_in_the_chrome_one() -> None:
    light = lamps(40)
    clipped = chrome(light, 0.8)
    assert matte_error(light_of([clipped], []), light) > 0.2
    found = light_of([clipped], [grey(light, 0.6), grey(light, 0.3, turn=1)])
    assert found.clipped == 0
    assert matte_error(found, light) < 0.03
    assert mean_radiance(found.radiance) == pytest.approx(0.8 * mean_radiance(light), rel=0.05)
    assert apart_deg(main_source(found.radiance), LAMPS[0]) < 6


# ---------------------------------------------------------------- nothing to see
@pytest.mark.parametrize("see", [seen_in_chrome, seen_on_grey])
@pytest.mark.parametrize(("value", "words"), [(255, "100 % of it are clipped"), (0, "it is black")])
def test_a_ball_that_shows_nothing_is_refused(see: Any, value: int, words: str) -> None:
    ball = photo("grey", lamps(1), 1.0)
    blank = BallPhoto(
        ball.center, ball.radius, np.full_like(ball.pixels, value), ball.rays_of, ball.pixels_of, np.eye(3)
    )
    with pytest.raises(ValueError, match=words):
        see(blank)
