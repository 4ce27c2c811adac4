"""Self-reflection: the paper's form with its known flaws, the stable form on shapes of known answer, gradients."""

from __future__ import annotations

import math

import pytest
import torch

from stages.neural.reflection_network import ReflectionNetwork
from stages.neural.sampling import SdfCache
from stages.neural.terms import reflection as refl


def unit(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.nn.functional.normalize(torch.randn(*shape, 3, generator=torch.Generator().manual_seed(seed)), dim=-1)


def cache_of(sdf, resolution: int = 96) -> SdfCache:
    cache = SdfCache(resolution, "cpu")
    cache.refresh(sdf)
    return cache


def network(features: int = 5) -> ReflectionNetwork:
    return ReflectionNetwork(features, 16, torch.Generator().manual_seed(0))


def test_reflection_keeps_length_and_tangent_and_turns_the_normal_part():
    directions, normals = unit(50), unit(50, seed=1)
    reflected = refl.reflect(directions, normals)
    torch.testing.assert_close(reflected.norm(dim=1), torch.ones(50))
    torch.testing.assert_close((reflected * normals).sum(1), -(directions * normals).sum(1))
    torch.testing.assert_close(torch.cross(reflected, normals, dim=1), torch.cross(directions, normals, dim=1))
    diagonal = torch.tensor([[1.0, 0, -1]]) / math.sqrt(2)
    torch.testing.assert_close(refl.reflect(diagonal, torch.tensor([[0.0, 0, 1]])), diagonal * torch.tensor([1, 1, -1]))


# ---------------------------------------------------------------------- the paper's form
def test_literal_probability_is_the_laplace_cdf_of_the_deepest_sample():
    sdf = torch.tensor([[0.3, 0.1, 0.2], [0.3, -0.1, -0.05]])
    expected = [0.5 * math.exp(-1), 1 - 0.5 * math.exp(-1)]
    assert refl.reflection_probability_literal(sdf).tolist() == pytest.approx(expected)
    assert refl.reflection_probability_literal(sdf, 20.0).tolist()[0] == pytest.approx(0.5 * math.exp(-2))


def test_literal_probability_is_half_as_soon_as_a_ray_begins_on_a_surface():
    """Even on a lone ball, which reflects nothing of itself: why there is a stable form."""
    normals = unit(20)
    distances = torch.linspace(0, 0.1, 16)
    sdf = (0.5 * normals[:, None] + distances[:, None] * normals[:, None]).norm(dim=2) - 0.5
    probability = refl.reflection_probability_literal(sdf)
    torch.testing.assert_close(probability, torch.full((20,), 0.5), atol=1e-5, rtol=0)
    anything = torch.rand(20, 7) * 2 - 1
    anything[:, 0] = 0
    assert (refl.reflection_probability_literal(anything) >= 0.5).all()


def test_literal_probability_has_a_gradient_to_the_sdf():
    sdf = torch.tensor([[0.2, -0.04, 0.1], [0.05, 0.3, 0.2]], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(refl.reflection_probability_literal, sdf)
    refl.reflection_probability_literal(sdf).sum().backward()
    assert (sdf.grad[0, 1] < -1) & (sdf.grad[1, 0] < -1)  # a nearer surface is a likelier mirror image
    assert torch.count_nonzero(sdf.grad) == 2


def test_uniform_points_fill_the_reach():
    points, directions = 0.3 * unit(40), unit(40, seed=1)
    samples = refl.uniform_points(points, directions, 0.1, 64, torch.Generator().manual_seed(0))
    along = ((samples - points[:, None]) * directions[:, None]).sum(2)
    torch.testing.assert_close(points[:, None] + along[..., None] * directions[:, None], samples, atol=1e-5, rtol=0)
    assert (along.min() > -1e-6) & (along.max() < 0.1 + 1e-6)
    assert along.mean().item() == pytest.approx(0.05, abs=0.002)
    even = refl.uniform_points(torch.zeros(1, 3), torch.tensor([[1.0, 0, 0]]), 0.1, 5, None)
    assert even[0, :, 0].tolist() == pytest.approx([0.01, 0.03, 0.05, 0.07, 0.09])


def test_nearest_to_surface_picks_by_magnitude_and_passes_the_gradient_on():
    sdf = torch.tensor([[0.3, -0.1, 0.2], [0.01, -0.1, 0.2]])
    values = torch.arange(12.0).view(2, 3, 2).requires_grad_()
    nearest = refl.nearest_to_surface(sdf, values)
    assert nearest.tolist() == [[2, 3], [6, 7]]
    nearest.sum().backward()
    assert values.grad.sum().item() == 4


# ---------------------------------------------------------------------- the stable form
def test_rays_begin_clear_of_the_blur_and_of_the_voxels():
    assert refl.reflection_start(0.01, 0.002) == pytest.approx(0.04)
    assert refl.reflection_start(0.001, 0.01) == pytest.approx(0.02)


@pytest.mark.parametrize(("resolution", "scale"), [(40, 0.002), (80, 0.002), (80, 0.02)])
def test_a_convex_ball_reflects_nothing_of_itself_at_any_angle(resolution, scale):
    cache = cache_of(lambda p: p.norm(dim=1) - 0.5, resolution)
    normals = unit(2000)
    tangents = torch.nn.functional.normalize(torch.cross(normals, unit(2000, seed=1), dim=1), dim=1)
    lift = torch.linspace(0, math.pi / 2, 2000)[:, None]  # from grazing to straight back
    directions = lift.cos() * tangents + lift.sin() * normals
    probability, _ = refl.trace_reflections(cache, 0.5 * normals, directions, scale, 0.004, 0.1, 16)
    assert probability.max() < 1e-3


def test_a_flat_mirror_does_not_reflect_itself_at_grazing_angles():
    """f is 0 but for rounding along the whole ray: a full blur's opacity, if it counted."""
    noise = 1e-6 * torch.randn(100, 16, generator=torch.Generator().manual_seed(0))
    distances = torch.linspace(0.02, 0.12, 16).expand(100, 16)
    probability, distance = refl.reflection_probability(noise, distances, 0.002)
    assert probability.max() == 0
    assert torch.equal(distance, distances[:, -1])


def test_a_concave_corner_reflects_its_other_wall():
    cache = cache_of(lambda p: torch.minimum(p[:, 0], p[:, 2]))
    away = torch.linspace(0.04, 0.09, 6)  # from the crease
    floor = torch.stack([away, torch.zeros(6), torch.zeros(6)], 1)
    directions = (torch.tensor([[-1.0, 0, 1]]) / math.sqrt(2)).expand(6, 3)
    probability, hits = refl.trace_reflections(cache, floor, directions, 0.002, 0.004, 0.1, 32)
    assert probability.min() > 0.99
    walls = torch.stack([torch.zeros(6), torch.zeros(6), away], 1)
    assert (hits - walls).norm(dim=1).max() < 0.006  # sections of 3e-3, blur of 2e-3
    turned, _ = refl.trace_reflections(cache, floor, directions * torch.tensor([-1, 1, 1]), 0.002, 0.004, 0.1, 32)
    assert turned.max() < 1e-3


def test_one_ball_shows_in_another_within_reach_only():
    for width in (0.08, 0.1, 0.3):
        centers = torch.tensor([[0.0, 0, 0.4 + width / 2], [0, 0, -0.4 - width / 2]])
        cache = cache_of(lambda p, c=centers: torch.cdist(p, c).min(1).values - 0.4, 64)
        below, up = torch.tensor([[0.0, 0, -width / 2]]), torch.tensor([[0.0, 0, 1]])
        probability, hit = refl.trace_reflections(cache, below, up, 0.002, 0.004, 0.1, 16)
        if width < 0.2:
            assert probability.item() > 0.99
            assert hit[0].tolist() == pytest.approx([0, 0, width / 2], abs=0.01)
        else:
            assert probability.item() < 1e-3
            reach = refl.reflection_start(0.002, cache.cell) + 0.1
            assert hit[0].tolist() == pytest.approx([0, 0, reach - width / 2], abs=1e-5)


def test_a_ray_that_begins_inside_the_other_wall_hits_at_once():
    sdf, distances = torch.tensor([[-0.01, -0.03, -0.05]]), torch.tensor([[0.04, 0.06, 0.08]])
    probability, distance = refl.reflection_probability(sdf, distances, 0.002)
    assert probability.item() > 0.99
    assert distance.item() == pytest.approx(0.05, abs=1e-3)


def test_probability_matches_a_slow_loop():
    generator = torch.Generator().manual_seed(0)
    sdf = 0.05 * torch.randn(20, 9, generator=generator, dtype=torch.float64)
    distances = torch.rand(20, 9, generator=generator, dtype=torch.float64).sort(1).values
    probability, distance = refl.reflection_probability(sdf, distances, 0.05)
    share = torch.linspace(0, 1, 4001, dtype=torch.float64)
    for q in range(20):
        left, mean = 1.0, 0.0
        for k in range(8):
            delta = (distances[q, k + 1] - distances[q, k]).item()
            if sdf[q, k] - sdf[q, k + 1] <= 0.05 * delta:
                continue
            line = sdf[q, k] + (sdf[q, k + 1] - sdf[q, k]) * share
            cdf = torch.where(line > 0, 0.5 * torch.exp(-line / 0.05), 1 - 0.5 * torch.exp(line / 0.05))
            alpha = 1 - math.exp(-torch.trapezoid(cdf / 0.05, share).item() * delta)
            mean += left * alpha * (distances[q, k] + distances[q, k + 1]).item() / 2
            left *= 1 - alpha
        assert probability[q].item() == pytest.approx(1 - left, abs=1e-4)
        assert distance[q].item() == pytest.approx(mean / (1 - left), abs=1e-3)


def test_probability_hardly_depends_on_the_number_of_samples():
    """Rays past a ball, from full hits to misses, blurred so that many are in between."""
    impact = torch.linspace(0, 0.2, 300)[:, None]

    def probability(num_samples: int) -> torch.Tensor:
        distances = torch.linspace(0.04, 0.24, num_samples).expand(300, num_samples)
        sdf = torch.sqrt(impact**2 + (distances - 0.14) ** 2) - 0.08
        return refl.reflection_probability(sdf, distances, 0.01)[0]

    fine = probability(512)
    assert (fine > 0.95).any() & (fine < 0.05).any() & ((fine > 0.3) & (fine < 0.7)).any()
    for num_samples in (16, 32, 64):
        difference = (probability(num_samples) - fine).abs()
        assert difference.mean() < 0.01
        assert difference.max() < 0.05


# ---------------------------------------------------------------------- both
def test_compose_blends_by_probability_and_reflectivity():
    color, reflected = torch.tensor([[0.2, 0.4, 0.6]] * 3), torch.tensor([[1.0, 0, 0]] * 3)
    probability = torch.tensor([0.0, 0.5, 1.0])
    paper = refl.compose(color, reflected, probability, 1.0)
    torch.testing.assert_close(paper, torch.tensor([[0.2, 0.4, 0.6], [0.6, 0.2, 0.3], [1, 0, 0]]))
    dim = refl.compose(color, reflected, probability, torch.tensor([0.5, 0.5, 0.0]))
    torch.testing.assert_close(dim, torch.tensor([[0.2, 0.4, 0.6], [0.4, 0.3, 0.45], [0.2, 0.4, 0.6]]))


def test_reflectivity_starts_near_its_floor_and_colours_are_colours():
    net = network()
    features = torch.randn(200, 5, generator=torch.Generator().manual_seed(2))
    rho = net.reflectivity(features, torch.linspace(-1, 1, 200))
    assert rho.shape == (200,)
    assert (rho > 0.005).all() & (rho < 0.08).all()
    assert rho.mean().item() == pytest.approx(0.02, abs=0.005)
    colors = net(0.5 * unit(200), unit(200), unit(200, seed=1))
    assert colors.shape == (200, 3)
    assert (colors > 0).all() & (colors < 1).all()
    assert torch.equal(network().color_layers[0].weight, net.color_layers[0].weight)  # the seed decides


@pytest.mark.parametrize("seen", [True, False])
def test_gradient_reaches_colour_and_reflectivity_where_something_is_reflected_only(seen):
    net = network()
    features = torch.randn(30, 5, generator=torch.Generator().manual_seed(2))
    normals, directions = unit(30), unit(30, seed=1)
    probability = torch.full((30,), 0.7) if seen else torch.zeros(30)
    rho = net.reflectivity(features, (normals * directions).sum(1))
    composed = refl.compose(torch.full((30, 3), 0.1), net(0.5 * normals, normals, directions), probability, rho)
    (composed - 0.9).square().sum().backward()
    for name, parameter in net.named_parameters():
        assert parameter.grad is not None, name
        assert (parameter.grad.abs().max() > 0) == seen, name


def test_paper_form_carries_the_colour_error_to_the_sdf():
    sdf = torch.tensor([[0.02, 0.05, 0.08]], requires_grad=True)
    probability = refl.reflection_probability_literal(sdf)
    refl.compose(torch.zeros(1, 3), torch.ones(1, 3), probability, 1.0).sum().backward()
    assert sdf.grad[0, 0].item() == pytest.approx(-3 * 10 * 0.5 * math.exp(-0.2), rel=1e-4)
