"""Materials from light and light from materials, where both are known."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
import torch
from lit_sphere import METAL, PLASTIC, ROWS, lit_sphere, shown, use_small_maps

from stages.light.environment import solid_angles
from stages.light.srgb import coded as reference_coded
from stages.shading.fitting import (
    BRIGHTEST,
    CLIPPED,
    PULL,
    Materials,
    Part,
    best_color,
    coded,
    decoded,
    find_light,
    grey_world,
    greyed,
    levels_of,
    radiance_of,
    residuals,
    robust,
    robust_weight,
    smoothed,
    try_out,
)

KINDS = (METAL, PLASTIC, ((0.2, 0.4, 0.7), 0.6, 0.0))


@pytest.fixture(autouse=True)
def _small(monkeypatch):
    use_small_maps(monkeypatch)


def linear_model(count: int = 6, photos: int = 9) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Slope, offset [S, K, 3] and base colours [S, 3]."""
    random = torch.Generator().manual_seed(0)
    slope = 0.3 + 0.5 * torch.rand(count, photos, 3, generator=random)
    offset = 0.1 * torch.rand(count, photos, 3, generator=random)
    return slope, offset, 0.1 + 0.7 * torch.rand(count, 3, generator=random)


# ---------------------------------------------------------------- colours
def test_codes_come_back_and_are_those_of_srgb():
    linear = torch.linspace(0, 1, 101)
    torch.testing.assert_close(decoded(coded(linear)), linear, atol=1e-5, rtol=1e-4)
    np.testing.assert_allclose(coded(linear), reference_coded(linear.numpy()), atol=1e-5)


def test_a_clipped_photo_agrees_with_all_that_is_brighter():
    clipped = torch.tensor([1.0, 1.0, 1.0, 0.5])
    off = residuals(torch.tensor([1.2, 7.0, 0.5, 0.9]), clipped)
    assert off[0] == off[1] == 0
    assert off[2] < -0.1  # darker than clipped is an error
    assert off[3] > 0.1  # and so is what is brighter than a photo that is not clipped
    assert residuals(torch.tensor([5.0]), torch.tensor([CLIPPED]))[0] == 0


def test_robust_is_half_the_square_and_its_weight_is_its_slope_over_the_difference():
    off = torch.linspace(-0.3, 0.3, 61, dtype=torch.float64, requires_grad=True)
    value = robust(off)
    (slope,) = torch.autograd.grad(value.sum(), off)
    spread2 = 0.04**2
    torch.testing.assert_close(slope * spread2, (robust_weight(off) * off))
    assert float(robust(torch.tensor(0.004))) == pytest.approx(0.005, rel=0.01)
    assert float(robust(torch.tensor(0.0))) == 0
    assert float(robust(torch.tensor(0.4))) == pytest.approx(9, rel=0.02)


def test_the_best_colour_is_the_planted_one():
    slope, offset, color = linear_model()
    observed = coded(slope * color[:, None] + offset)
    torch.testing.assert_close(best_color(slope, offset, observed, torch.ones(6, 9)), color, atol=1e-4, rtol=1e-3)


def test_one_wrong_photo_moves_the_best_colour_little_and_an_unseen_one_not_at_all():
    slope, offset, color = linear_model()
    observed = coded(slope * color[:, None] + offset)
    observed[:, 4] = 0.95
    weights = torch.ones(6, 9)
    plain = best_color(slope, offset, observed, weights, rounds=1)
    robustly = best_color(slope, offset, observed, weights, rounds=8)
    assert (robustly - color).abs().mean() < 0.6 * (plain - color).abs().mean()
    weights[:, 4] = 0
    torch.testing.assert_close(best_color(slope, offset, observed, weights), color, atol=1e-4, rtol=1e-3)


def test_a_paint_pulls_the_brightness_to_its_own_and_leaves_the_ratio_of_the_channels():
    slope, offset, color = linear_model()
    observed = coded(slope * color[:, None] + offset)
    paint = torch.full_like(color, 0.3)
    pulled = best_color(slope, offset, observed, torch.ones(6, 9), rounds=1, paint=paint)
    brightness = (color.mean(1) + PULL * 0.3) / (1 + PULL)
    expected = color * (brightness / color.mean(1))[:, None]
    torch.testing.assert_close(pulled, expected.clamp(max=BRIGHTEST), atol=1e-4, rtol=1e-3)


def test_a_highlight_that_clips_does_not_darken_the_colour():
    slope, offset, color = linear_model()
    slope[:, 2] *= 12
    observed = coded(slope * color[:, None] + offset)
    assert (observed[:, 2] >= CLIPPED).any()
    torch.testing.assert_close(best_color(slope, offset, observed, torch.ones(6, 9)), color, atol=1e-4, rtol=1e-3)


def test_where_all_photos_clip_the_colour_is_bright_enough_for_that():
    slope, offset = torch.full((1, 4, 3), 1.5), torch.zeros(1, 4, 3)
    found = best_color(slope, offset, torch.ones(1, 4, 3), torch.ones(1, 4))
    torch.testing.assert_close(found, torch.full((1, 3), 1 / 1.5))


# ---------------------------------------------------------------- materials
def test_under_the_true_light_roughness_metalness_and_colour_are_found():
    sphere = lit_sphere(KINDS, count=150)
    costs, colors = try_out(sphere.reflection, sphere.observed, sphere.weights, sphere.light)
    assert costs.shape == (150, 2, 10)
    best = costs.flatten(1).argmin(1)
    assert ((best // 10) == sphere.metallic).float().mean() > 0.97
    assert ((best % 10) == levels_of(sphere.roughness)).float().mean() > 0.97
    rows = torch.arange(150)
    true = sphere.metallic.long() * 10 + levels_of(sphere.roughness)
    assert (colors.flatten(1, 2)[rows, true] - sphere.color).abs().median() < 0.01
    assert costs.flatten(1)[rows, true].median() < 1e-3


def test_a_wrong_light_costs_more():
    sphere = lit_sphere(KINDS, count=60)
    grid = sphere.light.reshape(ROWS, 2 * ROWS, 3)

    def cost(light: torch.Tensor) -> float:
        costs, _ = try_out(sphere.reflection, sphere.observed, sphere.weights, light.reshape(-1, 3))
        return float(costs.flatten(1).amin(1).mean())

    true = cost(grid)
    assert cost(grid.roll(8, 1)) > 10 * true + 0.02
    assert cost(torch.full_like(grid, float(grid.mean()))) > 10 * true + 0.02


def test_levels_are_the_nearest():
    assert levels_of(torch.tensor([0.0, 0.1, 0.26, 0.98])).tolist() == [0, 0, 2, 9]


# ---------------------------------------------------------------- light
def test_the_light_is_found_from_materials_and_stays_above_zero():
    sphere = lit_sphere((METAL, PLASTIC))
    whole = Part(
        sphere.reflection, sphere.observed, sphere.weights, sphere.materials, torch.arange(len(sphere.observed))
    )
    light = torch.full_like(sphere.light, float(sphere.light.mean()))
    costs = []
    for _ in range(4):
        light = find_light(
            sphere.reflection, sphere.observed, sphere.weights, sphere.materials, light, rounds=2, smoothness=0, grey=0
        )
        assert light.min() > 0
        costs.append(whole.cost(light))
    assert all(after < 1.02 * before for before, after in pairwise(costs))
    assert costs[-1] < 0.6 * costs[0]
    assert np.corrcoef(light.log().flatten(), sphere.light.log().flatten())[0, 1] > 0.7
    # from the true light there is nowhere to go
    at_truth = find_light(
        sphere.reflection,
        sphere.observed,
        sphere.weights,
        sphere.materials,
        sphere.light,
        rounds=1,
        smoothness=0,
        grey=0,
    )
    assert whole.cost(at_truth) < 1e-4


def test_radiance_is_the_sum_of_the_model_s_parts():
    sphere = lit_sphere((PLASTIC, METAL), count=40, views=12)
    found = radiance_of(sphere.reflection, sphere.observed, sphere.weights, sphere.materials, sphere.light)
    expected = shown(sphere.reflection, sphere.light, sphere.color, sphere.roughness, sphere.metallic)
    seen = (sphere.weights > 0) & (expected < 1).all(2)
    torch.testing.assert_close(found[seen], expected[seen], atol=5e-3, rtol=0.02)


def test_smoothing_keeps_what_is_even_and_spreads_what_is_not():
    even = torch.full((2 * ROWS**2, 3), 0.7)
    torch.testing.assert_close(smoothed(even, 0.5), even)
    spot = even.clone()
    spot[200] = 7.0
    after = smoothed(spot, 0.1)
    assert after[200, 0] < 7.0
    assert after[201, 0] > 0.7
    assert after.min() > 0
    torch.testing.assert_close(smoothed(spot, 0.0), spot)


def test_a_light_of_a_tint_is_white_on_average_and_pictures_stay():
    light = torch.rand(2 * ROWS**2, 3, generator=torch.Generator().manual_seed(0)) * torch.tensor([1.2, 1.0, 0.8])
    color = torch.tensor([[0.5, 0.4, 0.3]])
    angles = torch.from_numpy(solid_angles(ROWS).reshape(-1))
    white, tinted = grey_world(light, color, angles)
    mean = (white * angles[:, None]).sum(0) / angles.sum()
    torch.testing.assert_close(mean, mean.mean().expand(3))
    torch.testing.assert_close(white * tinted, light * color)


def test_points_of_no_material_do_not_break_the_light():
    sphere = lit_sphere((PLASTIC,), count=20, views=6)
    black = Materials(torch.zeros(20, 3), torch.full((20,), 0.3), torch.zeros(20))
    nothing = torch.zeros_like(sphere.observed)
    light = find_light(sphere.reflection, nothing, sphere.weights, black, sphere.light)
    assert torch.isfinite(light).all()
    assert np.isfinite(Part(sphere.reflection, nothing, sphere.weights, black, torch.arange(20)).cost(light))


def test_a_tint_that_only_one_side_has_fades_and_brightness_stays():
    light = torch.ones(8, 3)
    light[0] = torch.tensor([8.0, 1.0, 1.0])
    after = greyed(light, 0.5)
    torch.testing.assert_close(after.log().mean(1), light.log().mean(1))
    assert 1 < after[0, 0] / after[0, 1] < 8
    torch.testing.assert_close(greyed(light, 0.0), light)


def test_a_tint_that_all_of_a_light_has_stays():
    light = torch.tensor([[2.0, 1.0, 0.5]]) * torch.linspace(0.1, 4, 8)[:, None]
    torch.testing.assert_close(greyed(light, 0.5), light)
