"""What the photos are about: sparse points that several of them see, none of them far behind what is nearest there.

Whatever a photo is framed for, its subject is among the nearest things in it; what lies far behind is background.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from stages.geometry.cameras import PinholeCameras

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int, Integer

# What is nearest in a photo is as far away as this quantile of the points in it; background is farther by this factor.
NEAR_QUANTILE, MAX_BEHIND = 0.1, 1.6
# A photo with fewer points does not tell what is near.
MIN_POINTS = 8
# This many photos have to look at a point; of a large set, this part of them.
MIN_LOOKING, MIN_LOOKING_SHARE = 3, 0.02
# Lines of sight to a point differ by this much at least, or its depth is a guess.
MIN_PARALLAX_DEG = 3.0
TINY = 1e-12  # keeps divisions finite; far below any length that occurs


def photos_looking_at(
    cameras: PinholeCameras, points: Float[np.ndarray, "p 3"], observations: Integer[np.ndarray, "m 2"]
) -> Int[np.ndarray, " p"]:
    """How many photos see each point and have it not far behind what is nearest to them.

    Args:
        observations: rows (image index, point index).
    """
    looking = np.zeros(len(points), dtype=np.int64)
    for i in range(len(cameras)):
        seen = observations[observations[:, 0] == i, 1]
        _, depth = cameras.project(i, points[seen])
        seen, depth = seen[depth > 0], depth[depth > 0]
        if len(seen) >= MIN_POINTS:
            looking[seen[depth < MAX_BEHIND * np.quantile(depth, NEAR_QUANTILE)]] += 1
    return looking


def parallax_deg(
    cameras: PinholeCameras, points: Float[np.ndarray, "p 3"], observations: Integer[np.ndarray, "m 2"]
) -> Float[np.ndarray, " p"]:
    """Twice the largest angle between the mean line of sight to a point and any other; 0 where one photo sees it."""
    images, seen = observations.T
    sight = points[seen].astype(np.float64) - cameras.centers[images]
    sight = sight / np.maximum(np.linalg.norm(sight, axis=1, keepdims=True), TINY)
    mean = np.stack([np.bincount(seen, sight[:, k], len(points)) for k in range(3)], 1)
    mean = mean / np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), TINY)
    cosines = np.ones(len(points))
    np.minimum.at(cosines, seen, np.einsum("mi,mi->m", sight, mean[seen]))
    return np.degrees(2 * np.arccos(np.clip(cosines, -1.0, 1.0)))


def attended(
    cameras: PinholeCameras, points: Float[np.ndarray, "p 3"], observations: Integer[np.ndarray, "m 2"]
) -> Bool[np.ndarray, " p"]:
    """Which points the photos are about: enough of them look there, and the depth is known."""
    wanted = max(MIN_LOOKING, MIN_LOOKING_SHARE * len(cameras))
    looking = photos_looking_at(cameras, points, observations)
    return (looking >= wanted) & (parallax_deg(cameras, points, observations) >= MIN_PARALLAX_DEG)
