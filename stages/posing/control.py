"""Ground control points: placed from their sightings in posed photos, and the similarity that takes them to where they
are known to be.

Shapes: P points, M sightings.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from stages.geometry.similarity import Similarity, align_points

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

MIN_FOR_SCALE, MIN_FOR_PLACE = 2, 3
# Two photos tell a point's depth from this angle between their rays on, degrees.
MIN_PARALLAX_DEG = 1.0
# A sighting is wrong that misses its point by more than this part of the photo's longest side, and this many pixels; or
# by this many times the median, where that is less.
MAX_MISS, MAX_MISS_PX = 0.005, 12.0
MISS_TIMES, MIN_MISS_PX = 5.0, 3.0
MIN_AGREEING = 0.5  # part of the sightings: with fewer, none is known to be right
# Points within this narrow a strip (part of its length) leave the turn about it open.
MIN_STRIP = 0.05
# A point's coordinates are wrong that lie further from where the others put it than this many times the others' median,
# and than this part of the points' spread: exact ones differ by tens of times, too.
BLUNDER, MIN_BLUNDER, MIN_FOR_BLUNDERS = 10.0, 0.01, 5
MAX_MISFIT = 0.05  # residual of a fit, part of the points' spread: beyond it they are mixed up
TINY_M = 1e-6  # below what anybody measures


@dataclass(frozen=True)
class PlacedPoint:
    """A point where the photos see it.

    Attributes:
        position: in the frame of the poses; None where fewer than two photos, or fewer than half, agree on it.
        errors: pixels by which each sighting misses it; NaN where it has no position.
        agrees: whether each sighting took part.
    """

    position: Float[np.ndarray, " 3"] | None
    errors: Float[np.ndarray, " m"]
    agrees: Bool[np.ndarray, " m"]


def place_point(photos: Sequence[Any], lenses: Mapping[int, Any], pixels: Float[np.ndarray, "m 2"]) -> PlacedPoint:
    """The point that pycolmap images (posed; with their cameras `lenses`) see at these pixels, wrong ones aside."""
    import pycolmap
    from scipy.optimize import least_squares

    none = PlacedPoint(None, np.full(len(pixels), np.nan), np.zeros(len(pixels), dtype=bool))
    if len(pixels) < 2:
        return none
    cameras = [lenses[photo.camera_id] for photo in photos]
    poses = [photo.cam_from_world() for photo in photos]
    limit = max(MAX_MISS_PX, MAX_MISS * max(max(camera.width, camera.height) for camera in cameras))
    options = pycolmap.EstimateTriangulationOptions()
    options.min_tri_angle = float(np.radians(MIN_PARALLAX_DEG))
    options.residual_type = pycolmap.TriangulationResidualType.REPROJECTION_ERROR
    options.ransac.max_error = limit
    options.ransac.random_seed = 0
    found = pycolmap.estimate_triangulation(pixels, poses, cameras, options)
    if found is None:
        return none

    def misses(position: Float[np.ndarray, " 3"], which: Sequence[int]) -> Float[np.ndarray, " k"]:
        seen = [cameras[i].img_from_cam((poses[i] * position)[None])[0] - pixels[i] for i in which]
        return np.nan_to_num(np.ravel(seen), nan=1e6)

    def refined(agrees: Bool[np.ndarray, " m"]) -> tuple[Float[np.ndarray, " 3"], Float[np.ndarray, " m"]]:
        position = least_squares(misses, found["xyz"], args=(np.flatnonzero(agrees),), method="lm").x
        return position, np.linalg.norm(misses(position, range(len(pixels))).reshape(-1, 2), axis=1)

    agrees = np.array(found["inliers"], dtype=bool)
    _, errors = refined(agrees)
    agrees = errors <= np.clip(MISS_TIMES * np.median(errors[agrees]), MIN_MISS_PX, limit)
    if agrees.sum() < max(2, MIN_AGREEING * len(pixels)):
        return none
    position, errors = refined(agrees)
    return PlacedPoint(position, errors, agrees)


@dataclass(frozen=True)
class ControlFit:
    """How placed points lie to where they are known to be.

    Attributes:
        similarity: to the known coordinates; None where the points only tell the scale.
        scale: of it.
        used: whether each point took part.
        left_out: distance in metres of each point from its coordinates, by the fit without it; NaN where the others
            do not tell.
        residual: root mean square distance in metres of the points used, corrected for the freedom of the fit.
        scale_error: relative standard error of the scale; None where two points tell nothing of it.
        open: why the points only tell the scale, in words; empty where they tell all.
    """

    similarity: Similarity | None
    scale: float
    used: Bool[np.ndarray, " p"]
    left_out: Float[np.ndarray, " p"]
    residual: float | None
    scale_error: float | None
    open: str = ""

    @property
    def fits(self) -> bool:
        """Whether the points used lie to each other as their coordinates do, within what a careful measurer errs."""
        return self.scale_error is None or self.scale_error * np.sqrt(3 * self.used.sum()) < MAX_MISFIT


def fit_control(found: Float[np.ndarray, "p 3"], known: Float[np.ndarray, "p 3"]) -> ControlFit:
    """The similarity from points in the frame of the poses to their known coordinates in metres.

    Of five points on, those that lie where the others by no means put them are left out, one after another.

    Raises:
        ValueError: fewer than two points, or two at the same place.
    """
    if len(found) < MIN_FOR_SCALE:
        raise ValueError(f"{len(found)} points could be placed, {MIN_FOR_SCALE} are needed for the scale")
    used = np.ones(len(found), dtype=bool)
    if strip := _strip(known) or _strip(found):
        lengths = [float(np.linalg.norm(each - each.mean(0))) for each in (known, found)]
        if min(lengths) <= TINY_M:
            raise ValueError("all points lie at one place")
        return ControlFit(None, lengths[0] / lengths[1], used, np.full(len(found), np.nan), None, None, strip)
    left_out, spread = _left_out(found, known, used), _spread(known)
    while used.sum() >= MIN_FOR_BLUNDERS:
        worst = int(np.nanargmax(np.where(used, left_out, -1)))
        rest = used & (np.arange(len(used)) != worst)
        without = _left_out(found, known, rest)
        limit = max(BLUNDER * float(np.nanmedian(without[rest])), MIN_BLUNDER * spread)
        if not without[worst] > limit or _strip(known[rest]):
            break
        used, left_out = rest, without
    similarity = align_points(found[used], known[used])
    misses = np.linalg.norm(similarity.apply(found) - known, axis=1)
    count = int(used.sum())
    residual = float(np.sqrt((misses[used] ** 2).sum() / count * 3 * count / (3 * count - 7)))
    return ControlFit(
        similarity, similarity.scale, used, left_out, residual, residual / np.sqrt(3 * count) / _spread(known[used])
    )


def _spread(points: Float[np.ndarray, "p 3"]) -> float:
    """Root mean square distance from their middle."""
    return float(np.sqrt(((points - points.mean(0)) ** 2).sum(1).mean()))


def _left_out(
    found: Float[np.ndarray, "p 3"], known: Float[np.ndarray, "p 3"], used: Bool[np.ndarray, " p"]
) -> Float[np.ndarray, " p"]:
    """Distance of each point from its known place, by the fit to the used ones but for itself."""
    distances = np.full(len(found), np.nan)
    for i in range(len(found)):
        others = used & (np.arange(len(used)) != i)
        if others.sum() >= MIN_FOR_PLACE and not _strip(known[others]):
            distances[i] = np.linalg.norm(align_points(found[others], known[others]).apply(found[i]) - known[i])
    return distances


def _strip(points: Float[np.ndarray, "p 3"]) -> str:
    """Why points do not tell the turn of a frame, in words; empty where they do."""
    if len(points) < MIN_FOR_PLACE:
        return f"{len(points)} points could be placed, {MIN_FOR_PLACE} are needed for place and direction"
    lengths = np.linalg.svd(points - points.mean(0), compute_uv=False)
    if lengths[1] <= MIN_STRIP * lengths[0]:
        return f"the {len(points)} points lie on one line, and the turn about it stays open"
    return ""
