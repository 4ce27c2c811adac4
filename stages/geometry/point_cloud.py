"""A dense point cloud: places on surfaces that several photos agree on."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from stages.geometry.similarity import Similarity

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int, UInt8

# Points, and depths, of at least this trust count as known.
TRUSTED = 0.5


@dataclass(frozen=True)
class PointCloud:
    """N points with what is known of each.

    Attributes:
        points: in the frame of the poses.
        normals: unit, towards the photos that see them.
        colors: sRGB.
        trust: in [0, 1], how far the photos that can see a point agree that it is there.
        starts: point k is seen by the photos `photos[starts[k] : starts[k + 1]]`.
        photos: indices into the scene's cameras.
    """

    points: Float[np.ndarray, "n 3"]
    normals: Float[np.ndarray, "n 3"]
    colors: UInt8[np.ndarray, "n 3"]
    trust: Float[np.ndarray, " n"]
    starts: Int[np.ndarray, " n+1"]
    photos: Int[np.ndarray, " m"]

    def __len__(self) -> int:
        return len(self.points)

    @staticmethod
    def empty() -> PointCloud:
        nothing = np.zeros((0, 3), np.float32)
        starts, photos = np.zeros(1, np.int64), np.zeros(0, np.int32)
        return PointCloud(nothing, nothing, nothing.astype(np.uint8), np.zeros(0, np.float32), starts, photos)

    def moved(self, target_from_poses: Similarity) -> PointCloud:
        """The same points in another frame, as float64: there they may be millions of metres from its origin."""
        points = target_from_poses.apply(self.points.astype(np.float64))
        normals = (self.normals @ target_from_poses.rotation.T).astype(np.float32)
        return PointCloud(points, normals, self.colors, self.trust, self.starts, self.photos)

    def within(self, poses_from_scene: Similarity) -> PointCloud:
        """These points of the poses' frame, in the scene frame."""
        return self.moved(poses_from_scene.inverse())

    def chosen(self, rows: Bool[np.ndarray, " n"]) -> PointCloud:
        """Only the points where `rows` is true."""
        counts = np.diff(self.starts)
        starts = np.concatenate([[0], np.cumsum(counts[rows])]).astype(np.int64)
        photos = self.photos[np.repeat(rows, counts)]
        return PointCloud(self.points[rows], self.normals[rows], self.colors[rows], self.trust[rows], starts, photos)
