"""What the 3D view needs to show Gaussian splats."""

from __future__ import annotations

import base64
from pathlib import Path
from typing import Any

import numpy as np

from stages.files.splat_files import spz_bytes
from stages.gaussians.keeping import read_gaussians
from stages.gaussians.levels_of_detail import lightened
from stages.gaussians.transforming import transformed
from stages.geometry.similarity import Similarity
from stages.geometry.up import y_up_rotation

# Of more Gaussians, whose files would make the page too heavy (50 bytes each), about so many are shown.
MAX_SPLATS = 150_000


def pack_splats(file: Path, up: np.ndarray) -> dict[str, Any] | None:
    """The Gaussians of a file in the frame of the mesh as SPZ, and how many are shown of how many; None where there are
    none, or they are damaged.

    Args:
        up: in the frame of the mesh.
    """
    try:
        gaussians = read_gaussians(file)
        shown = lightened(gaussians, MAX_SPLATS)
        turned = transformed(shown, Similarity(1.0, y_up_rotation(up), np.zeros(3)))
        packed = base64.b64encode(spz_bytes(turned)).decode()
    except (OSError, ValueError, KeyError):
        return None
    return {"spz": packed, "shown": len(shown), "total": len(gaussians)}
