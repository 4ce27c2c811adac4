"""The paper's terms on a batch: queries of the fields around the pure functions of `losses` and `visibility`.

Each has the paper's form and a stable form, chosen by a setting, and does nothing where it is off. `docs/math.md`
says how the two differ and why.

Shapes: R rays, K samples a ray, N = R K points, I photos, Q rays and J neighbours of the planar term.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property

import torch

from configs.params import TrainParams
from stages.neural import losses, schedules, visibility
from stages.neural.fields import Fields, points_at_a_time
from stages.neural.renderer import OPAQUE, Rendered
from stages.neural.sampling import SdfCache
from stages.neural.schedules import Moment
from stages.neural.training_photos import Photos

# Samples that weigh more than this count as near the surface for the relaxed Eikonal term.
_NEAR_SURFACE_WEIGHT = 0.01


class Terms:
    """Ambiguity weight, planar term and Eikonal relaxation, with what they look at."""

    def __init__(
        self, fields: Fields, photos: Photos, cache: SdfCache, params: TrainParams, generator: torch.Generator
    ) -> None:
        self.fields, self.photos, self.cache, self.params = fields, photos, cache, params
        self.generator = generator
        self.device = generator.device
        self.mesh_visibility = visibility.MeshVisibility(cache) if params.visibility == "mesh" else None

    @cached_property
    def color_precision(self) -> torch.Tensor:
        """The photos' inverse colour covariance [3, 3], from a draw of its own; only the ambiguity weight asks."""
        generator = torch.Generator(device=self.device).manual_seed(self.params.seed)
        if self.params.ambiguity == "paper":
            return visibility.color_precision(self.photos, generator, floor=0.0)
        return visibility.color_precision(self.photos, generator)

    # ------------------------------------------------------------------ ambiguity weight
    def trust(self, rendered: Rendered, exposed: torch.Tensor, moment: Moment) -> torch.Tensor:
        """Weight [R] of each ray's colour error, 1 / (1 + lambda_ambiguity) (paper eq. loss_without_ambiguity).

        The stable form compares photos with photos, carries no gradient, has mean 1 over the surface, and is 1 before
        `ambiguity_from`: early on, a pattern seen at a wrong depth would pass for a reflection. The paper's form
        compares the rendered colours `exposed` [R, 3] with the photos, from the first step.
        """
        params, batch = self.params, rendered.batch
        off = params.ambiguity == "off" or (params.ambiguity == "stable" and moment.progress < params.ambiguity_from)
        if off:
            return torch.ones(len(batch.leave), device=self.device)
        weights = torch.ones(len(batch.leave), device=self.device)  # no doubt where no surface was met
        met = rendered.opacity.detach() > OPAQUE
        hit = torch.nonzero(met if batch.masks is None else met & (batch.masks > 0.5)).squeeze(1)
        colors, seen = self._views(hit, rendered, moment)
        if params.ambiguity == "paper":
            distance = visibility.mahalanobis(exposed[hit, None], colors, self.color_precision)
            return weights.index_copy(0, hit, visibility.trust_literal(visibility.ambiguity(seen, distance)))
        gains = torch.exp(self.fields.log_gains.detach())
        own = batch.colors[hit] / gains[batch.images[hit]]
        distance = visibility.mahalanobis(own[:, None], colors / gains, self.color_precision)
        return weights.index_copy(0, hit, visibility.trust(visibility.ambiguity(seen, distance)))

    @torch.no_grad()
    def _views(self, hit: torch.Tensor, rendered: Rendered, moment: Moment) -> tuple[torch.Tensor, torch.Tensor]:
        """What every photo shows at the surface points of rays `hit` [M]: colours [M, I, 3], visibility factor [M, I].

        The factor is 0 in the ray's own photo, in those not trained on, and where the point is out of frame.
        """
        params, photos = self.params, self.photos
        surface, normals = (part[hit] for part in rendered.surface)
        to_cameras = torch.nn.functional.normalize(photos.centers - surface[:, None], dim=2)
        facing = torch.einsum("ma,mia->mi", normals, to_cameras)
        colors, in_frame = photos.observe(surface)
        others = torch.arange(len(photos), device=self.device) != rendered.batch.images[hit, None]
        candidates = in_frame & others & photos.training
        literal = params.visibility in ("network", "paper")
        if not literal:
            candidates &= facing > 0
        ray, view = torch.nonzero(candidates, as_tuple=True)
        points, centers, beta = surface[ray], photos.centers[view], params.visibility_sharpness
        if literal:
            sdf = self.cache.lookup if params.visibility == "paper" else self._network_sdf(moment)
            factor = visibility.visibility_literal(
                sdf, points, centers, params.visibility_samples, self.generator, beta
            )
        else:
            margin = self._path_margin(facing[ray, view], moment)
            if self.mesh_visibility is not None:
                factor = self.mesh_visibility(points, centers, margin)
            else:
                smallest = visibility.smallest_sdf_on_paths(
                    self.cache, points, centers, margin, params.visibility_samples, beta
                )
                factor = visibility.sdf_visibility(smallest, beta)
        seen = torch.zeros_like(facing)
        seen[ray, view] = factor
        return colors, seen

    def _path_margin(self, facing: torch.Tensor, moment: Moment) -> torch.Tensor:
        """How far from the surface the paths [...] start that leave it at the cosines `facing` [...]."""
        return visibility.path_margin(facing, moment.width, max(moment.voxel, self.cache.cell / 2))

    def _network_sdf(self, moment: Moment) -> Callable[[torch.Tensor], torch.Tensor]:
        """f [...] of the network at points [..., 3], in parts: they are many."""

        def sdf(points: torch.Tensor) -> torch.Tensor:
            parts = points.reshape(-1, 3).split(points_at_a_time(self.device))
            return torch.cat([self.fields.sdf.sdf(part, moment.levels) for part in parts]).view(points.shape[:-1])

        return sdf

    # ------------------------------------------------------------------ appearance features
    def appearance_loss(self, rendered: Rendered) -> torch.Tensor:
        """Colour error of the feature MLP at the surface points: what trains it in the stable form.

        Zero without the MLP, and in the paper's form.
        """
        mlp, params, batch = self.fields.appearance, self.params, rendered.batch
        nothing = torch.zeros((), device=self.device)
        if mlp is None or "stable" not in (params.planar, params.eikonal):
            return nothing
        hit = torch.nonzero(rendered.opacity.detach() > OPAQUE).squeeze(1)[: params.planar_rays]
        if len(hit) == 0:
            return nothing
        surface = rendered.surface[0][hit]
        predicted = mlp.color(mlp(surface, batch.directions[hit]))
        gains = torch.exp(self.fields.log_gains.detach())[batch.images[hit]]
        error = losses.rgb_error(predicted * gains, batch.colors[hit])
        return (error if batch.masks is None else error * batch.masks[hit]).mean()

    # ------------------------------------------------------------------ planar term
    def planar_loss(self, rendered: Rendered, moment: Moment) -> torch.Tensor:
        """Mean planar error around the surface points of some of the rays, adaptively weighted (paper L_planar).

        The paper's neighbours lie on the ray before the surface; in the stable form half of them do, the others lie on
        a disk in the tangent plane, and the reach shrinks to three voxels.
        """
        params = self.params
        nothing = torch.zeros((), device=self.device)
        if params.planar == "off":
            return nothing
        chosen = torch.nonzero(rendered.opacity.detach() > OPAQUE).squeeze(1)[: params.planar_rays]
        if len(chosen) == 0:
            return nothing
        surface, normals = (part[chosen] for part in rendered.surface)
        dirs = rendered.batch.directions[chosen]
        radius = params.planar_radius
        if params.planar == "stable":
            finest = 3 * self.fields.shape.sdf_grid.voxel_size()
            radius = schedules.exponential(moment.progress, radius, min(finest, radius))
        offsets = self._neighbors(normals, dirs, radius)
        count = offsets.shape[1]
        neighbors = (surface[:, None] + offsets).reshape(-1, 3)
        places = torch.cat([surface, neighbors])
        sdf, features, gradients = self.fields.sdf(places, moment.levels)
        # c_feat looks from x_k at the surface on its ray, which is along the ray, also for neighbours beside it.
        along = torch.cat([dirs, dirs.repeat_interleave(count, 0)])
        if self.fields.appearance is not None:
            features = self.fields.appearance(places, along)
        center, around = features[: len(chosen)], features[len(chosen) :].view(len(chosen), count, -1)
        unit_normals = torch.nn.functional.normalize(gradients[: len(chosen)], dim=1)
        sdf_center, sdf_around = sdf[: len(chosen)], sdf[len(chosen) :].view(len(chosen), count)
        if params.planar == "paper":
            weight = losses.planarity_literal(around, center)
            error = losses.planar_error_literal(sdf_around, unit_normals, offsets)
        else:
            weight = losses.planarity(around, center)
            error = losses.planar_error(sdf_around, sdf_center, unit_normals, offsets, radius)
        return self._planarity_scale(moment) * (weight * error).mean()

    def _planarity_scale(self, moment: Moment) -> float:
        """What lambda_pla is scaled by: from `planar_start` to 1 at progress `planar_until` (paper: 0.1 to 1.0)."""
        return schedules.exponential(moment.progress / self.params.planar_until, self.params.planar_start, 1.0)

    def _neighbors(self, normals: torch.Tensor, dirs: torch.Tensor, radius: float) -> torch.Tensor:
        """Offsets [Q, J, 3] of neighbours from surface points with normals [Q, 3], seen along dirs [Q, 3]."""
        shape = (len(normals), self.params.planar_neighbors)
        reach = radius * torch.rand(*shape, 1, generator=self.generator, device=self.device)
        on_ray = -dirs[:, None].expand(*shape, 3)
        if self.params.planar == "paper":
            return on_ray * reach
        draws = torch.randn(*shape, 3, generator=self.generator, device=self.device)
        tangent = draws - torch.einsum("qkc,qc->qk", draws, normals)[..., None] * normals[:, None]
        disk = torch.nn.functional.normalize(tangent, dim=2) * (reach * radius).sqrt()  # even over the disk's area
        half = torch.arange(shape[1], device=self.device) % 2 == 0
        return torch.where(half[None, :, None], on_ray * reach, disk)

    # ------------------------------------------------------------------ Eikonal relaxation
    def relaxation(
        self, rendered: Rendered, ray_error: torch.Tensor, trust: torch.Tensor, moment: Moment
    ) -> torch.Tensor:
        """Weight omega [N] of the Eikonal term at the rays' samples, from the colour error [R] (paper
        eq. adaptive_weight).

        The paper's form weighs every sample of a ray that meets a surface and carries gradients. The stable form weighs
        only samples near the surface, and takes the error times the `trust` [R] in the photo: what a mirror shows is
        no reason to bend f. 1 elsewhere: there is no x_0 to compare with.
        """
        params = self.params
        omega = torch.ones_like(rendered.weights).view(-1)
        if params.eikonal == "plain":
            return omega
        weighed = (rendered.opacity.detach() > OPAQUE)[:, None].expand_as(rendered.weights)
        if params.eikonal == "stable":
            weighed = weighed & (rendered.weights.detach() > _NEAR_SURFACE_WEIGHT)
        ray, sample = torch.nonzero(weighed, as_tuple=True)
        if len(ray) == 0:
            return omega
        places = ray * rendered.weights.shape[1] + sample
        gamma, clip = params.relaxation_gamma, params.relaxation_clip
        with torch.set_grad_enabled(params.eikonal == "paper"):
            if self.fields.appearance is None:
                features, center = rendered.features[places], rendered.mean(rendered.features)[ray]
            else:
                features = self.fields.appearance(rendered.points[places], rendered.batch.directions[ray])
                center = self.fields.appearance(rendered.surface[0], rendered.batch.directions)[ray]
            if params.eikonal == "paper":
                planarity = self._planarity_scale(moment) * losses.planarity_literal(features[:, None], center)[:, 0]
                values = losses.eikonal_relaxation_literal(ray_error[ray], planarity, gamma, clip)
            else:
                planarity = losses.planarity(features[:, None], center)[:, 0]
                values = losses.eikonal_relaxation((ray_error * trust)[ray], planarity, gamma, clip)
        return omega.index_copy(0, places, values)
