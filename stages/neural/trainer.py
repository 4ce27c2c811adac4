"""Training: one step is one page, and the losses meet in one visible sum.

Shapes: R rays, K samples a ray, N = R K points, P sparse points, I photos.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch

from configs.params import TrainParams
from stages.geometry.cameras import PosedScene
from stages.neural import losses, schedules
from stages.neural.encodings import HashGrid
from stages.neural.fields import BackgroundNetwork, Fields, FieldShape
from stages.neural.photos import Photos, RayBatch
from stages.neural.rendering import composite, sample_optical_depths, weights_from_optical_depth
from stages.neural.sampling import SdfCache, importance_distances, intersect_unit_sphere, stratified
from stages.neural.visibility import (
    ambiguity,
    color_precision,
    mahalanobis,
    path_margin,
    sdf_visibility,
    smallest_sdf_on_paths,
    trust,
)

# Samples that weigh less than this get no colour: together they change a pixel by less than one grey level.
_COLOR_THRESHOLD = 2e-4
# Samples that weigh more than this count as near the surface for the relaxed Eikonal term.
_NEAR_SURFACE_WEIGHT = 0.01
# The background's last sample is this near to infinity, as a part of the contracted shell: 200 radii away.
_BACKGROUND_REACH = 0.995


@dataclass(frozen=True)
class Sightings:
    """Which photo saw which SfM point: M lines of sight that are free up to the surface at their end.

    Attributes:
        points: [M, 3] the SfM point at the end of each line, inside the region of interest.
        directions: [M, 3] unit, from the camera to the point.
        free: [M] length of the line inside the unit sphere before the point.
        weights: [M] in [0, 1].
    """

    points: torch.Tensor
    directions: torch.Tensor
    free: torch.Tensor
    weights: torch.Tensor

    @staticmethod
    def from_scene(scene: PosedScene, device: torch.device | str) -> Sightings:
        """Sightings of points inside the unit sphere; weight 1 / (1 + e^2), e the reprojection error in pixels."""
        inside = np.linalg.norm(scene.points, axis=1) < 0.98
        image, point = scene.observations[inside[scene.observations[:, 1]]].T
        points = torch.from_numpy(scene.points[point]).float()
        origins = torch.from_numpy(scene.cameras.centers[image]).float()
        distances = torch.linalg.vector_norm(points - origins, dim=1)
        directions = (points - origins) / distances[:, None]
        entry, _, _ = intersect_unit_sphere(origins, directions)
        weights = torch.from_numpy(1 / (1 + scene.point_errors[point] ** 2)).float()
        kept = (points, directions, (distances - entry).clamp(min=0), weights)
        return Sightings(*(tensor.to(device) for tensor in kept))


@dataclass(frozen=True)
class Rendered:
    """What a batch of rays shows.

    Attributes:
        colors: [R, 3] sRGB with the background behind, before exposure.
        opacity: [R] of the surface alone.
        weights, distances: [R, K] rendering weights of the samples and where they lie on the ray.
        gradients: [N, 3] of the SDF at the samples.
        extra_sdf, extra_gradients: the same at the extra points that were asked for.
    """

    colors: torch.Tensor
    opacity: torch.Tensor
    weights: torch.Tensor
    distances: torch.Tensor
    gradients: torch.Tensor
    extra_sdf: torch.Tensor
    extra_gradients: torch.Tensor

    def surface(self, batch: RayBatch) -> tuple[torch.Tensor, torch.Tensor]:
        """Mean surface point and unit normal of each ray [R, 3]; mean something only where the ray is opaque."""
        depth = (self.weights * self.distances).sum(1) / self.opacity.clamp(min=1e-3)
        normals = composite(self.weights, self.gradients.view(*self.weights.shape, 3))
        points = batch.origins + depth[:, None] * batch.directions
        return points, torch.nn.functional.normalize(normals, dim=1)


def field_shape(params: TrainParams, num_images: int, background: bool) -> FieldShape:
    """The networks' shape for these settings."""
    grid = HashGrid(params.levels, params.level_features, params.log2_rows, params.coarsest, params.finest)
    background_grid = HashGrid(6, 4, params.background_log2_rows, 16, 256)
    return FieldShape(
        sdf_grid=grid,
        sdf_layers=params.sdf_layers,
        sdf_width=params.sdf_width,
        radiance_layers=params.radiance_layers,
        radiance_width=params.radiance_width,
        features=15,
        sphere_radius=params.sphere_radius,
        background_grid=background_grid if background else None,
        num_images=num_images,
    )


class Trainer:
    """Networks, optimiser, sampler and random state: all that a checkpoint must hold."""

    def __init__(self, photos: Photos, sightings: Sightings, params: TrainParams, device: torch.device | str) -> None:
        self.photos, self.sightings, self.params = photos, sightings, params
        self.device = torch.device(device)
        background = params.background and photos.masks is None
        self.fields = Fields(field_shape(params, len(photos), background), params.seed).to(device)
        tables = self.fields.tables()
        table_ids = {id(table) for table in tables}
        networks = [p for p in self.fields.parameters() if id(p) not in table_ids]
        self.optimizer = torch.optim.Adam(
            [
                {"params": tables, "base_lr": params.lr_table},
                {"params": networks, "base_lr": params.lr_network},
            ],
            lr=params.lr_table,
            betas=(0.9, 0.99),
            eps=1e-15,
            fused=True,
        )
        self.cache = SdfCache(params.cache_resolution, device)
        self.generator = torch.Generator(device=device).manual_seed(params.seed)
        self.step_index = 0
        self.cache_step = -(10**9)

    @cached_property
    def color_precision(self) -> torch.Tensor:
        """The photos' inverse colour covariance [3, 3], from a draw of its own; only the ambiguity weight asks."""
        generator = torch.Generator(device=self.device).manual_seed(self.params.seed)
        return color_precision(self.photos, generator)

    # ------------------------------------------------------------------ schedules
    def scale(self, progress: float) -> float:
        """Laplace scale b in scene units; it ends at half a voxel of the finest level, or at `scale_end`."""
        floor = 0.5 * self.fields.shape.sdf_grid.voxel_size()
        return schedules.exponential(
            progress / self.params.sharpen_until, self.params.scale_start, max(self.params.scale_end, floor)
        )

    def levels(self, progress: float) -> int:
        return schedules.active_levels(progress, self.params.levels, self.params.start_levels, self.params.coarse_until)

    # ------------------------------------------------------------------ one step
    def step(self, progress: float) -> dict[str, torch.Tensor]:
        """One optimiser step at progress in [0, 1]; returns its terms and checks, batch means as tensors (no sync)."""
        params = self.params
        self._refresh_cache(progress)
        batch = self.photos.draw(params.rays, self.generator)
        extra, sparse_weights = self._extra_points()
        num_sparse = len(sparse_weights)
        rendered = self.render(batch, progress, extra, self.generator)
        exposed = rendered.colors * torch.exp(self.fields.log_gains[batch.images])

        ray_error = losses.rgb_error(exposed, batch.colors)
        photo_error = ray_error * self._trust(batch, rendered, progress)
        if batch.masks is not None:  # outside the masks nothing is known of the colour
            photo_error = photo_error * batch.masks
            mask_loss = losses.mask_error(rendered.opacity, batch.masks).mean()
        else:
            mask_loss = torch.zeros((), device=self.device)
        rgb_loss = photo_error.mean()
        eikonal_loss = torch.cat(
            [
                self._relaxation(ray_error, rendered) * losses.eikonal_error(rendered.gradients),
                losses.eikonal_error(rendered.extra_gradients),
            ]
        ).mean()
        planar_loss = self._planar_loss(batch, rendered, progress)
        on_point, behind, front, free = rendered.extra_sdf[: 4 * num_sparse].view(4, num_sparse)
        margin = 0.25 * params.sparse_step
        sparse_error = (
            losses.sparse_point_error(on_point, params.sparse_tolerance)
            + losses.inside_error(behind, margin)
            + losses.outside_error(front, margin)
            + losses.outside_error(free, margin)
        )
        sparse_loss = (sparse_weights * sparse_error).sum() / max(num_sparse, 1)
        exposure_loss = losses.exposure_error(self.fields.log_gains).mean()

        loss = (
            rgb_loss
            + params.weight_eikonal * eikonal_loss
            + params.weight_planar * schedules.exponential(progress, 0.1, 1.0) * planar_loss
            + params.weight_sparse * schedules.fade_out(progress, params.sparse_until) * sparse_loss
            + params.weight_mask * mask_loss
            + params.weight_exposure * exposure_loss
        )
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        factor = schedules.warm_up_then_decay(progress, params.lr_warm_up, params.lr_final)
        for group in self.optimizer.param_groups:
            group["lr"] = group["base_lr"] * factor
        self.optimizer.step()
        self.step_index += 1
        with torch.no_grad():
            squared = ((exposed - batch.colors) ** 2).mean(1)
            if batch.masks is None:
                mse = squared.mean()
            else:
                mse = (batch.masks * squared).sum() / batch.masks.sum().clamp(min=1)
            return {
                "loss": loss.detach(),
                "rgb": rgb_loss.detach(),
                "eikonal": eikonal_loss.detach(),
                "planar": planar_loss.detach(),
                "sparse": sparse_loss.detach(),
                "mask": mask_loss.detach(),
                "psnr": -10 * torch.log10(mse.clamp(min=1e-10)),
                "gradient_norm": torch.linalg.vector_norm(rendered.gradients, dim=1).mean(),
                "opacity": rendered.opacity.detach().mean(),
            }

    @torch.no_grad()
    def _trust(self, batch: RayBatch, rendered: Rendered, progress: float) -> torch.Tensor:
        """Weight [R] of each ray's colour error: 1 / (1 + lambda_ambiguity), mean 1 (paper eq. loss_without_ambiguity).

        1 before `ambiguity_from`: early on, a pattern seen at a wrong depth would pass for a reflection.
        """
        num_rays = len(batch.leave)
        if self.params.ambiguity == "off" or progress < self.params.ambiguity_from:
            return torch.ones(num_rays, device=self.device)
        gains = torch.exp(self.fields.log_gains)
        surface, normals = rendered.surface(batch)
        to_cameras = torch.nn.functional.normalize(self.photos.centers - surface[:, None], dim=2)
        facing = torch.einsum("ra,ria->ri", normals, to_cameras)
        colors, in_frame = self.photos.observe(surface)
        others = torch.arange(len(self.photos), device=self.device) != batch.images[:, None]
        ray, view = torch.nonzero(in_frame & others & (facing > 0) & (rendered.opacity > 0.5)[:, None], as_tuple=True)
        margin = path_margin(facing[ray, view], self.scale(progress), max(self._voxel(progress), self.cache.cell / 2))
        smallest = smallest_sdf_on_paths(self.cache, surface[ray], self.photos.centers[view], margin)
        visibility = torch.zeros_like(facing)
        visibility[ray, view] = sdf_visibility(smallest)
        own = batch.colors / gains[batch.images]
        distance = mahalanobis(own[:, None], colors / gains, self.color_precision)
        return trust(ambiguity(visibility, distance))

    def _relaxation(self, ray_error: torch.Tensor, rendered: Rendered) -> torch.Tensor:
        """Weight [N] of the Eikonal term at the rays' samples: below 1 near surfaces whose photo is not met yet."""
        if self.params.eikonal == "plain":
            return torch.ones_like(rendered.weights).view(-1)
        near_surface = rendered.weights.detach() > _NEAR_SURFACE_WEIGHT
        omega = losses.eikonal_relaxation(ray_error)[:, None].expand_as(rendered.weights)
        return torch.where(near_surface, omega, torch.ones_like(omega)).reshape(-1)

    def _planar_loss(self, batch: RayBatch, rendered: Rendered, progress: float) -> torch.Tensor:
        """Mean planar error around the surface points of some of the rays, adaptively weighted (paper L_planar).

        Half of the neighbours lie on the ray before the surface, as in the paper, half on a disk in its tangent plane.
        """
        params = self.params
        nothing = torch.zeros((), device=self.device)
        if params.planar == "off":
            return nothing
        chosen = torch.nonzero(rendered.opacity.detach() > 0.5).squeeze(1)[: params.planar_rays]
        if len(chosen) == 0:
            return nothing
        surface, normals = (part.detach()[chosen] for part in rendered.surface(batch))
        radius = schedules.exponential(progress, params.planar_radius, 3 * self._voxel(1.0))
        count = params.planar_neighbors
        draws = torch.randn(len(chosen), count, 3, generator=self.generator, device=self.device)
        tangent = draws - torch.einsum("qkc,qc->qk", draws, normals)[..., None] * normals[:, None]
        disk = torch.nn.functional.normalize(tangent, dim=2)
        on_ray = -batch.directions[chosen, None].expand_as(disk)
        reach = radius * torch.rand(len(chosen), count, 1, generator=self.generator, device=self.device)
        half = torch.arange(count, device=self.device) % 2 == 0
        offsets = torch.where(half[None, :, None], on_ray * reach, disk * (reach * radius).sqrt())

        neighbors = (surface[:, None] + offsets).reshape(-1, 3)
        sdf, features, gradients = self.fields.sdf(torch.cat([surface, neighbors]), self.levels(progress))
        center, center_features = sdf[: len(chosen)], features[: len(chosen)]
        unit_normals = torch.nn.functional.normalize(gradients[: len(chosen)], dim=1)
        shape = (len(chosen), count)
        error = losses.planar_error(sdf[len(chosen) :].view(shape), center, unit_normals, offsets, radius)
        flatness = losses.planarity(features[len(chosen) :].view(*shape, -1), center_features)
        return (flatness * error).mean()

    def _voxel(self, progress: float) -> float:
        """Side of the finest active cell of the encoding, scene units: the paper's h."""
        return self.fields.shape.sdf_grid.voxel_size(self.levels(progress))

    def _extra_points(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Points [4 S + A, 3] evaluated beside the rays' samples, and the weights [S] of the sightings among them.

        Of S sightings the points, then places a step behind them, a step before them, and somewhere on the free line
        of sight; last A places anywhere in the cube.
        """
        params, sightings = self.params, self.sightings
        total = len(sightings.weights)
        count = min(params.sparse_batch, total)
        chosen = torch.randint(max(total, 1), (count,), generator=self.generator, device=self.device)
        along = torch.rand(count, generator=self.generator, device=self.device)
        points, directions = sightings.points[chosen], sightings.directions[chosen]
        step = params.sparse_step * directions
        free = (along * sightings.free[chosen]).clamp(min=params.sparse_step)[:, None] * directions
        anywhere = torch.rand(params.free_points, 3, generator=self.generator, device=self.device) * 2 - 1
        places = torch.cat([points, points + step, points - step, points - free, anywhere])
        return places, sightings.weights[chosen]

    # ------------------------------------------------------------------ rendering
    def render(
        self,
        batch: RayBatch,
        progress: float,
        extra: torch.Tensor,
        generator: torch.Generator | None,
    ) -> Rendered:
        """Render rays and evaluate the SDF at extra points [E, 3] in the same pass."""
        scale, levels = self.scale(progress), self.levels(progress)
        distances = importance_distances(
            self.cache, batch.origins, batch.directions, batch.entry, batch.leave,
            self.params.samples, scale, generator,
        )  # fmt: skip
        num_rays, num_samples = distances.shape
        points = (batch.origins[:, None] + distances[..., None] * batch.directions[:, None]).reshape(-1, 3)
        num_points = len(points)
        sdf, features, gradients = self.fields.sdf(torch.cat([points, extra]), levels)
        tau = sample_optical_depths(sdf[:num_points].view(num_rays, num_samples), distances, scale)
        weights, transmittance = weights_from_optical_depth(tau)

        seen = torch.nonzero(weights.detach().view(-1) > _COLOR_THRESHOLD).squeeze(1)
        ray = seen // num_samples
        normals = torch.nn.functional.normalize(gradients[seen], dim=1)
        sample_colors = self.fields.radiance(points[seen], normals, batch.directions[ray], features[seen])
        colors = torch.zeros(num_rays, 3, device=self.device).index_add(
            0, ray, weights.view(-1)[seen, None] * sample_colors
        )
        if self.fields.background is not None:
            colors = colors + self._background(self.fields.background, batch, transmittance, generator)
        return Rendered(
            colors, 1 - transmittance, weights, distances, gradients[:num_points],
            sdf[num_points:], gradients[num_points:],
        )  # fmt: skip

    def _background(
        self,
        background: BackgroundNetwork,
        batch: RayBatch,
        transmittance: torch.Tensor,
        generator: torch.Generator | None,
    ) -> torch.Tensor:
        """Background colour [R, 3] weighted by the transmittance [R] that the surface leaves.

        Samples are even in the inverse of their distance from the scene's centre, from the unit sphere outwards
        (NeRF++), so that half of them look at what lies within twice the region's radius.
        """
        count = self.params.background_samples
        behind = torch.nonzero(transmittance.detach() > 0.01).squeeze(1)
        origins, directions = batch.origins[behind], batch.directions[behind]
        inverse = 1 - _BACKGROUND_REACH * stratified(len(behind), count + 1, generator, self.device)
        middle = -(origins * directions).sum(1, keepdim=True)
        closest_squared = (origins**2).sum(1, keepdim=True) - middle**2
        distances = middle + (1 / inverse**2 - closest_squared).clamp(min=0).sqrt()
        centers = 0.5 * (distances[:, 1:] + distances[:, :-1])
        points = (origins[:, None] + centers[..., None] * directions[:, None]).reshape(-1, 3)
        delta = inverse[:, :-1] - inverse[:, 1:]  # the contracted radius is 2 - inverse
        dirs = directions[:, None].expand(-1, count, -1).reshape(-1, 3)
        density, colors = background(points, dirs)
        tau = density.view(len(behind), count) * delta
        weights, left = weights_from_optical_depth(tau)
        # What is left behind the last sample belongs to it: the background is opaque at infinity.
        weights = torch.cat([weights[:, :-1], weights[:, -1:] + left[:, None]], 1)
        color = composite(weights, colors.view(len(behind), count, 3))
        return torch.zeros(len(batch.leave), 3, device=self.device).index_add(
            0, behind, transmittance[behind, None] * color
        )

    @torch.no_grad()
    def _refresh_cache(self, progress: float) -> None:
        """Bring the sampler's grid up to date: all of it at first and now and then, else near the surface."""
        every = self.params.cache_every
        if self.step_index - self.cache_step < every:
            return
        levels = self.levels(progress)
        refreshes = self.step_index // every
        full = self.step_index <= 4 * every or refreshes % 8 == 0
        self.cache.refresh(lambda p: self.fields.sdf.sdf(p, levels), None if full else 4 * self.cache.cell)
        self.cache_step = self.step_index

    # ------------------------------------------------------------------ previews, checkpoints
    @torch.no_grad()
    def preview(self, image: int, progress: float, width: int = 160) -> np.ndarray:
        """Photo, render and normals of photo `image` side by side, [H, 3 W, 3] uint8, W about `width`."""
        photo_width, photo_height = self.photos.sizes[image].tolist()
        step = max(1, photo_width // width)
        y, x = torch.meshgrid(torch.arange(0, photo_height, step), torch.arange(0, photo_width, step), indexing="ij")
        pixels = torch.stack([x, y], 2).view(-1, 2).float().to(self.device)
        nothing = torch.zeros(0, 3, device=self.device)
        photo, color, normal = (torch.zeros(len(pixels), 3) for _ in range(3))
        for part in torch.arange(len(pixels), device=self.device).split(4096):
            batch = self.photos.rays(torch.full_like(part, image), pixels[part])
            rendered = self.render(batch, progress, nothing, None)
            rows = part[batch.drawn].cpu()
            _, normals = rendered.surface(batch)
            photo[rows] = batch.colors.cpu()
            color[rows] = (rendered.colors * torch.exp(self.fields.log_gains[image])).clamp(0, 1).cpu()
            normal[rows] = (normals * 0.5 + 0.5).cpu()
        panels = [panel.view(*x.shape, 3) for panel in (photo, color, normal)]
        return (255 * torch.cat(panels, 1)).byte().numpy()

    def state(self) -> dict[str, Any]:
        """Everything that the next step depends on."""
        return {
            "fields": self.fields.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "cache": self.cache.values,
            "cache_step": self.cache_step,
            "generator": self.generator.get_state(),
            "step_index": self.step_index,
        }

    def load_state(self, state: dict[str, Any]) -> None:
        self.fields.load_state_dict(state["fields"])
        self.optimizer.load_state_dict(state["optimizer"])
        self.cache.values.copy_(state["cache"])
        self.cache_step = state["cache_step"]
        self.generator.set_state(state["generator"].cpu())
        self.step_index = state["step_index"]
