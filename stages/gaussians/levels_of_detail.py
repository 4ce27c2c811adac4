"""Levels of detail: fewer Gaussians that cover what all of them cover."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from stages.gaussians.gaussians import Gaussians

if TYPE_CHECKING:
    from jaxtyping import Float, Int

# Gaussians of a level for one of the level before.
RATIO = 0.5
_CURVE_BITS = 21  # of a coordinate on the curve: three fit into 64
# A share is at most this often taken up again by the others when some are sure to stay.
_ROUNDS = 50


def levels_of_detail(gaussians: Gaussians, count: int) -> Iterator[Gaussians]:
    """`count` levels, each with half the Gaussians of the one before, the first with half of all."""
    for level in range(1, count + 1):
        yield lightened(gaussians, max(round(len(gaussians) * RATIO**level), 1))


def lightened(gaussians: Gaussians, count: int) -> Gaussians:
    """About `count` of the Gaussians, enlarged so that they cover as much.

    A Gaussian stays with a chance p in proportion to what it covers, its opacity times the area of its two longest
    axes, so that the large ones stay; it then stands for 1 / p of its like, and its two longest axes grow by
    p^-1/2: the area covered stays the same on average (Horvitz & Thompson 1952). Chances are drawn evenly along a
    curve through space (systematic sampling), so that no place is left bare, and no draw differs from the next.

    Args:
        count: >= 1; all are returned where there are no more.
    """
    if count >= len(gaussians):
        return gaussians
    order = np.argsort(_along_a_curve(gaussians.centers), kind="stable")
    chances = _chances(_covered(gaussians)[order], count)
    steps = np.floor(np.cumsum(chances) + 0.5)
    rows = np.flatnonzero(np.diff(steps, prepend=0) > 0)
    kept = gaussians.select(order[rows])
    longest = np.argsort(kept.log_scales, axis=1)[:, 1:]
    scales = kept.log_scales.copy()
    grown = np.take_along_axis(scales, longest, 1) - 0.5 * np.log(chances[rows])[:, None]
    np.put_along_axis(scales, longest, grown.astype(np.float32), 1)
    return replace(kept, log_scales=scales)


def _covered(gaussians: Gaussians) -> Float[np.ndarray, " n"]:
    """[N] opacity times the product of the two longest axes."""
    longest = np.sort(gaussians.log_scales.astype(np.float64), axis=1)[:, 1:]
    return gaussians.opacities * np.exp(longest.sum(1))


def _chances(weights: Float[np.ndarray, " n"], count: int) -> Float[np.ndarray, " n"]:
    """[N] chances of at most 1 that sum up to `count` < N, else in proportion to the weights."""
    weights = np.maximum(weights, weights.max() * 1e-9)
    sure = np.zeros(len(weights), dtype=bool)
    chances = weights
    for _ in range(_ROUNDS):
        chances = np.where(sure, 1.0, weights * (count - sure.sum()) / weights[~sure].sum())
        if (chances <= 1).all():
            break
        sure |= chances > 1
    return np.minimum(chances, 1)


def _along_a_curve(points: Float[np.ndarray, "n 3"]) -> Int[np.ndarray, " n"]:
    """[N] places on Morton's curve, whose neighbours are neighbours in space: the bits of x, y and z in turn."""
    low = points.min(0).astype(np.float64)
    size = max(float(np.ptp(points, axis=0).max()), 1e-30)
    cells = ((points - low) / size * (2**_CURVE_BITS - 1)).astype(np.int64)
    places = np.zeros(len(points), dtype=np.int64)
    for bit in range(_CURVE_BITS):
        for axis in range(3):
            places |= (cells[:, axis] >> bit & 1) << (3 * bit + axis)
    return places
