"""What a surface mirrors of the object itself (paper: Self-Reflection Compensation, eq. indirect_reflect, Alg. 2).

Shapes: Q rays with a surface point x_0, K samples on each reflected ray. Distances are in scene units.

The literal form reads the SDF network, and S carries a gradient to it. As x_0 itself has f = 0, its S is at least about
1/2 on every ray and its x_r stays next to x_0. The stable form reads the sampler's cached grid, without a gradient,
begins off the surface, and asks whether the reflected ray runs INTO something.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from stages.neural.density import laplace_density, section_optical_depth
from stages.neural.rendered import OPAQUE, Rendered
from stages.neural.rendering import weights_from_optical_depth
from stages.neural.sampling import SdfCache, free_outside, stratified
from stages.neural.schedules import Moment
from stages.neural.terms.term import Term

if TYPE_CHECKING:
    from jaxtyping import Float

# A ray on which f falls slower than this per unit of length runs along a surface, not into it: within 3 degrees. Else
# rounding and the grid's facets alone would make a flat mirror reflect itself at grazing angles.
_APPROACH = 0.05
# A ray that collects less opacity than this hits nothing, and has no mean hit.
_MISS = 1e-3
# Reflected rays that meet something with less than this probability are not followed: under one grey level.
_REFLECTION_THRESHOLD = 2e-3


def reflect(directions: Float[Tensor, "*any 3"], normals: Float[Tensor, "*any 3"]) -> Float[Tensor, "*any 3"]:
    """Unit reflected directions v - 2 (v.n) n of unit directions, about unit normals (paper r_refl)."""
    return directions - 2 * (directions * normals).sum(-1, keepdim=True) * normals


# ---------------------------------------------------------------------- the paper's form
def uniform_points(
    points: Float[Tensor, "q 3"],
    directions: Float[Tensor, "q 3"],
    reach: float,
    num_samples: int,
    generator: torch.Generator | None,
) -> Float[Tensor, "q {num_samples} 3"]:
    """Samples x_0 + t_k v_refl on reflected rays, t_k ~ U(0, t_max = reach) (paper Alg. 2).

    Evenly spaced without a generator.
    """
    if generator is None:
        share = stratified(len(points), num_samples, None, points.device)
    else:
        share = torch.rand(len(points), num_samples, generator=generator, device=points.device)
    return points[:, None] + reach * share[..., None] * directions[:, None]


def reflection_probability_literal(sdf: Float[Tensor, "q k"], temperature: float = 10.0) -> Float[Tensor, " q"]:
    """S = max_k Psi(-f(r_refl(t_k))) from f on the reflected ray (paper eq. indirect_reflect).

    Psi is the Laplace CDF of scale 1 / temperature, 0.1 scene units by default. The other reading, a scale of 10, makes
    Psi 1/2 to within 5 % everywhere in the region of interest. At least 1/2 as soon as one sample is on the surface,
    which the ray's start is. Differentiable in f of the sample that attains the maximum.
    """
    scale = 1 / temperature
    return (scale * laplace_density(sdf, scale)).max(1).values


def nearest_to_surface(sdf: Float[Tensor, "q k"], values: Float[Tensor, "q k d"]) -> Float[Tensor, "q d"]:
    """The row of values whose |f| is smallest on its ray (paper Alg. 2: x_r, and grad f there).

    The choice itself has no gradient; the values chosen keep theirs.
    """
    return values[torch.arange(len(sdf), device=sdf.device), sdf.abs().argmin(1)]


# ---------------------------------------------------------------------- the stable form
def reflection_start(scale: float, voxel: float) -> float:
    """How far from x_0 a reflected ray begins: max(4 b, 2 h), scene units; b Laplace scale, h voxel size."""
    return max(4 * scale, 2 * voxel)


def reflection_probability(
    sdf: Float[Tensor, "q k"], distances: Float[Tensor, "q k"], scale: Float[Tensor, ""] | float
) -> tuple[Float[Tensor, " q"], Float[Tensor, " q"]]:
    """S = 1 - prod_k (1 - alpha_k) over the sections where f falls, and the mean hit distance.

    f is piecewise linear between sorted distances, alpha_k = 1 - exp(-tau_k) with the exact optical depth
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
    points: Float[Tensor, "q 3"],
    directions: Float[Tensor, "q 3"],
    scale: float,
    voxel: float,
    reach: float,
    num_samples: int,
) -> tuple[Float[Tensor, " q"], Float[Tensor, "q 3"]]:
    """S and x_r of rays reflected at points into unit directions, from cached f. No gradient.

    A ray begins `reflection_start` off the surface and is `reach` long; h is the coarser of the encoding's voxel and
    the cache's cell, as facets of the grid bend f at that size.
    """
    start = reflection_start(scale, max(voxel, cache.cell))
    along = start + reach * torch.linspace(0, 1, num_samples, device=points.device)
    places = points[:, None] + along[:, None] * directions[:, None]
    sdf = free_outside(cache.lookup(places), torch.linalg.vector_norm(places, dim=2))
    probability, distance = reflection_probability(sdf, along.expand_as(sdf), scale)
    return probability, points + distance[:, None] * directions


# ---------------------------------------------------------------------- both forms
def compose(
    color: Float[Tensor, "q 3"],
    reflected_color: Float[Tensor, "q 3"],
    probability: Float[Tensor, " q"],
    reflectivity: Float[Tensor, " q"] | float,
) -> Float[Tensor, "q 3"]:
    """C' = (1 - rho S) C + rho S g for colours C and g (paper C').

    The paper has no reflectivity: rho = 1. C itself where S or rho is 0.
    """
    share = (reflectivity * probability)[:, None]
    return (1 - share) * color + share * reflected_color


# ---------------------------------------------------------------------- in a step
class Reflection(Term):
    """Colours of rays, with what the surface mirrors of the object."""

    def recolored(self, rendered: Rendered, moment: Moment, generator: torch.Generator | None) -> Rendered:
        """C' = (1 - rho S) C + rho S g of the rays that met a surface (paper, Self-Reflection Compensation).

        In the paper's form S carries a gradient to f along the reflected ray, though not to where the ray lies. In the
        stable form S, x_r and n_r carry none, and rays whose reflection meets nothing stay as they are.
        """
        network, params = self.fields.reflection, self.params.terms.reflection
        if network is None or (params.form == "stable" and moment.progress < params.start):
            return rendered
        hit = torch.nonzero(rendered.opacity.detach() > OPAQUE).squeeze(1)
        surface, normals = (part[hit] for part in rendered.surface)
        dirs = reflect(rendered.batch.directions[hit], normals)
        if params.form == "paper":
            along = uniform_points(surface, dirs, params.reach, params.samples, generator)
            sdf, _, gradients = self.fields.sdf(along.view(-1, 3), moment.levels)
            sdf = sdf.view(along.shape[:2])
            probability = reflection_probability_literal(sdf, params.temperature)
            points, gradients = (nearest_to_surface(sdf, each.view_as(along)) for each in (along, gradients))
            reflectivity = torch.ones_like(probability)
        else:
            probability, points = trace_reflections(
                self.cache, surface, dirs, moment.width, moment.voxel, params.reach, params.samples
            )
            met = torch.nonzero(probability > _REFLECTION_THRESHOLD).squeeze(1)
            hit, normals, dirs, probability, points = (x[met] for x in (hit, normals, dirs, probability, points))
            with torch.no_grad():
                _, _, gradients = self.fields.sdf(points, moment.levels)
            facing = (normals * rendered.batch.directions[hit]).sum(1)
            reflectivity = network.reflectivity(rendered.mean(rendered.features)[hit], facing)
        seen = network(points, torch.nn.functional.normalize(gradients, dim=1), dirs)
        composed = compose(rendered.colors[hit], seen, probability, reflectivity)
        return replace(
            rendered,
            colors=rendered.colors.index_copy(0, hit, composed),
            reflected=rendered.reflected.index_copy(0, hit, (reflectivity * probability).detach()),
        )
