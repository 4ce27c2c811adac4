"""Training: one step is one page, and the losses meet in one visible sum."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import numpy as np
import torch
from torch import Tensor

from configs.training import TrainParams
from stages.blocks import in_blocks, with_less
from stages.neural import losses, schedules
from stages.neural.acceleration import RAYS_AT_ONCE, RENDERED, is_mixed, points_at_a_time, short_products
from stages.neural.encoding_shapes import Frequencies, HashGrid
from stages.neural.evidence import Evidence
from stages.neural.fields import Fields, FieldShape
from stages.neural.needed_rays import NeededRays
from stages.neural.proposal import interlevel_loss, sample_edges, updates_now
from stages.neural.ranks import ALONE, Ranks
from stages.neural.rendered import Rendered
from stages.neural.renderer import Renderer
from stages.neural.replaying import Replay
from stages.neural.sampling import SdfCache
from stages.neural.schedules import Moment
from stages.neural.sightings import Drawn, Sightings, sighting_loss
from stages.neural.terms import Terms
from stages.neural.terms.planar import has_feature_mlp
from stages.neural.training_photos import Photos, RayBatch

if TYPE_CHECKING:
    from jaxtyping import Float, Int, UInt8

Result = TypeVar("Result")

# The regression to a hull before training: long enough for an error of about a cell of its grid.
HULL_STEPS, HULL_POINTS = 200, 2048
# Rays go where they are needed once there is a shape that says where; that is asked at each so many refreshes.
NEEDED_FROM, LOOK_EVERY = 0.1, 2
# Where memory runs out, a step renders its rays in parts, but never fewer than this at once.
FEWEST_RAYS = 16


class _Extra(NamedTuple):
    """Points of a step besides those on its rays."""

    sparse: Drawn
    dense: Drawn
    anywhere: Float[Tensor, "f 3"]

    @property
    def places(self) -> Float[Tensor, "e 3"]:
        return torch.cat([self.sparse.places, self.dense.places, self.anywhere])


class _Part(NamedTuple):
    """What some of a step's rays give.

    Attributes:
        numbers: their shares of the step's losses and means, which add up over its parts.
        ray_error: colour error, which says where rays are needed. squared: mean of the channels' squares.
        trust: the least of their weights.
    """

    numbers: dict[str, Tensor]
    ray_error: Float[Tensor, " r"]
    squared: Float[Tensor, " r"]
    trust: Float[Tensor, ""]


class _Share(NamedTuple):
    """What a process finds of a step: all of it where it is alone.

    Attributes:
        cells, masks: of all the step's rays. rows: those that are rendered here.
        numbers, ray_error, squared, trust: as of a part, of those.
    """

    cells: Int[Tensor, " all"]
    masks: Float[Tensor, " all"] | None
    rows: slice
    numbers: dict[str, Tensor]
    ray_error: Float[Tensor, " r"]
    squared: Float[Tensor, " r"]
    trust: Float[Tensor, ""]


def field_shape(params: TrainParams, num_images: int, background: bool) -> FieldShape:
    """The networks' shape for these settings."""
    field = params.field
    hash_grid = HashGrid(field.levels, field.level_features, field.log2_rows, field.coarsest, field.finest)
    background_grid = HashGrid(6, 4, field.background_log2_rows, 16, 256)
    return FieldShape(
        sdf_grid=hash_grid if field.encoding == "hash" else Frequencies(field.levels),
        sdf_layers=field.sdf_layers,
        sdf_width=field.sdf_width,
        radiance_layers=field.radiance_layers,
        radiance_width=field.radiance_width,
        reflected=field.radiance_inputs == "reflected",
        features=15,
        sphere_radius=field.sphere_radius,
        background_grid=background_grid if background else None,
        num_images=num_images,
        numerical=field.gradients == "numerical",
        learned_scale=params.density.scale_start if params.density.scale == "learned" else None,
        reflection=params.terms.reflection.form != "off",
        appearance=has_feature_mlp(params.terms),
        proposal=params.sampling.sampler == "proposal",
        shaded=field.colors == "shaded",
    )


class Trainer:
    """Networks, optimiser, sampler and random state: all that a checkpoint must hold."""

    def __init__(
        self,
        photos: Photos,
        sightings: Sightings,
        dense: Sightings,
        params: TrainParams,
        device: torch.device | str,
        evidence: Evidence | None = None,
        ranks: Ranks = ALONE,
    ) -> None:
        self.photos, self.params, self.ranks = photos, params, ranks
        self.evidence = evidence or Evidence.none(device)
        self.sightings, self.dense = (each.but_where(self.evidence.shiny) for each in (sightings, dense))
        self.device = torch.device(device)
        background = params.field.background and photos.masks is None
        self.fields = Fields(field_shape(params, len(photos), background), params.seed).to(device)
        self.fields.radiance.shiny.copy_(self.evidence.shiny)
        self.mixed = is_mixed(params.precision, self.device)
        if self.mixed:
            self.fields.use_mixed_precision()
        tables = self.fields.tables()
        table_ids = {id(table) for table in tables}
        networks = [p for p in self.fields.parameters() if id(p) not in table_ids]
        self.optimizer = torch.optim.Adam(
            [
                {"params": tables, "base_lr": params.schedule.lr_table},
                {"params": networks, "base_lr": params.schedule.lr_network},
            ],
            lr=params.schedule.lr_table,
            betas=(0.9, params.schedule.adam_beta2),
            eps=1e-15,
            fused=True,
        )
        self.cache = SdfCache(params.sampling.cache_resolution, device)
        self.needed = NeededRays(photos, params.sampling.needed_share)
        self.generator = torch.Generator(device=device).manual_seed(params.seed)
        # Of several processes each has chance of its own for what it does with its rays.
        self.chance = self.generator if ranks.alone else torch.Generator(device=device)
        self.terms = Terms(self.fields, self.cache, params, photos, self.chance, self.evidence)
        self.renderer = Renderer(self.fields, self.cache, params, self.terms)
        self.step_index = 0
        self.cache_step = -(10**9)
        self.replay = Replay(self.device, {self.generator, self.chance}) if self._replays() else None
        # What a graph reads anew at each step: the density's scale, how far outlines count, the sightings' weight.
        self._scale, self._outlined, self._sparse_weight = torch.zeros(3, device=self.device).unbind()
        self._prepare_rates()

    def start_from(self, distances: Float[np.ndarray, "g g g"]) -> float:
        """Bring the SDF to distances at the centres of a grid over [-1, 1]^3, before the first step.

        A short regression with an optimiser of its own: half of the points anywhere in the cube, half near the surface.
        Axes are x, y, z. Returns the mean error at the end.
        """
        grid = torch.from_numpy(distances).to(self.device)
        cells = len(grid)
        near = torch.nonzero(grid.abs() < 3 * 2 / cells)
        levels = self.moment(0.0).levels
        groups = [{"params": group["params"], "lr": group["base_lr"]} for group in self.optimizer.param_groups]
        optimizer = torch.optim.Adam(groups, betas=(0.9, 0.99), eps=1e-15)
        decay = torch.optim.lr_scheduler.LambdaLR(optimizer, lambda step: 1 - step / HULL_STEPS)
        for _ in range(HULL_STEPS):
            anywhere = torch.randint(cells, (HULL_POINTS, 3), generator=self.generator, device=self.device)
            rows = torch.randint(len(near), (HULL_POINTS,), generator=self.generator, device=self.device)
            picks = torch.cat([anywhere, near[rows]])
            points = (picks + 0.5) * (2 / cells) - 1
            error = (self.fields.sdf.sdf(points, levels) - grid[picks[:, 0], picks[:, 1], picks[:, 2]]).abs().mean()
            optimizer.zero_grad(set_to_none=True)
            error.backward()
            optimizer.step()
            decay.step()
        self._forget_gradients()
        return error.item()

    # ------------------------------------------------------------------ schedules
    def moment(self, progress: float) -> Moment:
        """What the schedules say at progress in [0, 1], see `Renderer.moment`."""
        return self.renderer.moment(progress)

    # ------------------------------------------------------------------ one step
    def step(self, progress: float) -> dict[str, Tensor]:
        """One optimiser step at progress in [0, 1]; returns its terms and checks, batch means as tensors (no sync)."""
        schedule, weights = self.params.schedule, self.params.losses
        moment = self.moment(progress)
        if self._refresh_cache(moment) and not self.ranks.alone:
            self.ranks.take_from_first([self.cache.values, *self.needed.tables])
            self.ranks.check_same(list(self.fields.parameters()))
        decay = schedules.warm_up_then_decay if schedule.lr_decay == "cosine" else schedules.warm_up_then_exponential
        self._set_rates(decay(progress, schedule.lr_warm_up, schedule.lr_final))
        sparse_weight = weights.sparse * schedules.fade_out(progress, weights.sparse_until)
        if self.replay is None:
            own = self._with_rays_that_fit(lambda rays: self._gradients(moment, sparse_weight, rays))
            numbers = self._update(own)
        else:
            self._scale.fill_(moment.scale)
            self._outlined.fill_(moment.outlined)
            self._sparse_weight.fill_(sparse_weight)
            current = replace(moment, scale=self._scale, outlined=self._outlined)
            kind = moment.levels, moment.samples, moment.deferred, self.terms.begun(moment)
            numbers = self._replayed(self.replay, current, kind)
        self.step_index += 1
        return numbers

    def _replayed(
        self, replay: Callable[[Callable[[], Any], Hashable], Any], moment: Moment, kind: Hashable
    ) -> dict[str, Tensor]:
        """The step as a graph; where there are several processes, up to their exchange."""

        def gradients(rays: int) -> _Share:
            return self._gradients(moment, self._sparse_weight, rays)

        if self.ranks.alone:
            return self._with_rays_that_fit(lambda rays: replay(lambda: self._update(gradients(rays)), (kind, rays)))
        return self._update(self._with_rays_that_fit(lambda rays: replay(lambda: gradients(rays), (kind, rays))))

    def _with_rays_that_fit(self, work: Callable[[int], Result]) -> Result:
        """`work`, told how many rays to render at once: those of the step, or fewer where memory runs out.

        It draws the same rays each time, and exchanges nothing: other processes may have memory enough.
        """
        drawn_from, most = self.generator.get_state(), self.params.sampling.rays

        def attempt(rays: int) -> Result:
            if rays < most:
                self.generator.set_state(drawn_from)
            if not self.ranks.alone:
                self.chance.manual_seed(self.ranks.seed(self.params.seed, self.step_index))
            return work(rays)

        return with_less(attempt, most, "rays of a training step", FEWEST_RAYS)

    def _gradients(self, moment: Moment, sparse_weight: Tensor | float, rays_at_once: int) -> _Share:
        """Draw the step's rays, and add the gradients of the losses at this process's share of them, part by part."""
        sampling, weights = self.params.sampling, self.params.losses
        batch, cells = self.needed.draw(sampling.rays, self.generator)
        extra = _Extra(
            self.sightings.draw(weights.sparse_batch, weights.sparse_step, self.generator),
            self.dense.draw(weights.dense_batch, weights.dense_step, self.generator),
            torch.rand(sampling.free_points, 3, generator=self.generator, device=self.device) * 2 - 1,
        )
        self._forget_gradients()
        rows = self.ranks.share(len(batch))
        parts = [
            self._part(
                batch, slice(first, min(first + rays_at_once, rows.stop)), extra, self._anew(moment), sparse_weight
            )
            for first in range(rows.start, max(rows.stop, 1), rays_at_once)
        ]
        numbers = {
            name: sum((part.numbers[name] for part in parts[1:]), of_first)
            for name, of_first in parts[0].numbers.items()
        }
        ray_error, squared = (torch.cat(each) for each in zip(*((p.ray_error, p.squared) for p in parts), strict=True))
        trust = torch.stack([part.trust for part in parts]).min()
        return _Share(cells, batch.masks, rows, numbers, ray_error, squared, trust)

    def _anew(self, moment: Moment) -> Moment:
        """The same, where the scale is learned with a graph of its own: each part of a step goes back through one."""
        return moment if self.fields.log_scale is None else self.moment(moment.progress)

    def _update(self, own: _Share) -> dict[str, Tensor]:
        """What all processes have found, the optimiser's step with it, and the step's numbers."""
        found = own if self.ranks.alone else self._together(own)
        self.needed.learn(found.cells, found.ray_error)
        masks, squared = found.masks, found.squared
        mse = squared.mean() if masks is None else (masks * squared).sum() / masks.sum().clamp(min=1)
        self.optimizer.step()
        return {**found.numbers, "psnr": -10 * torch.log10(mse.clamp(min=1e-10)), "trust": found.trust}

    def _together(self, own: _Share) -> _Share:
        """Sum gradients and numbers over all processes, and put their rays beside each other, in one exchange."""
        rays = torch.zeros(2, len(own.cells), device=self.device)
        rays[:, own.rows] = torch.stack([own.ray_error, own.squared])
        trust = torch.zeros(self.ranks.size, device=self.device)
        trust[self.ranks.rank] = own.trust
        parameters = [parameter for group in self.optimizer.param_groups for parameter in group["params"]]
        numbers, (ray_error, squared), trust = self.ranks.sum_gradients(
            parameters, [torch.stack(list(own.numbers.values())), rays, trust]
        )
        named = dict(zip(own.numbers, numbers, strict=True))
        return _Share(own.cells, own.masks, slice(None), named, ray_error, squared, trust.min())

    def _part(
        self, batch: RayBatch, rows: slice, extra: _Extra, moment: Moment, sparse_weight: Tensor | float
    ) -> _Part:
        """Render some rows of the batch, with the first of them the extra points; add their gradients of the loss."""
        weights = self.params.losses
        is_first, is_all = rows.start == 0, rows.stop >= len(batch)
        part = batch if is_first and is_all else batch.select(rows)
        places = extra.places if is_first else None
        rendered = self.renderer.render(part, moment, places, self.chance)
        exposed = rendered.colors * torch.exp(self.fields.log_gains[part.images])
        nothing = torch.zeros((), device=self.device)
        share = len(part) / max(len(batch), 1)

        ray_error = losses.rgb_error(exposed, part.colors)
        mask_loss = nothing
        if part.masks is not None:  # outside the masks nothing is known of the colour
            ray_error = ray_error * part.masks
            mask_loss = share * losses.mask_error(rendered.opacity, part.masks).mean()
        trust = self.terms.color_weight(rendered, exposed, moment)
        rgb_loss = share * (ray_error * trust).mean()
        omega = self.terms.eikonal_weight(rendered, ray_error, trust, moment)
        eikonal_errors = torch.cat(
            [omega * losses.eikonal_error(rendered.gradients), losses.eikonal_error(rendered.extra_gradients)]
        )
        num_points = len(batch) * rendered.weights.shape[1] + len(extra.places)
        eikonal_loss = len(eikonal_errors) / max(num_points, 1) * eikonal_errors.mean()
        of_terms = {name: (w, share * loss) for name, (w, loss) in self.terms.losses(rendered, moment).items()}
        sparse_loss = dense_loss = exposure_loss = nothing
        if is_first:
            sparse_loss, dense_loss = self._sighting_losses(rendered, extra)
            exposure_loss = losses.exposure_error(self.fields.log_gains).mean()
        gloss_loss = share * rendered.gloss.mean()
        proposal_loss = share * self._proposal_loss(rendered)

        loss = (
            rgb_loss
            + weights.eikonal * eikonal_loss
            + sum(weight * term_loss for weight, term_loss in of_terms.values())
            + sparse_weight * sparse_loss
            + weights.dense * dense_loss
            + weights.mask * mask_loss
            + weights.exposure * exposure_loss
            + weights.gloss * gloss_loss
            + proposal_loss
        )
        with short_products(self.mixed, self.device):
            loss.backward()
        with torch.no_grad():
            numbers = {
                "loss": loss.detach(),
                "rgb": rgb_loss.detach(),
                "eikonal": eikonal_loss.detach(),
                **{name: term_loss.detach() for name, (_, term_loss) in of_terms.items()},
                "sparse": sparse_loss.detach(),
                "dense": dense_loss.detach(),
                "mask": mask_loss.detach(),
                "proposal": proposal_loss.detach(),
                "gradient_norm": share * torch.linalg.vector_norm(rendered.gradients, dim=1).mean(),
                "opacity": share * rendered.opacity.detach().mean(),
                "gloss": gloss_loss.detach(),
                "reflected": share * rendered.reflected.mean(),
            }
            squared = ((exposed - part.colors) ** 2).mean(1)
            return _Part(numbers, ray_error.detach(), squared, trust.detach().min())

    def _sighting_losses(self, rendered: Rendered, extra: _Extra) -> tuple[Tensor, Tensor]:
        """Of the sparse points and of the dense ones, at the extra points."""
        weights, sparse, dense = self.params.losses, extra.sparse, extra.dense
        of_sparse, of_dense, _ = rendered.extra_sdf.split([len(sparse.places), len(dense.places), len(extra.anywhere)])
        return (
            sighting_loss(of_sparse, sparse.weights, weights.sparse_tolerance, weights.sparse_step),
            sighting_loss(of_dense, dense.weights, weights.dense_tolerance, weights.dense_step),
        )

    def _replays(self) -> bool:
        """Whether steps can be a CUDA graph: few things change in how they go, each a few times.

        Most of the paper's terms look at the progress and may wait for the device; a proposal network is not trained in
        each.
        """
        scheduled = self.params.density.scale == "scheduled" and self.fields.proposal is None
        return self.device.type == "cuda" and scheduled and not self.terms.waits

    def _prepare_rates(self) -> None:
        """Learning rates that a graph reads anew, where there is one; plain numbers elsewhere.

        A checkpoint may come from another device.
        """
        for group in self.optimizer.param_groups:
            if self.replay is None:
                group |= {"lr": group["base_lr"], "capturable": False}
            else:
                group |= {"lr": torch.tensor(group["base_lr"], device=self.device), "capturable": True}

    def _set_rates(self, factor: float) -> None:
        for group in self.optimizer.param_groups:
            if isinstance(group["lr"], Tensor):
                group["lr"].fill_(group["base_lr"] * factor)
            else:
                group["lr"] = group["base_lr"] * factor

    def _forget_gradients(self) -> None:
        """None for all gradients, but zero for the tables' on the CPU: making them anew takes longer than filling."""
        kept = self.fields.tables() if self.device.type == "cpu" else []
        gradients = [table.grad for table in kept]
        self.optimizer.zero_grad(set_to_none=True)
        for table, gradient in zip(kept, gradients, strict=True):
            table.grad = None if gradient is None else gradient.zero_()

    def _proposal_loss(self, rendered: Rendered) -> Tensor:
        """What trains the proposal network, in the steps that train it; zero where a grid guides the samples."""
        if rendered.proposal is None or not updates_now(self.step_index, self.params.sampling.proposal_updates):
            return torch.zeros((), device=self.device)
        edges = sample_edges(rendered.distances)
        return interlevel_loss(edges, rendered.weights, *rendered.proposal).mean()

    def render(self, batch: RayBatch, progress: float, extra: Float[Tensor, "e 3"] | None = None) -> Rendered:
        """Render rays and evaluate the SDF at extra points, with the schedules at progress and without chance."""
        return self.renderer.render(batch, self.moment(progress), extra)

    @torch.no_grad()
    def _refresh_cache(self, moment: Moment) -> bool:
        """Bring the sampler's grid up to date: all of it at first and now and then, else near the surface.

        Returns whether it was time for that.
        """
        every = self.params.sampling.cache_every
        if self.step_index - self.cache_step < every:
            return False
        refreshes = self.step_index // every
        # at first: of the training, or of a trainer that takes over from another
        full = self.step_index <= 4 * every or refreshes % 8 == 0 or self.cache_step < 0
        band = None if full else 4 * self.cache.cell
        self.cache.refresh(lambda p: self.fields.sdf.sdf(p, moment.levels), band)
        self.cache_step = self.step_index
        if self.needed.share and moment.progress >= NEEDED_FROM and refreshes % LOOK_EVERY == 0:
            self.needed.look(self.cache)
        return True

    # ------------------------------------------------------------------ the shape so far
    @torch.no_grad()
    def distances(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        """The SDF at points, with all levels."""
        places, levels = torch.from_numpy(points).float().to(self.device), self.params.field.levels

        def evaluate(rows: slice) -> Tensor:
            return self.fields.sdf.sdf(places[rows], levels)

        parts = in_blocks(evaluate, len(places), points_at_a_time(self.device), "points of the field")
        return torch.cat(parts).cpu().numpy()

    def coarse_surface(self) -> tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "f 3"]]:
        """Vertices of the surface in the sampler's grid; its faces that lie within the region, turned outwards."""
        from skimage.measure import marching_cubes

        if self.cache_step < 0:
            self._refresh_cache(self.moment(0.0))
        grid = self.cache.values[0, 0].cpu().numpy().transpose(2, 1, 0)
        if grid.min() >= 0 or grid.max() <= 0:
            return np.zeros((0, 3)), np.zeros((0, 3), dtype=int)
        vertices, faces, _, _ = marching_cubes(grid, 0.0, gradient_direction="descent")
        vertices = vertices * self.cache.cell - 1
        inside = (np.linalg.norm(vertices, axis=1) < 1)[faces].all(1)
        return vertices, faces[inside]

    # ------------------------------------------------------------------ previews, checkpoints
    @torch.no_grad()
    def preview(self, image: int, progress: float, width: int = 160) -> UInt8[np.ndarray, "h w3 3"]:
        """Photo, render and normals of photo `image` side by side, each about `width` wide."""
        photo_width, photo_height = self.photos.sizes[image].tolist()
        step = max(1, photo_width // width)
        y, x = torch.meshgrid(torch.arange(0, photo_height, step), torch.arange(0, photo_width, step), indexing="ij")
        pixels = torch.stack([x, y], 2).view(-1, 2).float().to(self.device)
        photo, color, normal = (torch.zeros(len(pixels), 3) for _ in range(3))
        every = torch.arange(len(pixels), device=self.device)

        def draw(some: slice) -> None:
            part = every[some]
            batch = self.photos.rays(torch.full_like(part, image), pixels[part])
            rendered = self.render(batch, progress)
            rows = part[batch.drawn].cpu()
            _, normals = rendered.surface
            photo[rows] = batch.colors.cpu()
            color[rows] = (rendered.colors * torch.exp(self.fields.log_gains[image])).clamp(0, 1).cpu()
            normal[rows] = (normals * 0.5 + 0.5).cpu()

        in_blocks(draw, len(pixels), RAYS_AT_ONCE, RENDERED)
        panels = [panel.view(*x.shape, 3) for panel in (photo, color, normal)]
        return (255 * torch.cat(panels, 1)).byte().numpy()

    def state(self) -> dict[str, Any]:
        """Everything that the next step depends on."""
        return {
            "fields": self.fields.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "cache": self.cache.values,
            "cache_step": self.cache_step,
            "needed": self.needed.state(),
            "generator": self.generator.get_state(),
            "step_index": self.step_index,
        }

    def fits(self, state: Any) -> bool:
        """Whether a state is of networks, an optimiser and photos like these: `load_state` takes no other."""
        own, groups = self.state(), self.optimizer.param_groups
        parameters = [parameter for group in groups for parameter in group["params"]]
        once = torch.zeros(())
        moments = [{"step": once, "exp_avg": parameter, "exp_avg_sq": parameter} for parameter in parameters]
        try:
            counts = [len(group["params"]) for group in state["optimizer"]["param_groups"]]
            learned = state["optimizer"]["state"].items()
            return (
                all(_alike(state[part], own[part]) for part in own.keys() - {"optimizer", "generator"})
                and counts == [len(group["params"]) for group in groups]
                and all(_alike(found, moments[i]) for i, found in learned)
                and isinstance(state["generator"], Tensor)
            )
        except (LookupError, TypeError, AttributeError):
            return False

    def load_state(self, state: dict[str, Any]) -> None:
        self.fields.load_state_dict(state["fields"])
        self.optimizer.load_state_dict(state["optimizer"])
        self._prepare_rates()
        self.cache.values.copy_(state["cache"])
        self.cache_step = state["cache_step"]
        self.needed.load_state(state["needed"])
        self.step_index = state["step_index"]
        drawn = state["generator"].cpu()
        if _alike(drawn, self.generator.get_state()) and drawn.dtype == torch.uint8:
            self.generator.set_state(drawn)
        else:  # that of a CPU means nothing to a GPU
            self.generator.manual_seed(self.params.seed + self.step_index)


def _alike(state: Any, own: Any) -> bool:
    """Whether a state has the keys, types and shapes of our own."""
    if isinstance(own, dict):
        alike = isinstance(state, dict) and state.keys() == own.keys()
        return alike and all(_alike(state[key], own[key]) for key in own)
    if isinstance(own, Tensor):
        return isinstance(state, Tensor) and state.shape == own.shape
    return type(state) is type(own)
