"""The ground, floor or table that the capture stands on, as a plane through the sparse points."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from stages.geometry.similarity import Similarity

if TYPE_CHECKING:
    from jaxtyping import Float

# Points this far from the region's centre count, in its radii: the table's edge and the floor below it do not.
REACH = 2.0
# Points this close to the plane lie on it, in radii of the region.
TOLERANCE = 0.01
# The normal is at most this far from up as the cameras have it, degrees.
MAX_TILT_DEG = 30.0
# At least this part of the points near lies on it, and this many.
MIN_SHARE, MIN_POINTS = 0.1, 30
# At most this part of the points near lies under it (what a glossy table mirrors, wrong matches) ...
MAX_BELOW = 0.05
# ... where "under" is this many tolerances down; and nearly all cameras are above.
BELOW_TOLERANCES = 3.0
MIN_CAMERAS_ABOVE = 0.95
# Its points reach at least this far in their narrow direction (standard deviation, in radii): a row is no plane.
MIN_WIDTH = 0.1
HYPOTHESES, MAX_SCORED = 1000, 4000
REFINEMENTS = 4


@dataclass(frozen=True)
class Plane:
    """The plane normal . x = offset.

    Attributes:
        normal: unit, pointing up.
        offset: distance of the plane from the origin along the normal.
        rms: root mean square distance of its points to it.
        share: part of the points near that lie on it.
    """

    normal: Float[np.ndarray, " 3"]
    offset: float
    rms: float
    share: float

    def heights(self, points: Float[np.ndarray, "p 3"]) -> Float[np.ndarray, " p"]:
        """Signed distance of points, positive above."""
        return points @ self.normal - self.offset

    def within(self, world_from_scene: Similarity) -> Plane:
        """This plane of the world frame, in the scene frame."""
        scale, rotation = world_from_scene.scale, world_from_scene.rotation
        offset = (self.offset - float(self.normal @ world_from_scene.translation)) / scale
        return Plane(rotation.T @ self.normal, offset, self.rms / scale, self.share)


def find_ground(
    points: Float[np.ndarray, "p 3"],
    camera_centers: Float[np.ndarray, "n 3"],
    up: Float[np.ndarray, " 3"],
    center: Float[np.ndarray, " 3"],
    radius: float,
) -> Plane | None:
    """The plane nearly all else stands on, or None where the points show none.

    RANSAC over triples of points, the best that has its normal near `up`, the cameras above and little below.

    Args:
        points: sparse points.
        up: unit, roughly.
        center, radius: the region of interest; lengths are judged against its radius.
    """
    near = points[np.linalg.norm(points - center, axis=1) < REACH * radius] - center
    if len(near) < MIN_POINTS:
        return None
    above = camera_centers - center
    random = np.random.default_rng(0)
    corners = near[random.integers(0, len(near), (HYPOTHESES, 3))]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(normals, axis=1)
    usable = lengths > 1e-9 * radius**2
    normals = normals[usable] / lengths[usable, None]
    normals *= np.where(normals @ up < 0, -1.0, 1.0)[:, None]
    usable_corners = corners[usable, 0]
    upright = normals @ up > np.cos(np.radians(MAX_TILT_DEG))
    normals, offsets = normals[upright], np.einsum("hi,hi->h", normals[upright], usable_corners[upright])
    scored = near if len(near) <= MAX_SCORED else near[random.choice(len(near), MAX_SCORED, replace=False)]
    heights = scored @ normals.T - offsets
    tolerance = TOLERANCE * radius
    fits = (
        ((heights < -BELOW_TOLERANCES * tolerance).mean(0) <= MAX_BELOW)
        & ((above @ normals.T > offsets).mean(0) >= MIN_CAMERAS_ABOVE)
    )  # fmt: skip
    if not fits.any():
        return None
    on_it = np.where(fits, (np.abs(heights) < tolerance).sum(0), -1)
    best = int(on_it.argmax())
    normal, offset = normals[best], float(offsets[best])
    for _ in range(REFINEMENTS):
        support = near[np.abs(near @ normal - offset) < tolerance]
        if len(support) < MIN_POINTS:
            return None
        normal, offset = fit_plane(support, up)
    distances = near @ normal - offset
    support = near[np.abs(distances) < tolerance]
    width = np.sqrt(max(np.linalg.eigvalsh(np.cov(support.T))[1], 0.0)) if len(support) >= MIN_POINTS else 0.0
    share = len(support) / len(near)
    if share < MIN_SHARE or width < MIN_WIDTH * radius or normal @ up < np.cos(np.radians(MAX_TILT_DEG)):
        return None
    rms = float(np.sqrt(np.mean(distances[np.abs(distances) < tolerance] ** 2)))
    return Plane(normal, offset + float(normal @ center), rms, share)


def fit_plane(
    points: Float[np.ndarray, "p 3"], up: Float[np.ndarray, " 3"], weights: Float[np.ndarray, " p"] | None = None
) -> tuple[Float[np.ndarray, " 3"], float]:
    """Least-squares normal (on the side of `up`) and offset of points, each with its weight."""
    mean = np.average(points, axis=0, weights=weights)
    normal = np.linalg.eigh(np.cov(points.T, aweights=weights))[1][:, 0]
    normal = normal if normal @ up > 0 else -normal
    return normal, float(normal @ mean)
