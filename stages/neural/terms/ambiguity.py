"""How far photos disagree on the colour of a surface point, and how little they are trusted there (paper: SDF-guided
multi-view consistency, eq. ambiguity_factor and loss_without_ambiguity).

Shapes: R rays, I photos.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from stages.errors import ReconstructionError, SystemRequirementError
from stages.neural.acceleration import points_at_a_time
from stages.neural.rendered import OPAQUE, Rendered
from stages.neural.schedules import Moment
from stages.neural.terms.term import Term
from stages.neural.training_photos import Photos
from stages.neural.visibility import (
    VISIBLE,
    MeshVisibility,
    path_margin,
    sdf_visibility,
    smallest_sdf_on_paths,
    visibility_literal,
)

if TYPE_CHECKING:
    from jaxtyping import Float, Int

# Keeps the colour covariance invertible where photos are nearly grey: one 8-bit level, squared.
COLOR_VARIANCE_FLOOR = (1 / 255) ** 2
# A covariance whose smallest eigenvalue is this small a part of the largest has no inverse worth the name.
_SINGULAR = 1e-9
# Smallest squared Mahalanobis distance: keeps the root's gradient finite where two colours agree.
_SQUARED_DISTANCE_FLOOR = 1e-12


def color_precision(
    photos: Photos, generator: torch.Generator, num_pixels: int = 100_000, floor: float = COLOR_VARIANCE_FLOOR
) -> Float[Tensor, "3 3"]:
    """Inverse of the empirical colour covariance over the training photos (paper: Sigma^-1).

    `floor` is added to each channel's variance. The paper adds none (0): photos in shades of one colour then have no
    inverse.

    Raises:
        ValueError: the covariance has none.
    """
    training = torch.nonzero(photos.training).squeeze(1)
    images = training[torch.randint(len(training), (num_pixels,), generator=generator, device=photos.device)]
    place = torch.rand(num_pixels, generator=generator, device=photos.device, dtype=torch.float64)
    rows = photos.first[images] + (place * photos.sizes[images].prod(1)).long()
    if photos.masks is not None:
        rows = rows[photos.masks[rows] > 127]
    covariance = torch.cov((photos.pixels[rows].double() / 255).T) + floor * torch.eye(3, device=photos.device)
    if torch.linalg.matrix_rank(covariance, rtol=_SINGULAR, hermitian=True) < 3:
        raise ValueError("the covariance of the photos' colours has no inverse: got fewer than 3 channels that vary")
    return torch.linalg.inv(covariance).float()


def mahalanobis(
    colors: Float[Tensor, "*#any 3"], others: Float[Tensor, "*any 3"], precision: Float[Tensor, "3 3"]
) -> Float[Tensor, "*any"]:
    """D_M = sqrt((C_i - C_j)^T Sigma^-1 (C_i - C_j)) for colours (paper eq. ambiguity_factor).

    At least 1e-6, without a gradient there. The paper's C_i is the rendered colour, and D_M pulls at it.
    """
    difference = colors - others
    squared = torch.einsum("...a,ab,...b->...", difference, precision, difference)
    return squared.clamp(min=_SQUARED_DISTANCE_FLOOR).sqrt()


def ambiguity(visibility: Float[Tensor, "r i"], distance: Float[Tensor, "r i"]) -> Float[Tensor, " r"]:
    """lambda = mean over the visible views of V_j D_M(C_i, C_j) (paper eq. ambiguity_factor).

    A view is visible when V_j > 0.9. Zero where no view is.
    """
    seen = (visibility > VISIBLE).to(visibility.dtype)
    return (seen * visibility * distance).sum(1) / seen.sum(1).clamp(min=1)


def trust_literal(lambda_ambiguity: Float[Tensor, " r"]) -> Float[Tensor, " r"]:
    """Weight of each ray's colour error: 1 / (1 + lambda) (paper eq. loss_without_ambiguity as written).

    Differentiable: where lambda comes from rendered colours, the loss can also be lowered by raising lambda.
    """
    return 1 / (1 + lambda_ambiguity)


def trust(lambda_ambiguity: Float[Tensor, " r"]) -> Float[Tensor, " r"]:
    """Weight of each ray's colour error: sg[1 / (1 + lambda)], scaled to mean 1 (paper eq. loss_without_ambiguity).

    The mean is held, so that doubt in some rays does not shift the balance against the other terms. Detached: else the
    error could be lowered by raising the doubt.
    """
    weights = trust_literal(lambda_ambiguity.detach())
    return weights / weights.mean()


# ---------------------------------------------------------------------- in a step
class Ambiguity(Term):
    """The weight of each ray's colour error."""

    def color_weight(
        self, rendered: Rendered, exposed: Float[Tensor, "r 3"], moment: Moment
    ) -> Float[Tensor, " r"] | None:
        """Weight of each ray's colour error, 1 / (1 + lambda_ambiguity) (paper eq. loss_without_ambiguity).

        The stable form compares photos with photos, carries no gradient, has mean 1 over the surface, and is 1 before
        `start`: early on, a pattern seen at a wrong depth would pass for a reflection. The paper's form
        compares the rendered colours `exposed` with the photos, from the first step.
        """
        params, batch = self.params.terms.ambiguity, rendered.batch
        if params.form == "off" or (params.form == "stable" and moment.progress < params.start):
            return None
        weights = torch.ones(len(batch), device=self.device)  # no doubt where no surface was met
        met = rendered.opacity.detach() > OPAQUE
        hit = torch.nonzero(met if batch.masks is None else met & (batch.masks > 0.5)).squeeze(1)
        colors, seen = self._views(hit, rendered, moment)
        if params.form == "paper":
            distance = mahalanobis(exposed[hit, None], colors, self.color_precision)
            return weights.index_copy(0, hit, trust_literal(ambiguity(seen, distance)))
        gains = torch.exp(self.fields.log_gains.detach())
        own = batch.colors[hit] / gains[batch.images[hit]]
        distance = mahalanobis(own[:, None], colors / gains, self.color_precision)
        return weights.index_copy(0, hit, trust(ambiguity(seen, distance)))

    @cached_property
    def color_precision(self) -> Float[Tensor, "3 3"]:
        """The photos' inverse colour covariance, from a draw of its own."""
        assert self.photos is not None
        generator = torch.Generator(device=self.device).manual_seed(self.params.seed)
        floor = 0.0 if self.params.terms.ambiguity.form == "paper" else COLOR_VARIANCE_FLOOR
        try:
            return color_precision(self.photos, generator, floor=floor)
        except ValueError as error:
            raise ReconstructionError(
                f"The photos cannot be compared by colour as `train.terms.ambiguity.form` = paper does: {error}.",
                "Use `--set train.terms.ambiguity.form=stable`, which regularises the covariance.",
            ) from error

    @cached_property
    def mesh_visibility(self) -> MeshVisibility:
        """Rays cast at a mesh; only the visibility `mesh` asks for it."""
        try:
            return MeshVisibility(self.cache)
        except ModuleNotFoundError as error:
            raise SystemRequirementError(
                "`train.terms.ambiguity.visibility` = mesh needs the Python package open3d, which is not installed.",
                "Run `pip install open3d`, or use `--set train.terms.ambiguity.visibility=stable`.",
            ) from error

    @torch.no_grad()
    def _views(
        self, hit: Int[Tensor, " m"], rendered: Rendered, moment: Moment
    ) -> tuple[Float[Tensor, "m i 3"], Float[Tensor, "m i"]]:
        """What every photo shows at the surface points of rays `hit`: colours, visibility factor.

        The factor is 0 in the ray's own photo, in those not trained on, and where the point is out of frame.
        """
        params, photos = self.params.terms.ambiguity, self.photos
        assert photos is not None
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
        points, centers, beta = surface[ray], photos.centers[view], params.sharpness
        if literal:
            sdf = self.cache.lookup if params.visibility == "paper" else self._network_sdf(moment)
            factor = visibility_literal(sdf, points, centers, params.samples, self.generator, beta)
        else:
            margin = path_margin(facing[ray, view], moment.width, max(moment.voxel, self.cache.cell / 2))
            if params.visibility == "mesh":
                factor = self.mesh_visibility(points, centers, margin)
            else:
                smallest = smallest_sdf_on_paths(self.cache, points, centers, margin, params.samples, beta)
                factor = sdf_visibility(smallest, beta)
        seen = torch.zeros_like(facing)
        seen[ray, view] = factor
        return colors, seen

    def _network_sdf(self, moment: Moment) -> Callable[[Tensor], Tensor]:
        """f [...] of the network at points [..., 3], in parts: they are many."""

        def sdf(points: Tensor) -> Tensor:
            parts = points.reshape(-1, 3).split(points_at_a_time(self.device))
            return torch.cat([self.fields.sdf.sdf(part, moment.levels) for part in parts]).view(points.shape[:-1])

        return sdf
