"""Pictures that are drawn one after another, to a video or side by side to one picture file."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from stages.engine.workspace import DISK_FULL
from stages.errors import ConfigError, InputError
from stages.files.video import write_mp4

PICTURES, VIDEOS = (".png",), (".mp4",)
FRAMES_PER_SECOND = 30
SMALLEST, LARGEST = 16, 4096
GAP = 8  # pixels between pictures in a row


def is_video(out: Path) -> bool:
    return out.suffix.lower() in VIDEOS


def check_film(out: Path, size: tuple[int, int]) -> None:
    """
    Args:
        size: width and height of one picture.

    Raises:
        ConfigError: `out` is of no known kind, or the size cannot be drawn.
        InputError: there is no folder for the file.
    """
    if out.suffix.lower() not in PICTURES + VIDEOS:
        raise ConfigError(f"--out {out} is neither a picture nor a video.", "Name a file that ends with .png or .mp4.")
    width, height = size
    if not (SMALLEST <= width <= LARGEST and SMALLEST <= height <= LARGEST) or (width | height) % 2:
        raise ConfigError(
            f"--size {width}x{height}: both must be even, {SMALLEST} to {LARGEST} pixels.", "Try `--size 1280x720`."
        )
    if not out.absolute().parent.is_dir():
        raise InputError(f"There is no folder {out.absolute().parent}.", "Make it, or name another place.")


def write_film(
    out: Path,
    pictures: Iterator[np.ndarray],
    count: int,
    size: tuple[int, int],
    progress: Callable[[int, int], None],
) -> dict[str, Any]:
    """Draw `count` pictures into a file, written beside it and renamed, so that what is there is whole.

    Args:
        pictures: [H, W, 3] uint8 RGB or, for a picture file, RGBA.
        progress: told how many are done, of how many.

    Returns:
        How many, and the codec of a video.

    Raises:
        InputError: it cannot be written there.
    """
    beside = out.with_name(f".{out.stem}.{os.getpid()}{out.suffix}")
    try:
        if is_video(out):
            _, codec = write_mp4(beside, _told(pictures, count, progress), size, FRAMES_PER_SECOND)
            about: dict[str, Any] = {"frames": count, "codec": codec}
        else:
            beside.write_bytes(png_bytes(in_a_row(list(_told(pictures, count, progress)))))
            about = {"sides": count}
        beside.replace(out)
    except OSError as error:
        if error.errno in DISK_FULL:
            raise
        raise InputError(
            f"{out} cannot be written: {error.strerror or error}.", "Name another place with `--out`."
        ) from error
    finally:
        beside.unlink(missing_ok=True)
    return about


def _told(pictures: Iterator[np.ndarray], count: int, progress: Callable[[int, int], None]) -> Iterator[np.ndarray]:
    progress(0, count)
    for done, drawn in enumerate(pictures, 1):
        yield drawn
        progress(done, count)


def in_a_row(pictures: list[np.ndarray]) -> np.ndarray:
    """Pictures of one size side by side, with white (or nothing, where they are transparent) between them."""
    gap = np.full((len(pictures[0]), GAP, pictures[0].shape[2]), 255, np.uint8)
    gap[..., 3:] = 0
    row = [part for drawn in pictures for part in (gap, drawn)][1:]
    return np.concatenate(row, axis=1)


def png_bytes(image: np.ndarray) -> bytes:
    """[H, W, 3] or [H, W, 4] uint8 RGB or RGBA as a PNG."""
    import cv2

    code = cv2.COLOR_RGBA2BGRA if image.shape[2] == 4 else cv2.COLOR_RGB2BGR
    return cv2.imencode(".png", cv2.cvtColor(image, code))[1].tobytes()
