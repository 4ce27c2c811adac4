"""Few materials make a thing: what is decided together by many points that look alike and lie close to each other."""

from __future__ import annotations

import numpy as np

# Points that are heard with each one, so many times over.
NEIGHBORS, ROUNDS = 16, 3
# Points that differ by so much in colour (coded, 0..1) are as far apart as points across REACH of the extent.
COLOR_REACH, REACH = 0.08, 0.08
# One more material must lower the cost of all points by this part, or a kind of error would be one.
WORTH = 0.05
MOST_MATERIALS = 6


def neighbors(positions: np.ndarray, colors: np.ndarray) -> np.ndarray:
    """The NEIGHBORS points [S, N] that are most like each one in place [S, 3] and colour [S, 3], itself the first."""
    from scipy.spatial import cKDTree

    extent = float(np.ptp(positions, axis=0).max())
    features = np.concatenate([positions / (REACH * extent), colors / COLOR_REACH], axis=1)
    return cKDTree(features).query(features, k=min(NEIGHBORS, len(features)))[1].reshape(len(features), -1)


def heard(values: np.ndarray, near: np.ndarray) -> np.ndarray:
    """Values [S, C] averaged over neighbours [S, N], ROUNDS times."""
    for _ in range(ROUNDS):
        values = values[near].mean(1)
    return values


def choose_few(costs: np.ndarray) -> tuple[list[int], np.ndarray]:
    """The few candidates that serve all points, and which one serves each.

    Greedy: the one that fits all points best, then each time the one that helps most, as long as it is worth it.

    Args:
        costs: [S, C] of each candidate at each point.

    Returns:
        Their numbers, and for each point [S] a place in that list.
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
    return chosen, costs[:, chosen].argmin(1)
