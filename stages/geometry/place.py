"""Where on Earth and how large: from the frame of the poses to a local frame in metres.

"poses" is the frame in which the camera poses were found or given. "world" is the frame of the results: that of the
poses where nothing is known, else metres, and with GPS east, north, up from an origin near the photos.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from stages.geometry.earth import east_north_up, east_north_up_axes, from_east_north_up, middle_position
from stages.geometry.plane import Plane
from stages.geometry.similarity import Similarity, align_points

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

MIN_LOCATED = 4
# This part of the positions at least must agree on one place.
MIN_AGREEING = 0.6
# Photos within this narrow a strip (part of its length) leave the turn about it open.
MIN_STRIP = 0.05
# The residual may be this part of the positions' spread: a larger one says that GPS wanders as far as the photographer.
MAX_RESIDUAL = 0.25
SAMPLES, OUTLIER_SIGMAS = 500, 3.0
EXACT_M = 1e-3  # positions that are made up agree to the last digit; one that misses by this is no outlier
# Coordinates keep this part of the region's radius in 32 bits; where they would not, the origin moves.
PRECISION = 1e-5
# The sphere about a given box has some air at the corners, because the mesh is cut off near the sphere.
BOX_MARGIN = 1.05
# Edges of a box as pairs of corners; bit k of a corner's number is its side of axis k.
BOX_EDGES = [(i, i | bit) for i in range(8) for bit in (1, 2, 4) if not i & bit]


@dataclass(frozen=True)
class ControlMark:
    """Where a photo shows a control point.

    Attributes:
        error_px: pixels of the photo as it was taken by which it misses the point; None where that has no position.
        used: whether it agrees with the others and took part.
    """

    photo: str
    error_px: float | None
    used: bool


@dataclass(frozen=True)
class ControlPoint:
    """A point with known coordinates, and how the photos meet them.

    Attributes:
        coordinates: as they were given.
        check: whether it only checks the result. used: whether it took part in the fit.
        miss: metres east, north, up (or x, y, z) from where it should be to where the photos see it; None where they do
            not tell.
        left_out_m: distance from where it should be by the fit without it, metres; None where the others do not tell.
    """

    name: str
    coordinates: tuple[float, float, float]
    check: bool
    used: bool
    miss: tuple[float, float, float] | None
    left_out_m: float | None
    marks: tuple[ControlMark, ...]


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
        up: unit, in the world, where GPS, control points or the settings tell it; None: as the scene has it.
        control: the ground control points, where there are any.
        control_residual: root mean square distance in metres of those used from where they should be, or None.
        crs: the coordinate system of which world coordinates are a part, as "EPSG:32632"; empty where `origin` says
            it, or nothing.
        offset: added to world coordinates it gives those of `crs`, or of the control points; None where there are none.
    """

    world_from_poses: Similarity
    metric: bool = False
    scale_from: str = ""
    scale_error: float | None = None
    origin: tuple[float, float, float] | None = None
    gps_residual: float | None = None
    up: Float[np.ndarray, " 3"] | None = None
    control: tuple[ControlPoint, ...] = ()
    control_residual: float | None = None
    crs: str = ""
    offset: tuple[float, float, float] | None = None

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
                f"x points east, y north, z up{self._residual()}."
            )
        elif self.offset is not None:
            added = " ".join(f"{value:.0f}" for value in self.offset)
            whose = self.crs or "the control points"
            text += f" Coordinates plus {added} are those of {whose}{self._residual()}."
        return text

    def _residual(self) -> str:
        if self.control_residual is not None:
            return f" (residual of the control points {self.control_residual:.2g} m)"
        return "" if self.gps_residual is None else f" (GPS residual {self.gps_residual:.2g} m)"

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
        shift, turn, origin = np.round(center), np.eye(3), None
        if self.origin is not None:
            latitude, longitude, altitude = from_east_north_up(shift[None], self.origin)[0].tolist()
            origin = latitude, longitude, altitude
            turn = east_north_up_axes(origin) @ east_north_up_axes(self.origin).T
        move = Similarity(1.0, turn, -(turn @ shift))
        return replace(
            self,
            world_from_poses=move.compose(self.world_from_poses),
            origin=origin,
            offset=None if self.offset is None else _added(self.offset, shift),
        )

    def in_grid(self, crs: str, enu: Float[np.ndarray, "n 3"], grid: Float[np.ndarray, "n 3"]) -> Place:
        """The same place with world axes, lengths and, but for an offset, coordinates of a map's grid.

        Args:
            enu: points about the scene, in this world. grid: the same in the coordinate system `crs`.
        """
        offset = np.round(grid.mean(0))
        to_grid = align_points(enu, grid - offset)
        return replace(
            self,
            world_from_poses=to_grid.compose(self.world_from_poses),
            origin=None,
            crs=crs,
            offset=_added((0.0, 0.0, 0.0), offset),
        )


def _added(offset: tuple[float, float, float], shift: Float[np.ndarray, " 3"]) -> tuple[float, float, float]:
    x, y, z = (np.array(offset) + shift).tolist()
    return x, y, z


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
        return [] if self.box is None else box_sides(self.box, self.world_from_poses.compose(poses_from_scene))


def box_sides(
    box: Float[np.ndarray, "2 3"], world_from_scene: Similarity, axes: Sequence[int] = (0, 1, 2)
) -> list[tuple[Float[np.ndarray, " 3"], float]]:
    """Planes (normal, offset) in the scene frame of the sides across these axes of a box in the world, which is above
    all of them."""
    sides = []
    for sign, corner in ((1.0, box[0]), (-1.0, box[1])):
        for axis in axes:
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
    origin = middle_position(positions)
    targets = east_north_up(positions, origin)
    apart = len(np.unique(np.round(targets / EXACT_M), axis=0))
    if apart < MIN_LOCATED:
        raise ValueError(f"{len(centers)} photos carry only {apart} different positions, {MIN_LOCATED} are needed")
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
    return best_misses <= max(OUTLIER_SIGMAS * best, EXACT_M)
