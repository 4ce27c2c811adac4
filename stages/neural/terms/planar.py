"""The surface is held to be flat where it looks even (paper L_planar, lambda_pla).

Shapes: Q rays with a surface point each, J neighbours of each, F appearance features.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from configs.training import PlanarParams, TermParams
from stages.neural import losses, schedules
from stages.neural.acceleration import first_rows, fixed_shapes
from stages.neural.evidence import at_places
from stages.neural.rendered import OPAQUE, Rendered
from stages.neural.schedules import Moment
from stages.neural.terms.term import Term

if TYPE_CHECKING:
    from jaxtyping import Float, Int

# Mean difference of a photo's colours that noise makes, and below which they are the same.
_NOISE = 0.02
# Difference of two unit normals from which it counts linearly: half a degree.
_BENT = 0.01
# The nearest neighbours are this part of the reach away.
_NEAREST = 0.2
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


def evenness(difference: Float[Tensor, " q"], tau: float = _NOISE) -> Float[Tensor, " q"]:
    """lambda_pla = exp(-|C(p) - C(p_0)| / tau) per pair of pixels of a photo, tau = 0.02 (paper lambda_pla^k).

    Args:
        difference: mean over the channels of the colours' absolute differences, colours in [0, 1].

    Near 1 where the photo shows one even colour, so that nothing but the light can differ: there the surface is flat,
    as far as anybody can tell. The paper compares features that training may choose, with tau = 1e-3.
    """
    return torch.exp(-difference / tau)


def bending_error(normals: Float[Tensor, "q 3"], others: Float[Tensor, "q 3"]) -> Float[Tensor, " q"]:
    """|n_k - n_0| of unit normals per pair, smoothed below half a degree (in place of the paper's L_planar).

    Zero on a plane, wherever f's zero is; on an edge every pair across it counts alike, so that edges stay sharp. The
    paper asks f(x_k) to be linear along the ray, and divides by the distance: an x_0 that is off by 1e-3 then outweighs
    the shape.
    """
    squared = ((normals - others) ** 2).sum(1)
    return torch.sqrt(squared + _BENT**2) - _BENT


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
    """Whether an MLP makes the features of the paper's lambda_pla, which the relaxed Eikonal term reads, too."""
    return params.planar.features == "mlp" and (params.planar.form == "paper" or params.eikonal.form != "plain")


# ---------------------------------------------------------------------- in a step
class Planar(Term):
    """The planar loss, and what trains the appearance features where an MLP of its own makes them."""

    def has_begun(self, moment: Moment) -> bool:
        """Whether the stable form counts by now."""
        params = self.params.terms.planar
        return params.form != "stable" or moment.progress >= params.start

    def losses(self, rendered: Rendered, moment: Moment) -> dict[str, tuple[float, Float[Tensor, ""]]]:
        return {
            "planar": (self.params.terms.planar.weight, self._planar_loss(rendered, moment)),
            "appearance": (1.0, self._appearance_loss(rendered)),
        }

    def _planar_loss(self, rendered: Rendered, moment: Moment) -> Float[Tensor, ""]:
        """Mean planar error around the surface points of some of the rays, adaptively weighted (paper L_planar)."""
        params = self.params.terms.planar
        nothing = torch.zeros((), device=self.device)
        if params.form == "off" or not self.has_begun(moment):
            return nothing
        met = rendered.opacity.detach() > OPAQUE
        if params.form == "stable" and fixed_shapes(self.device):
            return self._bending(rendered, first_rows(met, params.rays), moment)
        chosen = torch.nonzero(met).squeeze(1)[: params.rays]
        if len(chosen) == 0:
            return nothing
        if params.form == "stable":
            return self._bending(rendered, chosen, moment)
        return self._planar_loss_literal(rendered, chosen, moment)

    def _bending(self, rendered: Rendered, chosen: Int[Tensor, " q"], moment: Moment) -> Float[Tensor, ""]:
        """How much the normals differ from those of places beside them that have the same colour in the ray's photo.

        Where dense stereo knows the surface it needs no such help.
        """
        assert self.photos is not None
        assert self.evidence is not None
        surface, normals = (part[chosen] for part in rendered.surface)
        beside = surface + self._beside(normals)
        images = rendered.batch.images[chosen]
        colors, shown = self.photos.colors_at(images, beside)
        shown &= rendered.opacity.detach()[chosen] > OPAQUE
        difference = (colors - rendered.batch.colors[chosen]).abs().mean(1)
        _, _, gradients = self.fields.sdf(torch.cat([surface, beside]), moment.levels)
        here, there = torch.nn.functional.normalize(gradients, dim=1).chunk(2)
        unknown = 1 - at_places(self.evidence.known, surface)
        return (shown * unknown * evenness(difference) * bending_error(here, there)).mean()

    def _beside(self, normals: Float[Tensor, "q 3"]) -> Float[Tensor, "q 3"]:
        """Offsets along the surface, as many of each size on a log scale."""
        params = self.params.terms.planar
        draws = torch.randn(normals.shape, generator=self.generator, device=self.device)
        tangent = draws - (draws * normals).sum(1, keepdim=True) * normals
        part = torch.rand(len(normals), 1, generator=self.generator, device=self.device)
        return torch.nn.functional.normalize(tangent, dim=1) * params.radius * _NEAREST**part

    def _planar_loss_literal(self, rendered: Rendered, chosen: Int[Tensor, " q"], moment: Moment) -> Float[Tensor, ""]:
        """The paper's form: neighbours lie on the ray before the surface."""
        params = self.params.terms.planar
        surface, _ = (part[chosen] for part in rendered.surface)
        dirs = rendered.batch.directions[chosen]
        shape = (len(chosen), params.neighbors)
        reach = params.radius * torch.rand(*shape, 1, generator=self.generator, device=self.device)
        offsets = -dirs[:, None] * reach
        places = torch.cat([surface, (surface[:, None] + offsets).reshape(-1, 3)])
        sdf, features, gradients = self.fields.sdf(places, moment.levels)
        # c_feat looks from x_k at the surface on its ray, which is along the ray.
        along = torch.cat([dirs, dirs.repeat_interleave(params.neighbors, 0)])
        if self.fields.appearance is not None:
            features = self.fields.appearance(places, along)
        center, around = features[: len(chosen)], features[len(chosen) :].view(*shape, -1)
        unit_normals = torch.nn.functional.normalize(gradients[: len(chosen)], dim=1)
        error = planar_error_literal(sdf[len(chosen) :].view(shape), unit_normals, offsets)
        return planarity_scale(moment, params) * (planarity_literal(around, center) * error).mean()

    def _appearance_loss(self, rendered: Rendered) -> Float[Tensor, ""]:
        """Mean colour error of the feature MLP at surface points: what trains it for the stable Eikonal term.

        Zero without the MLP, and in the paper's form.
        """
        mlp, batch, terms = self.fields.appearance, rendered.batch, self.params.terms
        nothing = torch.zeros((), device=self.device)
        if mlp is None or terms.eikonal.form != "stable":
            return nothing
        hit = torch.nonzero(rendered.opacity.detach() > OPAQUE).squeeze(1)[: terms.planar.rays]
        if len(hit) == 0:
            return nothing
        predicted = mlp.color(mlp(rendered.surface[0][hit], batch.directions[hit]))
        gains = torch.exp(self.fields.log_gains.detach())[batch.images[hit]]
        error = losses.rgb_error(predicted * gains, batch.colors[hit])
        return (error if batch.masks is None else error * batch.masks[hit]).mean()
