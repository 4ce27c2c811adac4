"""Colours for distances."""

from __future__ import annotations

import numpy as np


def distance_colors(distances: np.ndarray, largest: float) -> np.ndarray:
    """Colours [P, 3] uint8 of distances [P]: from blue at 0 over green to red at `largest` and beyond."""
    import cv2

    levels = np.clip(255 * distances / max(largest, 1e-30), 0, 255).astype(np.uint8)
    return cv2.applyColorMap(levels[:, None], cv2.COLORMAP_TURBO)[:, 0, ::-1]
