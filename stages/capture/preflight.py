"""A quick look at photos before the work: decoded small, judged against each other.

Figures in the comments: 49 photos of a figure on a turntable, 16 of fruit by hand (one of them blurred), and twice 47
rendered with one exposure, all of them sets that can be reconstructed.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from stages.artifacts import SkippedImage
from stages.capture.background import find_background
from stages.capture.exif import ORIENTATION, camera_key, focal_px
from stages.capture.listing import list_captures
from stages.capture.photo_reading import MIN_SIDE, RAW_SUFFIXES, UnusableError, read_photo, register_formats, unreadable
from stages.capture.quality import sharpness
from stages.capture.video import video_size

GLANCE_SIDE = 1000  # JPEG decodes at 1/2, 1/4 or 1/8 not below this; blur that matters still shows
TURNED = (5, 6, 7, 8)  # EXIF orientations that swap width and height
LIKENESS_SIDE = 64

# Variance of the Laplacian: half the contrast of edges is a quarter of it. The set's own median stands for its texture.
# Lowest in the sets: 0.54 (figure), 0.68 (rendered), 0.46 (fruit) but for the blurred one at 0.26.
BLURRED = 0.3
# Stops from the set's median. Dark and light sides of a scene with one exposure reach 1.3.
EXPOSED = 1.5
# Correlation of 64 x 64 thumbnails. A turntable step of 7 degrees is at most 0.95, hand-held neighbours 0.85.
ALIKE = 0.99
DARKEST = 1e-4  # keeps a black photo's exposure finite
PLAIN_PHOTOS = 0.9  # masks can be made where this part of the backgrounds is plain


@dataclass(frozen=True)
class Glance:
    """What one photo looks like.

    Attributes:
        source: path relative to the photo folder.
        width, height: upright size in pixels.
        camera: photos with the same value share one camera's intrinsics.
        has_focal: whether EXIF gives the focal length.
        sharpness: variance of the Laplacian at <= 1 megapixel.
        exposure: log2 of the mean luminance.
        plain: whether its background is plain.
        look: [4096] its thumbnail, mean 0, norm 1.
    """

    source: str
    width: int
    height: int
    camera: str
    has_focal: bool
    sharpness: float
    exposure: float
    plain: bool
    look: np.ndarray


@dataclass(frozen=True)
class Video:
    """A video among the photos: how many frames of which size it may give."""

    source: str
    frames: int
    width: int
    height: int


@dataclass(frozen=True)
class Inspection:
    """All that was seen. The lists name photos by `source`, sorted.

    Attributes:
        blurred: far less sharp than the median.
        badly_exposed: far darker or lighter than the median.
        alike: pairs that show nearly the same.
        plain: whether nearly all backgrounds are plain.
        num_bytes: size of all the files.
    """

    photos: tuple[Glance, ...]
    videos: tuple[Video, ...]
    skipped: tuple[SkippedImage, ...]
    blurred: tuple[str, ...]
    badly_exposed: tuple[str, ...]
    alike: tuple[tuple[str, str], ...]
    plain: bool
    num_bytes: int

    @property
    def sizes(self) -> list[tuple[int, int]]:
        """Width and height of each photo and of each frame that a video may give."""
        frames = [(video.width, video.height) for video in self.videos for _ in range(video.frames)]
        return [(photo.width, photo.height) for photo in self.photos] + frames


def inspect(source: Path, masks_folder: Path | None, video_frames: int, workers: int) -> Inspection:
    """Look at all photos of `source` (see `list_captures`); `video_frames`: how many a video gives at most.

    Raises:
        InputError: see `list_captures`.
    """
    photos, videos, skipped = list_captures(source, masks_folder)
    folder = source if source.is_dir() else source.parent
    register_formats()

    def look(path: str) -> Glance | Video | SkippedImage:
        try:
            return _video(folder / path, path, video_frames) if path in videos else glance(folder / path, path)
        except UnusableError as reason:
            return SkippedImage(path, str(reason))

    with ThreadPoolExecutor(max_workers=max(1, workers)) as pool:
        seen = list(pool.map(look, [*photos, *videos]))
    glances = [item for item in seen if isinstance(item, Glance)]
    return Inspection(
        photos=tuple(glances),
        videos=tuple(item for item in seen if isinstance(item, Video)),
        skipped=tuple([*skipped, *(item for item in seen if isinstance(item, SkippedImage))]),
        blurred=find_blurred(glances),
        badly_exposed=find_badly_exposed(glances),
        alike=find_alike(glances),
        plain=bool(glances) and sum(photo.plain for photo in glances) >= PLAIN_PHOTOS * len(glances),
        num_bytes=sum((folder / path).stat().st_size for path in [*photos, *videos]),
    )


def glance(file: Path, source: str) -> Glance:
    """Look at one photo; `register_formats` must have been called for HEIC.

    Raises:
        UnusableError: it cannot be read or is too small to be a photo.
    """
    try:
        pixels, exif, (width, height) = _preview(file)
    except (UnusableError, MemoryError):
        raise
    except Exception as error:  # decoders raise nearly anything on a damaged file
        raise unreadable(error) from error
    if max(width, height) < MIN_SIDE:
        raise UnusableError(f"only {width} x {height} pixels")
    small = _thumbnail(pixels)
    grey = small.mean(axis=2)
    look = (grey - grey.mean()).ravel()
    upright = (height, width) if exif.get(ORIENTATION) in TURNED else (width, height)
    return Glance(
        source=source,
        width=upright[0],
        height=upright[1],
        camera=camera_key(exif, upright, source),
        has_focal=focal_px(exif, (width, height)) is not None,
        sharpness=sharpness(pixels),
        exposure=float(np.log2(np.mean((small / 255) ** 2.2) + DARKEST)),
        plain=find_background(pixels).is_plain,
        look=look / max(float(np.linalg.norm(look)), 1e-6),
    )


def find_blurred(photos: Sequence[Glance]) -> tuple[str, ...]:
    """Photos far less sharp than the median, see `BLURRED`."""
    if not photos:
        return ()
    least = BLURRED * np.median([photo.sharpness for photo in photos])
    return tuple(photo.source for photo in photos if photo.sharpness < least)


def find_badly_exposed(photos: Sequence[Glance]) -> tuple[str, ...]:
    """Photos far darker or lighter than the median, see `EXPOSED`."""
    if not photos:
        return ()
    usual = np.median([photo.exposure for photo in photos])
    return tuple(photo.source for photo in photos if abs(photo.exposure - usual) > EXPOSED)


def find_alike(photos: Sequence[Glance]) -> tuple[tuple[str, str], ...]:
    """Each photo that is nearly the same as an earlier one, after that one; see `ALIKE`."""
    if not photos:
        return ()
    looks = np.stack([photo.look for photo in photos])
    pairs = []
    for later in range(1, len(photos)):
        likeness = looks[:later] @ looks[later]
        if likeness.max() > ALIKE:
            pairs.append((photos[int(likeness.argmax())].source, photos[later].source))
    return tuple(pairs)


def _preview(file: Path) -> tuple[np.ndarray, Any, tuple[int, int]]:
    """Pixels [H, W, 3] uint8 of a reduced photo, not turned; its EXIF; its stored width and height."""
    from PIL import Image

    if file.suffix.lower() in RAW_SUFFIXES:
        photo = read_photo(file)  # half a second each; the previews in raw files have any size, or are not there
        return np.asarray(photo.rgb), photo.exif, photo.stored_size
    with Image.open(file) as stored:
        size = stored.size
        exif = stored.getexif()
        stored.draft("RGB", (GLANCE_SIDE, GLANCE_SIDE))
        return np.asarray(stored.convert("RGB")), exif, size


def _thumbnail(pixels: np.ndarray) -> np.ndarray:
    import cv2

    return cv2.resize(pixels, (LIKENESS_SIDE, LIKENESS_SIDE), interpolation=cv2.INTER_AREA).astype(np.float32)


def _video(file: Path, source: str, most: int) -> Video:
    frames, width, height = video_size(file)
    return Video(source, min(frames, most), width, height)
