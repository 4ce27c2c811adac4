"""Photos that were kept back, beside drawings of the final mesh from where they were taken."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from stages.artifacts import AtlasMesh
from stages.drawing.view_scores import draw_view, score_views, silhouette
from stages.geometry.cameras import PinholeCameras
from stages.reporting.pictures import jpeg_uri, shrink

PAIR_SIDE = 420
MAX_PAIRS = 12
# Around what counts, as a part of the photo's longer side.
MARGIN = 0.04


def compare_held_out(
    atlas: AtlasMesh,
    texture: np.ndarray,
    cameras: PinholeCameras,
    load_photo: Callable[[int], tuple[np.ndarray, np.ndarray | None]],
    names: Sequence[str],
) -> dict[str, Any] | None:
    """Mean PSNR and SSIM over the photos `names`, and the first pairs as pictures; None where there are none.

    Args:
        load_photo: camera -> photo [H, W, 3] uint8 and mask [H, W] bool or None.
    """
    indices = [number for number, name in enumerate(cameras.names) if name in names]
    drawings: dict[str, np.ndarray] = {}

    def draw(index: int) -> np.ndarray:
        drawings[cameras.names[index]] = draw_view(atlas, texture, cameras, index)
        return drawings[cameras.names[index]]

    def covered(index: int) -> np.ndarray:
        return silhouette(atlas.vertices, atlas.faces, cameras, index)

    pairs: list[dict[str, str]] = []
    scores = []
    for index in indices:
        for score in score_views(draw, cameras, load_photo, covered, [index]):
            scores.append(score)
            drawing = drawings.pop(score.name)
            if len(pairs) < MAX_PAIRS:
                photo, mask = load_photo(index)
                window = _window(covered(index) if mask is None else mask)
                pairs.append(
                    {
                        "name": score.name,
                        "psnr": f"{score.psnr:.1f}",
                        "ssim": f"{score.ssim:.3f}",
                        "photo": jpeg_uri(shrink(photo[window], PAIR_SIDE)),
                        "drawing": jpeg_uri(shrink(drawing[window], PAIR_SIDE)),
                    }
                )
    if not scores:
        return None
    return {
        "pairs": pairs,
        "count": len(scores),
        "psnr": float(np.mean([score.psnr for score in scores])),
        "ssim": float(np.mean([score.ssim for score in scores])),
    }


def _window(mask: np.ndarray) -> tuple[slice, slice]:
    """Rows and columns that hold all of a mask [H, W], with a margin."""
    margin = round(MARGIN * max(mask.shape))
    rows, columns = (
        slice(max(ends[0] - margin, 0), ends[-1] + margin + 1)
        for ends in (np.flatnonzero(mask.any(axis)) for axis in (1, 0))
    )
    return rows, columns
