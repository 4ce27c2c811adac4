"""Depth images in the layout of NeRO's GlossySynthetic, which also say where the object is."""

from __future__ import annotations

import math
import struct
from pathlib import Path

import numpy as np

from stages.inputs.bounded import read_bytes

DEPTH = "-depth.png"
PNG = b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR"  # how it begins; width and height follow
MOST_BYTES, MOST_PIXELS = 1 << 28, 1 << 25
# Depth is stored in 16 bits from 0 to 15; what is nearer than 14.5 is the object.
DEPTH_RANGE, DEPTH_OBJECT = 15.0, 14.5


def read_depth(file: Path) -> np.ndarray:
    """[H, W] float64 depth along the axis of a 16-bit depth image, infinite off the object.

    Raises:
        ValueError: it is none.
    """
    import cv2

    data = read_bytes(file, MOST_BYTES)
    if not data.startswith(PNG) or math.prod(struct.unpack_from(">2I", data.ljust(24), len(PNG))) > MOST_PIXELS:
        raise ValueError(f"{file} is no PNG of at most {MOST_PIXELS} pixels")
    stored = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if stored is None or stored.dtype != np.uint16:
        found = "it cannot be read" if stored is None else f"it has {8 * stored.itemsize} bits"
        raise ValueError(f"{file} is no 16-bit depth image: {found}")
    depth = (stored if stored.ndim == 2 else stored[..., 0]) / 65535 * DEPTH_RANGE
    return np.where(depth < DEPTH_OBJECT, depth, np.inf)
