"""A proposal network that says where on a ray to look (mip-NeRF 360, sec. 3; the paper's sampler, after nerfacc).

A small network's density guides the samples; it learns from the rendering weights found there, never from colours.
Shapes: R rays, P proposal intervals and K samples a ray, N points. Distances are along the ray, scene units.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

from stages.neural.appearance import positional_encoding
from stages.neural.mlp import mlp
from stages.neural.rendering import weights_from_optical_depth
from stages.neural.sampling import EVEN_SHARE, Rays, invert_cdf, stratified

if TYPE_CHECKING:
    from jaxtyping import Float

# Frequencies of the position's encoding; the finest has a period of 1/16 scene unit, about two of 64 intervals.
_FREQUENCIES = 6
# The density is this many times a softplus, as walls need hundreds per unit; it begins thin, so that the first rays
# look at all of their length.
_DENSITY_GAIN, _DENSITY_BIAS = 10.0, -2.5
# Keeps the loss finite where a sample has no weight.
_WEIGHT_EPSILON = 1e-5


class ProposalNetwork(nn.Module):
    """A density that only says where to look: an MLP of gamma(x, 6). 4 layers of 64, as in the paper."""

    def __init__(self, generator: torch.Generator, layers: int = 4, width: int = 64) -> None:
        super().__init__()
        self.layers = mlp([3 + 6 * _FREQUENCIES, *[width] * layers, 1], generator)

    def forward(self, points: Float[Tensor, "n 3"]) -> Float[Tensor, " n"]:
        """Density per scene unit at points."""
        outputs = self.layers(positional_encoding(points, _FREQUENCIES)).squeeze(1)
        return _DENSITY_GAIN * nn.functional.softplus(outputs + _DENSITY_BIAS)


def stratified_edges(
    rays: Rays, num_intervals: int, generator: torch.Generator | None
) -> Float[Tensor, "r {num_intervals}+1"]:
    """Ascending edges of intervals from entry to leave, inner edges within half an interval of even."""
    inner = stratified(len(rays), num_intervals - 1, generator, rays.entry.device)
    share = nn.functional.pad((inner * (num_intervals - 1) + 0.5) / num_intervals, (1, 0))
    share = nn.functional.pad(share, (0, 1), value=1.0)
    return rays.entry[:, None] + (rays.leave - rays.entry)[:, None] * share


def proposal_distances(
    network: ProposalNetwork, rays: Rays, num_proposal: int, num_samples: int, generator: torch.Generator | None
) -> tuple[Float[Tensor, "r {num_samples}"], Float[Tensor, "r {num_proposal}+1"], Float[Tensor, "r {num_proposal}"]]:
    """Sorted sample distances, and the edges and weights of the histogram behind them.

    The histogram holds the network's rendering weights, one density at the middle of each interval. Samples follow it,
    one stratified draw each (the strata's centres without a generator), but for the share `EVEN_SHARE`, which is spread
    evenly. The samples are detached; the weights carry the gradient that `interlevel_loss` needs.
    """
    edges = stratified_edges(rays, num_proposal, generator)
    middle, delta = 0.5 * (edges[:, 1:] + edges[:, :-1]), edges[:, 1:] - edges[:, :-1]
    density = network(rays.at(middle).reshape(-1, 3)).view_as(middle)
    weights, _ = weights_from_optical_depth(density * delta)
    with torch.no_grad():
        evenly = delta / (rays.leave - rays.entry)[:, None]
        blended = weights + (EVEN_SHARE * weights.sum(1, keepdim=True) + 1e-4) * evenly
        distances = invert_cdf(edges, blended, stratified(len(rays), num_samples, generator, edges.device))
    return distances, edges, weights


def sample_edges(distances: Float[Tensor, "r k"]) -> Float[Tensor, "r k+1"]:
    """Edges of the samples' own stretches, half way between sorted distances, from first to last.

    The same stretches as in `stages.neural.rendering.sample_optical_depths`.
    """
    middle = 0.5 * (distances[:, 1:] + distances[:, :-1])
    return torch.cat([distances[:, :1], middle, distances[:, -1:]], 1)


def interlevel_loss(
    edges: Float[Tensor, "r e"],
    weights: Float[Tensor, "r e-1"],
    proposal_edges: Float[Tensor, "r p"],
    proposal_weights: Float[Tensor, "r p-1"],
) -> Float[Tensor, " r"]:
    """L_prop = sum_k max(0, w_k - bound_k)^2 / w_k per ray (mip-NeRF 360, eq. 13).

    bound_k is the sum of the proposal weights whose intervals overlap sample k's stretch of the ray, between its edges:
    the most that a consistent histogram can hold there. Zero where it holds at least the rendering weight w everywhere.
    The samples' side is detached: the proposal learns from the rendering, not the rendering from the proposal.
    """
    edges, weights = edges.detach(), weights.detach()
    num_proposal = proposal_weights.shape[1]
    first = torch.searchsorted(proposal_edges, edges[:, :-1].contiguous(), right=True).sub(1).clamp(0, num_proposal)
    last = torch.searchsorted(proposal_edges, edges[:, 1:].contiguous()).clamp(0, num_proposal)
    total = nn.functional.pad(torch.cumsum(proposal_weights, 1), (1, 0))
    bound = total.gather(1, last) - total.gather(1, first)
    return (torch.relu(weights - bound) ** 2 / (weights + _WEIGHT_EPSILON)).sum(1)


def updates_now(step: int, first_updates: int, every: int = 5) -> bool:
    """Whether the proposal network learns in this step: in each of the first N, then in every fifth, as nerfacc does.

    The paper's "N = 128 proposal updates" leaves open what N counts: we read it as the first steps of training, each of
    which updates the network. It could also be the number of proposal samples on a ray, a setting of its own here.
    """
    return step < first_updates or step % every == 0
