"""Whether photos, masks, cameras and surface of a folder belong together: the surface, cast through the cameras that
`transforms.json` states, must cover what the renderer's masks cover."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from stages.evaluation.protocols.known_object import KnownObject, load_known_object, pinhole_rays
from stages.surface.triangle_mesh import raycaster

# A camera that is half a pixel off is far beyond these. An outline that runs along a row of pixels, as the city's does
# in photos straight down, falls to either side of their centres as a whole, which is a tenth of a pixel or so.
MAX_SHIFT = 0.25  # pixels
MIN_OUTLINE = 50  # pixels of outline across a direction, below which silhouettes say nothing of shifts along it
BLUR = 1.5  # pixels: outlines become slopes, whose height tells parts of a pixel
MIN_OVERLAP = 0.99
MIN_INSIDE = 0.99  # wires thinner than half a pixel have no mask: 0.4 % of the bicycle's vertices in one photo
EDGE = 1.0  # pixels next to which a pixel centre may fall to either side


@dataclass(frozen=True)
class Agreement:
    """The worst of all photos.

    Attributes:
        shift: of the cast silhouette against the rendered one, pixels.
        overlap: intersection over union of the two, pixels within EDGE of an outline left out.
        inside: share of the surface's vertices before the camera that fall onto the mask, or next to it.
    """

    shift: float
    overlap: float
    inside: float

    @property
    def is_exact(self) -> bool:
        return self.shift <= MAX_SHIFT and self.overlap >= MIN_OVERLAP and self.inside >= MIN_INSIDE


def check(folder: Path) -> Agreement:
    """Compare all masks of a finished folder with its surface and cameras."""
    import cv2

    known = load_known_object(folder)
    scene = raycaster(known.vertices, known.faces)
    shifts, overlaps, insides = [], [], []
    for i, path in enumerate(sorted((folder / "masks").iterdir())):
        mask = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) > 127
        cast = np.isfinite(scene.cast_rays(pinhole_rays(known.cameras, i))["t_hit"].numpy())
        shifts.append(_shift(mask, cast))
        sure = _away_from_outlines(cast)
        overlaps.append((mask & cast)[sure].sum() / max((mask | cast)[sure].sum(), 1))
        insides.append(_share_inside(known, i, mask))
    return Agreement(float(max(shifts)), float(min(overlaps)), float(min(insides)))


def _shift(mask: np.ndarray, cast: np.ndarray) -> float:
    """Pixels that best move one silhouette onto the other, by the slopes of both (Lucas and Kanade 1981).

    Their middles would say less: spokes thinner than a pixel are whole in one and gone from the other.
    """
    import cv2

    soft, other = (cv2.GaussianBlur(side.astype(np.float64), (0, 0), BLUR) for side in (mask, cast))
    slopes = np.stack(np.gradient((soft + other) / 2)).reshape(2, -1)
    strengths, axes = np.linalg.eigh(slopes @ slopes.T)
    told = strengths > MIN_OUTLINE / (2 * np.sqrt(np.pi) * BLUR)
    moved = axes.T @ (slopes @ (soft - other).ravel())
    return float(np.linalg.norm(moved[told] / strengths[told]))


def _away_from_outlines(mask: np.ndarray) -> np.ndarray:
    import cv2

    inside, outside = (cv2.distanceTransform(side.astype(np.uint8), cv2.DIST_L2, 5) for side in (mask, ~mask))
    return np.maximum(inside, outside) > EDGE


def _share_inside(known: KnownObject, index: int, mask: np.ndarray) -> float:
    import cv2

    pixels, depths = known.cameras.project(index, known.vertices)
    pixels = np.floor(pixels).astype(int)
    seen = (depths > 0) & np.all((pixels >= 0) & (pixels < np.array(mask.shape)[::-1]), axis=1)
    grown = cv2.dilate(mask.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    column, row = pixels[seen].T
    return float(grown[row, column].mean())
