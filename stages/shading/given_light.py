"""A light that was captured: how it was turned when the photos were taken, and how bright they show it.

Its map says what comes from each direction, but a reconstruction may have any azimuth, and photos any exposure. So it
is turned about the vertical and multiplied by one number, the same for all channels: the colour of the light is
believed. Both are searched for as what explains the photos best, base colours following in closed form (see `fitting`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from stages.light.environment import mean_radiance, resized, turned
from stages.shading.fitting import Materials, Part, decoded
from stages.shading.reflection import LIGHT_ROWS, Reflection

# The map is turned and written with so many rows: finer than what materials are found with.
ROWS = 128
# Degrees between turns that are all tried, and the steps around the best one.
COARSE_STEP, FINE_STEPS = 10.0, (5.0, 2.5, 1.25)
# Natural logarithms of scales that are all tried, over that under which surfaces return half; steps around the best.
COARSE_SCALES, SCALE_STEPS = (-1.5, -0.75, 0.0, 0.75, 1.5), (0.4, 0.2, 0.1, 0.05)
# A turn is told where all that are this far from it, in degrees, fit worse by this part.
APART, TOLD_MARGIN = 30.0, 0.02
# Points that all turns are tried with.
SEARCH_POINTS = 500


@dataclass(frozen=True)
class Placed:
    """How a given light lies over the photos.

    Attributes:
        degrees: what came from φ comes from φ + degrees, see `environment.turned`.
        scale: from the map's radiance to units of the photos' full scale.
        told: whether the photos tell the turn; true where it was given.
    """

    degrees: float
    scale: float
    told: bool = True


class GivenLight:
    """A map [H, 2 H, 3] of linear radiance that is not black, and its turn in degrees where that is known."""

    def __init__(self, radiance: np.ndarray, degrees: float | None = None) -> None:
        self.map, self.degrees = resized(radiance, min(max(len(radiance), LIGHT_ROWS), ROWS)), degrees
        self._turned: dict[float, Tensor] = {}

    def light(self, placed: Placed) -> Tensor:
        """[P, 3] for `fitting`."""
        if placed.degrees not in self._turned:
            small = resized(turned(self.map, placed.degrees), LIGHT_ROWS)
            self._turned[placed.degrees] = torch.from_numpy(small.reshape(-1, 3))
        return self._turned[placed.degrees] * placed.scale

    def written(self, placed: Placed) -> np.ndarray:
        """The map [h, 2 h, 3] as it lay, at the size it has here."""
        return (turned(self.map, placed.degrees) * np.float32(placed.scale)).astype(np.float32)

    def find(self, reflection: Reflection, observed: Tensor, weights: Tensor, materials: Materials) -> Placed:
        """Among all turns (or the one given) and scales."""
        rows = torch.from_numpy(np.random.default_rng(0).permutation(len(observed))[:SEARCH_POINTS])
        part = Part(reflection, observed, weights, materials, rows, free=True)
        usual = 2 * float(decoded(observed[weights > 0]).mean()) / mean_radiance(self.map)
        turns = [self.degrees] if self.degrees is not None else np.arange(-180.0, 180.0, COARSE_STEP).tolist()
        tried = [Placed(turn, usual * float(np.exp(log))) for turn in turns for log in COARSE_SCALES]
        costs = [part.cost(self.light(each)) for each in tried]
        best = tried[int(np.argmin(costs))]
        away = [cost for each, cost in zip(tried, costs, strict=True) if _apart(each, best) >= APART]
        told = self.degrees is not None or min(away) > (1 + TOLD_MARGIN) * min(costs)
        return self.refined(part, Placed(best.degrees, best.scale, told))

    def refined(self, part: Part, placed: Placed) -> Placed:
        """The best one near to a placement, by ever smaller steps of turn (unless that was given) and scale."""

        def cost(each: Placed) -> float:
            return part.cost(self.light(each))

        for step in FINE_STEPS if self.degrees is None else ():
            placed = min((placed, _turned_by(placed, -step), _turned_by(placed, step)), key=cost)
        for step in SCALE_STEPS:
            placed = min((placed, _brighter(placed, -step), _brighter(placed, step)), key=cost)
        return placed


def _apart(a: Placed, b: Placed) -> float:
    """Degrees between two turns, 0..180."""
    return abs((a.degrees - b.degrees + 180) % 360 - 180)


def _turned_by(placed: Placed, degrees: float) -> Placed:
    return replace(placed, degrees=(placed.degrees + degrees + 180) % 360 - 180)


def _brighter(placed: Placed, log: float) -> Placed:
    return replace(placed, scale=placed.scale * float(np.exp(log)))
