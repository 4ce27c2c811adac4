"""What one of the paper's terms may do in a training step.

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
from stages.neural.training_photos import Photos

if TYPE_CHECKING:
    from jaxtyping import Float


class Term:
    """A term overrides what it has a say in, and looks into its settings for whether and from when on it has one.

    Attributes:
        photos, generator, evidence: what training has; None where a trained field is only rendered.
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
        self.fields, self.cache, self.params = fields, cache, params
        self.photos, self.generator, self.evidence = photos, generator, evidence
        self.device = cache.values.device

    def has_begun(self, moment: Moment) -> bool:
        """Whether it counts by now; a recorded step goes on as it was, so it is recorded anew when one begins."""
        return True

    def recolored(self, rendered: Rendered, moment: Moment, generator: torch.Generator | None) -> Rendered:
        """The rays with the colours that they have by this term."""
        return rendered

    def color_weight(
        self, rendered: Rendered, exposed: Float[Tensor, "r 3"], moment: Moment
    ) -> Float[Tensor, " r"] | None:
        """Weight of each ray's colour error; `exposed` is what is compared with the photos. None: 1."""
        return None

    def eikonal_weight(
        self, rendered: Rendered, ray_error: Float[Tensor, " r"], trust: Float[Tensor, " r"], moment: Moment
    ) -> Float[Tensor, " n"] | None:
        """Weight of the Eikonal error at the samples, given each ray's colour error and its weight.

        None: 1.
        """
        return None

    def losses(self, rendered: Rendered, moment: Moment) -> dict[str, tuple[float, Float[Tensor, ""]]]:
        """What is to be lowered, by its name in the metrics: its weight in the sum, and its value before weighting."""
        return {}
