"""Whether silhouettes that somebody guessed are of one and the same thing: does their visual hull fill them?"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from stages.geometry.cameras import PinholeCameras
from stages.geometry.hull import HULL_AGREEMENT, Hull, carve
from stages.geometry.region import meeting_point

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Shaped

# Measured in docs/benchmarks/auto-masks.md: where so large a part of the silhouettes agree with the hull, each that
# does has an IoU of 0.84 or more with the truth; where fewer do, they may agree on a part of the thing.
MIN_IOU, MIN_SHARE = 0.8, 2 / 3
# Agreement that carves the hull, and the IoU below which a silhouette has no say in the next one. The first hulls must
# stand up to silhouettes of something else, and are too large for that.
ROUNDS = ((0.8, 0.6), (HULL_AGREEMENT, 0.7), (HULL_AGREEMENT, MIN_IOU), (HULL_AGREEMENT, MIN_IOU))
CUBE = 2.0  # half the side of the cube the hull is looked for in, in median reaches of the silhouettes
JUDGED_SIDE = 64  # pixels along the longest side that are looked at
STEPS_PER_CELL = 1.0  # along a line of sight


def silhouette_agreement(
    cameras: PinholeCameras, masks: Sequence[Shaped[np.ndarray, "_ _"] | None]
) -> Float[np.ndarray, " n"]:
    """How well each silhouette fits the others': its IoU with the outline of their visual hull, in [0, 1].

    Silhouettes that fit badly lose their say in the hull, which is carved anew from the others, see `ROUNDS`.
    Silhouettes with the same fault in every photo (a shadow, the table) cannot be told from good ones.

    Args:
        cameras: in any frame.
        masks: one array (not zero on the object) per camera, of the camera's size, or None where there is none.

    Returns:
        0 for all where there is no hull; not a number where there is no mask.
    """
    masked = {i: mask for i, mask in enumerate(masks) if mask is not None}
    scores = np.full(len(masks), np.nan)
    scores[list(masked)] = 0.0
    cube = _cube_around(cameras, masks)
    if cube is None:
        return scores
    voters = list(masks)
    for agreement, least in ROUNDS:
        hull = carve(cameras, voters, *cube, agreement)
        if hull is None:
            scores[list(masked)] = 0.0
            break
        scores[list(masked)] = [_iou(cameras, i, mask, hull) for i, mask in masked.items()]
        voters = [mask if score >= least else None for mask, score in zip(masks, scores, strict=True)]
    return scores


def agreeing(scores: Float[np.ndarray, " n"]) -> Bool[np.ndarray, " n"]:
    """Which silhouettes to believe, by their `silhouette_agreement`: none where too few fit the others."""
    fit = scores >= MIN_IOU
    return fit & (np.count_nonzero(fit) >= MIN_SHARE * np.count_nonzero(~np.isnan(scores)))


def _cube_around(
    cameras: PinholeCameras, masks: Sequence[Shaped[np.ndarray, "_ _"] | None]
) -> tuple[Float[np.ndarray, " 3"], float] | None:
    """Centre and half side of a cube around what the silhouettes show: the rays through their middles meet there."""
    origins, directions, reaches = [], [], []
    for i, mask in enumerate(masks):
        if mask is None or not mask.any():
            continue
        rows, columns = np.nonzero(mask)
        middle = np.array([[columns.mean() + 0.5, rows.mean() + 0.5]])
        origin, direction = cameras.rays(i, middle)
        origins.append(origin[0])
        directions.append(direction[0])
        half = 0.5 * float(np.hypot(columns.max() - columns.min(), rows.max() - rows.min()))
        reaches.append(half / cameras.intrinsics[i, 0, 0])
    try:
        center, _ = meeting_point(np.reshape(origins, (-1, 3)), np.reshape(directions, (-1, 3)))
    except ValueError:  # too few, or parallel
        return None
    distances = np.linalg.norm(np.array(origins) - center, axis=1)
    return center, CUBE * float(np.median(np.array(reaches) * distances))


def _iou(cameras: PinholeCameras, index: int, mask: Shaped[np.ndarray, "_ _"], hull: Hull) -> float:
    """Intersection over union of a mask and the hull's outline, on a grid of its pixels."""
    height, width = mask.shape
    step = max(1, round(max(height, width) / JUDGED_SIDE))
    rows, columns = np.mgrid[step // 2 : height : step, step // 2 : width : step].reshape(2, -1)
    on_mask = mask[rows, columns] != 0
    on_hull = _meets(hull, *cameras.rays(index, np.stack([columns, rows], 1) + 0.5))
    union = int(np.count_nonzero(on_mask | on_hull))
    return int(np.count_nonzero(on_mask & on_hull)) / max(union, 1)


def _meets(
    hull: Hull, origins: Float[np.ndarray, "p 3"], directions: Float[np.ndarray, "p 3"]
) -> Bool[np.ndarray, " p"]:
    """Which rays pass through a cell of the hull."""
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = np.stack([(hull.low - origins) / directions, (hull.high - origins) / directions])
    entry, leave = np.maximum(np.nanmax(ends.min(0), axis=1), 0), np.nanmin(ends.max(0), axis=1)
    crossing = np.flatnonzero(leave > entry)
    cells = np.array(hull.inside.shape)
    steps = int(STEPS_PER_CELL * cells.max())
    along = (np.arange(steps) + 0.5) / steps
    distances = entry[crossing, None] + along * (leave - entry)[crossing, None]
    met = np.zeros(len(origins), bool)
    places = origins[crossing, None] + distances[..., None] * directions[crossing, None]
    x, y, z = np.clip((places - hull.low) // hull.cell, 0, cells - 1).astype(np.int64).transpose(2, 0, 1)
    met[crossing] = hull.inside[x, y, z].any(1)
    return met
