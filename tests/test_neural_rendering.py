"""Density, rendering weights and samples against closed forms, quadrature and slow loops."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from stages.neural.density import laplace_density, section_optical_depth
from stages.neural.rendering import (
    composite,
    ray_means,
    rendering_weights,
    sample_optical_depths,
    weights_from_optical_depth,
)
from stages.neural.sampling import (
    Rays,
    SdfCache,
    importance_distances,
    importance_distances_reference,
    intersect_unit_sphere,
    stratified,
)
from stages.neural.schedules import even_steps, fade_in


def test_laplace_density_at_known_places():
    b = 0.1
    density = laplace_density(torch.tensor([0.0, -100.0, 100.0, b]), b)
    expected = torch.tensor([0.5 / b, 1 / b, 0.0, 0.5 * math.exp(-1) / b])
    torch.testing.assert_close(density, expected)


@given(start=st.floats(-1, 1), end=st.floats(-1, 1), scale=st.floats(1e-2, 0.5), delta=st.floats(1e-3, 2))
def test_optical_depth_is_the_integral_of_the_density(start, end, scale, delta):
    t = torch.linspace(0, 1, 20001, dtype=torch.float64)
    brute = torch.trapezoid(laplace_density(start + (end - start) * t, scale), t) * delta
    as64 = [torch.tensor(v, dtype=torch.float64) for v in (start, end, delta)]
    closed = section_optical_depth(as64[0], as64[1], as64[2], scale)
    assert closed.item() == pytest.approx(brute.item(), rel=2e-3, abs=1e-7)


def test_optical_depth_has_a_gradient_even_where_the_sdf_is_flat():
    start = torch.full((1,), 1e-4, requires_grad=True)
    depth = section_optical_depth(start, torch.zeros(1), torch.ones(1), 0.1)
    depth.sum().backward()
    # d/df of Psi(-f)/b at f = 0 is -1 / (2 b^2); the start holds half of the middle's share.
    assert start.grad.item() == pytest.approx(-0.5 * 0.5 / 0.1**2, rel=1e-2)


def test_weights_match_a_slow_loop_and_sum_to_one():
    tau = torch.rand(5, 7, generator=torch.Generator().manual_seed(0)) * 2
    weights, left = weights_from_optical_depth(tau)
    for r in range(5):
        transmittance = 1.0
        for k in range(7):
            alpha = 1 - math.exp(-tau[r, k].item())
            assert weights[r, k].item() == pytest.approx(transmittance * alpha, abs=1e-6)
            transmittance *= 1 - alpha
        assert left[r].item() == pytest.approx(transmittance, abs=1e-6)
    torch.testing.assert_close(weights.sum(1) + left, torch.ones(5))


@pytest.mark.parametrize("scale", [0.1, 0.02, 0.001])
@pytest.mark.parametrize("outlined_part", [0.0, 0.3, 1.0])
def test_the_kernel_weighs_samples_and_pulls_on_f_as_the_reference_does(scale, outlined_part):
    generator = torch.Generator().manual_seed(0)
    distances = torch.sort(1.5 * torch.rand(200, 16, generator=generator), 1).values
    sdf = 0.4 - distances + 0.05 * torch.randn(200, 16, generator=generator)
    sdf[:20], sdf[20:30] = 0.01 * torch.randn(20, 16, generator=generator), -0.02  # grazing, and flat inside
    pull = torch.randn(200, 17, generator=generator)
    outlined = outlined_part * torch.linspace(0, 1, 16).expand(200, 16)
    results = []
    for precision in (torch.float32, torch.float64):  # the kernel takes the first
        f = sdf.to(precision, copy=True).requires_grad_()
        weights, left = rendering_weights(f, distances.to(precision), scale, outlined.to(precision))
        ((weights * pull[:, :16]).sum() + (left * pull[:, 16]).sum()).backward()
        results.append((weights.float(), left.float(), f.grad.float()))
    (weights, left, gradient), (expected_weights, expected_left, expected_gradient) = results
    torch.testing.assert_close(weights, expected_weights, rtol=0, atol=1e-6)
    torch.testing.assert_close(left, expected_left, rtol=0, atol=1e-6)
    largest = float(expected_gradient.abs().max())
    assert largest > 1
    torch.testing.assert_close(gradient, expected_gradient, rtol=0, atol=2e-5 * largest)


@pytest.mark.parametrize("num_samples", [8, 16, 200])
def test_a_wall_is_rendered_where_it_stands_whatever_the_samples(num_samples):
    distances = torch.linspace(0, 2, num_samples)[None]
    weights, left = weights_from_optical_depth(sample_optical_depths(1.0 - distances, distances, 0.01))
    depth = (weights * distances).sum()
    assert left.item() < 1e-6
    assert depth.item() == pytest.approx(1.0, abs=0.6 * 2 / (num_samples - 1) + 0.01)


def test_a_near_miss_stays_transparent_with_few_samples():
    distances = torch.tensor([[0.0, 0.7, 1.5, 2.0]])
    _, left = weights_from_optical_depth(sample_optical_depths(torch.full((1, 4), 0.1), distances, 0.005))
    assert left.item() > 0.999


def test_the_outline_of_a_ball_is_where_its_surface_is():
    """Opacity of rays that pass beside the surface of a ball: 3 b from it, it is a half by the density alone."""
    radius, scale = 0.3, 0.002
    beside = torch.tensor([-1.0, 1.0, 2.5, 6.0]) * scale
    along = torch.linspace(-0.5, 0.5, 4001)
    f = (along**2 + (radius + beside[:, None]) ** 2).sqrt() - radius
    distances = along.expand(4, -1)
    assert _opacity(f, distances, scale, 0.0) == pytest.approx([1, 1, 0.71, 0.04], abs=0.02)
    # 1 - exp(-exp(-f / b)) outside: the density's integral over f, to the surface and away from it
    assert _opacity(f, distances, scale, 1.0) == pytest.approx([1, 0.31, 0.08, 0.002], abs=0.01)


def test_what_is_solid_lets_no_light_through_where_f_is_even():
    distances = torch.linspace(0, 1, 101)[None]
    for part in (0.0, 1.0):
        assert _opacity(torch.full_like(distances, -0.001), distances, 0.002, part) == pytest.approx([1])
    assert _opacity(torch.full_like(distances, 0.001), distances, 0.002, 1.0) == pytest.approx([0])


def _opacity(f: torch.Tensor, distances: torch.Tensor, scale: float, outlined: float) -> list[float]:
    tau = sample_optical_depths(f, distances, scale, torch.full_like(f, outlined))
    opacity: list[float] = (1 - weights_from_optical_depth(tau)[1]).tolist()
    return opacity


def test_outlines_come_in_evenly():
    assert [fade_in(progress, 0.3, 0.6) for progress in (0.0, 0.3, 0.45, 0.6, 1.0)] == pytest.approx([0, 0, 0.5, 1, 1])
    assert [fade_in(progress, 0.3, 0.3) for progress in (0.29, 0.3)] == [0, 1]


def test_composite_is_the_weighted_sum():
    weights, values = torch.tensor([[0.25, 0.5]]), torch.tensor([[[1.0, 0, 2], [0, 1, 2]]])
    torch.testing.assert_close(composite(weights, values), torch.tensor([[0.25, 0.5, 1.5]]))


def test_unit_sphere_hits_misses_and_cameras_inside():
    origins = torch.tensor([[0.0, 0, -3], [0, 2, -3], [0, 0, 0], [0, 0, 3]])
    directions = torch.tensor([[0.0, 0, 1]] * 4)
    entry, leave, hit = intersect_unit_sphere(origins, directions)
    assert hit.tolist() == [True, False, True, False]
    assert (entry[0].item(), leave[0].item()) == (pytest.approx(2), pytest.approx(4))
    assert (entry[2].item(), leave[2].item()) == (pytest.approx(0.02), pytest.approx(1))


def sphere_cache(resolution: int = 48, radius: float = 0.5) -> SdfCache:
    cache = SdfCache(resolution, "cpu")
    cache.refresh(lambda p: torch.linalg.vector_norm(p, dim=1) - radius)
    return cache


def test_cache_reads_back_what_was_written():
    points = torch.rand(500, 3, generator=torch.Generator().manual_seed(0)) * 1.2 - 0.6
    expected = torch.linalg.vector_norm(points, dim=1) - 0.5
    assert (sphere_cache().lookup(points) - expected).abs().max() < 0.02
    axis = torch.tensor([[0.5, 0, 0], [0, 0.25, 0], [0, 0, -0.75]])  # tells the axes apart
    cache = SdfCache(33, "cpu")
    cache.refresh(lambda p: p[:, 0] + 10 * p[:, 1] + 100 * p[:, 2])
    torch.testing.assert_close(cache.lookup(axis), torch.tensor([0.5, 2.5, -75]), rtol=1e-4, atol=1e-4)


def test_the_lookup_kernel_reads_what_grid_sample_reads_outside_the_cube_too():
    cache = SdfCache(20, "cpu")
    generator = torch.Generator().manual_seed(0)
    cache.values.copy_(torch.randn(cache.values.shape, generator=generator))
    points = torch.rand(7, 300, 3, generator=generator) * 3 - 1.5
    found = cache.lookup(points)
    assert found.shape == (7, 300)
    torch.testing.assert_close(found, cache.lookup_reference(points), rtol=1e-4, atol=1e-4)


def test_band_refresh_touches_only_the_neighbourhood_of_the_surface():
    cache = sphere_cache()
    far = cache.values.clone()
    count = cache.refresh(lambda p: torch.full((len(p),), 9.0), band=2 * cache.cell)
    assert 0 < count < 0.4 * cache.values.numel()
    renewed, near = (values.view(-1)[cache.inside] for values in (cache.values == 9.0, far.abs() < 2 * cache.cell))
    assert torch.equal(renewed, near)


@pytest.mark.parametrize("resolution", [9, 24])
def test_the_cache_holds_all_that_is_read_within_the_unit_sphere_and_little_more(resolution):
    cache = SdfCache(resolution, "cpu")
    count = cache.refresh(lambda p: torch.full((len(p),), 9.0))
    ball = torch.nn.functional.normalize(torch.randn(5000, 3, generator=torch.Generator().manual_seed(0)), dim=1)
    torch.testing.assert_close(
        cache.lookup(ball), torch.full((5000,), 9.0)
    )  # all eight corners of the cells that the sphere passes through
    assert count == (cache.values == 9.0).sum() < 0.9 * cache.values.numel()
    corner = cache.values[0, 0, 0, 0, 0].item()
    assert corner == pytest.approx(3**0.5 - 1)


def test_samples_gather_at_the_surface_sorted_inside_the_interval():
    cache = sphere_cache()
    origins, directions = torch.tensor([[0.0, 0, -2]]).expand(64, 3), torch.tensor([[0.0, 0, 1]]).expand(64, 3)
    entry, leave, _ = intersect_unit_sphere(origins, directions)
    rays, generator = Rays(origins, directions, entry, leave), torch.Generator().manual_seed(0)
    distances = importance_distances(cache, rays, 16, 0.01, generator)
    assert (distances[:, 1:] >= distances[:, :-1]).all()
    assert (distances >= entry[:, None] - 1e-5).all()
    assert (distances <= leave[:, None] + 1e-5).all()
    near = ((distances - 1.5).abs() < 0.1).float().mean()
    assert near > 0.7  # the surface is at 1.5; an even spread would have 0.1
    assert (distances.max() - distances.min()) > 1.0  # and some look elsewhere
    fixed = [importance_distances(cache, rays, 16, 0.01, None) for _ in range(2)]
    assert torch.equal(*fixed)


@pytest.mark.parametrize("scale", [0.02, 0.1])
def test_the_sampling_kernel_agrees_with_the_reference(scale):
    """Rays through the ball, past it, and from a camera inside the sphere; random strata and even ones."""
    cache, cache64, draws = sphere_cache(), sphere_cache(), torch.Generator().manual_seed(0)
    cache64.values = cache64.values.double()
    origins = torch.nn.functional.normalize(torch.randn(200, 3, generator=draws), dim=1) * 2
    origins[:20] *= 0.4
    targets = 0.4 * torch.randn(200, 3, generator=draws)
    directions = torch.nn.functional.normalize(targets - origins, dim=1)
    entry, leave, hit = intersect_unit_sphere(origins, directions)
    rays = [tensor[hit] for tensor in (origins, directions, entry, leave)]
    for seed in (None, 1):
        first, second = (None if seed is None else torch.Generator().manual_seed(seed) for _ in range(2))
        got = importance_distances(cache, Rays(*rays), 16, scale, first)
        places = stratified(len(rays[0]), 16, second, torch.device("cpu"))
        # In float64: a grazing ray's weights are near the rounding error of its transmittance in float32.
        rays64 = Rays(*(tensor.double() for tensor in rays))
        expected = importance_distances_reference(cache64, rays64, places.double(), max(scale, 0.5 * cache.cell))
        torch.testing.assert_close(got.double(), expected, rtol=0, atol=1e-4)
        assert (got - expected).abs().median() < 1e-6


def test_half_of_the_laplace_depth_lies_on_each_side_of_a_wall():
    """Optical depth up to f = 0 is 1/2 at normal incidence: the density's known bias, stated in the maths page."""
    distances = torch.linspace(0, 1, 4001, dtype=torch.float64)[None]
    tau = sample_optical_depths(1.0 - distances, distances, 0.02)
    assert tau.sum().item() == pytest.approx(0.5, rel=1e-3)
    assert np.isfinite(tau.numpy()).all()


# ---------------------------------------------------------------- one colour a ray
def ray_values(num_rays: int = 5, num_samples: int = 7) -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    points, gradients, features = (torch.randn(num_rays * num_samples, n, generator=generator) for n in (3, 3, 4))
    weights = torch.rand(num_rays, num_samples, generator=generator) / num_samples
    values = {"weights": weights, "points": points, "gradients": gradients, "features": features}
    return {name: value.requires_grad_() for name, value in values.items()}


def test_means_over_rays_match_a_slow_loop():
    values = ray_values()
    opacity, points, normals, features = ray_means(**values)
    for r in range(5):
        weights, rows = values["weights"][r], range(7 * r, 7 * r + 7)
        total = sum(weights)
        torch.testing.assert_close(opacity[r, 0], total)
        units = [values["gradients"][row] / values["gradients"][row].norm() for row in rows]
        normal = sum(weight * unit for weight, unit in zip(weights, units, strict=True))
        torch.testing.assert_close(normals[r], normal / normal.norm())
        for means, name in ((points, "points"), (features, "features")):
            summed = sum(weight * values[name][row] for weight, row in zip(weights, rows, strict=True))
            torch.testing.assert_close(means[r], summed / total)


def test_the_means_of_one_sample_are_it_and_pull_at_all_they_are_made_of():
    values = ray_values(5, 1)
    opacity, points, normals, features = ray_means(**values)
    torch.testing.assert_close((opacity, points, features), tuple(values[n] for n in ("weights", "points", "features")))
    torch.testing.assert_close(normals, torch.nn.functional.normalize(values["gradients"], dim=1))
    (opacity * torch.cat([points**2, normals, features], 1)).sum().backward()
    assert all(value.grad.abs().max() > 0 for value in values.values())


def test_the_means_of_a_ray_that_meets_nothing_have_finite_gradients():
    values = ray_values()
    weights = torch.zeros(5, 7, requires_grad=True)
    opacity, *means = ray_means(**{**values, "weights": weights})
    assert opacity.abs().max() == 0
    assert all(mean.abs().max() == 0 for mean in means)
    (opacity * torch.cat(means, 1)).sum().backward()
    assert torch.isfinite(weights.grad).all()
    none = ray_means(torch.zeros(0, 7), torch.zeros(0, 3), torch.zeros(0, 3), torch.zeros(0, 4))
    assert [tuple(part.shape) for part in none] == [(0, 1), (0, 3), (0, 3), (0, 4)]


def test_samples_get_fewer_in_even_steps():
    counts = [even_steps(i / 100, 16, 8, 0.3, 0.9) for i in range(101)]
    assert counts[:31] == [16] * 31
    assert counts[90:] == [8] * 11
    assert counts[60] == 12
    assert sorted(set(counts), reverse=True) == list(range(16, 7, -1))
    assert [even_steps(p, 16, 8, 0.3, 0.3) for p in (0.3, 0.31)] == [16, 8]
