"""The paper's terms: one file each, with its equations, its paper form, its stable form and when it counts.

To add one: its file here, its settings in `configs/training.py`, its name in `KINDS`. `docs/math.md` says how the forms
differ and why.

Shapes: R rays, K samples a ray, N = R K points.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from configs.training import TrainParams
from stages.neural.evidence import Evidence
from stages.neural.fields import Fields
from stages.neural.rendered import Rendered
from stages.neural.sampling import SdfCache
from stages.neural.schedules import Moment
from stages.neural.terms.ambiguity import Ambiguity
from stages.neural.terms.eikonal import Eikonal
from stages.neural.terms.planar import Planar
from stages.neural.terms.reflection import Reflection
from stages.neural.terms.term import Term
from stages.neural.training_photos import Photos

if TYPE_CHECKING:
    from jaxtyping import Float

KINDS: tuple[type[Term], ...] = (Ambiguity, Reflection, Planar, Eikonal)


class Terms:
    """All terms on a batch; see `Term` for what each may do.

    Attributes:
        waits: whether any of those that the settings ask for, now or later, look at the progress as it changes, or may
            wait for the device: all but the planar term's stable form, which begins at one step and goes on.
    """

    def __init__(
        self,
        fields: Fields,
        cache: SdfCache,
        params: TrainParams,
        photos: Photos | None = None,
        generator: torch.Generator | None = None,
        evidence: Evidence | None = None,
    ) -> None:
        terms = params.terms
        forms = (terms.ambiguity.form, terms.reflection.form)
        self.waits = set(forms) != {"off"} or terms.eikonal.form != "plain" or terms.planar.form == "paper"
        self.all = tuple(kind(fields, cache, params, photos, generator, evidence) for kind in KINDS)

    def begun(self, moment: Moment) -> tuple[bool, ...]:
        """Which of them count by now."""
        return tuple(term.has_begun(moment) for term in self.all)

    def recolored(self, rendered: Rendered, moment: Moment, generator: torch.Generator | None) -> Rendered:
        """The rays with the colours that they have by all terms."""
        for term in self.all:
            rendered = term.recolored(rendered, moment, generator)
        return rendered

    def color_weight(self, rendered: Rendered, exposed: Float[Tensor, "r 3"], moment: Moment) -> Float[Tensor, " r"]:
        """Weight of each ray's colour error."""
        weight = torch.ones_like(rendered.batch.leave)
        for term in self.all:
            if (factor := term.color_weight(rendered, exposed, moment)) is not None:
                weight = weight * factor
        return weight

    def eikonal_weight(
        self, rendered: Rendered, ray_error: Float[Tensor, " r"], trust: Float[Tensor, " r"], moment: Moment
    ) -> Float[Tensor, " n"]:
        """Weight of the Eikonal error at the samples."""
        weight = torch.ones_like(rendered.weights).view(-1)
        for term in self.all:
            if (factor := term.eikonal_weight(rendered, ray_error, trust, moment)) is not None:
                weight = weight * factor
        return weight

    def losses(self, rendered: Rendered, moment: Moment) -> dict[str, tuple[float, Float[Tensor, ""]]]:
        """Weight and value of each loss, by name."""
        return {name: loss for term in self.all for name, loss in term.losses(rendered, moment).items()}
