"""Environment maps that other programs wrote: Radiance HDR and OpenEXR, to linear radiance.

What a header says is held against `MOST_ROWS` and the bytes that are there before memory is taken for it.
"""

from __future__ import annotations

import contextlib
import io
import math
import re
from pathlib import Path
from typing import Any

import numpy as np

from stages.inputs.bounded import read_bytes
from stages.inputs.formats import HEAD_BYTES, Kind, in_words, kind_of_head, read_head_bytes

MOST_BYTES = 1 << 29  # of a file
MOST_ROWS = 4096
MOST_DECODED = 1 << 30  # bytes of all channels of an EXR: its reader decodes them all
LARGEST = 1e9  # radiance; sums of squares over a map must be numbers in single precision, too
EXR, RADIANCE = b"v/1\x01", (b"#?RADIANCE", b"#?RGBE")
COLOURS = ("R", "G", "B")

# Of a Radiance file: the longest header, and the size: "-Y 32 +X 64" is 32 rows from the top.
MOST_HEADER = 1 << 16
SIZE = re.compile(rb"([-+])Y +(\d{1,9}) +([-+])X +(\d{1,9})")
# Widths between which rows may be run-length encoded, each of the four bytes of a pixel for itself.
SHORTEST_RUN_ROW, LONGEST_RUN_ROW = 8, 32767
# A pixel is mantissa · 2^(exponent - EXPONENT) with a mantissa of 8 bits.
EXPONENT = 128 + 8


def read_light_map(file: Path) -> np.ndarray:
    """Radiance [H, 2 H, 3] float32 of an equirectangular map, row 0 at the top: all finite, none below zero.

    Raises:
        OSError: it cannot be read.
        ValueError: it is no such map, or no HDR image. Damaged EXR files raise nearly anything.
    """
    head = read_head_bytes(file)
    if head.startswith(EXR):
        radiance = _read_exr(file)
    elif head.startswith(RADIANCE):
        radiance = _read_radiance(read_bytes(file, MOST_BYTES))
    else:
        raise ValueError(_not_hdr(head, file.suffix.lower()))
    return _checked(radiance)


def _not_hdr(head: bytes, suffix: str) -> str:
    if kind_of_head(head[:HEAD_BYTES], suffix) == Kind.PHOTO:
        return "it is a picture for the screen, which holds no HDR light: nothing in it is brighter than white"
    return f"it is no HDR image but {in_words(head)}"


def check_size(height: int, width: int) -> None:
    """
    Raises:
        ValueError: a map of this size is not equirectangular, or larger than is read.
    """
    if height < 1 or width != 2 * height:
        raise ValueError(f"it has {width} x {height} pixels; an equirectangular map is twice as wide as high")
    if height > MOST_ROWS:
        raise ValueError(f"it has {width} x {height} pixels, at most {2 * MOST_ROWS} x {MOST_ROWS} are read")


def _checked(radiance: np.ndarray) -> np.ndarray:
    wrong = ~(np.abs(radiance) <= LARGEST).all(2)
    for count, what, bad in (
        (int(wrong.sum()), f"are no number, infinite or beyond {LARGEST:g}", wrong),
        (int((negative := (radiance < 0).any(2)).sum()), "are negative", negative),
    ):
        if count:
            row, column = np.unravel_index(int(np.argmax(bad)), bad.shape)
            values = ", ".join(f"{value:g}" for value in radiance[row, column])
            raise ValueError(f"{count} of its pixels {what}, the first in column {column}, row {row}: {values}")
    if not radiance.any():
        raise ValueError("it is black everywhere")
    return np.abs(radiance)  # minus zero becomes zero


# ---------------------------------------------------------------- Radiance
def _read_radiance(data: bytes) -> np.ndarray:
    head, end, body = data[:MOST_HEADER].partition(b"\n\n")
    size, _, _ = body.partition(b"\n")
    found = SIZE.fullmatch(size.strip())
    if not end or not found:
        raise ValueError("its Radiance header has no size of the form -Y 32 +X 64")
    from_top, rows, from_left, columns = found.groups()
    height, width = int(rows), int(columns)
    check_size(height, width)
    start = len(head) + len(end) + len(size) + 1
    pixels = np.frombuffer(_rows(data, start, height, width), np.uint8).reshape(height, width, 4)
    pixels = pixels[:: 1 if from_top == b"-" else -1, :: 1 if from_left == b"+" else -1]
    radiance = pixels[..., :3].astype(np.float32)
    radiance *= np.ldexp(np.float32(1), pixels[..., 3].astype(np.int32) - EXPONENT)[..., None]
    return radiance / np.float32(_exposure(head))


def _exposure(head: bytes) -> float:
    """What the values were multiplied by, as the header says: the product of all that did so."""
    lines = [line.partition(b"=") for line in head.split(b"\n")]
    kinds = [value.strip() for name, _, value in lines if name.strip() == b"FORMAT"]
    if any(kind != b"32-bit_rle_rgbe" for kind in kinds):
        raise ValueError(f"its colours are {kinds[-1][:40].decode('latin-1')}, only 32-bit_rle_rgbe is read")
    exposure = math.prod(float(value) for name, _, value in lines if name.strip() == b"EXPOSURE")
    if not 1 / LARGEST <= exposure <= LARGEST:
        raise ValueError(f"its header says an exposure of {exposure:g}")
    return exposure


def _rows(data: bytes, at: int, height: int, width: int) -> bytes:
    """Bytes of all pixels, four each, from rows that are as they are or in runs.

    Raises:
        ValueError: they end before, or a run leaves its row.
    """
    rows = []
    for row in range(height):
        start = data[at : at + 4]
        if start[:2] == b"\2\2" and len(start) == 4 and start[2] < 128:
            if int.from_bytes(start[2:], "big") != width:
                raise ValueError(f"its row {row} says that it has another width than the file")
            planes, at = _runs(data, at + 4, 4 * width, width)
            rows.append(np.frombuffer(planes, np.uint8).reshape(4, width).T.tobytes())
        elif start[:3] == b"\1\1\1":
            raise ValueError("its runs are of a kind that was given up in 1991: save it again with another program")
        else:
            rows.append(data[at : at + 4 * width])
            at += 4 * width
        if at > len(data):
            raise ValueError(f"it ends in row {row} of {height}")
    return b"".join(rows)


def _runs(data: bytes, at: int, length: int, width: int) -> tuple[bytes, int]:
    """So many bytes of runs, and where these end. A run stays within a plane of `width` bytes."""
    found = bytearray()
    while len(found) < length:
        if at >= len(data):
            break
        count = data[at]
        repeated = count > 128
        count -= 128 * repeated
        if not count or len(found) % width + count > width:
            raise ValueError("a run in it is longer than its row, or empty")
        values = data[at + 1 : at + 2] * count if repeated else data[at + 1 : at + 1 + count]
        found += values
        at += 2 if repeated else 1 + count
        if len(values) < count:
            break
    if len(found) < length:
        return bytes(length), len(data) + 1  # the file ends in this row
    return bytes(found), at


# ---------------------------------------------------------------- OpenEXR
def _read_exr(file: Path) -> np.ndarray:
    """The first part with R, G and B, or with Y alone, which is grey.

    Raises:
        ValueError: there is none, it is not equirectangular, or all that would be decoded is too much.
    """
    if file.stat().st_size > MOST_BYTES:
        raise ValueError(f"it has {file.stat().st_size} bytes, at most {MOST_BYTES} are read")
    headers = [part.header for part in _exr_parts(file, header_only=True)]
    i, colours = _colour_part(headers)
    rows, columns = _size(headers[i])
    check_size(rows, columns)
    decoded = sum(math.prod(_size(header)) * 4 * len(header["channels"]) for header in headers)
    if decoded > MOST_DECODED:
        raise ValueError(f"its channels have {decoded} bytes together, at most {MOST_DECODED} are read")
    parts = _exr_parts(file)
    if len(parts) != len(headers):
        raise ValueError("its pixels are damaged or cut off")
    planes = [np.asarray(parts[i].channels[name].pixels) for name in colours]
    if any(plane.shape != (rows, columns) or plane.dtype.kind not in "fu" for plane in planes):
        raise ValueError("its pixels are damaged or cut off")
    return np.stack([plane.astype(np.float32) for plane in planes], axis=2)


def _colour_part(headers: list[dict[str, Any]]) -> tuple[int, tuple[str, ...]]:
    """Which part holds the light, and the names of its red, green and blue."""
    names = [{channel.name: channel for channel in header["channels"]} for header in headers]
    for colours, without in ((COLOURS, ()), (("Y",) * 3, ("RY", "BY"))):
        for i, channels in enumerate(names):
            if set(colours) <= set(channels) and not set(without) & set(channels):
                if any(channels[name].xSampling != 1 or channels[name].ySampling != 1 for name in colours):
                    raise ValueError("its channels R, G and B have fewer pixels than the image")
                return i, colours
    found = sorted(set().union(*names))
    told = ", ".join(name[:40] for name in found[:8]) + (", ..." if len(found) > 8 else "")
    raise ValueError(f"it has no channels R, G and B (nor Y alone) but {told or 'none'}")


def _size(header: dict[str, Any]) -> tuple[int, int]:
    """Rows and columns that hold data."""
    first, last = (np.asarray(corner, dtype=np.int64) for corner in header["dataWindow"])
    columns, rows = (int(count) for count in last - first + 1)
    if min(rows, columns) < 1:
        raise ValueError(f"it has {columns} x {rows} pixels")
    return rows, columns


def _exr_parts(file: Path, header_only: bool = False) -> list[Any]:
    """Its parts; those whose pixels are damaged are left out, which OpenEXR prints and does not raise."""
    import OpenEXR

    with contextlib.redirect_stdout(io.StringIO()):
        return list(OpenEXR.File(str(file), separate_channels=True, header_only=header_only).parts)
