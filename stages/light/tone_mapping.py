"""Linear radiance of any brightness as a picture for a screen."""

from __future__ import annotations

import numpy as np

# How bright the mean of a picture becomes, of 1, before the curve.
MIDDLE_GREY = 0.18
LUMINANCE = np.array([0.2126, 0.7152, 0.0722])  # of linear sRGB


def srgb(linear: np.ndarray) -> np.ndarray:
    """The tone curve of sRGB (IEC 61966-2-1) for linear values in [0, 1]."""
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 0.0031308) ** (1 / 2.4) - 0.055)


def tone_mapped(radiance: np.ndarray) -> np.ndarray:
    """[..., 3] linear radiance as uint8 sRGB: its mean luminance to `MIDDLE_GREY`, then L / (1 + L), colours kept.

    The global operator of Reinhard et al., "Photographic Tone Reproduction for Digital Images" (2002), with the
    arithmetic mean. Black stays black, and so does what is not finite.
    """
    known = np.where(np.isfinite(radiance), np.maximum(radiance, 0), 0).astype(np.float64)
    luminance = known @ LUMINANCE
    mean = luminance.mean()
    exposed = known * (MIDDLE_GREY / mean if mean > 0 else 1.0)
    shown = exposed / (1 + exposed @ LUMINANCE)[..., None]
    return (255 * srgb(np.clip(shown, 0, 1)) + 0.5).astype(np.uint8)
