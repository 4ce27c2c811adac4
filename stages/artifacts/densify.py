"""What densify publishes: a depth map for each photo, and the point cloud that is fused of them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from stages.artifacts.artifact import arrays_artifact, in_folder
from stages.geometry.point_cloud import PointCloud

_DEPTHS = "depths"


@dataclass(frozen=True)
class DepthMaps:
    """The depth maps in densify's folder, each read when asked for."""

    folder: Path

    def path(self, name: str) -> Path:
        """Where the depth map of image `name` lies; may not exist."""
        return self.folder / _DEPTHS / f"{name}.npz"

    def save(self, name: str, depth: np.ndarray, trust: np.ndarray) -> None:
        """Write the depths [h, w] float32 along the optical axis of image `name`, 0 where unknown, in units of the
        poses; and their trust [h, w] in [0, 1]."""
        self.path(name).parent.mkdir(parents=True, exist_ok=True)
        np.savez_compressed(
            self.path(name), depth=depth.astype(np.float32), trust=np.round(255 * trust).astype(np.uint8)
        )

    def load(self, name: str) -> tuple[np.ndarray, np.ndarray] | None:
        """Depths [h, w] and trust [h, w] float32 of image `name`, see `save`; None where it has none."""
        if not self.path(name).exists():
            return None
        with np.load(self.path(name)) as data:
            return data["depth"], data["trust"].astype(np.float32) / 255


# Smaller than the pinhole photos: a pixel stands for a part of the photo of the same shape.
DEPTH_MAPS = in_folder("densify", (f"{_DEPTHS}/*",), DepthMaps, optional=True)
# In the frame of the poses; nothing where no photos overlap.
POINT_CLOUD = arrays_artifact("densify", "cloud.npz", PointCloud)
