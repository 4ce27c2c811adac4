"""Disparities of two rectified photos by semi-global matching."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from stages.stereo.rectification import Rectified, View

if TYPE_CHECKING:
    from jaxtyping import Float32, Int16, UInt8

# Side of the compared blocks; penalties for a disparity that changes by one pixel and by more (Hirschmueller 2008), as
# OpenCV scales them for one channel.
BLOCK = 5
P1, P2 = 8 * BLOCK**2, 32 * BLOCK**2
# The best match must be so much better than the next (percent), and the same from right to left (pixels).
UNIQUENESS, MAX_CHANGE = 8, 1
# Islands of so many pixels are noise, where disparities within this many pixels belong together.
SPECKLE, SPECKLE_RANGE = 60, 2
# Standard deviation of grey values; with less there is nothing to even.
LEAST_CONTRAST = 2.0
# Photos of one exposure differ by less, in mean and contrast, by what they show: to even them costs a twentieth of the
# surface.
JUMP = 1.5
# OpenCV's fixed point.
STEPS = 16.0
_HALF = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1]])


def warped(photo: UInt8[np.ndarray, "h w"], view: View, plane: Rectified, right: bool) -> UInt8[np.ndarray, "a b"]:
    """A grey photo turned onto the common plane; black where it shows nothing."""
    import cv2

    matrix = np.linalg.inv(_HALF) @ plane.homography(view, right) @ _HALF  # OpenCV's pixel centres are whole numbers
    turned: np.ndarray = cv2.warpPerspective(photo, matrix, plane.size, flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
    return turned


def evened(
    left: UInt8[np.ndarray, "a b"], right: UInt8[np.ndarray, "a b"]
) -> tuple[UInt8[np.ndarray, "a b"], UInt8[np.ndarray, "a b"]]:
    """Both with the mean and contrast of the one that has more, where both show something: an exposure that jumps."""
    import cv2

    both = ((left > 0) & (right > 0)).astype(np.uint8)
    (mean_left, spread_left), (mean_right, spread_right) = (
        [float(each[0, 0]) for each in cv2.meanStdDev(photo, mask=both)] for photo in (left, right)
    )
    if (
        min(spread_left, spread_right) < LEAST_CONTRAST
        or max(_ratio(mean_left, mean_right), _ratio(spread_left, spread_right)) < JUMP
    ):
        return left, right
    if spread_left < spread_right:
        return _stretched(left, spread_right / spread_left, mean_left, mean_right), right
    return left, _stretched(right, spread_left / spread_right, mean_right, mean_left)


def _ratio(a: float, b: float) -> float:
    return max(a, b) / max(min(a, b), 1e-6)


def _stretched(photo: UInt8[np.ndarray, "a b"], factor: float, mean: float, onto: float) -> UInt8[np.ndarray, "a b"]:
    """Values `factor` times as far from another mean; black, which is nothing, stays."""
    import cv2

    table = np.clip(np.round(factor * (np.arange(256) - mean) + onto), 1, 255).astype(np.uint8)
    table[0] = 0
    stretched: np.ndarray = cv2.LUT(photo, table)
    return stretched


def disparities(
    left: UInt8[np.ndarray, "a b"], right: UInt8[np.ndarray, "a b"], plane: Rectified
) -> Int16[np.ndarray, "a b"]:
    """Disparity of each pixel of the left photo as OpenCV has it, see `in_pixels`."""
    import cv2

    matcher = cv2.StereoSGBM.create(
        plane.least, plane.count, BLOCK, P1, P2, MAX_CHANGE, 63, UNIQUENESS, SPECKLE, SPECKLE_RANGE,
        cv2.STEREO_SGBM_MODE_SGBM_3WAY,
    )  # fmt: skip
    found: np.ndarray = matcher.compute(left, right)
    return found


def in_pixels(found: Int16[np.ndarray, "a b"], plane: Rectified) -> Float32[np.ndarray, "a b"]:
    """OpenCV's disparities in pixels, NaN where none was found."""
    unknown = (plane.least - 1) * STEPS
    return np.where(found <= unknown, np.float32(np.nan), found.astype(np.float32) / np.float32(STEPS))
