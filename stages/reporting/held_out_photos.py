"""Held-out photos, beside drawings of the final mesh from where they were taken."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from stages.artifacts import AtlasMesh
from stages.drawing.view_scores import score_views
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
    pairs: list[dict[str, str]] = []
    scores = []
    for view in score_views(atlas, texture, cameras, load_photo, [name for name in cameras.names if name in names]):
        scores.append((view.psnr, view.ssim))
        if len(pairs) < MAX_PAIRS:
            window = _window(view.counted)
            pairs.append(
                {
                    "name": view.name,
                    "psnr": f"{view.psnr:.1f}",
                    "ssim": f"{view.ssim:.3f}",
                    "photo": jpeg_uri(shrink(view.photo[window], PAIR_SIDE)),
                    "drawing": jpeg_uri(shrink(view.drawing[window], PAIR_SIDE)),
                }
            )
    if not scores:
        return None
    mean_psnr, mean_ssim = np.mean(scores, axis=0).tolist()
    return {"pairs": pairs, "count": len(scores), "psnr": mean_psnr, "ssim": mean_ssim}


def _window(mask: np.ndarray) -> tuple[slice, slice]:
    """Rows and columns that hold all of a mask [H, W], with a margin."""
    margin = round(MARGIN * max(mask.shape))
    rows, columns = (
        slice(max(ends[0] - margin, 0), ends[-1] + margin + 1)
        for ends in (np.flatnonzero(mask.any(axis)) for axis in (1, 0))
    )
    return rows, columns
