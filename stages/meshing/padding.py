"""Colours for the texels outside every chart, so that filtering and mip-maps never pull in a wrong colour."""

from __future__ import annotations

import numpy as np

# Texels around charts that repeat the nearest colour; beyond, the fill is smooth.
PADDING_REACH = 16


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
    filled = push_pull(image, known)
    filled[padded] = image.reshape(-1, 3)[index_of[nearest[padded]]]
    return filled, padded


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
