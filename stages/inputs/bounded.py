"""Bytes that other programs and people wrote: read as far as a bound, and arrays only as large as their file.

What a header says is held against the bytes that are there before memory is taken for it.
"""

from __future__ import annotations

import errno
import io
import math
import os
import stat
import zipfile
from pathlib import Path

import numpy as np

MOST_TEXT = 1 << 30  # bytes; the largest poses known, of 100 000 photos, have a tenth of it
MOST_ARRAYS = 1 << 26  # bytes unpacked, of all arrays in a file of poses
LARGE, HOLLOW = 1 << 34, 1000  # bytes of a file, and times those that it takes of its disk
SHORT = 200  # characters of a reason that is told


def read_bytes(file: Path, most: int) -> bytes:
    """All of a file, which must be one: pipes and devices may never end.

    Raises:
        OSError: it cannot be read.
        ValueError: it is no file, or larger than `most` bytes.
    """
    found = file.stat()
    if not stat.S_ISREG(found.st_mode):
        raise ValueError("it is no file but a folder, a pipe, a socket or a device")
    if found.st_size > most:
        raise ValueError(f"it has {found.st_size} bytes, at most {most} are read")
    with file.open("rb") as stream:
        return stream.read(found.st_size)


def check_regular(file: Path) -> None:
    """
    Raises:
        OSError: `file` is not there; or it is a pipe, which would keep us waiting, or a device or a file that is all
            hole, which have no end.
    """
    found = file.stat()
    if not stat.S_ISREG(found.st_mode):
        raise OSError(errno.EINVAL, "a folder, a pipe, a socket or a device", str(file))
    if is_hole(found):
        raise OSError(errno.EINVAL, f"it claims {found.st_size} bytes and has next to none", str(file))


def is_hole(found: os.stat_result) -> bool:
    """Whether a file claims to be larger than videos are, and takes next to nothing of its disk."""
    return found.st_size > LARGE and getattr(found, "st_blocks", LARGE) * 512 * HOLLOW < found.st_size


def read_arrays(file: Path) -> dict[str, np.ndarray]:
    """The arrays of an .npz file as float64; pickles in it are refused.

    Raises:
        OSError: it cannot be read.
        ValueError: an array is of no numbers, or of another size than its header says. Damaged archives raise nearly
            anything.
    """
    with zipfile.ZipFile(io.BytesIO(read_bytes(file, MOST_ARRAYS))) as archive:
        check_unpacked(archive)
        return {name.removesuffix(".npy"): _array(archive.read(name)) for name in archive.namelist()}


def check_unpacked(archive: zipfile.ZipFile) -> None:
    """
    Raises:
        ValueError: the archive unpacks to more than `MOST_ARRAYS` bytes.
    """
    unpacked = sum(member.file_size for member in archive.infolist())
    if unpacked > MOST_ARRAYS:
        raise ValueError(f"it unpacks to {unpacked} bytes, at most {MOST_ARRAYS} are read")


def _array(data: bytes) -> np.ndarray:
    """An array of the bytes of an .npy file."""
    stream = io.BytesIO(data)
    version = np.lib.format.read_magic(stream)
    read_header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, _, kind = read_header(stream)
    if kind.kind not in "biuf":
        raise ValueError(f"an array of {kind}, numbers are needed")
    if math.prod(shape) * kind.itemsize != len(data) - stream.tell():
        raise ValueError(f"an array says that it is {shape} of {kind}, but has {len(data) - stream.tell()} bytes")
    stream.seek(0)
    return np.asarray(np.lib.format.read_array(stream, allow_pickle=False), dtype=np.float64)


def reason(error: Exception) -> str:
    """Why a file cannot be read, short enough for a sentence: some errors quote all of what they were given."""
    if isinstance(error, RecursionError):
        return "it is nested too deeply"
    if isinstance(error, MemoryError):
        return "it needs more memory than there is"
    if isinstance(error, KeyError):
        return f"it has no {str(error)[:SHORT]}"
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    text = " ".join(str(error).split()).rstrip(".") or type(error).__name__
    return text if len(text) <= SHORT else f"{text[:SHORT]}..."
