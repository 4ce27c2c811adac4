"""Pictures to a video, by the FFmpeg that OpenCV brings."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

# What browsers play; then what every build of OpenCV writes and desktop players play.
CODECS = {"vp09": "VP9", "mp4v": "MPEG-4 part 2"}


def write_mp4(file: Path, frames: Iterable[np.ndarray], size: tuple[int, int], per_second: float) -> tuple[int, str]:
    """Write frames [H, W, 3] uint8 RGB of one size (width and height, both even) to an MP4 file.

    Returns:
        How many there were, and the codec's name.

    Raises:
        OSError: nothing can be written there, or by no codec; or the file cannot be read again.
    """
    import cv2

    with file.open("wb"):  # OpenCV would not say why it cannot
        pass
    writers = (
        (name, cv2.VideoWriter(str(file), cv2.VideoWriter.fourcc(*code), per_second, size))
        for code, name in CODECS.items()
    )
    name, writer = next(((name, writer) for name, writer in writers if writer.isOpened()), ("", None))
    if writer is None:
        raise OSError(f"this OpenCV writes none of {', '.join(CODECS.values())}")
    count = 0
    try:
        for frame in frames:
            writer.write(cv2.cvtColor(frame, cv2.COLOR_RGB2BGR))
            count += 1
    finally:
        writer.release()
    found = count_frames(file)
    if found != count:
        raise OSError(f"{found} of {count} frames are in {file}: is the disk full?")
    return count, name


def count_frames(file: Path) -> int:
    """Of a video, as its header says; 0 where it cannot be opened or its first frame not be decoded."""
    import cv2

    video = cv2.VideoCapture(str(file))
    try:
        return int(video.get(cv2.CAP_PROP_FRAME_COUNT)) if video.isOpened() and video.read()[0] else 0
    finally:
        video.release()
