"""Depth maps to one point cloud."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from stages.geometry.point_cloud import PointCloud
from stages.stereo.rectification import View
from stages.stereo.trust import places, view_normals

if TYPE_CHECKING:
    from jaxtyping import Float, Float32, Int, UInt8

# No more depths than this become points, evenly chosen of all: memory.
MAX_DEPTHS = 4_000_000


def fused(
    views: Sequence[View],
    depths: Sequence[Float32[np.ndarray, "h w"]],
    trusts: Sequence[Float32[np.ndarray, "h w"]],
    colors: Sequence[UInt8[np.ndarray, "h w 3"]],
) -> PointCloud:
    """The depths with some trust as points: means, weighed by trust, of those that lie in one cell about a pixel wide.

    Cells double where pixels do, so that a close-up keeps its detail beside a photo from afar.
    """
    total = sum(int((trust > 0).sum()) for trust in trusts)
    stride = max(1, int(np.ceil(np.sqrt(total / MAX_DEPTHS))))
    rows, photos, cells = [], [], []
    for k, view in enumerate(views):
        v, u = (stride * each for each in np.nonzero(trusts[k][::stride, ::stride] > 0))
        at, trust = places(view, depths[k], v, u), trusts[k][v, u]
        normals = view_normals(view, depths[k])[v, u]
        rows.append(
            np.column_stack([at, normals, colors[k][v, u], np.ones(len(v))]).astype(np.float32) * trust[:, None]
        )
        photos.append(np.full(len(v), k, np.int32))
        cells.append(_cells(at, depths[k][v, u] * stride / view.matrix[0, 0]))
    if not total:
        return PointCloud.empty()
    return _means(np.concatenate(rows), np.concatenate(photos), np.concatenate(cells))


def _cells(points: Float[np.ndarray, "n 3"], widths: Float[np.ndarray, " n"]) -> Int[np.ndarray, "n 4"]:
    """The cell of each point: its size as a power of two, and where it is on a grid of that size."""
    octave = np.round(np.log2(widths)).astype(np.int64)
    return np.column_stack([octave, np.floor(points / 2.0 ** octave[:, None]).astype(np.int64)])


def _means(rows: Float[np.ndarray, "n 10"], photos: Int[np.ndarray, " n"], cells: Int[np.ndarray, "n 4"]) -> PointCloud:
    """One point for each cell; rows are place, normal, colour and 1, times trust."""
    key = np.zeros(len(cells), np.uint64)
    for factor, column in zip((0x9E3779B97F4A7C15, 73856093, 19349663, 83492791), cells.T, strict=True):
        key = (key ^ column.astype(np.uint64)) * np.uint64(factor | 1) + np.uint64(factor >> 7)
    order = np.lexsort((photos, key))
    key, photos = key[order], photos[order]
    first = np.flatnonzero(np.concatenate([[True], key[1:] != key[:-1]]))
    sums = np.add.reduceat(rows[order], first, axis=0)
    seen_first = np.concatenate([[True], (key[1:] != key[:-1]) | (photos[1:] != photos[:-1])])
    starts = np.concatenate([np.cumsum(seen_first)[first] - 1, [seen_first.sum()]])
    trust = sums[:, 9] / np.diff(np.append(first, len(key)))
    normals = sums[:, 3:6] / np.maximum(np.linalg.norm(sums[:, 3:6], axis=1, keepdims=True), 1e-12)
    return PointCloud(
        points=sums[:, :3] / sums[:, 9:],
        normals=normals,
        colors=np.round(sums[:, 6:9] / sums[:, 9:]).astype(np.uint8),
        trust=trust.astype(np.float32),
        starts=starts.astype(np.int64),
        photos=photos[seen_first],
    )
