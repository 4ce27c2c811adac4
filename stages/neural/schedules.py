"""Schedules against progress in [0, 1], so that a budget can be steps or wall time."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch


@dataclass(frozen=True)
class Moment:
    """What the schedules say at one point of the training.

    Attributes:
        progress: part of the budget that is spent, from 0 to 1.
        scale: the density's scale b, scene units; a tensor with a gradient where it is learned.
        levels: how many levels of the encoding are in use.
        voxel: side h of a cell of the finest of them, scene units.
        samples: how many samples a ray has inside the region.
        deferred: whether a ray's colour is that of its mean surface point, not the mean of its samples' colours.
        outlined: how far outlines are where f is 0 where something is shiny, from 0 to 1.
    """

    progress: float
    scale: torch.Tensor | float
    levels: int
    voxel: float
    samples: int
    deferred: bool
    outlined: torch.Tensor | float

    @property
    def width(self) -> float:
        """The scale b as a plain number, for what carries no gradient."""
        return self.scale.item() if isinstance(self.scale, torch.Tensor) else self.scale


def exponential(progress: float, start: float, end: float) -> float:
    """start at 0, end at 1, straight on a log scale between."""
    return start * (end / start) ** min(max(progress, 0.0), 1.0)


def fade_out(progress: float, until: float) -> float:
    """1 at 0, straight down to 0 at `until`."""
    return max(0.0, 1.0 - progress / until) if until > 0 else 0.0


def fade_in(progress: float, start: float, until: float) -> float:
    """0 up to `start`, then straight up to 1 at `until`."""
    return min(max((progress - start) / (until - start), 0.0), 1.0) if until > start else float(progress >= start)


def warm_up_then_decay(progress: float, warm_up: float, final: float) -> float:
    """Learning-rate factor: straight up from 0 to 1 until `warm_up`, then a cosine down to `final` at 1."""
    if progress < warm_up:
        return progress / warm_up
    phase = min((progress - warm_up) / (1 - warm_up), 1.0)
    return final + (1 - final) * 0.5 * (1 + math.cos(math.pi * phase))


def warm_up_then_exponential(progress: float, warm_up: float, final: float) -> float:
    """Learning-rate factor: straight up from 0 to 1 until `warm_up`, then down to `final` at 1, straight on a log scale
    (the paper's decay from 1e-2 to 1e-5)."""
    if progress < warm_up:
        return progress / warm_up
    return exponential((progress - warm_up) / (1 - warm_up), 1.0, final)


def active_levels(progress: float, levels: int, start: int, until: float) -> int:
    """How many levels of the encoding are in use: `start` at 0, one more at even steps, all from `until` on."""
    if progress >= until:
        return levels
    return min(levels, start + int((levels - start + 1) * progress / until))


def even_steps(progress: float, first: int, last: int, begin: float, end: float) -> int:
    """A count that goes from `first`, until `begin`, to `last`, from `end` on, in even steps of one between."""
    if progress <= begin:
        return first
    return round(first + (last - first) * fade_in(progress, begin, end))
