"""What a batch of rays shows: what the renderer gives and the terms look at.

Shapes: r rays, k samples a ray, p edges of the proposal network's bins, e extra points.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from stages.neural.rendering import composite
from stages.neural.training_photos import RayBatch

if TYPE_CHECKING:
    from jaxtyping import Float

# Rays more opaque than this count as having met a surface.
OPAQUE = 0.5


@dataclass(frozen=True)
class Rendered:
    """What a batch of rays shows.

    Attributes:
        batch: the rays.
        colors: sRGB with reflections and the background behind, before exposure.
        opacity: of the surface alone.
        weights, distances: rendering weights of the samples and where they lie on the ray.
        points: the samples.
        gradients: of the SDF at the samples.
        features: geometry features at the samples.
        reflected: part of the colour that came from reflections of the object itself.
        gloss: part of the colour that is not shaded, see `stages.neural.radiance`.
        proposal: edges and weights of the proposal network, or None where a grid guides the samples.
        extra_sdf, extra_gradients: f and its gradients at the extra points that were asked for.
    """

    batch: RayBatch
    colors: Float[Tensor, "r 3"]
    opacity: Float[Tensor, " r"]
    weights: Float[Tensor, "r k"]
    distances: Float[Tensor, "r k"]
    points: Float[Tensor, "r*k 3"]
    gradients: Float[Tensor, "r*k 3"]
    features: Float[Tensor, "r*k g"]
    reflected: Float[Tensor, " r"]
    gloss: Float[Tensor, " r"]
    proposal: tuple[Float[Tensor, "r p"], Float[Tensor, "r p-1"]] | None
    extra_sdf: Float[Tensor, " e"]
    extra_gradients: Float[Tensor, "e 3"]

    def mean(self, values: Float[Tensor, "n d"]) -> Float[Tensor, "r d"]:
        """Mean of values of the samples over each ray's surface; means something only where the ray is opaque."""
        summed = composite(self.weights, values.view(*self.weights.shape, values.shape[-1]))
        return summed / self.opacity.clamp(min=1e-3)[:, None]

    @cached_property
    def surface(self) -> tuple[Float[Tensor, "r 3"], Float[Tensor, "r 3"]]:
        """Mean surface point x_0 and unit normal n_0 of each ray, without gradient.

        They mean something only where the ray is opaque.
        """
        with torch.no_grad():
            depth = (self.weights * self.distances).sum(1) / self.opacity.clamp(min=1e-3)
            points = self.batch.origins + depth[:, None] * self.batch.directions
            return points, torch.nn.functional.normalize(self.mean(self.gradients), dim=1)
