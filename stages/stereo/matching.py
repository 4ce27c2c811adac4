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
# OpenCV's fixed point.
STEPS = 16.0
_HALF = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1]])


def warped(photo: UInt8[np.ndarray, "h w"], view: View, plane: Rectified, right: bool) -> UInt8[np.ndarray, "a b"]:
    """A grey photo turned onto the common plane; black where it shows nothing."""
    import cv2

    matrix = np.linalg.inv(_HALF) @ plane.homography(view, right) @ _HALF  # OpenCV's pixel centres are whole numbers
    turned: np.ndarray = cv2.warpPerspective(photo, matrix, plane.size, flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
    return turned


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
