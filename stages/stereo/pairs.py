"""Which photos are compared: neighbours that share much and look from neither too near nor too far."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from stages.geometry.cameras import PinholeCameras

if TYPE_CHECKING:
    from jaxtyping import Float, Integer

# Degrees between two lines of sight that suit matching best, and how fast it gets worse below and above (MVSNet's
# view selection, Yao et al. 2018, with a wider top): less gives no depth, more other pixels.
BEST_ANGLE, SPREAD_BELOW, SPREAD_ABOVE = 10.0, 5.0, 10.0
# Points that two photos must share to be compared.
MIN_SHARED = 8


def scores(
    cameras: PinholeCameras, points: Float[np.ndarray, "p 3"], observations: Integer[np.ndarray, "m 2"]
) -> Float[np.ndarray, "n n"]:
    """How well each two photos suit each other: points that both see, each weighed by the angle between the lines of
    sight; 0 where they share fewer than `MIN_SHARED` points."""
    count = len(cameras)
    seen = np.zeros((count, len(points)), dtype=bool)
    seen[observations[:, 0], observations[:, 1]] = True
    centers = cameras.centers
    result = np.zeros((count, count))
    for i in range(count):
        of_i = np.flatnonzero(seen[i])
        if len(of_i) == 0:
            continue
        lines = _unit(points[of_i][None] - centers[:, None])
        angles = np.degrees(np.arccos(np.clip((lines * lines[i]).sum(-1), -1, 1)))
        spread = np.where(angles < BEST_ANGLE, SPREAD_BELOW, SPREAD_ABOVE)
        weights = np.exp(-((angles - BEST_ANGLE) ** 2) / (2 * spread**2))
        shared = seen[:, of_i]
        result[i] = (weights * shared).sum(1) * (shared.sum(1) >= MIN_SHARED)
    np.fill_diagonal(result, 0)
    return result


def neighbors_of(scores: Float[np.ndarray, "n n"], count: int) -> set[tuple[int, int]]:
    """The `count` best neighbours of each photo, as unordered pairs (i < j)."""
    found = set()
    for i, row in enumerate(scores):
        for j in np.argsort(-row, kind="stable")[:count]:
            if row[j] > 0:
                found.add((min(i, int(j)), max(i, int(j))))
    return found


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12)
