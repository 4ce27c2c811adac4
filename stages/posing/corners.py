"""Corners of a photo, exact to a part of a pixel: few points, but ones that stay in place on plain objects.

J. Shi, C. Tomasi, "Good Features to Track", CVPR 1994, at points where the structure tensor also passes Harris' test of
both directions; then the point to which all gradients around it are at right angles (W. Förstner, E. Gülch, 1987).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from jaxtyping import Float

GRADIENT_SIGMA = 1.0  # pixels: of the blur before gradients; outlines that were cut out have steps
WINDOW_SIGMA = 1.5  # pixels: of the window in which gradients are gathered
# The smaller eigenvalue of the structure tensor, against the larger one and as a gradient in grey levels a pixel: less
# in the one is an edge, along which a point slides, in the other noise.
MIN_RATIO, MIN_GRADIENT = 0.03, 0.5
SPACING = 2  # pixels: a corner is the strongest within a square of this half side
BORDER = 4  # pixels at the edge of a photo where no corner is looked for
REFINING_HALF_SIDE, MAX_MOVE = 4, 3.0  # pixels: window of the exact position, and how far it may lie from the peak
MAX_CORNERS = 2048


def find_corners(grey: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "n 2"]:
    """Corners in pixels, the strongest first; the middle of the top left pixel is (0.5, 0.5).

    Args:
        grey: 0 to 255.
    """
    import cv2

    smaller, larger = _eigenvalues(grey)
    strongest = cv2.dilate(smaller, np.ones((2 * SPACING + 1,) * 2, np.uint8))
    chosen = (smaller == strongest) & (smaller > MIN_GRADIENT**2) & (smaller > MIN_RATIO * larger)
    inside = np.zeros_like(chosen)
    inside[BORDER:-BORDER, BORDER:-BORDER] = True
    rows, columns = np.nonzero(chosen & inside)
    order = np.argsort(-smaller[rows, columns], kind="stable")[:MAX_CORNERS]
    peaks = np.stack([columns[order], rows[order]], 1).astype(np.float32)
    return _refined(grey, peaks) + 0.5


def _eigenvalues(grey: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """[H, W] smaller and larger eigenvalue of the structure tensor."""
    import cv2

    smooth = cv2.GaussianBlur(grey.astype(np.float32), (0, 0), GRADIENT_SIGMA)
    dx, dy = (cv2.Sobel(smooth, cv2.CV_32F, *axis, scale=1 / 8) for axis in ((1, 0), (0, 1)))
    xx, xy, yy = (cv2.GaussianBlur(product, (0, 0), WINDOW_SIGMA) for product in (dx * dx, dx * dy, dy * dy))
    half, spread = (xx + yy) / 2, np.hypot((xx - yy) / 2, xy)
    return half - spread, half + spread


def _refined(grey: np.ndarray, peaks: np.ndarray) -> np.ndarray:
    """[n, 2] exact positions; a peak stays where it is if its own lies too far away."""
    import cv2

    if len(peaks) == 0:
        return peaks
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 30, 0.01)
    half_sides = (REFINING_HALF_SIDE,) * 2
    refined = cv2.cornerSubPix(
        grey.astype(np.float32), peaks.reshape(-1, 1, 2).copy(), half_sides, (-1, -1), criteria
    ).reshape(-1, 2)  # fmt: skip
    moved = np.linalg.norm(refined - peaks, axis=1) > MAX_MOVE
    refined[moved] = peaks[moved]
    return refined
