"""Depth images in the layout of NeRO's GlossySynthetic, which also say where the object is."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np

from stages.inputs.bounded import read_bytes
from stages.inputs.formats import check_png

DEPTH = "-depth.png"
MOST_BYTES = 1 << 28
# Depth is stored in 16 bits from 0 to 15; what is nearer than 14.5 is the object.
DEPTH_RANGE, DEPTH_OBJECT = 15.0, 14.5


def read_depth(file: Path) -> np.ndarray:
    """[H, W] float64 depth along the axis of a 16-bit depth image, infinite off the object.

    Raises:
        ValueError: it is none.
    """
    import cv2

    data = read_bytes(file, MOST_BYTES)
    try:
        check_png(io.BytesIO(data))
    except ValueError as error:
        raise ValueError(f"{file} is no 16-bit depth image: {error}") from error
    stored = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if stored is None or stored.dtype != np.uint16:
        found = "it cannot be read" if stored is None else f"it has {8 * stored.itemsize} bits"
        raise ValueError(f"{file} is no 16-bit depth image: {found}")
    depth = (stored if stored.ndim == 2 else stored[..., 0]) / 65535 * DEPTH_RANGE
    return np.where(depth < DEPTH_OBJECT, depth, np.inf)
