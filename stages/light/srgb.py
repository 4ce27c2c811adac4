"""The tone curve of sRGB (IEC 61966-2-1): between what a file holds and what light is."""

from __future__ import annotations

import numpy as np


def coded(linear: np.ndarray) -> np.ndarray:
    """Codes in 0..1 of linear values in 0..1."""
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 1e-9) ** (1 / 2.4) - 0.055)


def decoded(codes: np.ndarray) -> np.ndarray:
    """Linear values of codes in 0..1."""
    return np.where(codes <= 0.04045, codes / 12.92, ((codes + 0.055) / 1.055) ** 2.4)


def as_bytes(linear: np.ndarray) -> np.ndarray:
    """8-bit codes of linear values in 0..1."""
    return np.clip(255 * coded(linear) + 0.5, 0, 255).astype(np.uint8)
