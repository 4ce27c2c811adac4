"""The SDF is held to be linear around surface points of even appearance (paper L_planar, lambda_pla).

Shapes: Q rays with a surface point each, J neighbours of each, F appearance features.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from configs.training import PlanarParams, TermParams
from stages.neural import losses, schedules
from stages.neural.rendered import OPAQUE, Rendered
from stages.neural.schedules import Moment
from stages.neural.terms.term import Term

if TYPE_CHECKING:
    from jaxtyping import Float

# Slope error from which the planar term pulls linearly: about 6 degrees, so that a sharp edge is not rounded away.
_PLANAR_DELTA = 0.1
# The literal planar term divides by a length, which may be 0.
_LENGTH_FLOOR = 1e-9


def planar_error_literal(
    sdf: Float[Tensor, "q j"], normals: Float[Tensor, "q 3"], offsets: Float[Tensor, "q j 3"]
) -> Float[Tensor, "q j"]:
    """|f(x_k) / |x_k - x_0| - n_0.(x_k - x_0) / |x_k - x_0|| per neighbour (paper L_planar as written).

    sdf at x_0 + offsets, unit normals at x_0. The paper takes x_k on the viewing ray before
    x_0. Zero for a plane only where f(x_0) = 0; f(x_0) / |x_k - x_0| otherwise, without bound near x_0.
    """
    length = torch.linalg.vector_norm(offsets, dim=2).clamp(min=_LENGTH_FLOOR)
    return (sdf / length - torch.einsum("qc,qkc->qk", normals, offsets) / length).abs()


def planar_error(
    sdf: Float[Tensor, "q j"],
    sdf_center: Float[Tensor, " q"],
    normals: Float[Tensor, "q 3"],
    offsets: Float[Tensor, "q j 3"],
    radius: float,
) -> Float[Tensor, "q j"]:
    """Huber of (f(x_k) - f(x_0) - n_0.(x_k - x_0)) / max(|x_k - x_0|, eta/4) per neighbour (paper L_planar).

    How far f is from linear around surface points: sdf at x_0 + offsets, sdf_center and unit normals at x_0, eta =
    radius. Zero for a plane at any distance. The paper leaves f(x_0) out, divides by |x_k - x_0| alone and takes the
    absolute value: an x_0 that is off by 1e-3 then outweighs the shape.
    """
    linear = sdf_center[:, None] + torch.einsum("qc,qkc->qk", normals, offsets)
    length = torch.linalg.vector_norm(offsets, dim=2).clamp(min=0.25 * radius)
    return torch.nn.functional.huber_loss(sdf / length, linear / length, reduction="none", delta=_PLANAR_DELTA)


def planarity_literal(
    features: Float[Tensor, "q j f"], center_features: Float[Tensor, "q f"], epsilon: float = 1e-3
) -> Float[Tensor, "q j"]:
    """lambda_pla = epsilon / (|c(x_k) - c(x_0)| + epsilon) (paper lambda_pla^k as written).

    1 for equal features, about 1e-3 for features that differ by 1. Differentiable, since the
    paper does not stop it: pulling features apart lowers the loss.
    """
    return epsilon / (torch.linalg.vector_norm(features - center_features[:, None], dim=2) + epsilon)


def planarity(features: Float[Tensor, "q j f"], center_features: Float[Tensor, "q f"]) -> Float[Tensor, "q j"]:
    """lambda_pla = sg[tau / (|c(x_k) - c(x_0)| + tau)], tau the batch's median difference (paper lambda_pla^k).

    Near 1 where the appearance features equal those at the centre, 1/2 at the median. The paper's
    tau = 1e-3 drives it to ~1e-3 everywhere. Detached: else features would be pulled apart to be rid of the term.
    """
    difference = torch.linalg.vector_norm(features - center_features[:, None], dim=2).detach()
    tau = difference.median().clamp(min=1e-6)
    return tau / (difference + tau)


def planarity_scale(moment: Moment, params: PlanarParams) -> float:
    """What lambda_pla is scaled by: from `scale_start` to 1 at progress `scale_until` (paper: 0.1 to 1.0)."""
    return schedules.exponential(moment.progress / params.scale_until, params.scale_start, 1.0)


def has_feature_mlp(params: TermParams) -> bool:
    """Whether an MLP makes the features of lambda_pla; the relaxed Eikonal term reads lambda_pla, too."""
    return params.planar.features == "mlp" and (params.planar.form != "off" or params.eikonal.form != "plain")


# ---------------------------------------------------------------------- in a step
class Planar(Term):
    """The planar loss, and what trains the appearance features where an MLP of its own makes them."""

    def losses(self, rendered: Rendered, moment: Moment) -> dict[str, tuple[float, Float[Tensor, ""]]]:
        return {
            "planar": (self.params.terms.planar.weight, self._planar_loss(rendered, moment)),
            "appearance": (1.0, self._appearance_loss(rendered)),
        }

    def _planar_loss(self, rendered: Rendered, moment: Moment) -> Float[Tensor, ""]:
        """Mean planar error around the surface points of some of the rays, adaptively weighted (paper L_planar).

        The paper's neighbours lie on the ray before the surface; in the stable form half of them do, the others lie on
        a disk in the tangent plane, and the reach shrinks to three voxels.
        """
        params = self.params.terms.planar
        nothing = torch.zeros((), device=self.device)
        if params.form == "off":
            return nothing
        chosen = torch.nonzero(rendered.opacity.detach() > OPAQUE).squeeze(1)[: params.rays]
        if len(chosen) == 0:
            return nothing
        surface, normals = (part[chosen] for part in rendered.surface)
        dirs = rendered.batch.directions[chosen]
        radius = params.radius
        if params.form == "stable":
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
        if params.form == "paper":
            weight = planarity_literal(around, center)
            error = planar_error_literal(sdf_around, unit_normals, offsets)
        else:
            weight = planarity(around, center)
            error = planar_error(sdf_around, sdf_center, unit_normals, offsets, radius)
        return planarity_scale(moment, params) * (weight * error).mean()

    def _appearance_loss(self, rendered: Rendered) -> Float[Tensor, ""]:
        """Mean colour error of the feature MLP at surface points: what trains it in the stable form.

        Zero without the MLP, and in the paper's form.
        """
        mlp, batch, terms = self.fields.appearance, rendered.batch, self.params.terms
        nothing = torch.zeros((), device=self.device)
        if mlp is None or "stable" not in (terms.planar.form, terms.eikonal.form):
            return nothing
        hit = torch.nonzero(rendered.opacity.detach() > OPAQUE).squeeze(1)[: terms.planar.rays]
        if len(hit) == 0:
            return nothing
        predicted = mlp.color(mlp(rendered.surface[0][hit], batch.directions[hit]))
        gains = torch.exp(self.fields.log_gains.detach())[batch.images[hit]]
        error = losses.rgb_error(predicted * gains, batch.colors[hit])
        return (error if batch.masks is None else error * batch.masks[hit]).mean()

    def _neighbors(
        self, normals: Float[Tensor, "q 3"], dirs: Float[Tensor, "q 3"], radius: float
    ) -> Float[Tensor, "q j 3"]:
        """Offsets of neighbours from surface points with these normals, seen along dirs."""
        params = self.params.terms.planar
        shape = (len(normals), params.neighbors)
        reach = radius * torch.rand(*shape, 1, generator=self.generator, device=self.device)
        on_ray = -dirs[:, None].expand(*shape, 3)
        if params.form == "paper":
            return on_ray * reach
        draws = torch.randn(*shape, 3, generator=self.generator, device=self.device)
        tangent = draws - torch.einsum("qkc,qc->qk", draws, normals)[..., None] * normals[:, None]
        disk = torch.nn.functional.normalize(tangent, dim=2) * (reach * radius).sqrt()  # even over the disk's area
        half = torch.arange(shape[1], device=self.device) % 2 == 0
        return torch.where(half[None, :, None], on_ray * reach, disk)
