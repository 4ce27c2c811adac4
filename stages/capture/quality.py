"""Is a photo good? Sharpness, brightness and likeness, each of an array of pixels."""

from __future__ import annotations

import math

import numpy as np

BLUR_PIXELS = 1_000_000  # sharpness is measured at this size, so that it compares between cameras


def sharpness(rgb: np.ndarray) -> float:
    """Variance of the Laplacian of the grey image of [H, W, 3] uint8 at <= 1 megapixel; low is blurred."""
    import cv2

    grey = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
    scale = math.sqrt(BLUR_PIXELS / grey.size)
    if scale < 1:
        grey = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return round(float(cv2.Laplacian(grey, cv2.CV_32F).var()), 3)
