"""From linear radiance to the screen: an exposure, Khronos PBR Neutral, sRGB."""

from __future__ import annotations

import numpy as np

from stages.light.srgb import coded

NAME = "Khronos PBR Neutral"
# Below this nothing but the reflection off what is no metal is taken away; above, the way to white begins.
_START, _DESATURATION = 0.8 - 0.04, 0.15


def neutral(radiance: np.ndarray) -> np.ndarray:
    """Khronos PBR Neutral: base colours under a white light of 1 come out as they are, highlights roll off to white.

    The reference code of github.com/KhronosGroup/ToneMapping (2024), which glTF viewers share.

    Args:
        radiance: [..., 3] linear.

    Returns:
        [..., 3] linear, in 0..1.
    """
    color = np.asarray(radiance, dtype=np.float32)
    low = color.min(-1, keepdims=True)
    color = color - np.where(low < 0.08, low - 6.25 * low**2, 0.04)
    peak = np.maximum(color.max(-1, keepdims=True), 1e-9)
    room = 1 - _START
    new_peak = np.where(peak < _START, peak, 1 - room**2 / (peak + room - _START))
    color = color * (new_peak / peak)
    whiter = 1 - 1 / (_DESATURATION * (peak - new_peak) + 1)
    return color * (1 - whiter) + new_peak * whiter


def on_screen(radiance: np.ndarray, exposure_ev: float = 0.0) -> np.ndarray:
    """[..., 3] float32 sRGB codes in 0..1 of linear radiance, made 2^EV times as bright before."""
    linear = np.clip(neutral(radiance * np.float32(2.0**exposure_ev)), 0, 1)
    return coded(linear)


def picture(
    radiance: np.ndarray, coverage: np.ndarray, behind: np.ndarray | float | None, exposure_ev: float = 0.0
) -> np.ndarray:
    """What a screen shows of a drawing over what is behind it.

    Args:
        radiance: [H, W, 3] linear, already times the coverage.
        coverage: [H, W].
        behind: [H, W, 3] linear radiance that is exposed, too; or a code in 0..1 (1: white); or None: transparent.

    Returns:
        [H, W, 3] uint8, [H, W, 4] where it is transparent, the alpha not multiplied in.
    """
    part = coverage[..., None]
    if isinstance(behind, np.ndarray):
        return _bytes(on_screen(radiance + (1 - part) * behind, exposure_ev))
    own = on_screen(radiance / np.maximum(part, 1e-6), exposure_ev)
    if behind is None:
        return _bytes(np.concatenate([own * (part > 0), part], axis=2))
    return _bytes(own * part + behind * (1 - part))


def _bytes(codes: np.ndarray) -> np.ndarray:
    return (np.clip(codes, 0, 1) * 255 + 0.5).astype(np.uint8)
