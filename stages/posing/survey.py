"""Ground control points brought together with posed photos: where these see them, and what that tells of the world."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from stages.artifacts import ImageRecord
from stages.errors import InputError
from stages.geometry.earth import east_north_up, middle_position
from stages.geometry.place import ControlMark, ControlPoint
from stages.posing.control import MIN_FOR_PLACE, MIN_FOR_SCALE, ControlFit, PlacedPoint, fit_control, place_point
from stages.posing.control_files import GroundControl, KnownPoint, Sighting
from stages.posing.coordinates import to_geodetic
from stages.posing.marks import MIN_PHOTOS, match_sightings, sentences_on_missing

if TYPE_CHECKING:
    from jaxtyping import Float

NAMED = 4  # points whose trouble is told one by one


@dataclass(frozen=True)
class Survey:
    """What ground control says of the world.

    Attributes:
        fit: of the points that are placed and are no check points.
        points: all of them, as they are told.
        origin: latitude, longitude (degrees) and altitude (metres) of the origin of the fit's coordinates, which are
            metres east, north and up of it; None where they are the file's own.
        warnings: sentences.
    """

    fit: ControlFit
    points: tuple[ControlPoint, ...]
    origin: tuple[float, float, float] | None
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True)
class _SeenPoint:
    """A point and the posed photos that show it.

    Attributes:
        photos: their sources. scales: pixels of each photo as it was read, in one of it as it was taken.
        placed: its errors are in pixels of the photo as it was read.
    """

    point: KnownPoint
    photos: tuple[str, ...]
    scales: tuple[float, ...]
    placed: PlacedPoint

    @property
    def marks(self) -> tuple[ControlMark, ...]:
        found = zip(self.photos, self.placed.errors / np.array(self.scales), self.placed.agrees, strict=True)
        return tuple(
            ControlMark(photo, float(error) if np.isfinite(error) else None, bool(agrees))
            for photo, error, agrees in found
        )

    @property
    def trouble(self) -> str:
        """The point and why it could not be placed."""
        count = len(self.photos)
        if count < MIN_PHOTOS:
            photos = f"{count} photo{'' if count == 1 else 's'} with a pose"
            return f"{self.point.name} (marked in {photos}, {MIN_PHOTOS} are needed)"
        return f"{self.point.name} (most of its marks in {count} photos do not meet, or are seen from one side)"


def survey(
    control: GroundControl,
    crs: str,
    photos: Sequence[Any],
    lenses: Mapping[int, Any],
    records: Sequence[ImageRecord],
) -> Survey:
    """Place the points, fit them to their coordinates.

    Args:
        crs: the coordinate system; empty: metres in a frame of their own, z up.
        photos: pycolmap images that have a pose, with their cameras `lenses`.
        records: of all photos.

    Raises:
        InputError: sightings are of no photo or outside theirs, coordinates cannot be, or too few points are placed.
        ConfigError, SystemRequirementError: see `to_geodetic`.
    """
    seen, warnings = _place_points(control, photos, lenses, records)
    known, origin = np.array([point.xyz for point in control.points]), None
    if crs:
        positions = to_geodetic(known, crs, "control points")
        origin = middle_position(positions)
        known = east_north_up(positions, origin)
    positions_found = [each.placed.position for each in seen]
    found = np.array([np.full(3, np.nan) if position is None else position for position in positions_found])
    fitted = np.flatnonzero(np.isfinite(found[:, 0]) & [not point.check for point in control.points])
    try:
        fit = fit_control(found[fitted], known[fitted])
    except ValueError as error:
        raise _too_few(control, seen, str(error)) from error
    misses = np.full_like(found, np.nan) if fit.similarity is None else fit.similarity.apply(found) - known
    used, left_out = np.zeros(len(seen), dtype=bool), np.linalg.norm(misses, axis=1)
    used[fitted], left_out[fitted] = fit.used, fit.left_out
    points = tuple(
        _told(each, bool(takes_part), miss, float(alone))
        for each, takes_part, miss, alone in zip(seen, used, misses, left_out, strict=True)
    )
    return Survey(fit, points, origin, tuple(warnings + _warnings(seen, points, fit)))


def _place_points(
    control: GroundControl, photos: Sequence[Any], lenses: Mapping[int, Any], records: Sequence[ImageRecord]
) -> tuple[list[_SeenPoint], list[str]]:
    """Each point where posed photos see it, and sentences on photos that are not there or have no pose."""
    of_source = {record.source: record for record in records}
    sizes = {source: record.taken or (record.width, record.height) for source, record in of_source.items()}
    posed = {photo.name: photo for photo in photos}
    found, missing = match_sightings(control, sizes)
    warnings = sentences_on_missing(missing, control)
    unposed = {source for _, source in found if of_source[source].name not in posed}
    if unposed:
        warnings.append(f"{len(unposed)} photos with control points have no pose, e.g. {min(unposed)}.")
    marks: dict[str, list[tuple[Sighting, str]]] = defaultdict(list)
    for mark, source in found:
        if source not in unposed:
            marks[mark.point].append((mark, source))
    seen = []
    for point in control.points:
        sources = tuple(source for _, source in marks[point.name])
        scales = tuple(of_source[source].width / sizes[source][0] for source in sources)
        pixels = np.array([mark.pixel for mark, _ in marks[point.name]]).reshape(-1, 2) * np.array(scales)[:, None]
        placed = place_point([posed[of_source[source].name] for source in sources], lenses, pixels)
        seen.append(_SeenPoint(point, sources, scales, placed))
    return seen, warnings


# ---------------------------------------------------------------- what is told
def _told(each: _SeenPoint, used: bool, miss: Float[np.ndarray, " 3"], left_out: float) -> ControlPoint:
    x, y, z = miss.tolist()
    return ControlPoint(
        each.point.name,
        each.point.xyz,
        each.point.check,
        used,
        (x, y, z) if np.isfinite(x) else None,
        left_out if np.isfinite(left_out) else None,
        each.marks,
    )


def _warnings(seen: Sequence[_SeenPoint], points: Sequence[ControlPoint], fit: ControlFit) -> list[str]:
    sentences = [text for point in points if (text := _wrong_marks(point))]
    if trouble := _troubles(seen):
        count = sum(each.placed.position is None for each in seen)
        sentences.append(f"{count} of {len(seen)} control points could not be placed: {trouble}.")
    sentences += [
        f"Control point {point.name} lies {point.left_out_m:.2g} m from where the others put it and is not used: look "
        "at its coordinates, and whether the photos show that point."
        for point in points
        if not point.check and not point.used and point.left_out_m is not None
    ]
    if not fit.fits:
        sentences.append(
            "The control points do not lie to each other as their coordinates say: they miss them by "
            f"{fit.residual:.2g} m. Are names mixed up, or the coordinates degrees (`--set place.control_epsg=4326`)?"
        )
    if fit.open:
        sentences.append(f"The control points only tell the scale: {fit.open}.")
    return sentences


def _wrong_marks(point: ControlPoint) -> str:
    """A sentence on the marks that do not fit the others, the worst first; empty where all do."""
    wrong = sorted((-mark.error_px, mark.photo) for mark in point.marks if not mark.used and mark.error_px is not None)
    if not wrong:
        return ""
    named = ", ".join(f"{-error:.0f} px in {photo}" for error, photo in wrong[:NAMED])
    more = f" and {len(wrong) - NAMED} more" if len(wrong) > NAMED else ""
    return (
        f"{len(wrong)} of {len(point.marks)} marks of control point {point.name} are not used, because they miss where "
        f"the other photos see it: by {named}{more}."
    )


def _too_few(control: GroundControl, seen: Sequence[_SeenPoint], reason: str) -> InputError:
    fitted = [each for each in seen if not each.point.check]
    checks = f" ({len(seen) - len(fitted)} more only check)" if len(fitted) < len(seen) else ""
    trouble = _troubles(fitted)
    return InputError(
        f"The {len(fitted)} control points in {control.origin}{checks} do not tell the scale: {reason}"
        f"{': ' + trouble if trouble else ''}.",
        f"Mark at least {MIN_FOR_SCALE} points ({MIN_FOR_PLACE} for place and direction) in {MIN_PHOTOS} photos or "
        "more each, from apart; pixels count from the upper left corner of the upright photo in full size. "
        "`--no-control` leaves control points out.",
    )


def _troubles(seen: Sequence[_SeenPoint]) -> str:
    """The first few points that could not be placed, and why; empty where all could."""
    troubles = [each.trouble for each in seen if each.placed.position is None]
    more = f"; and {len(troubles) - NAMED} more" if len(troubles) > NAMED else ""
    return "; ".join(troubles[:NAMED]) + more
