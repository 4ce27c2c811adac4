"""Pictures of Gaussians, as files hold them."""

from __future__ import annotations

import numpy as np

from stages.gaussians.drawing import draw
from stages.gaussians.gaussians import Gaussians
from stages.geometry.cameras import PinholeCameras


def draw_picture(gaussians: Gaussians, cameras: PinholeCameras, index: int) -> np.ndarray:
    """What a camera sees: [H, W, 3] uint8 sRGB, white behind."""
    image, _ = draw(gaussians, cameras, index)
    return np.rint(255 * image).astype(np.uint8)
