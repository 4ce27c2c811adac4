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

# Disparities beyond those of the known points, as a part of their range to either side: where they are many; and where
# they are few, this over the root of their number more.
MARGIN, FEW = 0.15, 1.0
# So many disparities are searched at most, and a rectified photo has at most so many times the photos' pixels: beyond,
# both are compared at a smaller size.
MAX_DISPARITIES, MAX_AREA = 384, 2.0
MIN_WINDOW = 32  # pixels
MIN_POINTS = 4
MAX_FORWARD = 0.85  # cosine between base line and viewing axis
# Rays of a photo's corners are at least so near (cosine) to the common axis: further aside, pixels are stretched by 25.
MIN_CORNER = 0.2
# Known points count but for this part at either end: outliers.
OUTER = 0.02
# Depths agree that differ by less than this part of them, or by less than so many pixels of disparity between lines of
# sight ten degrees apart: a small photo cannot tell depths so well.
TOLERANCE, TOLERANCE_PX = 0.004, 0.6


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

    @property
    def focal(self) -> float:
        """Focal length, pixels."""
        return float(self.matrix[0, 0] + self.matrix[1, 1]) / 2


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


def tolerance_of(view: View) -> float:
    """Part of a depth within which two that are found for a pixel of a photo agree."""
    return max(TOLERANCE, TOLERANCE_PX / (view.focal * np.tan(np.radians(10))))


def comparable(left: View, right: View) -> bool:
    """Whether two photos can be turned onto one plane: they look the same way, and not along their base line."""
    base_line = right.center - left.center
    base = float(np.linalg.norm(base_line))
    forwards = np.stack([left.rotation[2], right.rotation[2]])
    return base > 1e-12 and bool(
        forwards[0] @ forwards[1] > 0 and (abs(forwards @ base_line) < MAX_FORWARD * base).all()
    )


def rectify(left: View, right: View, points: Float[np.ndarray, "p 3"]) -> Rectified | None:
    """The common plane of two photos, whose disparities hold the points that they see.

    None where they are not `comparable`, or too little of what they show is in both.
    """
    if not comparable(left, right):
        return None
    turn, base = _turn(left, right), float(np.linalg.norm(right.center - left.center))
    inverse = _inverse_depths((points - left.center) @ turn[2])
    if inverse is None:
        return None
    near, far = inverse
    shift, reach = -base * (near + far) / 2, base * (near - far) / 2  # for a focal length of 1
    window = _window(left, right, turn, shift, reach)
    if window is None:
        return None
    low, high = window
    pixels = (np.prod(left.size) + np.prod(right.size)) / 2
    focal = min(
        0.5 * (left.focal + right.focal),
        MAX_DISPARITIES / (2 * reach),
        np.sqrt(MAX_AREA * pixels / np.prod(high - low)),
    )
    count = 16 * int(np.ceil((2 * focal * reach + 2) / 16))
    width, height = (int(np.ceil(side)) for side in focal * (high - low))
    # OpenCV finds disparities only where both photos hold all of the range
    if min(width - count, height) < MIN_WINDOW:
        return None
    left_x, top = -focal * low
    return Rectified(turn, float(focal), left_x, top, base, focal * shift, -count // 2, count, (width, height))


def _turn(left: View, right: View) -> Float[np.ndarray, "3 3"]:
    """x along the base line, z as near as may be to the mean of both viewing axes."""
    x_axis = right.center - left.center
    y_axis = np.cross(left.rotation[2] + right.rotation[2], x_axis)
    x_axis, y_axis = x_axis / np.linalg.norm(x_axis), y_axis / np.linalg.norm(y_axis)
    return np.stack([x_axis, y_axis, np.cross(x_axis, y_axis)])


def _inverse_depths(depths: Float[np.ndarray, " p"]) -> tuple[float, float] | None:
    """1 / depth between which to search, the nearest first; None where too few points lie before the photos."""
    before = depths[depths > 0]
    if len(before) < MIN_POINTS:
        return None
    near, far = np.quantile(1 / before, [1 - OUTER, OUTER])
    margin = (MARGIN + FEW / np.sqrt(len(before))) * (near - far) + 0.02 * near
    return float(near + margin), float(max(far - margin, 0.0))


def _window(
    left: View, right: View, turn: Float[np.ndarray, "3 3"], shift: float, reach: float
) -> tuple[Float[np.ndarray, " 2"], Float[np.ndarray, " 2"]] | None:
    """Lowest and highest [x, y] on the plane that both photos hold, for a focal length of 1, the left one's axis at 0;
    None where they hold nothing in common."""
    boxes = []
    for view in (left, right):
        width, height = view.size
        corners = np.array([[0, 0, 1], [width, 0, 1], [0, height, 1], [width, height, 1]], float)
        rays = corners @ np.linalg.inv(view.matrix).T @ view.rotation @ turn.T
        if not (rays[:, 2] >= MIN_CORNER * np.linalg.norm(rays, axis=1)).all():  # nor where axes leave no plane: NaN
            return None
        places = rays[:, :2] / rays[:, 2:]
        boxes.append((places.min(0), places.max(0)))
    (low, high), (low_right, high_right) = boxes
    # a right place x stands for left ones within `reach` around x - shift
    low = np.maximum(low, low_right - [shift + reach, 0])
    high = np.minimum(high, high_right - [shift - reach, 0])
    return (low, high) if (high > low).all() else None
