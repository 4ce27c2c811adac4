"""What photos say outright of free and solid space: which of them saw which point.

Points are those of structure from motion, few and exact, or those of dense stereo, many and each with its trust.

Shapes: P points, I photos, M lines of sight, S of them drawn for a step.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from torch import Tensor

from stages.geometry.cameras import PosedScene
from stages.geometry.point_cloud import PointCloud
from stages.neural import losses
from stages.neural.evidence import at_places
from stages.neural.sampling import intersect_unit_sphere

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int, Integer

# Points nearer to the region's border than this are left out, scene units: what is behind them may lie outside.
_BORDER = 0.02


class Drawn(NamedTuple):
    """Sightings of a step.

    Attributes:
        places: four along each line: the points, then those behind them, those before, and those on the free line.
        weights: in [0, 1].
    """

    places: Float[Tensor, "places 3"]
    weights: Float[Tensor, " s"]


@dataclass(frozen=True)
class Sightings:
    """Which photo saw which point: M lines of sight that are free up to the surface at their end.

    Attributes:
        points: inside the region of interest.
        weights: of the points, in [0, 1].
        origins: of all photos, projection centres.
        lines: photo and point of each.
    """

    points: Float[Tensor, "p 3"]
    weights: Float[Tensor, " p"]
    origins: Float[Tensor, "i 3"]
    lines: Int[Tensor, "m 2"]

    def __len__(self) -> int:
        return len(self.lines)

    @staticmethod
    def from_scene(
        scene: PosedScene, device: torch.device | str, training: Bool[np.ndarray, " i"] | None = None
    ) -> Sightings:
        """Of the scene's SfM points; weight 1 / (1 + e^2), e the reprojection error in pixels.

        Of the photos where `training` is true only, if it is given.
        """
        weights = 1 / (1 + scene.point_errors**2)
        return _within(scene.points, weights, scene.cameras.centers, scene.observations, device, training)

    @staticmethod
    def from_cloud(
        cloud: PointCloud,
        centers: Float[np.ndarray, "i 3"],
        device: torch.device | str,
        training: Bool[np.ndarray, " i"] | None = None,
    ) -> Sightings:
        """Of a dense cloud in the scene frame; the trust of its points is their weight."""
        point = np.repeat(np.arange(len(cloud)), np.diff(cloud.starts))
        observations = np.stack([cloud.photos, point], 1)
        return _within(cloud.points, cloud.trust, centers, observations, device, training)

    def but_where(self, shiny: Float[Tensor, "1 1 g g g"]) -> Sightings:
        """These, weighed down where something is shiny (see `Evidence`): reflections are seen there, behind it.

        What is seen past a shiny thing keeps its weight: it tells of the outlines.
        """
        return replace(self, weights=self.weights * (1 - at_places(shiny, self.points)))

    def draw(self, count: int, step: float, generator: torch.Generator) -> Drawn:
        """Four places along each of S random sightings; S is at most `count`.

        The points, places a `step` (scene units) behind them, a step before them, and somewhere on the free line of
        sight inside the unit sphere.
        """
        total = len(self.lines)
        count, device = min(count, total), self.weights.device
        chosen = torch.randint(max(total, 1), (count,), generator=generator, device=device)
        along = torch.rand(count, generator=generator, device=device)
        photo, point = self.lines[chosen].unbind(1)
        points, origins = self.points[point], self.origins[photo]
        lengths = torch.linalg.vector_norm(points - origins, dim=1)
        directions = (points - origins) / lengths[:, None]
        entry, _, _ = intersect_unit_sphere(origins, directions)
        offset = step * directions
        free = (along * (lengths - entry)).clamp(min=step)[:, None] * directions
        places = torch.cat([points, points + offset, points - offset, points - free])
        return Drawn(places, self.weights[point])


def _within(
    points: Float[np.ndarray, "p 3"],
    weights: Float[np.ndarray, " p"],
    centers: Float[np.ndarray, "i 3"],
    lines: Integer[np.ndarray, "m 2"],
    device: torch.device | str,
    training: Bool[np.ndarray, " i"] | None,
) -> Sightings:
    """Of the points inside the unit sphere."""
    inside = (np.linalg.norm(points, axis=1) < 1 - _BORDER) & (weights > 0)
    kept = inside[lines[:, 1]]
    if training is not None:
        kept &= training[lines[:, 0]]
    at, trust = (torch.from_numpy(each[inside]).float().to(device) for each in (points, weights))
    row = np.cumsum(inside) - 1
    rows = np.stack([lines[kept, 0], row[lines[kept, 1]]], 1)
    origins = torch.from_numpy(centers).float().to(device)
    return Sightings(at, trust, origins, torch.from_numpy(rows).long().to(device))


def sighting_loss(
    sdf: Float[Tensor, " places"], weights: Float[Tensor, " s"], tolerance: float, step: float
) -> Float[Tensor, ""]:
    """Mean error of f at the places of `Sightings.draw`: 0 at the points, solid behind them, free before."""
    on_point, behind, front, free = sdf.view(4, len(weights))
    margin = 0.25 * step
    error = (
        losses.sparse_point_error(on_point, tolerance)
        + losses.inside_error(behind, margin)
        + losses.outside_error(front, margin)
        + losses.outside_error(free, margin)
    )
    return (weights * error).sum() / max(len(weights), 1)
