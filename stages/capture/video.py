"""A video as photos: frames spread evenly over the camera's motion, of each stretch the sharpest.

Frames are counted and never sought, since seeking in a compressed video lands on different frames with different
decoders. Which ones are looked at goes by their time stamps: rates are not noted in every file, nor kept by every
camera. The decoder undoes the rotation that phones note in the file.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from stages.capture.photo_reading import UnusableError, check_size, telling_damage
from stages.inputs.folders import readable
from stages.inputs.formats import CONTAINERS, Kind, kind_of

LOOKS_PER_S = 10.0  # frames looked at; hand-held blur comes and goes within some tenths of a second
TRACK_SIDE = 320  # longest side of the thumbnails that motion is followed on, pixels
SHARP_SIDE = 960  # longest side of those that sharpness is measured on: blur of two pixels still shows
CORNERS = 200
# Where only the object moves (a turntable), most corners may stand on the background: the faster quarter tells.
MOVING = 0.75
# Photos nearer than this part of the frame's diagonal see the same thing: a full turn around an object that fills half
# of the frame moves its front by about 1.6 diagonals, which allows some 150 of them.
MIN_STRETCH = 0.01
STILL = 0.0005  # motion below this part of the diagonal is what tracking gets wrong
LOST = 0.25  # nothing could be followed: the view changed by a good part of the frame
JPEG_QUALITY = 97
STAMP_SLACK_MS = 5.0  # stamps are rounded, to whole milliseconds in WebM
UNSTAMPED_MS = 1000 / 30  # a frame lasts so long where its stamp is missing or before the last one's

# No camera makes frames of more pixels. The work is held against the bytes of the file: so many pixels are decoded of
# each, after those that are decoded of any file; smaller frames take as long as those of so many pixels.
LARGEST_FRAME = 80_000_000
PIXELS_PER_BYTE, PIXELS_OF_ANY, LEAST_WORK = 2000, 2e9, 3e5

# A file that is given as a video must not make FFmpeg read other files, or from the network, as playlists do.
FFMPEG_OPTIONS = f"protocol_whitelist;file|format_whitelist;{CONTAINERS}"


@dataclass(frozen=True)
class Look:
    """What was seen of one frame.

    Attributes:
        frame: its number, from 0.
        sharpness: variance of the Laplacian of its thumbnail; compares between neighbours only.
        moved: motion since the last look, as part of the frame's diagonal.
    """

    frame: int
    sharpness: float
    moved: float


def extract_frames(
    video: Path, folder: Path, count: int, progress: Callable[[float], None] = lambda part: None
) -> list[Path]:
    """Write up to `count` frames of `video` as JPEG files named by frame number into `folder`; fewer where it stands.

    `progress` is told the part done, 0 to 1.

    Raises:
        UnusableError: it cannot be read as a video.
    """
    with telling_damage():
        looks = list(_look(video, lambda part: progress(0.7 * part)))
    if not looks:
        raise UnusableError("no frame of this video can be read")
    return _write(video, folder, choose_frames(looks, count), lambda part: progress(0.7 + 0.3 * part))


def video_size(video: Path) -> tuple[int, int, int]:
    """Number of frames, upright width and height; nothing is decoded.

    Raises:
        UnusableError: it cannot be read as a video.
    """
    with telling_damage():
        capture = _open(video)
        width, height = _frame_size(capture)
        capture.release()
        return _count(video), width, height


def choose_frames(looks: list[Look], count: int) -> list[int]:
    """Up to `count` frame numbers, ascending: the way is cut into equal stretches, of each the sharpest is taken."""
    way = np.cumsum([0.0] + [look.moved if look.moved > STILL else 0.0 for look in looks[1:]])
    stretches = int(np.clip(np.ceil(way[-1] / MIN_STRETCH), 1, count))
    of_stretch = np.minimum((way / max(way[-1], STILL) * stretches).astype(int), stretches - 1)
    best: dict[int, Look] = {}
    for look, stretch in zip(looks, of_stretch.tolist(), strict=True):
        if stretch not in best or look.sharpness > best[stretch].sharpness:
            best[stretch] = look
    return sorted(look.frame for look in best.values())


def _look(video: Path, progress: Callable[[float], None]) -> Iterator[Look]:
    import cv2

    before = None
    for frame, pixels in _frames(video, None, progress):
        grey = cv2.cvtColor(pixels, cv2.COLOR_BGR2GRAY)
        small = _reduced(grey, TRACK_SIDE)
        sharpness = float(cv2.Laplacian(_reduced(grey, SHARP_SIDE), cv2.CV_32F).var())
        moved = 0.0 if before is None else motion(before, small) if before.shape == small.shape else LOST
        before = small
        yield Look(frame, sharpness, moved)


def motion(before: np.ndarray, after: np.ndarray) -> float:
    """How far corners moved between two grey pictures [H, W] uint8, as part of the diagonal; see `MOVING`, `LOST`."""
    import cv2

    corners = cv2.goodFeaturesToTrack(before, CORNERS, 0.01, 7)
    if corners is None:
        return 0.0  # nothing to see
    arrived, found, _ = cv2.calcOpticalFlowPyrLK(before, after, corners, np.empty_like(corners))
    ok = found.ravel() == 1
    if ok.mean() < 0.25:
        return LOST
    distances = np.linalg.norm((arrived - corners).reshape(-1, 2)[ok], axis=1)
    return float(min(np.quantile(distances, MOVING) / np.hypot(*before.shape), LOST))


def _reduced(grey: np.ndarray, side: int) -> np.ndarray:
    import cv2

    height, width = grey.shape
    scale = side / max(height, width)
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    return cv2.resize(grey, size, interpolation=cv2.INTER_AREA) if scale < 1 else grey


def _write(video: Path, folder: Path, chosen: list[int], progress: Callable[[float], None]) -> list[Path]:
    from PIL import Image

    folder.mkdir(parents=True, exist_ok=True)
    written = []
    for frame, pixels in _frames(video, set(chosen), progress):
        path = folder / f"{frame:06d}.jpg"
        Image.fromarray(pixels[:, :, ::-1]).save(path, quality=JPEG_QUALITY, subsampling=0)
        written.append(path)
    return written


def _frames(
    video: Path, wanted: set[int] | None, progress: Callable[[float], None]
) -> Iterator[tuple[int, np.ndarray]]:
    """Number and BGR pixels [H, W, 3] of the `wanted` frames; of None, `LOOKS_PER_S` a second."""
    total = max(1, _count(video))
    capture = _open(video)
    import cv2

    most = _most_frames(video, _frame_size(capture))
    last = max(wanted, default=-1) if wanted is not None else None
    frame, now_ms, due_ms = 0, -math.inf, -math.inf
    try:
        while (last is None or frame <= last) and capture.grab():
            if frame > most:
                raise UnusableError(f"a video of more than {most} frames in {video.stat().st_size} bytes")
            stamp_ms = capture.get(cv2.CAP_PROP_POS_MSEC)
            now_ms = stamp_ms if stamp_ms > now_ms else now_ms + UNSTAMPED_MS
            if frame in wanted if wanted is not None else now_ms + STAMP_SLACK_MS >= due_ms:
                due_ms = now_ms + 1000 / LOOKS_PER_S
                done, pixels = capture.retrieve()
                if done:
                    yield frame, pixels
            frame += 1
            progress(min(1.0, frame / total))
    finally:
        capture.release()


def _count(video: Path) -> int:
    """Number of frames: as the file states it, else of its packets, which are read and not decoded."""
    capture = _open(video)
    import cv2

    frames = _number(capture, cv2.CAP_PROP_FRAME_COUNT)
    if frames <= 0 and capture.set(cv2.CAP_PROP_FORMAT, -1):
        frames = 0
        while capture.grab():
            frames += 1
    capture.release()
    return max(0, frames)


def _number(capture: Any, key: int) -> int:
    """A property of a video as a whole number, 0 where it is none."""
    value = capture.get(key)
    return int(value) if math.isfinite(value) else 0


def _frame_size(capture: Any) -> tuple[int, int]:
    """Upright width and height."""
    import cv2

    return _number(capture, cv2.CAP_PROP_FRAME_WIDTH), _number(capture, cv2.CAP_PROP_FRAME_HEIGHT)


def _most_frames(video: Path, size: tuple[int, int]) -> int:
    """So many frames are decoded; a video of more has next to nothing in each."""
    pixels = PIXELS_OF_ANY + PIXELS_PER_BYTE * video.stat().st_size
    return int(pixels / max(size[0] * size[1], LEAST_WORK))


def _open(video: Path) -> Any:
    """
    Raises:
        UnusableError: it cannot be read as a video, or its frames are no photos by their size.
    """
    import cv2

    if kind_of(video) is not Kind.VIDEO:
        raise UnusableError("cannot be read as a video (damaged, or another format)")
    os.environ["OPENCV_FFMPEG_CAPTURE_OPTIONS"] = FFMPEG_OPTIONS
    level = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_ERROR)  # it warns of damaged files, which we name
    try:
        with _path_for_opencv(video) as path:
            capture = cv2.VideoCapture(path, cv2.CAP_FFMPEG)
    finally:
        cv2.utils.logging.setLogLevel(level)
    if not capture.isOpened():
        raise UnusableError("cannot be read as a video (damaged, or a codec that FFmpeg does not have)")
    size = _frame_size(capture)
    check_size(size)
    if size[0] * size[1] > LARGEST_FRAME:
        raise UnusableError(f"a video of {size[0]} x {size[1]} pixels")
    return capture


@contextmanager
def _path_for_opencv(file: Path) -> Iterator[str]:
    """An absolute path to open `file` by: a link, where its own is not UTF-8, on which OpenCV crashes."""
    path = str(file.absolute())
    if path == readable(path):
        yield path
        return
    with TemporaryDirectory() as folder:
        link = Path(folder) / f"video{file.suffix}"
        link.symlink_to(path)
        yield str(link)
