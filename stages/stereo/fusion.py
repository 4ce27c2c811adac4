"""Depth maps to one point cloud."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from stages.geometry.point_cloud import PointCloud
from stages.geometry.vectors import unit
from stages.stereo.rectification import View
from stages.stereo.trust import normals_at, places

if TYPE_CHECKING:
    from jaxtyping import Float, Float32, Int, UInt8, UInt64

# No more depths than this become points, evenly chosen of all: memory.
MAX_DEPTHS = 4_000_000
# Bits of a cell's place along an axis; with those of its size they fill 64. A cell is about a pixel wide, so that
# places which share their last 19 bits are hundreds of photos apart.
_BITS = 19


def fused(
    views: Sequence[View],
    depths: Sequence[Float32[np.ndarray, "h w"]],
    trusts: Sequence[Float32[np.ndarray, "h w"]],
    colors: Iterable[UInt8[np.ndarray, "h w 3"]],
) -> PointCloud:
    """The depths with some trust as points: means, weighed by trust, of those that lie in one cell about a pixel wide.

    Cells double where pixels do, so that a close-up keeps its detail beside a photo from afar. Colours are taken one
    photo at a time, so that they need not all be held.
    """
    total = sum(int((trust > 0).sum()) for trust in trusts)
    if not total:
        return PointCloud.empty()
    stride = max(1, int(np.ceil(np.sqrt(total / MAX_DEPTHS))))
    counts = [int((trust[::stride, ::stride] > 0).sum()) for trust in trusts]
    ends = np.cumsum(counts)
    rows, cells = np.empty((ends[-1], 10), np.float32), np.empty(ends[-1], np.uint64)
    for k, (view, depth, trust, color) in enumerate(zip(views, depths, trusts, colors, strict=True)):
        v, u = (stride * each for each in np.nonzero(trust[::stride, ::stride] > 0))
        at, of_photo = places(view, depth, v, u), slice(ends[k] - counts[k], ends[k])
        row = rows[of_photo]
        row[:, :3], row[:, 3:6], row[:, 6:9], row[:, 9] = at, normals_at(view, depth, v, u), color[v, u], 1
        row *= trust[v, u][:, None]
        cells[of_photo] = _cells(at, depth[v, u] * stride / view.focal)
    return _means(rows, np.repeat(np.arange(len(views), dtype=np.int32), counts), cells)


def _cells(points: Float[np.ndarray, "n 3"], widths: Float[np.ndarray, " n"]) -> UInt64[np.ndarray, " n"]:
    """A number for the cell of each point: of its size as a power of two, and where it is on a grid of that size."""
    octave = np.round(np.log2(widths)).astype(np.int64)
    key = octave.astype(np.uint64)
    for column in np.floor(points / 2.0 ** octave[:, None]).astype(np.int64).T:
        key = key << np.uint64(_BITS) | column.astype(np.uint64) & np.uint64(2**_BITS - 1)
    return key


def _means(
    rows: Float32[np.ndarray, "n 10"], photos: Int[np.ndarray, " n"], key: UInt64[np.ndarray, " n"]
) -> PointCloud:
    """One point for each cell; rows are place, normal, colour and 1, times trust."""
    order = np.lexsort((photos, key))
    key, photos = key[order], photos[order]
    first = np.flatnonzero(np.concatenate([[True], key[1:] != key[:-1]]))
    sums = np.empty((len(first), 10), np.float32)
    for column in range(10):  # one at a time: memory
        sums[:, column] = np.add.reduceat(rows[order, column], first)
    seen_first = np.concatenate([[True], (key[1:] != key[:-1]) | (photos[1:] != photos[:-1])])
    starts = np.concatenate([np.cumsum(seen_first)[first] - 1, [seen_first.sum()]])
    trust = sums[:, 9] / np.diff(np.append(first, len(key)))
    return PointCloud(
        points=sums[:, :3] / sums[:, 9:],
        normals=unit(sums[:, 3:6]),
        colors=np.round(sums[:, 6:9] / sums[:, 9:]).astype(np.uint8),
        trust=trust.astype(np.float32),
        starts=starts.astype(np.int64),
        photos=photos[seen_first],
    )
