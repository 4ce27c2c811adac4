"""Gains of the photos of a whole, and textures of two blocks that meet in one brightness by them."""

from __future__ import annotations

import numpy as np
import pytest
from test_bake import WORKERS, X, Y, join, photograph, quad

from stages.drawing.rasterizing import rasterize_atlas, surface_points
from stages.drawing.rendering import look_at
from stages.geometry.cameras import PinholeCameras
from stages.texture.baking import bake_texture
from stages.texture.gains import in_gauge_of, solve_gains
from stages.texture.rough_gains import SMALL, colors_at, solve_rough_gains


def tracks(num_photos: int, per_photo: int, seen_by: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Observations of points that so many photos in a row see each, and the points' own colours [P, 3]."""
    rng = np.random.default_rng(seed)
    first = rng.integers(0, num_photos - seen_by + 1, num_photos * per_photo // seen_by)
    photo = (first[:, None] + np.arange(seen_by)).ravel()
    point = np.repeat(np.arange(len(first)), seen_by)
    return np.column_stack([photo, point]), rng.uniform(60, 150, (len(first), 3))


def drift(count: int, over: float = 1.6) -> np.ndarray:
    """Exposures [N, 3] that drift by this factor from the first photo to the last, each channel by another part."""
    return over ** (np.linspace(-0.5, 0.5, count)[:, None] * [1.0, 0.8, 0.6])


def test_a_drift_is_found_through_noise_and_highlights():
    rng = np.random.default_rng(1)
    seen, own = tracks(30, 200, 5)
    colors = own[seen[:, 1]] * drift(30)[seen[:, 0]] * rng.lognormal(0, 0.04, (len(seen), 3))
    colors[rng.random(len(seen)) < 0.1] = 240
    found = solve_rough_gains(seen, colors, 31)
    np.testing.assert_allclose(found[:30] * drift(30), 1, rtol=0.02)
    np.testing.assert_allclose(np.exp(np.log(found[:30]).mean(0)), 1)
    assert np.isnan(found[30]).all(), "a photo that shares nothing has none"


def test_a_drift_over_hundreds_of_photos_is_not_pulled_back():
    seen, own = tracks(300, 30, 3)
    found = solve_rough_gains(seen, own[seen[:, 1]] * drift(300)[seen[:, 0]], 300)
    np.testing.assert_allclose(found[[0, -1]] * drift(300)[[0, -1]], 1, rtol=0.03)


def test_few_photos_get_the_gains_that_the_bake_finds():
    rng = np.random.default_rng(2)
    true = np.exp(rng.uniform(-0.3, 0.3, (6, 3)))
    colors = rng.uniform(60, 150, (400, 1, 3)) * true
    weights = (rng.random((400, 6)) < 0.7).astype(float)
    point, photo = np.nonzero(weights)
    ours = solve_rough_gains(np.column_stack([photo, point]), colors[point, photo], 6)
    np.testing.assert_allclose(ours, solve_gains(colors, weights), rtol=2e-3)


def test_photos_without_points_have_no_gains():
    assert np.isnan(solve_rough_gains(np.zeros((0, 2), int), np.zeros((0, 3)), 2)).all()
    alone = np.array([[0, 0], [1, 1]])
    assert np.isnan(solve_rough_gains(alone, np.full((2, 3), 100.0), 2)).all()


@pytest.mark.parametrize("width", [40, 2 * SMALL])
def test_colors_are_those_of_the_place(width):
    ramp = np.broadcast_to((np.arange(width) + 0.5) * (200 / width), (30, width))
    photo = np.stack([ramp, np.full_like(ramp, 90), 220 - ramp], -1).round().astype(np.uint8)
    places = np.array([[0.25 * width, 3.0], [0.7 * width, 20.0]])
    np.testing.assert_allclose(colors_at(photo, places), [[50, 90, 170], [140, 90, 80]], atol=1.1)
    assert colors_at(photo, np.zeros((0, 2))).shape == (0, 3)


def test_more_places_than_opencv_takes_at_once():
    photo = np.full((20, 30, 3), 77, np.uint8)
    assert (colors_at(photo, np.full((40_000, 2), 9.0)) == 77).all()


def test_the_gauge_is_that_of_most_photos():
    gains = np.exp(np.random.default_rng(3).normal(0, 0.1, (20, 3)))
    rough = gains * [1.2, 0.9, 1.0]
    rough[0] *= 3  # wrong
    rough[1] = np.nan  # not known
    np.testing.assert_allclose(in_gauge_of(gains, rough), gains * [1.2, 0.9, 1.0])
    np.testing.assert_array_equal(in_gauge_of(gains, np.full_like(gains, np.nan)), gains)
    with pytest.raises(ValueError, match="shape"):
        in_gauge_of(gains, rough[:5])


# ---------------------------------------------------------------- two blocks
def test_two_blocks_of_a_town_whose_exposure_drifts_meet_in_one_brightness():
    """A strip of ground from x = -2 to 2, photographed from above by a flight along it; a block for each half."""
    cameras, photos = flight()
    rng = np.random.default_rng(4)
    places = np.column_stack([rng.uniform(-2, 2, 600), rng.uniform(-0.5, 0.5, 600), np.zeros(600)])
    rough = solve_rough_gains(*seen_by_all(cameras, photos, places), len(cameras))
    alone, tied = ([border(side, cameras, photos, gains) for side in (-1, 1)] for gains in (None, rough))
    step = [100 * np.abs(np.log(left / right)).mean() for left, right in (alone, tied)]
    assert step[0] > 10, "photos of each block alone have another mean"
    assert step[1] < 2.5, "each photo is found to a percent"


def flight() -> tuple[PinholeCameras, list[np.ndarray]]:
    views = [look_at(np.array([x, -0.3, 1.6]), np.array([x, 0, 0]), Y, 90, 70, 50) for x in np.linspace(-1.9, 1.9, 16)]
    cameras = PinholeCameras(
        tuple(f"{i}.png" for i in range(len(views))),
        *(np.concatenate([getattr(view, name) for view in views]) for name in ("sizes", "intrinsics", "extrinsics")),
    )
    ground = join([quad((x, 0, 0), X, Y, 0.5, 4, (0, 0), 1) for x in (-1.5, -0.5, 0.5, 1.5)])
    photos = [photograph(ground, cameras, i, painted) for i in range(len(cameras))]
    exposed = [np.clip(p * e + 0.5, 0, 255).astype(np.uint8) for p, e in zip(photos, drift(16), strict=True)]
    return cameras, exposed


def painted(points: np.ndarray) -> np.ndarray:
    x, y, _ = points.T
    return np.stack([110 + 30 * np.sin(7 * x + k) * np.cos(5 * y - k) for k in range(3)], 1)


def seen_by_all(cameras: PinholeCameras, photos, places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Observations and colours, as those of sparse points."""
    seen, colors = [], []
    for i, photo in enumerate(photos):
        at = (places @ cameras.extrinsics[i, :, :3].T + cameras.extrinsics[i, :, 3]) @ cameras.intrinsics[i].T
        pixels = at[:, :2] / at[:, 2:]
        framed = np.flatnonzero(((pixels > 1) & (pixels < cameras.sizes[i] - 1)).all(1))
        seen.append(np.column_stack([np.full(len(framed), i), framed]))
        colors.append(colors_at(photo, pixels[framed]))
    return np.concatenate(seen), np.concatenate(colors)


def border(side: int, cameras: PinholeCameras, photos, rough: np.ndarray | None) -> np.ndarray:
    """Mean colour [3] of a block's texture along x = 0."""
    half = join([quad((0.5 * side, 0, 0), X, Y, 0.5, 8, (0, 0), 2), quad((1.5 * side, 0, 0), X, Y, 0.5, 8, (1, 0), 2)])
    mine = [i for i, center in enumerate(cameras.centers) if side * center[0] > -0.4]
    texels = rasterize_atlas(half.uvs, half.faces, half.texture_size)
    baked = bake_texture(
        half, texels, cameras.select(mine), lambda k: (photos[mine[k]], None), lambda p, n, v: np.full(p.shape, 0.5),
        workers=WORKERS, rough_gains=None if rough is None else rough[mine],
    )  # fmt: skip
    points, _ = surface_points(half, texels.face_ids, texels.corner)
    near = (np.abs(points[:, 0]) < 0.02) & (np.abs(points[:, 1]) < 0.3)
    return baked.base_color.reshape(-1, 3)[texels.index[near]].mean(0)
