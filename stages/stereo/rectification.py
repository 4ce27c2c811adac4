"""Two photos turned onto one plane, so that a point lies in the same row of both.

Source: Fusiello et al., "A compact algorithm for rectification of stereo pairs", 2000; here with a window that holds
only what both photos show, and disparities around zero.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from jaxtyping import Float

# Disparities beyond those of the known points, as a part of their range to either side.
MARGIN = 0.15
MAX_DISPARITIES = 384
MIN_WINDOW = 32  # pixels
MAX_FORWARD = 0.85  # cosine between base line and viewing axis
# Known points count but for this part at either end: outliers.
OUTER = 0.02


@dataclass(frozen=True)
class View:
    """One photo at the size at which it is compared.

    Attributes:
        matrix: [3, 3] intrinsics in pixels of that size, top-left corner (0, 0), pixel centres at .5.
        rotation: camera from the frame.
        center: in the frame.
        size: width and height.
    """

    matrix: Float[np.ndarray, "3 3"]
    rotation: Float[np.ndarray, "3 3"]
    center: Float[np.ndarray, " 3"]
    size: tuple[int, int]


@dataclass(frozen=True)
class Rectified:
    """The common plane of two photos.

    A point at [x, y, z] in the turned frame of the left camera has the left pixel (focal x / z + left_x, focal y / z +
    top), and the right one that much further left by its disparity: focal * base / z + shift.

    Attributes:
        turn: [3, 3] turned frame from the frame.
        focal, left_x, top: pixels.
        base: length of the base line.
        shift: disparity at infinity, negative: with it known points lie around zero.
        least, count: smallest disparity, and how many are searched (a multiple of 16).
        size: width and height of both rectified photos.
    """

    turn: Float[np.ndarray, "3 3"]
    focal: float
    left_x: float
    top: float
    base: float
    shift: float
    least: int
    count: int
    size: tuple[int, int]

    def homography(self, view: View, right: bool) -> Float[np.ndarray, "3 3"]:
        """Pixels of the rectified photo to those of the photo itself."""
        x = self.left_x - (self.shift if right else 0.0)
        back = np.array([[1 / self.focal, 0, -x / self.focal], [0, 1 / self.focal, -self.top / self.focal], [0, 0, 1]])
        matrix: np.ndarray = view.matrix @ view.rotation @ self.turn.T @ back
        return matrix


def rectify(left: View, right: View, points: Float[np.ndarray, "p 3"]) -> Rectified | None:
    """The common plane of two photos, whose disparities hold the points that they see.

    None where the base line runs along the lines of sight, or nothing of the points is in both photos.
    """
    base_line = right.center - left.center
    base = float(np.linalg.norm(base_line))
    if base < 1e-12:
        return None
    x_axis = base_line / base
    forward = left.rotation[2] + right.rotation[2]
    forward = forward / max(float(np.linalg.norm(forward)), 1e-12)
    if max(abs(x_axis @ left.rotation[2]), abs(x_axis @ right.rotation[2])) > MAX_FORWARD:
        return None
    y_axis = np.cross(forward, x_axis)
    y_axis /= np.linalg.norm(y_axis)
    turn = np.stack([x_axis, y_axis, np.cross(x_axis, y_axis)])
    depths = ((points - left.center) @ turn.T)[:, 2]
    depths = depths[depths > 0]
    if len(depths) < 4:
        return None
    focal = 0.5 * (left.matrix[0, 0] + right.matrix[0, 0])
    near, far = np.quantile(1 / depths, [1 - OUTER, OUTER])
    margin = MARGIN * (near - far) + 0.02 * near
    near, far = near + margin, max(far - margin, 0.0)
    focal *= min(1.0, MAX_DISPARITIES / (focal * base * (near - far)))
    middle = 0.5 * (near + far)
    shift = -focal * base * middle
    reach = focal * base * (near - far) / 2
    count = 16 * int(np.ceil((2 * reach + 2) / 16))
    window = _window(left, right, turn, focal, shift, reach)
    if window is None:
        return None
    low, high = window
    size = (int(np.ceil(high[0] - low[0])), int(np.ceil(high[1] - low[1])))
    if size[0] - count < MIN_WINDOW:  # OpenCV finds disparities only where both photos hold all of the range
        return None
    return Rectified(turn, focal, -low[0], -low[1], base, shift, -count // 2, count, size)


def _window(
    left: View, right: View, turn: np.ndarray, focal: float, shift: float, reach: float
) -> tuple[np.ndarray, np.ndarray] | None:
    """Lowest and highest rectified pixel that both photos hold, the principal point of the left one at 0."""
    boxes = []
    for view in (left, right):
        width, height = view.size
        corners = np.array([[0, 0, 1], [width, 0, 1], [0, height, 1], [width, height, 1]], float)
        rays = corners @ np.linalg.inv(view.matrix).T @ view.rotation @ turn.T
        if (rays[:, 2] < 0.2 * np.linalg.norm(rays, axis=1)).any():
            return None
        pixels = focal * rays[:, :2] / rays[:, 2:]
        boxes.append((pixels.min(0), pixels.max(0)))
    (low, high), (low_right, high_right) = boxes
    # a right pixel x stands for left ones within `reach` around x - shift
    aside = np.array([reach, 0])
    low = np.maximum(low, low_right - np.array([shift, 0]) - aside)
    high = np.minimum(high, high_right - np.array([shift, 0]) + aside)
    if (high - low < MIN_WINDOW).any():
        return None
    return low, high
