"""Are the photos of a set good? Each one's sharpness, exposure and likeness to the others, and which fall out of line.

Figures in the comments: 49 photos of a figure on a turntable, 16 of fruit by hand (one of them blurred), and twice 47
rendered with one exposure, all of them sets that can be reconstructed. They were decoded at a megapixel or more.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stages.capture.listing import name_some

BLUR_PIXELS = 1_000_000  # sharpness is measured at this size, so that it compares between cameras
LIKENESS_SIDE = 64

# Variance of the Laplacian: half the contrast of edges is a quarter of it. The set's own median stands for its texture.
# Lowest in the sets: 0.54 (figure), 0.68 (rendered), 0.46 (fruit) but for the blurred one at 0.26.
BLURRED = 0.3
# Stops from the set's median. Dark and light sides of a scene with one exposure reach 1.3.
EXPOSED = 1.5
# Correlation of 64 x 64 thumbnails. A turntable step of 7 degrees is at most 0.95, hand-held neighbours 0.85.
ALIKE = 0.99
DARKEST = 1e-4  # keeps a black photo's exposure finite


@dataclass(frozen=True)
class Appearance:
    """What one photo looks like.

    Attributes:
        source: path relative to the photo folder.
        sharpness: see `sharpness`.
        exposure: log2 of the mean luminance.
        thumbnail: [4096] its grey thumbnail, mean 0, norm 1.
    """

    source: str
    sharpness: float
    exposure: float
    thumbnail: np.ndarray


@dataclass(frozen=True)
class Oddities:
    """Photos that fall out of line, by `source`.

    Attributes:
        blurred: far less sharp than the median, see `BLURRED`.
        badly_exposed: far darker or lighter than the median, see `EXPOSED`.
        alike: each photo that is nearly the same as an earlier one, after that one; see `ALIKE`.
    """

    blurred: tuple[str, ...] = ()
    badly_exposed: tuple[str, ...] = ()
    alike: tuple[tuple[str, str], ...] = ()

    @property
    def warnings(self) -> list[str]:
        found = []
        if self.blurred:
            found.append(
                f"Far less sharp than the others: {name_some(self.blurred)}. Take them again or move them away."
            )
        if self.badly_exposed:
            found.append(f"Far darker or lighter than the others: {name_some(self.badly_exposed)}. Fix the exposure.")
        if self.alike:
            pairs = [f"{earlier} = {later}" for earlier, later in self.alike]
            found.append(f"Nearly the same picture: {name_some(pairs)}. They take time and add nothing.")
        return found


def appearance(source: str, rgb: np.ndarray) -> Appearance:
    """Of the photo's pixels [H, W, 3] uint8."""
    import cv2

    small = cv2.resize(rgb, (LIKENESS_SIDE, LIKENESS_SIDE), interpolation=cv2.INTER_AREA).astype(np.float32)
    grey = small.mean(axis=2)
    thumbnail = (grey - grey.mean()).ravel()
    return Appearance(
        source=source,
        sharpness=sharpness(rgb),
        exposure=float(np.log2(np.mean((small / 255) ** 2.2) + DARKEST)),
        thumbnail=thumbnail / max(float(np.linalg.norm(thumbnail)), 1e-6),
    )


def sharpness(rgb: np.ndarray) -> float:
    """Variance of the Laplacian of the grey image of [H, W, 3] uint8 at <= 1 megapixel; low is blurred."""
    import cv2

    grey = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
    scale = math.sqrt(BLUR_PIXELS / grey.size)
    if scale < 1:
        grey = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return round(float(cv2.Laplacian(grey, cv2.CV_32F).var()), 3)


def find_oddities(photos: Sequence[Appearance]) -> Oddities:
    """What falls out of line in this set."""
    if not photos:
        return Oddities()
    least = BLURRED * np.median([photo.sharpness for photo in photos])
    usual = np.median([photo.exposure for photo in photos])
    return Oddities(
        blurred=tuple(photo.source for photo in photos if photo.sharpness < least),
        badly_exposed=tuple(photo.source for photo in photos if abs(photo.exposure - usual) > EXPOSED),
        alike=_alike(photos),
    )


def _alike(photos: Sequence[Appearance]) -> tuple[tuple[str, str], ...]:
    thumbnails = np.stack([photo.thumbnail for photo in photos])
    pairs = []
    for later in range(1, len(photos)):
        likeness = thumbnails[:later] @ thumbnails[later]
        if likeness.max() > ALIKE:
            pairs.append((photos[int(likeness.argmax())].source, photos[later].source))
    return tuple(pairs)
