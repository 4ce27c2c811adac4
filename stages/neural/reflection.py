"""What a surface mirrors of the object itself (paper: Self-Reflection Compensation, eq. indirect_reflect, Alg. 2).

Shapes: Q rays with a surface point x_0, K samples on each reflected ray. Distances are in scene units.

The literal form reads the SDF network, and S carries a gradient to it. As x_0 itself has f = 0, its S is at least about
1/2 on every ray and its x_r stays next to x_0. The stable form reads the sampler's cached grid, without a gradient,
begins off the surface, and asks whether the reflected ray runs INTO something.
"""

from __future__ import annotations

import torch
from torch import nn

from stages.neural.density import laplace_density, section_optical_depth
from stages.neural.mlp import mlp, spherical_harmonics
from stages.neural.rendering import weights_from_optical_depth
from stages.neural.sampling import SdfCache, free_outside, stratified

# A ray on which f falls slower than this per unit of length runs along a surface, not into it: within 3 degrees. Else
# rounding and the grid's facets alone would make a flat mirror reflect itself at grazing angles.
_APPROACH = 0.05
# A ray that collects less opacity than this hits nothing, and has no mean hit.
_MISS = 1e-3
# Reflectivity before training: compensation has to earn its place.
_INITIAL_REFLECTIVITY = 0.02


def reflect(directions: torch.Tensor, normals: torch.Tensor) -> torch.Tensor:
    """Unit reflected directions v - 2 (v.n) n [..., 3] of unit directions, about unit normals (paper r_refl)."""
    return directions - 2 * (directions * normals).sum(-1, keepdim=True) * normals


# ---------------------------------------------------------------------- the paper's form
def uniform_points(
    points: torch.Tensor, directions: torch.Tensor, reach: float, num_samples: int, generator: torch.Generator | None
) -> torch.Tensor:
    """Samples x_0 + t_k v_refl [Q, K, 3] on reflected rays, t_k ~ U(0, t_max = reach) (paper Alg. 2).

    Evenly spaced without a generator.
    """
    if generator is None:
        share = stratified(len(points), num_samples, None, points.device)
    else:
        share = torch.rand(len(points), num_samples, generator=generator, device=points.device)
    return points[:, None] + reach * share[..., None] * directions[:, None]


def reflection_probability_literal(sdf: torch.Tensor, temperature: float = 10.0) -> torch.Tensor:
    """S = max_k Psi(-f(r_refl(t_k))) [Q] from f [Q, K] on the reflected ray (paper eq. indirect_reflect).

    Psi is the Laplace CDF of scale 1 / temperature, 0.1 scene units by default. The other reading, a scale of 10, makes
    Psi 1/2 to within 5 % everywhere in the region of interest. At least 1/2 as soon as one sample is on the surface,
    which the ray's start is. Differentiable in f of the sample that attains the maximum.
    """
    scale = 1 / temperature
    return (scale * laplace_density(sdf, scale)).max(1).values


def nearest_to_surface(sdf: torch.Tensor, values: torch.Tensor) -> torch.Tensor:
    """The row [Q, D] of values [Q, K, D] whose |f| [Q, K] is smallest on its ray (paper Alg. 2: x_r, and grad f there).

    The choice itself has no gradient; the values chosen keep theirs.
    """
    return values[torch.arange(len(sdf), device=sdf.device), sdf.abs().argmin(1)]


# ---------------------------------------------------------------------- the stable form
def reflection_start(scale: float, voxel: float) -> float:
    """How far from x_0 a reflected ray begins: max(4 b, 2 h), scene units; b Laplace scale, h voxel size."""
    return max(4 * scale, 2 * voxel)


def reflection_probability(
    sdf: torch.Tensor, distances: torch.Tensor, scale: torch.Tensor | float
) -> tuple[torch.Tensor, torch.Tensor]:
    """S = 1 - prod_k (1 - alpha_k) [Q] over the sections where f falls, and the mean hit distance [Q].

    f [Q, K] is piecewise linear between sorted distances [Q, K], alpha_k = 1 - exp(-tau_k) with the exact optical depth
    tau_k. Where f rises the ray leaves a surface, most often its own, and meets none: those sections are transparent.
    The hit is averaged with the rendering weights, each section at its middle; without a hit it is the ray's end.
    """
    delta = distances[:, 1:] - distances[:, :-1]
    falls = sdf[:, :-1] - sdf[:, 1:] > _APPROACH * delta
    tau = section_optical_depth(sdf[:, :-1], sdf[:, 1:], delta, scale) * falls
    weights, left = weights_from_optical_depth(tau)
    middle = 0.5 * (distances[:, 1:] + distances[:, :-1])
    probability = 1 - left
    mean = (weights * middle).sum(1) / probability.clamp(min=_MISS)
    return probability, torch.where(probability > _MISS, mean, distances[:, -1])


@torch.no_grad()
def trace_reflections(
    cache: SdfCache,
    points: torch.Tensor,
    directions: torch.Tensor,
    scale: float,
    voxel: float,
    reach: float,
    num_samples: int,
) -> tuple[torch.Tensor, torch.Tensor]:
    """S [Q] and x_r [Q, 3] of rays reflected at points [Q, 3] into unit directions [Q, 3], from cached f. No gradient.

    A ray begins `reflection_start` off the surface and is `reach` long; h is the coarser of the encoding's voxel and
    the cache's cell, as facets of the grid bend f at that size.
    """
    start = reflection_start(scale, max(voxel, cache.cell))
    along = start + reach * torch.linspace(0, 1, num_samples, device=points.device)
    places = points[:, None] + along[:, None] * directions[:, None]
    sdf = free_outside(cache.lookup(places), torch.linalg.vector_norm(places, dim=2))
    probability, distance = reflection_probability(sdf, along.expand_as(sdf), scale)
    return probability, points + distance[:, None] * directions


# ---------------------------------------------------------------------- both
def compose(
    color: torch.Tensor, reflected_color: torch.Tensor, probability: torch.Tensor, reflectivity: torch.Tensor | float
) -> torch.Tensor:
    """C' = (1 - rho S) C + rho S g [Q, 3] for colours C and g [Q, 3], S and rho [Q] (paper C').

    The paper has no reflectivity: rho = 1. C itself where S or rho is 0.
    """
    share = (reflectivity * probability)[:, None]
    return (1 - share) * color + share * reflected_color


class ReflectionNetwork(nn.Module):
    """g(x_r, n_r, v_r), the colour that the second surface sends to the first, and the first one's reflectivity rho."""

    def __init__(self, features: int, width: int, generator: torch.Generator, layers: int = 2) -> None:
        super().__init__()
        self.color_layers = mlp([3 + 3 + 15, *[width] * layers, 3], generator)
        self.reflectivity_layer = mlp([features + 1, 1], generator)
        head = self.reflectivity_layer[0]
        assert isinstance(head, nn.Linear)
        head.weight.data *= 0.1
        head.bias.data.fill_(torch.logit(torch.tensor(_INITIAL_REFLECTIVITY)).item())

    def forward(self, points: torch.Tensor, normals: torch.Tensor, directions: torch.Tensor) -> torch.Tensor:
        """sRGB colour g [Q, 3] in [0, 1] of x_r [Q, 3] with unit n_r, seen along the reflected directions v_r."""
        inputs = [points, normals, spherical_harmonics(directions)]
        return torch.sigmoid(self.color_layers(torch.cat(inputs, 1)))

    def reflectivity(self, features: torch.Tensor, facing: torch.Tensor) -> torch.Tensor:
        """rho [Q] in (0, 1) at x_0, from its geometry features [Q, G] and facing ratio n.v [Q]; 0.02 before training.

        Not in the paper, where whatever faces another part of the object is a perfect mirror.
        """
        return torch.sigmoid(self.reflectivity_layer(torch.cat([features, facing[:, None]], 1))).squeeze(1)
