"""Each loss: known zeros, known non-zeros, gradients; schedules at their ends."""

from __future__ import annotations

import math

import pytest
import torch

from stages.neural import losses, schedules
from stages.neural.terms import eikonal, planar


def test_rgb_error_is_the_colour_distance():
    predicted, observed = torch.tensor([[0.3, 0.4, 0.0], [0.2, 0.2, 0.2]]), torch.tensor([[0.0, 0, 0], [0.2] * 3])
    assert losses.rgb_error(predicted, observed).tolist() == pytest.approx([0.5, 0.0], abs=1e-3)


def test_rgb_error_has_a_finite_gradient_at_zero_and_unit_slope_away():
    predicted = torch.tensor([[0.2, 0.2, 0.2], [0.7, 0.2, 0.2]], requires_grad=True)
    losses.rgb_error(predicted, torch.full((2, 3), 0.2)).sum().backward()
    assert predicted.grad[0].tolist() == [0, 0, 0]
    assert predicted.grad[1].tolist() == pytest.approx([1, 0, 0], abs=1e-4)


def test_eikonal_error_is_zero_on_unit_gradients_only():
    gradients = torch.tensor([[0.0, 1, 0], [0, 0, 3], [0, 0.5, 0]], requires_grad=True)
    error = losses.eikonal_error(gradients)
    assert error.tolist() == pytest.approx([0, 4, 0.25])
    error.sum().backward()
    assert gradients.grad[1].tolist() == pytest.approx([0, 0, 4])


def test_sparse_points_pull_evenly_beyond_the_tolerance():
    sdf = torch.tensor([0.0, 0.001, -0.1, 0.4], requires_grad=True)
    error = losses.sparse_point_error(sdf, 0.01)
    assert error.tolist() == pytest.approx([0, 0.001**2 / 0.02, 0.095, 0.395])
    error.sum().backward()
    assert sdf.grad.tolist() == pytest.approx([0, 0.1, -1, 1])


def test_relaxation_is_one_on_met_photos_and_bounded_below():
    error = torch.tensor([0.0, 0.1, 0.2, 5.0], requires_grad=True)
    omega = eikonal.eikonal_relaxation(error)
    expected = [1, 0.2 + 0.8 * math.exp(-0.5), *[0.2 + 0.8 * math.exp(-1)] * 2]
    assert omega.tolist() == pytest.approx(expected)
    assert not omega.requires_grad
    assert eikonal.eikonal_relaxation(torch.zeros(1), planarity=0.0).item() == pytest.approx(0.6)


def test_relaxation_listens_to_gamma_and_clip_and_detaches_the_planarity():
    planarity = torch.tensor([0.5], requires_grad=True)
    omega = eikonal.eikonal_relaxation(torch.tensor([0.3]), planarity, gamma=2.0, clip=0.25)
    assert omega.item() == pytest.approx(0.2 + 0.8 * math.exp(-0.5) * 0.75)
    assert not omega.requires_grad


def test_literal_relaxation_is_the_paper_s_product_and_differentiable_in_both():
    error = torch.tensor([0.0, 0.1, 0.3], requires_grad=True)
    planarity = torch.tensor([1.0, 0.4, 0.4], requires_grad=True)
    omega = eikonal.eikonal_relaxation_literal(error, planarity, gamma=5.0, clip=0.2)
    assert omega.tolist() == pytest.approx([1, 0.4 * math.exp(-0.5), 0.4 * math.exp(-1)])
    omega.sum().backward()
    assert error.grad.tolist() == pytest.approx([-5, -2 * math.exp(-0.5), 0])  # none beyond the clip
    assert planarity.grad.tolist() == pytest.approx([1, math.exp(-0.5), math.exp(-1)])


def test_literal_relaxation_lets_the_eikonal_term_vanish():
    # Features a unit apart: lambda_pla = 1e-3 / 1.001. A gradient of length 2, wrong by all there is, then costs 1e-3.
    features = torch.nn.functional.one_hot(torch.zeros(16, 4, dtype=torch.long), 8).float()
    flat = planar.planarity_literal(features, torch.zeros(16, 8)).mean(1)
    assert flat.tolist() == pytest.approx([1e-3 / 1.001] * 16)
    error, photo_error = losses.eikonal_error(torch.tensor([[0.0, 0, 2]]).expand(16, 3)), torch.full((16,), 0.05)
    literal = (eikonal.eikonal_relaxation_literal(photo_error, flat) * error).mean().item()
    assert literal == pytest.approx(1e-3 / 1.001 * math.exp(-0.25))  # 7.8e-4
    stable = (
        eikonal.eikonal_relaxation(photo_error, planar.planarity(features, torch.zeros(16, 8)).mean(1)) * error
    ).mean()
    assert stable.item() == pytest.approx(0.2 + 0.8 * math.exp(-0.25) * 0.75)  # 0.67: the median weight is 1/2


def test_bending_is_nothing_between_equal_normals_and_counts_an_edge_like_a_chord():
    up, aside = torch.tensor([[0.0, 0, 1]]), torch.tensor([[1.0, 0, 0]])
    assert planar.bending_error(up, up).tolist() == [0]
    assert planar.bending_error(up, aside).item() == pytest.approx(math.sqrt(2), abs=0.01)


def test_bending_pulls_normals_together_also_where_they_nearly_agree():
    normal = torch.tensor([[0.02, 0, 1]], requires_grad=True)
    planar.bending_error(normal, torch.tensor([[0.0, 0, 1]])).sum().backward()
    assert normal.grad[0, 0].item() == pytest.approx(2 / math.sqrt(5))


def test_evenness_is_one_where_colours_are_equal_and_fades_over_a_few_grey_levels():
    difference = torch.tensor([0.0, 0.02, 0.2])
    assert planar.evenness(difference).tolist() == pytest.approx([1, math.exp(-1), math.exp(-10)])


def test_literal_planar_error_is_zero_on_a_plane_through_x_0_and_not_on_one_beside_it():
    generator = torch.Generator().manual_seed(0)
    offsets = 0.1 * (torch.rand(5, 8, 3, generator=generator) - 0.5)
    normals = torch.nn.functional.normalize(torch.randn(5, 3, generator=generator), dim=1)
    plane = torch.einsum("qc,qkc->qk", normals, offsets)
    assert planar.planar_error_literal(plane, normals, offsets).max() < 1e-5
    beside = planar.planar_error_literal(plane + 1e-3, normals, offsets)
    torch.testing.assert_close(beside, 1e-3 / offsets.norm(dim=2), rtol=1e-3, atol=1e-5)


def test_literal_planar_error_weighs_an_error_by_the_inverse_length():
    sdf = torch.tensor([[0.02, -0.03]], requires_grad=True)
    offsets, normals = torch.tensor([[[0.04, 0, 0], [0, 0, -0.01]]]), torch.tensor([[0.0, 0, 1]])
    error = planar.planar_error_literal(sdf, normals, offsets)
    assert error[0].tolist() == pytest.approx([0.5, 2.0])
    error.sum().backward()
    assert sdf.grad[0].tolist() == pytest.approx([25, -100])


def test_literal_planar_error_is_finite_at_x_0_itself():
    sdf = torch.tensor([[1e-3, 0.0]], requires_grad=True)
    offsets = torch.zeros(1, 2, 3, requires_grad=True)
    error = planar.planar_error_literal(sdf, torch.tensor([[0.0, 0, 1]]), offsets)
    assert error[0].tolist() == pytest.approx([1e6, 0])
    error.sum().backward()
    assert sdf.grad.isfinite().all()
    assert offsets.grad.isfinite().all()


def test_literal_planar_terms_agree_with_finite_differences():
    generator = torch.Generator().manual_seed(1)
    sdf, normals, offsets, features, center = (
        torch.randn(*shape, generator=generator, dtype=torch.float64, requires_grad=True)
        for shape in ((3, 4), (3, 3), (3, 4, 3), (3, 4, 5), (3, 5))
    )
    assert torch.autograd.gradcheck(planar.planar_error_literal, (sdf, normals, offsets))
    assert torch.autograd.gradcheck(lambda f, c: planar.planarity_literal(f, c, 0.5), (features, center))


def test_literal_planarity_is_one_for_equal_features_and_pulls_others_apart():
    features = torch.tensor([[[0.0], [1e-3], [1.0]]], requires_grad=True)
    weight = planar.planarity_literal(features, torch.zeros(1, 1))
    assert weight[0].tolist() == pytest.approx([1, 0.5, 1e-3 / 1.001])
    weight.sum().backward()
    assert features.grad[0, :, 0].tolist() == pytest.approx([0, -250, -1e-3 / 1.001**2])


def test_planarity_is_one_for_equal_features_and_half_at_the_median():
    features = torch.tensor([[[0.0], [1.0], [3.0]]])
    weight = planar.planarity(features.requires_grad_(), torch.zeros(1, 1))
    assert weight[0].tolist() == pytest.approx([1, 0.5, 0.25])
    assert not weight.requires_grad


def test_free_and_solid_places_are_pushed_to_their_side_of_the_surface():
    sdf = torch.tensor([0.02, 0.0, -0.01], requires_grad=True)
    outside, inside = losses.outside_error(sdf, 0.005), losses.inside_error(sdf, 0.005)
    assert outside.tolist() == pytest.approx([0, 0.005, 0.015])
    assert inside.tolist() == pytest.approx([0.025, 0.005, 0])
    outside.sum().backward()
    assert sdf.grad.tolist() == [0, -1, -1]
    sdf.grad = None
    inside.sum().backward()
    assert sdf.grad.tolist() == [1, 1, 0]


def test_mask_error_pulls_the_opacity_towards_the_mask():
    opacity = torch.tensor([0.9, 0.9], requires_grad=True)
    error = losses.mask_error(opacity, torch.tensor([1.0, 0.0]))
    assert error.tolist() == pytest.approx([-math.log(0.9), -math.log(0.1)], rel=1e-4)
    error.sum().backward()
    assert opacity.grad[0] < 0 < opacity.grad[1]


def test_exposure_error_is_zero_without_gain():
    log_gains = torch.tensor([[0.0, 0, 0], [0.1, 0, -0.2]])
    assert losses.exposure_error(log_gains).sum(1).tolist() == pytest.approx([0, 0.05])


def test_schedules_meet_their_ends():
    assert schedules.exponential(0, 0.1, 0.001) == pytest.approx(0.1)
    assert schedules.exponential(0.5, 0.1, 0.001) == pytest.approx(0.01)
    assert schedules.exponential(2, 0.1, 0.001) == pytest.approx(0.001)
    assert [schedules.fade_out(p, 0.5) for p in (0, 0.25, 0.5, 1)] == [1, 0.5, 0, 0]
    assert schedules.fade_out(0.3, 0) == 0
    rates = [schedules.warm_up_then_decay(p, 0.1, 0.05) for p in (0, 0.05, 0.1, 1)]
    assert rates == pytest.approx([0, 0.5, 1, 0.05])
    assert [schedules.active_levels(p, 8, 4, 0.5) for p in (0, 0.11, 0.49, 0.5, 1)] == [4, 5, 8, 8, 8]
