"""The SDF's gradient is held to length 1 less where the photos are not met yet (paper eq. adaptive_weight).

Shapes: R rays, K samples a ray, N = R K points.
"""

from __future__ import annotations

import torch

from stages.neural.rendered import OPAQUE, Rendered
from stages.neural.schedules import Moment
from stages.neural.terms.planar import planarity, planarity_literal, planarity_scale
from stages.neural.terms.term import Term

# Samples that weigh more than this count as near the surface for the relaxed Eikonal term.
_NEAR_SURFACE_WEIGHT = 0.01
# The relaxed Eikonal term keeps at least this weight, or f stops being a distance and every other term breaks.
_RELAXATION_FLOOR = 0.2


def eikonal_relaxation_literal(
    photo_error: torch.Tensor, planarity: torch.Tensor, gamma: float = 5.0, clip: float = 0.2
) -> torch.Tensor:
    """omega [...] = planarity exp(-gamma min(err, clip)) (paper eq. adaptive_weight as written).

    Differentiable in both, since the paper stops neither: a higher colour error, below the clip, then lowers the
    Eikonal loss. Never above the planarity, which in its literal form is about 1e-3: so is the whole term.
    """
    return planarity * torch.exp(-gamma * photo_error.clamp(max=clip))


def eikonal_relaxation(
    photo_error: torch.Tensor, planarity: torch.Tensor | float = 1.0, gamma: float = 5.0, clip: float = 0.2
) -> torch.Tensor:
    """omega [...] = sg[w + (1 - w) exp(-gamma min(err, clip)) (1 + planarity) / 2], w = 0.2.

    The paper's eq. adaptive_weight. 1 where the photo is met, falling where the colour error err is large, so that
    detail may bend f there. The paper's omega = lambda_pla exp(-gamma err) vanishes with its lambda_pla ~ 1e-3; this
    one never falls below w, which keeps f metric. Detached: else the error could be raised to be rid of the
    constraint.
    """
    decay = torch.exp(-gamma * photo_error.clamp(max=clip))
    return (_RELAXATION_FLOOR + (1 - _RELAXATION_FLOOR) * decay * (0.5 + 0.5 * planarity)).detach()


# ---------------------------------------------------------------------- in a step
class Eikonal(Term):
    """The weight of the Eikonal term at the rays' samples."""

    def eikonal_weight(
        self, rendered: Rendered, ray_error: torch.Tensor, trust: torch.Tensor, moment: Moment
    ) -> torch.Tensor:
        """Weight omega [N] of the Eikonal term at the rays' samples, from the colour error [R] (paper
        eq. adaptive_weight).

        The paper's form weighs every sample of a ray that meets a surface and carries gradients. The stable form weighs
        only samples near the surface, and takes the error times the `trust` [R] in the photo: what a mirror shows is
        no reason to bend f. 1 elsewhere: there is no x_0 to compare with.
        """
        params = self.params.terms.eikonal
        omega = torch.ones_like(rendered.weights).view(-1)
        if params.form == "plain":
            return omega
        weighed = (rendered.opacity.detach() > OPAQUE)[:, None].expand_as(rendered.weights)
        if params.form == "stable":
            weighed = weighed & (rendered.weights.detach() > _NEAR_SURFACE_WEIGHT)
        ray, sample = torch.nonzero(weighed, as_tuple=True)
        if len(ray) == 0:
            return omega
        places = ray * rendered.weights.shape[1] + sample
        with torch.set_grad_enabled(params.form == "paper"):
            if self.fields.appearance is None:
                features, center = rendered.features[places], rendered.mean(rendered.features)[ray]
            else:
                features = self.fields.appearance(rendered.points[places], rendered.batch.directions[ray])
                center = self.fields.appearance(rendered.surface[0], rendered.batch.directions)[ray]
            if params.form == "paper":
                scale = planarity_scale(moment, self.params.terms.planar)
                lambda_pla = scale * planarity_literal(features[:, None], center)[:, 0]
                values = eikonal_relaxation_literal(ray_error[ray], lambda_pla, params.gamma, params.clip)
            else:
                lambda_pla = planarity(features[:, None], center)[:, 0]
                values = eikonal_relaxation((ray_error * trust)[ray], lambda_pla, params.gamma, params.clip)
        return omega.index_copy(0, places, values)
