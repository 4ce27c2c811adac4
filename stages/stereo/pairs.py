"""Which photos are compared: neighbours that share much and look from neither too near nor too far."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from stages.geometry.vectors import unit
from stages.stereo.rectification import View, comparable, rectify

if TYPE_CHECKING:
    from jaxtyping import Float, Integer

# Degrees between two lines of sight that suit matching best, and how fast it gets worse below and above (MVSNet's
# view selection, Yao et al. 2018, with a wider top): less gives no depth, more other pixels. And nothing beyond limits.
BEST_ANGLE, SPREAD_BELOW, SPREAD_ABOVE = 10.0, 5.0, 10.0
LEAST_ANGLE, MOST_ANGLE = 0.5, 60.0
# Points that two photos must share to be compared.
MIN_SHARED = 8
# Neighbours less than these degrees apart say the same twice: frames of a video.
APART = 4.0


def pairs_of(
    views: Sequence[View], points: Float[np.ndarray, "p 3"], observations: Integer[np.ndarray, "m 2"], neighbors: int
) -> list[tuple[int, int]]:
    """Pairs of photos to compare (i < j), in order: each photo with its `neighbors` best, and those it is one of.

    All can be rectified: a photo that cannot, beside another, leaves its place to the next.

    Args:
        points, observations: known points, and rows (photo, point): which photo sees which.
    """
    suited = scores(views, points, observations)
    centers = np.stack([view.center for view in views])
    seen = points_seen(points, observations, len(views))
    found: set[tuple[int, int]] = set()
    for i, row in enumerate(suited):

        def usable(j: int, i: int = i) -> bool:
            left, right = sorted((i, j))
            return rectify(views[left], views[right], np.concatenate([seen[left], seen[right]])) is not None

        if len(seen[i]):
            directions = unit(centers - np.median(seen[i], axis=0))
            found |= {(min(i, j), max(i, j)) for j in _best(row, directions, neighbors, usable)}
    return sorted(found)


def points_seen(
    points: Float[np.ndarray, "p 3"], observations: Integer[np.ndarray, "m 2"], num_photos: int
) -> list[Float[np.ndarray, "_ 3"]]:
    """The known points that each photo sees."""
    return [points[observations[observations[:, 0] == k, 1]] for k in range(num_photos)]


def scores(
    views: Sequence[View], points: Float[np.ndarray, "p 3"], observations: Integer[np.ndarray, "m 2"]
) -> Float[np.ndarray, "n n"]:
    """How well each two photos suit each other.

    The points that both see, each weighed by the angle between the lines of sight, and by how alike the sizes are at
    which they show it (Goesele et al. 2007); 0 where they share fewer than `MIN_SHARED`, or are not `comparable`.
    """
    from scipy.sparse import csr_array

    count = len(views)
    centers, focals = np.stack([view.center for view in views]), np.array([view.focal for view in views])
    ones = np.ones(len(observations), np.int32)
    seen = csr_array((ones, (observations[:, 0], observations[:, 1])), shape=(count, len(points)))
    seen.sum_duplicates()
    by_point = seen.tocsc()
    result = np.zeros((count, count))
    for i in range(count):
        of_i = seen.indices[seen.indptr[i] : seen.indptr[i + 1]]
        both = by_point[:, of_i].tocoo()
        j, at = both.row, points[of_i[both.col]]
        here, there = at - centers[i], at - centers[j]
        widths = np.linalg.norm(here, axis=1) / focals[i], np.linalg.norm(there, axis=1) / focals[j]
        alike = np.minimum(*widths) / np.maximum(np.maximum(*widths), 1e-12)
        weights = _by_angle(np.degrees(np.arccos(np.clip((unit(here) * unit(there)).sum(1), -1, 1)))) * alike
        shared = np.bincount(j, minlength=count) >= MIN_SHARED
        result[i] = np.bincount(j, weights, count) * shared
        result[i] *= [k != i and shared[k] and comparable(views[i], view) for k, view in enumerate(views)]
    return result


def _by_angle(degrees: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    spread = np.where(degrees < BEST_ANGLE, SPREAD_BELOW, SPREAD_ABOVE)
    within = (degrees > LEAST_ANGLE) & (degrees < MOST_ANGLE)
    weights: np.ndarray = np.exp(-((degrees - BEST_ANGLE) ** 2) / (2 * spread**2)) * within
    return weights


def _best(
    scores: Float[np.ndarray, " n"], directions: Float[np.ndarray, "n 3"], count: int, usable: Callable[[int], bool]
) -> list[int]:
    """The best `count` usable photos, each chosen for what those before it have not said already.

    Args:
        directions: unit, towards the photos from what they look at.
    """
    left, chosen = scores.copy(), list[int]()
    while len(chosen) < count and (left > 0).any():
        best = int(left.argmax())
        if not usable(best):
            left[best] = 0
            continue
        chosen.append(best)
        degrees = np.degrees(np.arccos(np.clip(directions @ directions[best], -1, 1)))
        left *= np.minimum(degrees / APART, 1)
        left[best] = 0
    return chosen
