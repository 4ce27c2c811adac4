"""A plain background - black cloth, white sweep, chroma key - told from the object by its colour at the frame's border.

Distances are CIE76 in Lab, L from 0 to 100. Figures in the comments were measured on 49 photos of a figure on black
cloth (plain) and 16 of fruit on a grey carpet (not plain: its pile is what structure from motion holds on to).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

SIDE = 1024  # longest side that masks are made at, pixels; larger photos get theirs from a smooth edge
JUDGED_SIDE = 640  # longest side at which the border is judged: the same grain at every resolution
BORDER = 0.02  # width of the border that is looked at, as part of the longest side
NEAR = 8.0  # a border pixel this near to the background's colour belongs to it
# The object may reach out of the frame at one side, but a border that is mostly something else is no background.
PLAIN_SHARE = 0.85  # cloth: 0.95 to 1.00 of the border is near; scenes: 0.01 to 0.61
GRAIN_SCALE = 4.0  # grain is what differs from a blur of this many pixels
MAX_GRAIN = 1.7  # its median; cloth: 0.84 to 1.11, carpet: 2.3 to 5.7
PLAIN_PHOTOS = 0.9  # this part of the photos must have a plain background before masks are made from it
TRIM, FITS = 0.8, 4  # each fit leaves out the fifth of the border that the last one met worst: the object, marks
MIN_THRESHOLD, MAX_THRESHOLD = 6.0, 14.0  # of the distance that separates: noise of a phone; what a shadow may add
SHADOW = 15.0  # the object's shadow is darker than the border by so much in L: black cloth's is as black as can be
SPECK = 0.05  # pieces smaller than this part of the largest are dust and reflections
MIN_OBJECT, MAX_OBJECT = 0.005, 0.9  # a mask outside these parts of the frame found nothing, or no background


@dataclass(frozen=True)
class Background:
    """The colour of the background, and how plain it is.

    Attributes:
        colour: [3, 3] Lab at the middle of the frame, its change over the width, its change over the height.
        near: share of the border that has that colour.
        grain: median difference in L between the border and its blur.
        spread: distance from that colour that 95 % of the border's near pixels keep.
    """

    colour: np.ndarray
    near: float
    grain: float
    spread: float

    @property
    def is_plain(self) -> bool:
        return self.near >= PLAIN_SHARE and self.grain <= MAX_GRAIN


def find_background(rgb: np.ndarray) -> Background:
    """The border's colour in a photo [H, W, 3] uint8: a plane over the frame, since light falls off."""
    import cv2

    lab = _lab(_reduced(rgb, JUDGED_SIDE))
    height, width = lab.shape[:2]
    border = np.ones((height, width), bool)
    edge = max(2, round(BORDER * max(height, width)))
    border[edge:-edge, edge:-edge] = False
    grain = np.abs(lab[:, :, 0] - cv2.GaussianBlur(lab[:, :, 0], (0, 0), GRAIN_SCALE))[border]

    basis, colours = _basis(height, width)[border], cv2.GaussianBlur(lab, (0, 0), 1.0)[border]
    distances = np.linalg.norm(colours - np.median(colours, axis=0), axis=1)
    for _ in range(FITS):
        kept = distances <= np.quantile(distances, TRIM)
        colour = np.linalg.lstsq(basis[kept], colours[kept], rcond=None)[0]
        distances = np.linalg.norm(colours - basis @ colour, axis=1)
    near = distances < NEAR
    spread = float(np.quantile(distances[near], 0.95)) if near.any() else NEAR
    return Background(colour, float(near.mean()), float(np.median(grain)), spread)


def plain_mask(rgb: np.ndarray) -> np.ndarray | None:
    """`object_mask` of a photo before a plain background; None where that is not plain, too."""
    background = find_background(rgb)
    return object_mask(rgb, background) if background.is_plain else None


def object_mask(rgb: np.ndarray, background: Background) -> np.ndarray | None:
    """[H, W] bool, True on what stands before the background; None where that is next to nothing or nearly all.

    What has the background's colour and hangs together with the border is background. Holes are filled: a dark spot
    of the object before black cloth is likelier than a hole through it.
    """
    import cv2

    height, width = rgb.shape[:2]
    lab = cv2.GaussianBlur(_lab(_reduced(rgb, SIDE)), (0, 0), 1.0)
    distance = np.linalg.norm(lab - _in_shadow(_basis(*lab.shape[:2]) @ background.colour, lab), axis=2)
    threshold = np.clip(1.5 * background.spread, MIN_THRESHOLD, MAX_THRESHOLD)
    outside = _touching_the_border(distance < threshold)
    # a thread of background colour between object and border must not open the object
    found = cv2.morphologyEx((~outside).astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    found = cv2.morphologyEx(found, cv2.MORPH_CLOSE, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (9, 9)))
    found = without_specks(found)
    filled = ~_touching_the_border(found == 0)
    if not MIN_OBJECT <= filled.mean() <= MAX_OBJECT:
        return None
    if filled.shape != (height, width):
        smooth = cv2.resize(filled.astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR)
        filled = smooth > 0.5
    return filled


def _in_shadow(expected: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """`expected` [H, W, 3] dimmed to the lightness that is `seen`, by `SHADOW` at most.

    Less light of the same colour scales L + 16, a and b alike: in Lab all three are differences of cube roots.
    """
    light = np.maximum(expected[:, :, :1] + 16, 1)
    dimmed = np.clip(seen[:, :, :1] + 16, light - SHADOW, light) / light
    offset = np.array([16, 0, 0], np.float32)
    return (expected + offset) * dimmed - offset


def _lab(rgb: np.ndarray) -> np.ndarray:
    import cv2

    return cv2.cvtColor(rgb.astype(np.float32) / 255, cv2.COLOR_RGB2LAB)


def _reduced(rgb: np.ndarray, side: int) -> np.ndarray:
    import cv2

    scale = side / max(rgb.shape[:2])
    return cv2.resize(rgb, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA) if scale < 1 else rgb


def _basis(height: int, width: int) -> np.ndarray:
    """[height, width, 3]: 1, x, y with x and y from -0.5 to 0.5."""
    y, x = np.mgrid[:height, :width].astype(np.float32)
    return np.stack([np.ones_like(x), x / width - 0.5, y / height - 0.5], axis=-1)


def _touching_the_border(region: np.ndarray) -> np.ndarray:
    """The pieces of `region` [H, W] bool that reach the border."""
    import cv2

    _, labels = cv2.connectedComponents(region.astype(np.uint8), connectivity=4)
    rim = np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]])
    return np.isin(labels, np.unique(rim[rim > 0]))


def without_specks(region: np.ndarray) -> np.ndarray:
    import cv2

    count, labels, stats, _ = cv2.connectedComponentsWithStats(region, connectivity=8)
    if count < 2:
        return region
    areas = stats[:, cv2.CC_STAT_AREA].copy()
    areas[0] = 0
    return (areas >= SPECK * areas.max())[labels].astype(np.uint8)
