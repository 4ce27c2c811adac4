"""Which photos are blurred: those whose detail is weaker than the other photos' at the same points."""

from __future__ import annotations

import numpy as np

# A point tells something where at least this many photos see it and their detail is above noise (colour levels).
MIN_PHOTOS = 3
MIN_DETAIL = 2.0
# A photo's weight falls with this power of its detail against the others'.
POWER = 4.0
# Photos below this are counted as blurred; none counts less than `LEAST`.
BLURRED = 0.25
LEAST = 0.01


def sharpness_of_photos(highs: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Factor [N] in [LEAST, 1] on each photo's weight: (its detail / the other photos' detail)^POWER, at most 1.

    Detail is the mean of |highs|, the others' the mean of the points' medians; over the middle one of these ratios. A
    mean over many points: a single point's detail depends on noise and on the line of sight.

    Args:
        highs: [P, N] high band of point p in photo i, colour levels.
        weights: [P, N] trust in it, 0 where the photo does not see the point.

    Returns:
        1 for photos that share too few points with others.
    """
    seen = weights > 0
    detail = np.where(seen, np.abs(highs), np.nan)
    shared = seen.sum(1) >= MIN_PHOTOS
    detail = detail[shared]
    if not len(detail):
        return np.ones(weights.shape[1])
    typical = np.nanmedian(detail, axis=1)
    telling = typical >= MIN_DETAIL
    detail, typical = detail[telling], typical[telling]
    own = np.nansum(detail, axis=0)
    others = np.where(np.isfinite(detail), typical[:, None], 0.0).sum(0)
    ratio = np.where(others > 0, own / np.maximum(others, 1e-12), 1.0)
    return np.clip((ratio / max(np.median(ratio), 1e-12)) ** POWER, LEAST, 1.0)
