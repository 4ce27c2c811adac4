"""What a batch of rays shows: what the renderer gives and the terms look at.

Shapes: R rays, K samples a ray, N = R K points, P bins of the proposal network.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import torch

from stages.neural.rendering import composite
from stages.neural.training_photos import RayBatch

# Rays more opaque than this count as having met a surface.
OPAQUE = 0.5


@dataclass(frozen=True)
class Rendered:
    """What a batch of rays shows.

    Attributes:
        batch: the rays.
        colors: [R, 3] sRGB with reflections and the background behind, before exposure.
        opacity: [R] of the surface alone.
        weights, distances: [R, K] rendering weights of the samples and where they lie on the ray.
        points: [N, 3] the samples.
        gradients: [N, 3] of the SDF at the samples.
        features: [N, G] geometry features at the samples.
        reflected: [R] part of the colour that came from reflections of the object itself.
        proposal: edges [R, P + 1] and weights [R, P] of the proposal network, or None where a grid guides the samples.
        extra_sdf, extra_gradients: f [E] and its gradients [E, 3] at the extra points that were asked for.
    """

    batch: RayBatch
    colors: torch.Tensor
    opacity: torch.Tensor
    weights: torch.Tensor
    distances: torch.Tensor
    points: torch.Tensor
    gradients: torch.Tensor
    features: torch.Tensor
    reflected: torch.Tensor
    proposal: tuple[torch.Tensor, torch.Tensor] | None
    extra_sdf: torch.Tensor
    extra_gradients: torch.Tensor

    def mean(self, values: torch.Tensor) -> torch.Tensor:
        """Mean [R, D] of values [N, D] over each ray's surface; means something only where the ray is opaque."""
        summed = composite(self.weights, values.view(*self.weights.shape, values.shape[-1]))
        return summed / self.opacity.clamp(min=1e-3)[:, None]

    @cached_property
    def surface(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Mean surface point x_0 and unit normal n_0 of each ray [R, 3], without gradient.

        They mean something only where the ray is opaque.
        """
        with torch.no_grad():
            depth = (self.weights * self.distances).sum(1) / self.opacity.clamp(min=1e-3)
            points = self.batch.origins + depth[:, None] * self.batch.directions
            return points, torch.nn.functional.normalize(self.mean(self.gradients), dim=1)
