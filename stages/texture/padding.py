"""Colours for the texels outside every chart, so that filtering and mip-maps never pull in a wrong colour."""

from __future__ import annotations

import numpy as np

# Texels around charts that repeat the nearest colour; beyond, the fill is smooth.
PADDING_REACH = 16
# The smooth fill is made on a texture this many times smaller: only mip-maps show it, and a float image of a large
# texture would take gigabytes.
COARSER = 4


def pad_charts(image: np.ndarray, known: np.ndarray, reach: int = PADDING_REACH) -> tuple[np.ndarray, np.ndarray]:
    """Fill the unknown texels: nearest known colour within `reach` texels, smooth push-pull beyond.

    Args:
        image: [S, S, 3] uint8.
        known: [S, S] bool.
        reach: texels.

    Returns:
        filled image [S, S, 3] uint8; [S, S] bool, the texels within `reach`.
    """
    import cv2

    if not known.any():
        return image.copy(), np.zeros_like(known)
    distance, nearest = cv2.distanceTransformWithLabels(
        (~known).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    # Labels number the known texels; turn them into texel indices.
    index_of = np.zeros(int(nearest.max()) + 1, dtype=np.int64)
    where = np.flatnonzero(known.ravel())
    index_of[nearest.ravel()[where]] = where
    padded = ~known & (distance <= reach)
    filled = cv2.resize(push_pull(*_shrunk(image, known)), known.shape[::-1], interpolation=cv2.INTER_LINEAR)
    filled[known] = image[known]
    filled[padded] = image.reshape(-1, 3)[index_of[nearest[padded]]]
    return filled, padded


def _shrunk(image: np.ndarray, known: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The mean [s, s, 3] of the known texels in each square of `COARSER` squared, and where there are any [s, s]."""
    import cv2

    size = (max(1, known.shape[1] // COARSER), max(1, known.shape[0] // COARSER))
    covered = cv2.resize(known.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    colors = np.zeros((*covered.shape, 3), dtype=np.uint8)
    for channel in range(3):
        values = np.where(known, image[..., channel], 0).astype(np.float32)
        mean = cv2.resize(values, size, interpolation=cv2.INTER_AREA) / np.maximum(covered, 1e-6)
        colors[..., channel] = np.clip(mean + 0.5, 0, 255)
    return colors, covered > 0


def push_pull(image: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Fill unknown texels of [H, W, 3] uint8 from coarser and coarser averages of the known ones."""
    import cv2

    colors: np.ndarray = np.where(known[..., None], image, 0).astype(np.float32)
    weight: np.ndarray = known.astype(np.float32)
    levels = []
    while min(weight.shape) > 1:
        levels.append((colors, weight))
        size = (max(1, weight.shape[1] // 2), max(1, weight.shape[0] // 2))
        summed = cv2.resize(colors * weight[..., None], size, interpolation=cv2.INTER_AREA)
        covered = cv2.resize(weight, size, interpolation=cv2.INTER_AREA)
        colors = summed / np.maximum(covered, 1e-6)[..., None]
        weight = (covered > 0).astype(np.float32)
    for finer, covered in reversed(levels):
        coarse = cv2.resize(colors, covered.shape[::-1], interpolation=cv2.INTER_LINEAR)
        colors = np.where(covered[..., None] > 0, finer, coarse)
    return np.clip(colors + 0.5, 0, 255).astype(np.uint8)
