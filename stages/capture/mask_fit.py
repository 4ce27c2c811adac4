"""Whether a mask is one of this photo: an object's outline lies on edges of its photo, elsewhere only by chance.

The chance is measured on the photo itself, with the same outline moved, mirrored and turned. Measured on the four
development sets that come with masks (16 photos of each): the right mask wins in all photos, also where it was widened
by 6/256 of the photo (by 10/256: in 50 to 100 %); the next photo's mask wins in 0 to 31 %, one of another set in
0 to 12 %.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

SIDE = 256  # longest side at which edges are compared, pixels
WIDER = (-7, -3, 0, 3, 7)  # a mask may be drawn within or around its object, by so many pixels at that size
MOVED = ((0, 1), (0, -1), (1, 0), (-1, 0))  # quarters of the frame
MOVED_SLANTED = ((0.6, 0.6), (-0.6, 0.6), (0.6, -0.6), (-0.6, -0.6))
TURNS = ("mirrored", "upside down and mirrored", "turned by 180 degrees")
RIM = 3  # an outline along the frame's border is the frame's
MIN_OUTLINE = 20  # pixels; shorter ones say nothing


@dataclass(frozen=True)
class OutlineFit:
    """How well an outline lies on a photo's edges.

    Attributes:
        own: mean rank of the gradient under it, from 0 (the weakest in this photo) to 1.
        chance: the same of the best among its copies elsewhere.
        turn: one of TURNS where that copy is the best and beats the outline itself; else empty.
    """

    own: float
    chance: float
    turn: str = ""

    @property
    def fits(self) -> bool:
        return self.own > self.chance


def outline_fit(mask: np.ndarray, rgb: np.ndarray) -> OutlineFit | None:
    """Of a mask [H, W] bool on its upright photo [h, w, 3] uint8; None where the mask has no outline in the frame."""
    import cv2

    scale = SIDE / max(rgb.shape[:2])
    size = max(2, round(rgb.shape[1] * scale)), max(2, round(rgb.shape[0] * scale))
    grey = cv2.resize(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), size, interpolation=cv2.INTER_AREA)
    small = cv2.resize(mask.astype(np.uint8) * 255, size, interpolation=cv2.INTER_AREA) > 127
    strength, best = _edge_ranks(grey), None
    for pixels in WIDER:
        outline = _outline(_widened(small, pixels))
        if outline.sum() >= MIN_OUTLINE:
            scores = np.array([_mean(strength, copy) for copy in (outline, *_turns(outline), *_moves(outline))])
            best = scores if best is None else np.maximum(best, scores)
    if best is None:
        return None
    winner = int(np.argmax(best))
    return OutlineFit(float(best[0]), float(best[1:].max()), TURNS[winner - 1] if 1 <= winner <= len(TURNS) else "")


def _edge_ranks(grey: np.ndarray) -> np.ndarray:
    """[H, W] from 0 to 1: the part of the photo whose gradient is weaker."""
    import cv2

    smooth = cv2.GaussianBlur(grey.astype(np.float32), (0, 0), 1.0)
    gradient = np.hypot(cv2.Sobel(smooth, cv2.CV_32F, 1, 0), cv2.Sobel(smooth, cv2.CV_32F, 0, 1))
    gradient = cv2.dilate(gradient, np.ones((3, 3), np.uint8))
    ranks = np.empty(gradient.size)
    ranks[np.argsort(gradient.ravel(), kind="stable")] = np.linspace(0, 1, gradient.size)
    return ranks.reshape(gradient.shape)


def _widened(mask: np.ndarray, pixels: int) -> np.ndarray:
    import cv2

    if pixels == 0:
        return mask
    disk = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * abs(pixels) + 1,) * 2)
    change = cv2.dilate if pixels > 0 else cv2.erode
    return change(mask.astype(np.uint8), disk) > 0


def _outline(mask: np.ndarray) -> np.ndarray:
    import cv2

    outline: np.ndarray = mask & (cv2.erode(mask.astype(np.uint8), np.ones((3, 3), np.uint8)) == 0)
    outline[:RIM] = outline[-RIM:] = False
    outline[:, :RIM] = outline[:, -RIM:] = False
    return outline


def _turns(outline: np.ndarray) -> list[np.ndarray]:
    """In the order of TURNS."""
    return [outline[:, ::-1], outline[::-1], outline[::-1, ::-1]]


def _moves(outline: np.ndarray) -> list[np.ndarray]:
    height, width = outline.shape
    moved = []
    for down, right in (*MOVED, *MOVED_SLANTED):
        y, x = np.nonzero(outline)
        y, x = y + round(down * height / 4), x + round(right * width / 4)
        inside = (y >= 0) & (y < height) & (x >= 0) & (x < width)
        copy = np.zeros_like(outline)
        copy[y[inside], x[inside]] = True
        moved.append(copy)
    return moved


def _mean(strength: np.ndarray, outline: np.ndarray) -> float:
    return float(strength[outline].mean()) if outline.sum() >= MIN_OUTLINE else 0.0
