"""Pinhole cameras and posed scenes.

The one camera convention of the project: OpenCV axes (x right, y down, z forward), pixel centres at .5 (the
top-left corner of the image is (0, 0)), matrices named target_from_source. Three frames: "poses", in which the
cameras were found or given; "world", that of the results; "scene", normalised: the region of interest is the unit
sphere.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from stages.geometry.place import Place
from stages.geometry.plane import Plane
from stages.geometry.similarity import Similarity

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Float32, Float64, Integer, Shaped


@dataclass(frozen=True)
class PinholeCameras:
    """N pinhole cameras without distortion, all in one frame: the scene's where nothing else is said.

    Attributes:
        names: N image names, relative posix paths.
        sizes: width and height in pixels.
        intrinsics: pixels.
        extrinsics: rotation and translation from that frame into the camera.
    """

    names: tuple[str, ...]
    sizes: Integer[np.ndarray, "n 2"]
    intrinsics: Float64[np.ndarray, "n 3 3"]
    extrinsics: Float64[np.ndarray, "n 3 4"]

    def __len__(self) -> int:
        return len(self.names)

    def select(self, indices: Sequence[int] | np.ndarray) -> PinholeCameras:
        """These cameras alone, in this order."""
        chosen = np.asarray(indices, dtype=np.int64)
        names = tuple(self.names[i] for i in chosen)
        return PinholeCameras(names, self.sizes[chosen], self.intrinsics[chosen], self.extrinsics[chosen])

    @property
    def centers(self) -> Float[np.ndarray, "n 3"]:
        """Projection centres in their frame."""
        rotation, translation = self.extrinsics[:, :, :3], self.extrinsics[:, :, 3]
        return -np.einsum("nji,nj->ni", rotation, translation)

    @property
    def forward(self) -> Float[np.ndarray, "n 3"]:
        """Unit viewing directions in their frame."""
        return self.extrinsics[:, 2, :3]

    def project(
        self, index: int, points: Float[np.ndarray, "p 3"]
    ) -> tuple[Float[np.ndarray, "p 2"], Float[np.ndarray, " p"]]:
        """Pixel coordinates and depths of points in one camera. Depth <= 0 is behind it."""
        in_cam = points @ self.extrinsics[index, :, :3].T + self.extrinsics[index, :, 3]
        depth = in_cam[:, 2]
        safe = np.where(np.abs(depth) < 1e-12, 1e-12, depth)
        pixels = in_cam[:, :2] / safe[:, None]
        K = self.intrinsics[index]
        return np.stack(
            [K[0, 0] * pixels[:, 0] + K[0, 1] * pixels[:, 1] + K[0, 2], K[1, 1] * pixels[:, 1] + K[1, 2]], 1
        ), depth

    def in_frame(self, index: int, points: Float[np.ndarray, "p 3"]) -> Bool[np.ndarray, " p"]:
        """Which points lie before one camera and within its photo, hidden or not."""
        pixels, depth = self.project(index, points)
        return (depth > 0) & (pixels >= 0).all(1) & (pixels < self.sizes[index]).all(1)

    def on_mask(
        self, index: int, points: Float[np.ndarray, "p 3"], mask: Shaped[np.ndarray, "h w"]
    ) -> tuple[Bool[np.ndarray, " p"], Bool[np.ndarray, " p"]]:
        """Which points lie `in_frame`, and which of them on pixels of the photo's mask that are not zero."""
        framed = self.in_frame(index, points)
        columns, rows = np.floor(self.project(index, points[framed])[0]).astype(np.int64).T
        on = framed.copy()
        on[framed] = mask[rows, columns] != 0
        return framed, on

    def rays(
        self, index: int, pixels: Float[np.ndarray, "p 2"]
    ) -> tuple[Float[np.ndarray, "p 3"], Float[np.ndarray, "p 3"]]:
        """Origins and unit directions of rays through pixel positions."""
        directions = self._directions(index, pixels)
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        return np.broadcast_to(self.centers[index], directions.shape).copy(), directions

    def unproject(
        self, index: int, pixels: Float[np.ndarray, "p 2"], depths: Float[np.ndarray, " p"]
    ) -> Float[np.ndarray, "p 3"]:
        """Points at pixel positions and depths along the optical axis: what `project` takes back."""
        return self.centers[index] + depths[:, None] * self._directions(index, pixels)

    def _directions(self, index: int, pixels: Float[np.ndarray, "p 2"]) -> Float[np.ndarray, "p 3"]:
        """Directions through pixel positions, of length 1 along the optical axis."""
        K, rotation = self.intrinsics[index], self.extrinsics[index, :, :3]
        y = (pixels[:, 1] - K[1, 2]) / K[1, 1]
        x = (pixels[:, 0] - K[0, 2] - K[0, 1] * y) / K[0, 0]
        directions: np.ndarray = np.stack([x, y, np.ones_like(x)], 1) @ rotation
        return directions


@dataclass(frozen=True)
class PosedScene:
    """What training and everything after it knows of the capture.

    Attributes:
        cameras: the registered, undistorted images.
        poses_from_scene: similarity from the normalised frame to the one in which the poses were found or given.
        points: sparse points in the scene frame.
        point_errors: mean reprojection error in pixels.
        observations: rows (image index, point index): which image saw which point.
        up: unit vector, the estimated up direction in the scene frame.
        kind: "object" (cameras around one thing) or "forward" (a room, a facade, a survey flight).
        ground: plane of the ground or table in the scene frame, or None where none was found.
        growable: whether the region may grow where it turns out to cut what the photos show: it was found, not given.
        roi_scale: the `undistort.roi_scale` that would have made a region which holds this one.
        contents: digest of each camera's photo, for when some are added or removed; empty where it is not known.
        lineage: scenes with the same one are of one capture at different times, made in the same way, and the photos
            that they share are at the same places in the frame of the poses; empty: with no other.
    """

    cameras: PinholeCameras
    poses_from_scene: Similarity
    points: Float32[np.ndarray, "p 3"]
    point_errors: Float32[np.ndarray, " p"]
    observations: Integer[np.ndarray, "m 2"]
    up: Float[np.ndarray, " 3"]
    kind: str = "object"
    ground: Plane | None = None
    growable: bool = False
    roi_scale: float = 1.0
    contents: tuple[str, ...] = ()
    lineage: str = ""

    def world_from_scene(self, place: Place) -> Similarity:
        """To the frame of the results."""
        return place.world_from_poses.compose(self.poses_from_scene)

    def up_in(self, place: Place) -> Float[np.ndarray, " 3"]:
        """Unit, scene frame: up as the place tells it, else as the capture does."""
        return self.up if place.up is None else place.up @ self.world_from_scene(place).rotation
