"""What densify publishes: a depth map for each photo, and the point cloud that is fused of them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from stages.artifacts.artifact import arrays_artifact, in_folder
from stages.artifacts.own_files import inside
from stages.artifacts.pictures import write_png
from stages.errors import WorkspaceError
from stages.geometry.point_cloud import PointCloud

if TYPE_CHECKING:
    from jaxtyping import Float32

_DEPTHS, _TRUST = "depths", "trust"


@dataclass(frozen=True)
class DepthMaps:
    """The depth maps in densify's folder, each read when asked for."""

    folder: Path

    def path(self, name: str) -> Path:
        """Where the depth map of image `name` lies: a TIFF of 32-bit floats; may not exist."""
        return inside(self.folder / _DEPTHS, f"{name}.tiff")

    def trust_path(self, name: str) -> Path:
        """Where the trust of these depths lies: 255 stands for 1; may not exist."""
        return inside(self.folder / _TRUST, f"{name}.png")

    def save(self, name: str, depth: Float32[np.ndarray, "h w"], trust: Float32[np.ndarray, "h w"]) -> None:
        """Write the depths along the optical axis of image `name`, 0 where unknown, in units of the poses; and their
        trust in [0, 1]."""
        import cv2

        self.path(name).parent.mkdir(parents=True, exist_ok=True)
        self.path(name).write_bytes(cv2.imencode(".tiff", depth)[1].tobytes())
        write_png(self.trust_path(name), np.round(255 * trust).astype(np.uint8), compression=1)

    def load(self, name: str) -> tuple[Float32[np.ndarray, "h w"], Float32[np.ndarray, "h w"]] | None:
        """Depths and trust of image `name`, see `save`; None where it has none.

        Raises:
            WorkspaceError: they are there but cannot be read.
        """
        import cv2

        if not self.path(name).exists():
            return None
        paths = self.path(name), self.trust_path(name)
        depth, trust = (cv2.imread(str(path), cv2.IMREAD_UNCHANGED) for path in paths)
        if depth is None or trust is None:
            raise WorkspaceError(
                f"{paths[0]} or {paths[1]} cannot be read.", "Make them again: `hineus run PHOTOS --force densify`."
            )
        return depth, trust.astype(np.float32) / 255


# Smaller than the pinhole photos: a pixel stands for a part of the photo of the same shape.
DEPTH_MAPS = in_folder("densify", (f"{_DEPTHS}/*", f"{_TRUST}/*"), DepthMaps, optional=True)
# In the frame of the poses; nothing where no photos overlap.
POINT_CLOUD = arrays_artifact("densify", "cloud.npz", PointCloud)
