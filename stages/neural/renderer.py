"""Rays to colours: samples, surface, background, and what the terms make of them, in that order.

Shapes: R rays, K samples a ray, N = R K points, Q rays that hit something, P bins of the proposal network.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from configs.training import TrainParams
from stages.neural import schedules
from stages.neural.acceleration import fixed_shapes
from stages.neural.evidence import at_places
from stages.neural.fields import BackgroundNetwork, Fields
from stages.neural.proposal import proposal_distances
from stages.neural.radiance import Colored
from stages.neural.rendered import Rendered
from stages.neural.rendering import composite, ray_means, rendering_weights, weights_from_optical_depth
from stages.neural.sampling import SdfCache, beyond_too, importance_distances, stratified
from stages.neural.schedules import Moment
from stages.neural.terms import Terms
from stages.neural.training_photos import RayBatch

if TYPE_CHECKING:
    from jaxtyping import Float

# Samples that weigh less than this get no colour: together they change a pixel by less than one grey level.
_COLOR_THRESHOLD = 2e-4
# Progress until which a ray has all its samples: the surface is found by then.
_FEWER_FROM = 0.3
# Rays that let less than this through show nothing of the background: two grey levels at most.
_BACKGROUND_THRESHOLD = 0.01
# The background's last sample is this near to infinity, as a part of the contracted shell: 200 radii away.
_BACKGROUND_REACH = 0.995


class Renderer:
    """Renders rays through the fields; holds no state of its own."""

    def __init__(self, fields: Fields, cache: SdfCache, params: TrainParams, terms: Terms) -> None:
        self.fields, self.cache, self.params, self.terms = fields, cache, params, terms

    def moment(self, progress: float) -> Moment:
        """What the schedules say at progress in [0, 1].

        A scheduled scale ends at half a voxel of the finest level, or at `scale_end`; a learned one starts at
        `scale_start` and stays above a tenth of that voxel.
        """
        density, schedule, grid = self.params.density, self.params.schedule, self.fields.shape.sdf_grid
        levels = schedules.active_levels(progress, grid.levels, schedule.start_levels, schedule.coarse_until)
        scale: Tensor | float
        if self.fields.log_scale is not None:
            scale = torch.exp(self.fields.log_scale) + 0.1 * grid.voxel_size()
        else:
            end = max(density.scale_end, 0.5 * grid.voxel_size())
            scale = schedules.exponential(progress / density.sharpen_until, density.scale_start, end)
        sampling = self.params.sampling
        last = min(sampling.samples_end, sampling.samples)
        samples = schedules.even_steps(progress, sampling.samples, last, _FEWER_FROM, density.sharpen_until)
        deferred = schedule.deferred_from is not None and progress >= schedule.deferred_from
        outlined = schedules.fade_in(progress, density.outlines_from, density.outlines_until)
        return Moment(progress, scale, levels, grid.voxel_size(levels), samples, deferred, outlined)

    def render(
        self,
        batch: RayBatch,
        moment: Moment,
        extra: Float[Tensor, "e 3"] | None = None,
        generator: torch.Generator | None = None,
    ) -> Rendered:
        """Render rays and, where there are extra points, evaluate the SDF there in the same pass.

        Without a generator samples lie at the centres of their strata: the same rays give the same colours.
        """
        distances, proposal = self._sample(batch, moment, generator)
        num_rays, num_samples = distances.shape
        points = batch.at(distances).reshape(-1, 3)
        num_points = len(points)
        places = points if extra is None else torch.cat([points, extra])
        sdf, features, gradients = self.fields.sdf(places, moment.levels)
        # what is shiny is found by its outlines: they have to be where the surface is
        outlined = moment.outlined * at_places(self.fields.radiance.shiny, points).view(num_rays, num_samples)
        weights, transmittance = rendering_weights(
            sdf[:num_points].view(num_rays, num_samples), distances, moment.scale, outlined, self.params.density.form
        )

        shade = self._deferred_colors if moment.deferred else self._colors
        colors, gloss = shade(batch, weights, points, gradients[:num_points], features[:num_points])
        if self.fields.background is not None:
            colors = colors + self._background(self.fields.background, batch, transmittance, generator)
        rendered = Rendered(
            batch, colors, 1 - transmittance, weights, distances, points, gradients[:num_points], features[:num_points],
            torch.zeros(num_rays, device=points.device), gloss, proposal, sdf[num_points:], gradients[num_points:],
        )  # fmt: skip
        return self.terms.recolored(rendered, moment, generator)

    def _sample(
        self, batch: RayBatch, moment: Moment, generator: torch.Generator | None
    ) -> tuple[Float[Tensor, "r k"], tuple[Float[Tensor, "r p"], Float[Tensor, "r p-1"]] | None]:
        """Distances of the samples, and the proposal network's histogram where it made them."""
        params = self.params.sampling
        if self.fields.proposal is None:
            return importance_distances(self.cache, batch, moment.samples, moment.scale, generator), None
        distances, edges, weights = proposal_distances(
            self.fields.proposal, batch, params.proposal_samples, moment.samples, generator
        )
        return distances, (edges, weights)

    def _colors(
        self,
        batch: RayBatch,
        weights: Float[Tensor, "r k"],
        points: Float[Tensor, "r*k 3"],
        gradients: Float[Tensor, "r*k 3"],
        features: Float[Tensor, "r*k g"],
    ) -> Colored:
        """Colour and gloss of the samples that weigh enough, weighted and summed over each ray.

        Gloss has no gradient with respect to the weights: a surface is not to fade where it shines.
        """
        num_rays, num_samples = weights.shape
        heavy = weights.detach().view(-1) > _COLOR_THRESHOLD
        if fixed_shapes(weights.device):
            directions = batch.directions[:, None].expand(-1, num_samples, -1).reshape(-1, 3)
            normals = torch.nn.functional.normalize(gradients, dim=1)
            colors, gloss = self.fields.radiance(points, normals, directions, features, self._surroundings)
            kept = weights * heavy.view_as(weights)
            gloss = (kept.detach() * gloss.view_as(kept)).sum(1)
            return Colored(composite(kept, colors.view(num_rays, num_samples, 3)), gloss)
        seen = torch.nonzero(heavy).squeeze(1)
        ray = seen // num_samples
        normals = torch.nn.functional.normalize(gradients[seen], dim=1)
        colors, gloss = self.fields.radiance(
            points[seen], normals, batch.directions[ray], features[seen], self._surroundings
        )
        weight = weights.view(-1)[seen]
        nothing = torch.zeros(num_rays, 3, device=points.device)
        return Colored(
            nothing.index_add(0, ray, weight[:, None] * colors),
            nothing[:, 0].index_add(0, ray, weight.detach() * gloss),
        )

    def _deferred_colors(
        self,
        batch: RayBatch,
        weights: Float[Tensor, "r k"],
        points: Float[Tensor, "r*k 3"],
        gradients: Float[Tensor, "r*k 3"],
        features: Float[Tensor, "r*k g"],
    ) -> Colored:
        """Opacity of each ray times the colour at its mean point, of its mean normal and features: one colour a ray.

        And the opacity, without gradient, times the gloss there.
        """
        opacity, point, normal, feature = ray_means(weights, points, gradients, features)
        colors, gloss = self.fields.radiance(point, normal, batch.directions, feature, self._surroundings)
        return Colored(opacity * colors, opacity.detach().squeeze(1) * gloss)

    def _surroundings(self, points: Float[Tensor, "n 3"]) -> Float[Tensor, " n"]:
        """The cached SDF, also outside the sphere."""
        return beyond_too(self.cache.lookup, points)

    def _background(
        self,
        background: BackgroundNetwork,
        batch: RayBatch,
        transmittance: Float[Tensor, " r"],
        generator: torch.Generator | None,
    ) -> Float[Tensor, "r 3"]:
        """Background colour weighted by the transmittance that the surface leaves."""
        shining = transmittance.detach() > _BACKGROUND_THRESHOLD
        if fixed_shapes(transmittance.device):
            color = self.background_color(background, batch.origins, batch.directions, generator)
            return (transmittance * shining)[:, None] * color
        behind = torch.nonzero(shining).squeeze(1)
        color = self.background_color(background, batch.origins[behind], batch.directions[behind], generator)
        nothing = torch.zeros(len(batch), 3, device=transmittance.device)
        return nothing.index_add(0, behind, transmittance[behind, None] * color)

    def background_color(
        self,
        background: BackgroundNetwork,
        origins: Float[Tensor, "q 3"],
        directions: Float[Tensor, "q 3"],
        generator: torch.Generator | None,
    ) -> Float[Tensor, "q 3"]:
        """What rays see of the background, sRGB.

        Samples are even in the inverse of their distance from the scene's centre, from the unit sphere outwards
        (NeRF++), so that half of them look at what lies within twice the region's radius.
        """
        count = self.params.sampling.background_samples
        inverse = 1 - _BACKGROUND_REACH * stratified(len(origins), count + 1, generator, origins.device)
        middle = -(origins * directions).sum(1, keepdim=True)
        closest_squared = (origins**2).sum(1, keepdim=True) - middle**2
        distances = middle + (1 / inverse**2 - closest_squared).clamp(min=0).sqrt()
        centers = 0.5 * (distances[:, 1:] + distances[:, :-1])
        points = (origins[:, None] + centers[..., None] * directions[:, None]).reshape(-1, 3)
        delta = inverse[:, :-1] - inverse[:, 1:]  # the contracted radius is 2 - inverse
        dirs = directions[:, None].expand(-1, count, -1).reshape(-1, 3)
        density, colors = background(points, dirs)
        tau = density.view(len(origins), count) * delta
        weights, left = weights_from_optical_depth(tau)
        # What is left behind the last sample belongs to it: the background is opaque at infinity.
        weights = torch.cat([weights[:, :-1], weights[:, -1:] + left[:, None]], 1)
        return composite(weights, colors.view(len(origins), count, 3))
