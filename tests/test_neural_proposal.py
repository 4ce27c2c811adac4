"""The proposal sampler: its draws, its loss against a slow loop, where its gradient goes, and that it learns."""

from __future__ import annotations

import pytest
import torch

from stages.neural import proposal as prop
from stages.neural.rendering import sample_optical_depths, weights_from_optical_depth
from stages.neural.sampling import Rays, intersect_unit_sphere, invert_cdf, stratified


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def network() -> prop.ProposalNetwork:
    return prop.ProposalNetwork(seeded())


def random_rays(count: int, seed: int = 0) -> Rays:
    """Rays from radius 2.5 at places within 0.25 of the centre."""
    generator = seeded(seed)
    origins = 2.5 * torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=1)
    targets = 0.5 * torch.rand(count, 3, generator=generator) - 0.25
    directions = torch.nn.functional.normalize(targets - origins, dim=1)
    entry, leave, _ = intersect_unit_sphere(origins, directions)
    return Rays(origins, directions, entry, leave)


def histogram(rows: int, bins: int, seed: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Random edges of [0, 1] and weights with a sum below 1, float64."""
    generator = seeded(seed)
    inner = torch.rand(rows, bins - 1, generator=generator, dtype=torch.float64).sort(1).values
    edges = torch.nn.functional.pad(torch.nn.functional.pad(inner, (1, 0)), (0, 1), value=1.0)
    weights = torch.rand(rows, bins, generator=generator, dtype=torch.float64)
    return edges, 0.9 * weights / weights.sum(1, keepdim=True)


def test_edges_ascend_from_entry_to_leave():
    entry, leave = torch.tensor([1.0, 2.0]), torch.tensor([2.0, 4.0])
    rays = Rays(torch.zeros(2, 3), torch.zeros(2, 3), entry, leave)
    edges = prop.stratified_edges(rays, 8, seeded())
    assert (edges[:, 1:] > edges[:, :-1]).all()
    assert torch.equal(edges[:, 0], entry)
    torch.testing.assert_close(edges[:, -1], leave)
    even = prop.stratified_edges(rays, 8, None)
    torch.testing.assert_close(even[0], torch.linspace(1, 2, 9))
    assert ((edges - even).abs() <= (leave - entry)[:, None] / 16).all()


def test_draws_follow_the_histogram():
    edges = torch.tensor([[0.0, 0.1, 0.5, 1.0]]).expand(50, 4)
    weights = torch.tensor([[0.2, 0.0, 0.6]]).expand(50, 3)
    distances = invert_cdf(edges, weights, stratified(50, 400, seeded(), edges.device))
    assert (distances[:, 1:] >= distances[:, :-1]).all()
    assert (distances < 0.1).float().mean().item() == pytest.approx(0.25, abs=0.01)
    assert ((distances > 0.1) & (distances < 0.5)).float().mean() < 1e-3
    late = distances[distances > 0.5]
    assert late.mean().item() == pytest.approx(0.75, abs=0.01)  # even inside an interval
    fixed = [invert_cdf(edges, weights, stratified(50, 8, None, edges.device)) for _ in range(2)]
    assert torch.equal(*fixed)
    torch.testing.assert_close(fixed[0][0, :2], torch.tensor([0.025, 0.075]))


def test_proposal_samples_are_sorted_detached_and_inside():
    rays = random_rays(20)
    distances, edges, weights = prop.proposal_distances(network(), rays, 32, 16, seeded())
    assert distances.shape == (20, 16)
    assert edges.shape == (20, 33)
    assert weights.shape == (20, 32)
    assert (distances[:, 1:] >= distances[:, :-1]).all()
    assert (distances >= rays.entry[:, None] - 1e-5).all() & (distances <= rays.leave[:, None] + 1e-5).all()
    assert weights.requires_grad
    assert not distances.requires_grad
    assert (weights >= 0).all() & (weights.sum(1) <= 1 + 1e-5).all()
    assert weights[:, -8:].min() > 1e-4  # thin at first: the far side is looked at too


def test_stretches_meet_half_way():
    edges = prop.sample_edges(torch.tensor([[1.0, 2, 4, 5]]))
    assert edges.tolist() == [[1, 1.5, 3, 4.5, 5]]


def test_interlevel_loss_matches_a_slow_loop():
    edges, weights = histogram(10, 7, seed=0)
    proposal_edges, proposal_weights = histogram(10, 5, seed=1)
    loss = prop.interlevel_loss(edges, weights, proposal_edges, 0.5 * proposal_weights)
    for r in range(10):
        expected = 0.0
        for k in range(7):
            bound = 0.0
            for j in range(5):
                overlaps = proposal_edges[r, j] < edges[r, k + 1] and proposal_edges[r, j + 1] > edges[r, k]
                bound += 0.5 * proposal_weights[r, j].item() if overlaps else 0.0
            w = weights[r, k].item()
            expected += max(0.0, w - bound) ** 2 / (w + 1e-5)
        assert loss[r].item() == pytest.approx(expected, rel=1e-6, abs=1e-12)
    assert loss.max() > 1e-3


def test_interlevel_loss_is_zero_where_the_proposal_holds_enough():
    edges, weights = histogram(10, 12, seed=0)
    coarse_edges, coarse_weights = edges[:, ::3].contiguous(), weights.view(10, 4, 3).sum(2)
    assert prop.interlevel_loss(edges, weights, coarse_edges, coarse_weights).max() < 1e-12
    assert prop.interlevel_loss(edges, weights, edges, weights).max() < 1e-12
    missing = torch.zeros(10, 12, dtype=torch.float64)
    torch.testing.assert_close(prop.interlevel_loss(edges, weights, edges, missing), weights.sum(1), rtol=1e-3, atol=0)


def test_interlevel_gradient_goes_to_the_proposal_only():
    edges, weights = histogram(4, 6, seed=0)
    proposal_edges, proposal_weights = histogram(4, 5, seed=1)
    weights.requires_grad_()
    small = (0.3 * proposal_weights).requires_grad_()
    prop.interlevel_loss(edges, weights, proposal_edges, small).sum().backward()
    assert weights.grad is None
    assert (small.grad <= 0).all()  # more weight where it was short, never less
    assert small.grad.min() < -0.1
    free = lambda w: prop.interlevel_loss(edges, weights, proposal_edges, w)  # noqa: E731
    assert torch.autograd.gradcheck(free, small)


def test_every_step_learns_at_first_then_every_fifth():
    learning = [step for step in range(24) if prop.updates_now(step, 8)]
    assert learning == [*range(8), 10, 15, 20]
    assert [step for step in range(9) if prop.updates_now(step, 0, every=4)] == [0, 4, 8]


def test_a_few_steps_gather_the_samples_at_a_ball():
    net, radius, generator = network(), 0.5, seeded(3)
    optimizer = torch.optim.Adam(net.parameters(), lr=5e-3)

    def at_surface(count: int, seed: int) -> tuple[torch.Tensor, torch.Tensor]:
        """Part of the samples within 0.06 of the ball's front, and the mean interlevel loss."""
        rays = random_rays(count, seed)
        distances, edges, weights = prop.proposal_distances(net, rays, 32, 16, generator)
        sdf = rays.at(distances).norm(dim=2) - radius
        rendered, _ = weights_from_optical_depth(sample_optical_depths(sdf, distances, 0.02))
        closest = -(rays.origins * rays.directions).sum(1, keepdim=True)
        front = (sdf.abs() < 0.06) & (distances < closest)
        loss = prop.interlevel_loss(prop.sample_edges(distances), rendered, edges, weights).mean()
        return front.float().mean(), loss

    before, loss_before = at_surface(64, 100)
    for step in range(40):
        _, loss = at_surface(48, step)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    after, loss_after = at_surface(64, 100)
    assert before < 0.12  # about the even spread
    assert after > 4 * before
    assert loss_after < 0.2 * loss_before
