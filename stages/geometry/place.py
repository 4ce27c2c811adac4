"""Where on Earth and how large: from the frame of the poses to a local frame in metres.

"poses" is the frame in which the camera poses were found or given. "world" is the frame of the results: that of the
poses where nothing is known, else metres, and with GPS east, north, up from an origin near the photos.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from stages.geometry.plane import Plane
from stages.geometry.similarity import Similarity, align_points

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

# WGS 84: semi-major axis in metres and flattening.
EARTH_RADIUS, FLATTENING = 6378137.0, 1 / 298.257223563
MIN_LOCATED = 4
# This part of the positions at least must agree on one place.
MIN_AGREEING = 0.6
# Photos within this narrow a strip (part of its length) leave the turn about it open.
MIN_STRIP = 0.05
# The residual may be this part of the positions' spread: a larger one says that GPS wanders as far as the photographer.
MAX_RESIDUAL = 0.25
SAMPLES, OUTLIER_SIGMAS = 500, 3.0
# Coordinates keep this part of the region's radius in 32 bits; where they would not, the origin moves.
PRECISION = 1e-5
# The sphere about a given box has some air at the corners, because the mesh is cut off near the sphere.
BOX_MARGIN = 1.05
# Edges of a box as pairs of corners; bit k of a corner's number is its side of axis k.
BOX_EDGES = [(i, i | bit) for i in range(8) for bit in (1, 2, 4) if not i & bit]


@dataclass(frozen=True)
class Place:
    """How the world of the results stands to the poses' own frame, to metres and to the Earth.

    Attributes:
        world_from_poses: from the frame of the poses.
        metric: whether world units are metres.
        scale_from: what the scale was found from, in words; empty where it is not known.
        scale_error: relative standard error of the scale, or None where it is not known.
        origin: latitude and longitude in degrees and altitude in metres of the world's origin (x east, y north,
            z up), or None.
        gps_residual: root mean square distance in metres of the cameras from their GPS positions, or None.
        up: unit, in the world, where GPS or the settings tell it; None: as the scene has it.
    """

    world_from_poses: Similarity
    metric: bool = False
    scale_from: str = ""
    scale_error: float | None = None
    origin: tuple[float, float, float] | None = None
    gps_residual: float | None = None
    up: Float[np.ndarray, " 3"] | None = None

    @property
    def units(self) -> str:
        return "metres" if self.metric else "arbitrary units"

    def describe(self) -> str:
        """One sentence on the scale, one on the place."""
        if not self.metric:
            return "The scale is not known: lengths are in arbitrary units."
        error = "" if self.scale_error is None else f" ± {100 * self.scale_error:.2g} %"
        text = f"Lengths are in metres{error}, from {self.scale_from}."
        if self.origin is not None:
            latitude, longitude, altitude = self.origin
            text += (
                f" The origin is at latitude {latitude:.6f}, longitude {longitude:.6f}, altitude {altitude:.1f} m; "
                f"x points east, y north, z up (GPS residual {self.gps_residual:.2g} m)."
            )
        return text

    def rescaled(self, factor: float, scale_from: str, scale_error: float | None) -> Place:
        """The same place with all lengths multiplied by `factor`, the origin where it was."""
        stretch = Similarity(factor, np.eye(3), np.zeros(3))
        return replace(
            self,
            world_from_poses=stretch.compose(self.world_from_poses),
            metric=True,
            scale_from=scale_from,
            scale_error=scale_error,
        )

    def near(self, center: Float[np.ndarray, " 3"], radius: float) -> Place:
        """The same place with its origin near `center` (world) where 32-bit coordinates would lose precision."""
        if np.abs(center).max() * np.finfo(np.float32).eps < PRECISION * radius:
            return self
        shift = Similarity(1.0, np.eye(3), -np.round(center))
        return replace(self, world_from_poses=shift.compose(self.world_from_poses), origin=None)


@dataclass(frozen=True)
class GivenRegion:
    """The region of interest that the user gave, brought into the frame of the poses.

    Attributes:
        center: of the sphere. radius: of it, or of the sphere about the box.
        box: lowest and highest corner in the world of the box that the mesh is cropped to, or None.
        world_from_poses: as it was when the region was given.
    """

    center: Float[np.ndarray, " 3"]
    radius: float
    box: Float[np.ndarray, "2 3"] | None
    world_from_poses: Similarity

    def box_corners(self) -> Float[np.ndarray, "8 3"] | None:
        """Corners of the box in the frame of the poses, numbered as in `BOX_EDGES`."""
        if self.box is None:
            return None
        picks = np.array([[i >> k & 1 for k in range(3)] for i in range(8)])
        return self.world_from_poses.inverse().apply(np.take_along_axis(self.box, picks, axis=0))

    def holds(self, points: Float[np.ndarray, "p 3"]) -> Bool[np.ndarray, " p"]:
        """Which points, in the frame of the poses, lie in the sphere, or in the box where there is one."""
        if self.box is None:
            return np.linalg.norm(points - self.center, axis=1) < self.radius
        world = self.world_from_poses.apply(points)
        return ((world > self.box[0]) & (world < self.box[1])).all(1)

    def sides(self, poses_from_scene: Similarity) -> list[tuple[Float[np.ndarray, " 3"], float]]:
        """Planes (normal, offset) in the scene frame with the box above them; none where there is no box."""
        if self.box is None:
            return []
        world_from_scene, sides = self.world_from_poses.compose(poses_from_scene), []
        for sign, corner in ((1.0, self.box[0]), (-1.0, self.box[1])):
            for axis in range(3):
                side = Plane(sign * np.eye(3)[axis], sign * float(corner[axis]), 0.0, 0.0).within(world_from_scene)
                sides.append((side.normal, side.offset))
        return sides


def given_region(form: str, numbers: Sequence[float], world_from_poses: Similarity) -> GivenRegion:
    """The region a user wrote: "sphere" (x, y, z, radius) or "box" (x0, y0, z0, x1, y1, z1), in the world."""
    values, box = np.array(numbers, dtype=np.float64), None
    center, radius = values[:3], float(values[3])
    if form == "box":
        box = values.reshape(2, 3)
        center, radius = box.mean(0), BOX_MARGIN * float(np.linalg.norm(box[1] - box[0])) / 2
    poses_from_world = world_from_poses.inverse()
    return GivenRegion(poses_from_world.apply(center), poses_from_world.scale * radius, box, world_from_poses)


# ---------------------------------------------------------------- GPS
@dataclass(frozen=True)
class Located:
    """A model aligned to GPS.

    Attributes:
        world_from_poses: to metres east, north, up of `origin`.
        origin: latitude, longitude (degrees), altitude (metres).
        residual: root mean square distance in metres of the photos used, corrected for the freedom of the fit.
        scale_error: relative standard error of the scale.
        tilt_error_deg: standard error of up, degrees.
        used: photos whose position fits, of those that carry one.
    """

    world_from_poses: Similarity
    origin: tuple[float, float, float]
    residual: float
    scale_error: float
    tilt_error_deg: float
    used: int

    @property
    def up(self) -> Float[np.ndarray, " 3"]:
        """Unit, in the frame of the poses."""
        return self.world_from_poses.rotation[2]


def east_north_up(positions: Float[np.ndarray, "n 3"], origin: tuple[float, float, float]) -> Float[np.ndarray, "n 3"]:
    """Metres east, north and up of `origin` of positions: latitude, longitude (degrees), altitude (m)."""
    latitude, longitude = np.radians(origin[:2])
    east = np.array([-np.sin(longitude), np.cos(longitude), 0.0])
    up = np.array([np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude), np.sin(latitude)])
    return (_earth_centred(positions) - _earth_centred(np.array([origin]))) @ np.stack([east, np.cross(up, east), up]).T


def _earth_centred(positions: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Metres from the Earth's centre (WGS 84)."""
    latitude, longitude = np.radians(positions[:, :2]).T
    altitude = positions[:, 2]
    squared_eccentricity = FLATTENING * (2 - FLATTENING)
    normal_radius = EARTH_RADIUS / np.sqrt(1 - squared_eccentricity * np.sin(latitude) ** 2)
    across = (normal_radius + altitude) * np.cos(latitude)
    along_axis = (normal_radius * (1 - squared_eccentricity) + altitude) * np.sin(latitude)
    return np.stack([across * np.cos(longitude), across * np.sin(longitude), along_axis], 1)


def locate(centers: Float[np.ndarray, "n 3"], positions: Float[np.ndarray, "n 3"]) -> Located:
    """Align camera centres to their GPS positions.

    The least median of squares over triples, then least squares over the photos that fit.

    Args:
        centers: in the model's frame.
        positions: latitude, longitude (degrees), altitude (metres).

    Raises:
        ValueError: why GPS does not tell the place, with the numbers found.
    """
    if len(centers) < MIN_LOCATED:
        raise ValueError(f"{len(centers)} photos carry a GPS position with altitude, {MIN_LOCATED} are needed")
    latitude, longitude, altitude = (float(value) for value in np.median(positions, axis=0))
    origin = latitude, longitude, altitude
    targets = east_north_up(positions, origin)
    _, lengths, _ = np.linalg.svd(centers - centers.mean(0))
    if lengths[1] < MIN_STRIP * lengths[0]:
        raise ValueError("the photos were taken from one line, and the turn about it stays open")
    kept = _agreeing(centers, targets)
    if kept.sum() < max(MIN_LOCATED, MIN_AGREEING * len(centers)):
        raise ValueError(f"only {kept.sum()} of {len(centers)} GPS positions agree with the cameras and each other")
    world_from_poses = align_points(centers[kept], targets[kept])
    misses = world_from_poses.apply(centers[kept]) - targets[kept]
    count = int(kept.sum())
    # a similarity has seven parameters: with few photos it bends to their errors
    freedom = np.sqrt(3 * count / (3 * count - 7))
    residual = float(freedom * np.sqrt((misses**2).sum(1).mean()))
    spread = np.linalg.svd(targets[kept] - targets[kept].mean(0))[1] / np.sqrt(count)
    total = float(np.linalg.norm(spread))
    if residual > MAX_RESIDUAL * total:
        raise ValueError(
            f"GPS positions miss the cameras by {residual:.2g} m while they spread over {total:.2g} m "
            f"(at most {MAX_RESIDUAL * total:.2g} m would do)"
        )
    vertical = freedom * np.sqrt((misses[:, 2] ** 2).mean())  # GPS knows heights less well than the rest
    tilt = np.degrees(vertical / np.sqrt(count) / max(float(spread[1]), 1e-9))
    return Located(world_from_poses, origin, residual, residual / np.sqrt(3 * count) / total, float(tilt), count)


def _agreeing(centers: Float[np.ndarray, "n 3"], targets: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
    """Photos whose position agrees with the similarity that most agree with."""
    random = np.random.default_rng(0)
    best, best_misses = np.inf, np.zeros(len(centers))
    for _ in range(SAMPLES):
        triple = random.choice(len(centers), 3, replace=False)
        try:
            found = align_points(centers[triple], targets[triple])
        except ValueError:
            continue
        misses = np.linalg.norm(found.apply(centers) - targets, axis=1)
        # the three of the sample fit of themselves: the median of all N would be theirs where N is small
        median = np.sort(misses)[min(len(misses) - 1, (len(misses) + 3) // 2)]
        if median < best:
            best, best_misses = float(median), misses
    return best_misses <= max(OUTLIER_SIGMAS * best, 1e-9)
