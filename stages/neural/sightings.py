"""What structure from motion knows of free and solid space: which photo saw which point.

Shapes: M lines of sight, S of them drawn for a step.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from configs.training import LossParams
from stages.geometry.cameras import PosedScene
from stages.neural import losses
from stages.neural.sampling import intersect_unit_sphere


@dataclass(frozen=True)
class Sightings:
    """Which photo saw which SfM point: M lines of sight that are free up to the surface at their end.

    Attributes:
        points: [M, 3] the SfM point at the end of each line, inside the region of interest.
        directions: [M, 3] unit, from the camera to the point.
        free: [M] length of the line inside the unit sphere before the point.
        weights: [M] in [0, 1].
    """

    points: torch.Tensor
    directions: torch.Tensor
    free: torch.Tensor
    weights: torch.Tensor

    @staticmethod
    def from_scene(scene: PosedScene, device: torch.device | str, training: np.ndarray | None = None) -> Sightings:
        """Sightings of points inside the unit sphere; weight 1 / (1 + e^2), e the reprojection error in pixels.

        Of the photos where `training` [I] bool is true only, if it is given.
        """
        inside = np.linalg.norm(scene.points, axis=1) < 0.98
        kept = inside[scene.observations[:, 1]]
        if training is not None:
            kept &= training[scene.observations[:, 0]]
        image, point = scene.observations[kept].T
        points = torch.from_numpy(scene.points[point]).float()
        origins = torch.from_numpy(scene.cameras.centers[image]).float()
        distances = torch.linalg.vector_norm(points - origins, dim=1)
        directions = (points - origins) / distances[:, None]
        entry, _, _ = intersect_unit_sphere(origins, directions)
        weights = torch.from_numpy(1 / (1 + scene.point_errors[point] ** 2)).float()
        lines = (points, directions, (distances - entry).clamp(min=0), weights)
        return Sightings(*(tensor.to(device) for tensor in lines))

    def draw(self, count: int, step: float, generator: torch.Generator) -> tuple[torch.Tensor, torch.Tensor]:
        """Places [4 S, 3] along S random sightings, and the sightings' weights [S]; S is at most `count`.

        First the points, then places a `step` (scene units) behind them, a step before them, and somewhere on the free
        line of sight.
        """
        total = len(self.weights)
        count, device = min(count, total), self.weights.device
        chosen = torch.randint(max(total, 1), (count,), generator=generator, device=device)
        along = torch.rand(count, generator=generator, device=device)
        points, directions = self.points[chosen], self.directions[chosen]
        offset = step * directions
        free = (along * self.free[chosen]).clamp(min=step)[:, None] * directions
        return torch.cat([points, points + offset, points - offset, points - free]), self.weights[chosen]


def sighting_loss(sdf: torch.Tensor, weights: torch.Tensor, params: LossParams) -> torch.Tensor:
    """Mean error of f [4 S] at the places of `Sightings.draw`: 0 at the points, solid behind them, free before."""
    on_point, behind, front, free = sdf.view(4, len(weights))
    margin = 0.25 * params.sparse_step
    error = (
        losses.sparse_point_error(on_point, params.sparse_tolerance)
        + losses.inside_error(behind, margin)
        + losses.outside_error(front, margin)
        + losses.outside_error(free, margin)
    )
    return (weights * error).sum() / max(len(weights), 1)
