"""What one of the paper's terms may do in a training step.

Shapes: R rays, K samples a ray, N = R K points.
"""

from __future__ import annotations

import torch

from configs.training import TrainParams
from stages.neural.fields import Fields
from stages.neural.rendered import Rendered
from stages.neural.sampling import SdfCache
from stages.neural.schedules import Moment
from stages.neural.training_photos import Photos


class Term:
    """A term overrides what it has a say in, and looks into its settings for whether and from when on it has one.

    Attributes:
        name: of its loss in the metrics.
        photos, generator: what training has; None where a trained field is only rendered.
    """

    name = ""

    def __init__(
        self,
        fields: Fields,
        cache: SdfCache,
        params: TrainParams,
        photos: Photos | None = None,
        generator: torch.Generator | None = None,
    ) -> None:
        self.fields, self.cache, self.params = fields, cache, params
        self.photos, self.generator = photos, generator
        self.device = cache.values.device

    def recolored(self, rendered: Rendered, moment: Moment, generator: torch.Generator | None) -> Rendered:
        """The rays with the colours that they have by this term."""
        return rendered

    def color_weight(self, rendered: Rendered, exposed: torch.Tensor, moment: Moment) -> torch.Tensor | None:
        """Weight [R] of each ray's colour error; `exposed` [R, 3] is what is compared with the photos. None: 1."""
        return None

    def eikonal_weight(
        self, rendered: Rendered, ray_error: torch.Tensor, trust: torch.Tensor, moment: Moment
    ) -> torch.Tensor | None:
        """Weight [N] of the Eikonal error at the samples, given each ray's colour error [R] and its weight [R].

        None: 1.
        """
        return None

    @property
    def weight(self) -> float:
        """Of `loss` in the sum."""
        return 0.0

    def loss(self, rendered: Rendered, moment: Moment) -> torch.Tensor | None:
        """What is to be lowered, a number, not yet weighted. None: nothing, ever."""
        return None
