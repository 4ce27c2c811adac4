"""Few materials make a thing: what is decided together by many points that look alike and lie close to each other."""

from __future__ import annotations

import numpy as np

# Points that are heard with each one, so many times over.
NEIGHBORS, ROUNDS = 16, 3
# Points that differ by so much in colour (coded, 0..1) are as far apart as points across REACH of the extent.
COLOR_REACH, REACH = 0.08, 0.08
# One more material must lower the cost of all points by this part, or a kind of error would be one.
WORTH = 0.03
MOST_MATERIALS = 6


def looks(positions: np.ndarray, colors: np.ndarray, extent: float) -> np.ndarray:
    """Place and look of points [S, 6]: 1 apart is REACH of the extent or COLOR_REACH of a coded colour."""
    return np.concatenate([positions / (REACH * extent), colors / COLOR_REACH], axis=1)


def neighbors(positions: np.ndarray, colors: np.ndarray) -> np.ndarray:
    """The NEIGHBORS points [S, N] that are most like each one in place [S, 3] and colour [S, 3], itself the first."""
    from scipy.spatial import cKDTree

    extent = float(np.ptp(positions, axis=0).max())
    features = looks(positions, colors, extent)
    return cKDTree(features).query(features, k=min(NEIGHBORS, len(features)))[1].reshape(len(features), -1)


def heard(values: np.ndarray, near: np.ndarray) -> np.ndarray:
    """Values [S, C] averaged over neighbours [S, N], ROUNDS times."""
    for _ in range(ROUNDS):
        values = values[near].mean(1)
    return values


def choose_few(costs: np.ndarray) -> list[int]:
    """The few candidates that serve all points.

    Greedy: the one that fits all points best, then each time the one that helps most, as long as it is worth it.

    Args:
        costs: [S, C] of each candidate at each point.
    """
    chosen = [int(costs.mean(0).argmin())]
    served = costs[:, chosen[0]]
    while len(chosen) < MOST_MATERIALS:
        totals = np.minimum(served[:, None], costs).mean(0)
        best = int(totals.argmin())
        if totals[best] > (1 - WORTH) * served.mean():
            break
        chosen.append(best)
        served = np.minimum(served, costs[:, best])
    return chosen


def of_one_kind(costs: np.ndarray, kinds: np.ndarray, paint: np.ndarray, worth: float) -> np.ndarray:
    """Costs [S, C], infinite where a point's paint [S] is not of the candidate's kind [C] (ints both).

    A paint is of the kind that serves its points best; of all kinds, where that lowers their cost by the part `worth`.
    """
    allowed = costs.copy()
    for each in np.unique(paint):
        rows = np.flatnonzero(paint == each)
        alone = {kind: costs[np.ix_(rows, kinds == kind)].min(1).mean() for kind in np.unique(kinds)}
        best = min(alone, key=lambda kind: alone[kind])
        if costs[rows].min(1).mean() >= (1 - worth) * alone[best]:
            allowed[np.ix_(rows, kinds != best)] = np.inf
    return allowed


# ---------------------------------------------------------------- base colours
# Base colours within this of each other (natural log) are of one paint.
SAME = 0.25
# A difference in brightness counts by this part of one in colour: shading changes the one, not the other.
BRIGHTNESS = 0.2
# Paints that a thing has at most; what is left over is of the nearest.
MOST_PAINTS = 16
_ROUNDS_OF_MEANS = 5


def few_colors(colors: np.ndarray, brightness: float = BRIGHTNESS) -> np.ndarray:
    """For each base colour [S, 3] (linear) the paint that it may be: the median of those like it.

    Reflectance is sparse over a whole thing (Gehler et al., "Recovering Intrinsic Images with a Global Sparsity Prior
    on Reflectance", 2011), and shading keeps the ratio of the channels.
    """
    features = hues(colors, brightness)
    centers = _crowded(features)
    for _ in range(_ROUNDS_OF_MEANS):
        which = ((features[:, None] - centers) ** 2).sum(2).argmin(1)
        centers = np.stack([np.median(features[which == k], axis=0) if (which == k).any() else centers[k]
                            for k in range(len(centers))])  # fmt: skip
    paints = np.stack([np.median(colors[which == k], axis=0) if (which == k).any() else np.zeros(3)
                       for k in range(len(centers))])  # fmt: skip
    return paints[which].astype(np.float32)


def hues(colors: np.ndarray, brightness: float = BRIGHTNESS) -> np.ndarray:
    """Where base colours [S, 3] (linear) lie for `few_colors`: ratios of the channels, and brightness [S, 4]."""
    logs = np.log(np.maximum(colors.astype(np.float64), 0.02))
    mean = logs.mean(1, keepdims=True)
    return np.concatenate([logs - mean, brightness * mean], axis=1)


def _crowded(features: np.ndarray) -> np.ndarray:
    """Places [C, F] where features [S, F] crowd, none within SAME of another: the fullest first."""
    from scipy.spatial import cKDTree

    some = features[:: max(len(features) // 1000, 1)]
    crowd = np.array([len(near) for near in cKDTree(some).query_ball_point(some, SAME)])
    left = np.ones(len(some), dtype=bool)
    centers: list[np.ndarray] = []
    while left.any() and len(centers) < MOST_PAINTS:
        center = some[np.argmax(np.where(left, crowd, -1))]
        centers.append(center)
        left &= ((some - center) ** 2).sum(1) > (2 * SAME) ** 2
    return np.stack(centers)
