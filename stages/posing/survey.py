"""Ground control points brought together with posed photos: which photo each sighting is of, what the points tell."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import PurePosixPath
from typing import TYPE_CHECKING, Any

import numpy as np

from stages.artifacts import ImageRecord
from stages.errors import InputError
from stages.geometry.earth import east_north_up, middle_position
from stages.geometry.place import ControlMark, ControlPoint
from stages.posing.control import MIN_FOR_PLACE, MIN_FOR_SCALE, ControlFit, PlacedPoint, fit_control, place_point
from stages.posing.control_files import GroundControl, KnownPoint, Sighting
from stages.posing.coordinates import to_geodetic
from stages.posing.known import best_fits

if TYPE_CHECKING:
    from jaxtyping import Float

NAMED = 4  # points whose trouble is told one by one
EDGE_PX = 1.0  # a sighting may lie this far outside its photo: programs count pixels from 0, .5 or 1


@dataclass(frozen=True)
class Survey:
    """What ground control says of the world.

    Attributes:
        fit: of the points that are no check points.
        points: all of them, as they are told.
        origin: latitude, longitude (degrees) and altitude (metres) of the origin of the fit's coordinates, which are
            metres east, north and up of it; None where they are the file's own.
        warnings: sentences.
    """

    fit: ControlFit
    points: tuple[ControlPoint, ...]
    origin: tuple[float, float, float] | None
    warnings: tuple[str, ...] = ()


@dataclass
class _Marks:
    """The sightings of one point in posed photos: pixels of the photo as it was read; `scales` leads back."""

    photos: list[Any] = field(default_factory=list)
    names: list[str] = field(default_factory=list)
    pixels: list[tuple[float, float]] = field(default_factory=list)
    scales: list[float] = field(default_factory=list)


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
    marks, lost = _of_photos(control, photos, records)
    placed = {
        point.name: place_point(found.photos, lenses, np.array(found.pixels).reshape(-1, 2))
        for point in control.points
        for found in [marks[point.name]]
    }
    known = np.array([point.xyz for point in control.points])
    origin = None
    if crs:
        positions = to_geodetic(known, crs, "control points")
        origin = middle_position(positions)
        known = east_north_up(positions, origin)
    usable = [i for i, point in enumerate(control.points) if placed[point.name].position is not None]
    fitted = [i for i in usable if not control.points[i].check]
    found = np.full((len(known), 3), np.nan)
    for i in usable:
        found[i] = placed[control.points[i].name].position
    try:
        fit = fit_control(found[fitted], known[fitted])
    except ValueError as error:
        raise _too_few(control, placed, marks, str(error)) from error
    points = _told(control, placed, marks, fit, found, known, fitted)
    return Survey(fit, points, origin, tuple([*lost, *_warnings(points, control, placed, marks, fit)]))


# ---------------------------------------------------------------- which photo
def match_sightings(
    control: GroundControl, sizes: Mapping[str, tuple[int, int]]
) -> tuple[list[tuple[Sighting, str]], set[str]]:
    """Each sighting with its photo, and the names of photos that are not there.

    Args:
        sizes: photo, as a relative posix path -> upright width and height as it was taken.

    Raises:
        InputError: none is of a photo, one fits several, or one lies outside its photo.
    """
    by_stem: dict[str, dict[str, str]] = defaultdict(dict)
    for source in sizes:
        by_stem[_stem(source)][source.lower()] = source
    found, missing = [], set()
    for mark in control.sightings:
        near = by_stem.get(_stem(mark.photo), {})
        _, fitting = best_fits(mark.photo.lower(), near)
        if len(fitting) > 1:
            raise InputError(
                f"{mark.photo} in {control.origin} fits {len(fitting)} photos: {fitting[0]}, {fitting[1]}.",
                "Write the photos' folder before their names.",
            )
        if not fitting:
            missing.add(mark.photo)
            continue
        source = near[fitting[0]]
        _check_inside(mark, source, sizes[source])
        found.append((mark, source))
    if not found:
        raise InputError(
            f"None of the {len(missing)} photos that {control.origin} marks is among the {len(sizes)} photos: it names "
            f"e.g. {min(missing)}, photos are called e.g. {min(sizes, default='-')}.",
            "Name photos in it as the files are named.",
        )
    return found, missing


def _stem(name: str) -> str:
    return PurePosixPath(name.lower()).stem


def _check_inside(mark: Sighting, source: str, size: tuple[int, int]) -> None:
    if not all(-EDGE_PX <= at <= side + EDGE_PX for at, side in zip(mark.pixel, size, strict=True)):
        raise InputError(
            f"{mark.point} is marked at {mark.pixel[0]:g} {mark.pixel[1]:g} in {source}, which has "
            f"{size[0]} x {size[1]} pixels.",
            "Pixels count from the upper left corner of the photo as viewers show it: upright, in its full size.",
        )


def foresee(control: GroundControl, crs: str, sizes: Mapping[str, tuple[int, int]]) -> tuple[list[str], list[str]]:
    """What can be told of control points before photos have poses: why they cannot do, and what to look at.

    Raises:
        InputError, ConfigError, SystemRequirementError: as `survey`.
    """
    found, missing = match_sightings(control, sizes)
    if crs:
        to_geodetic(np.array([point.xyz for point in control.points]), crs, "control points")
    photos_of: dict[str, set[str]] = defaultdict(set)
    for mark, source in found:
        photos_of[mark.point].add(source)
    fitted = [point.name for point in control.points if not point.check]
    count = sum(len(photos_of[name]) >= MIN_FOR_SCALE for name in fitted)
    marked = f"{count} of {len(fitted)} control points are marked in two photos or more"
    warnings = _of_missing(missing, control)
    if count < MIN_FOR_SCALE:
        return [f"{marked}, {MIN_FOR_SCALE} are needed for the scale, {MIN_FOR_PLACE} for the place."], warnings
    if count < MIN_FOR_PLACE:
        warnings.append(f"{marked}: they tell the scale; {MIN_FOR_PLACE} are needed for place and direction.")
    return [], warnings


def _of_missing(missing: Collection[str], control: GroundControl) -> list[str]:
    names = {mark.photo for mark in control.sightings}
    if not missing:
        return []
    return [f"{len(missing)} of {len(names)} photos with control points are not there, e.g. {min(missing)}."]


def _of_photos(
    control: GroundControl, photos: Sequence[Any], records: Sequence[ImageRecord]
) -> tuple[dict[str, _Marks], list[str]]:
    """The sightings in posed photos by point, and sentences on those of photos that are not there or have no pose."""
    of_source = {record.source: record for record in records}
    sizes = {source: record.taken or (record.width, record.height) for source, record in of_source.items()}
    posed = {photo.name: photo for photo in photos}
    found, missing = match_sightings(control, sizes)
    marks: dict[str, _Marks] = defaultdict(_Marks)
    unposed = set()
    for mark, source in found:
        record = of_source[source]
        if record.name not in posed:
            unposed.add(source)
            continue
        theirs, scale = marks[mark.point], record.width / sizes[source][0]
        theirs.photos.append(posed[record.name])
        theirs.names.append(source)
        theirs.pixels.append((scale * mark.pixel[0], scale * mark.pixel[1]))
        theirs.scales.append(scale)
    sentences = _of_missing(missing, control)
    if unposed:
        sentences.append(f"{len(unposed)} photos with control points have no pose, e.g. {min(unposed)}.")
    return marks, sentences


# ---------------------------------------------------------------- what is told
def _told(
    control: GroundControl,
    placed: Mapping[str, PlacedPoint],
    marks: Mapping[str, _Marks],
    fit: ControlFit,
    found: Float[np.ndarray, "p 3"],
    known: Float[np.ndarray, "p 3"],
    fitted: Sequence[int],
) -> tuple[ControlPoint, ...]:
    told = []
    for i, point in enumerate(control.points):
        seen, miss, left_out = placed[point.name], None, None
        if fit.similarity is not None and seen.position is not None:
            x, y, z = (fit.similarity.apply(found[i]) - known[i]).tolist()
            miss = (x, y, z)
            left_out = float(np.linalg.norm(miss))
            if i in fitted:
                alone = float(fit.left_out[fitted.index(i)])
                left_out = alone if np.isfinite(alone) else None
        theirs = marks[point.name]
        told.append(
            ControlPoint(
                point.name,
                point.xyz,
                point.check,
                used=i in fitted and bool(fit.used[fitted.index(i)]),
                miss=miss,
                left_out_m=left_out,
                marks=tuple(
                    ControlMark(name, float(error / scale) if np.isfinite(error) else None, bool(agrees))
                    for name, error, scale, agrees in zip(
                        theirs.names, seen.errors, theirs.scales, seen.agrees, strict=True
                    )
                ),
            )
        )
    return tuple(told)


def _warnings(
    points: Sequence[ControlPoint],
    control: GroundControl,
    placed: Mapping[str, PlacedPoint],
    marks: Mapping[str, _Marks],
    fit: ControlFit,
) -> list[str]:
    sentences = [
        f"Control point {point.name} in {mark.photo} is marked {mark.error_px:.0f} px from where the other photos see "
        "it; that mark is not used."
        for point in points
        for mark in point.marks
        if not mark.used and mark.error_px is not None
    ]
    fault = [f"{point.name} ({_trouble(point, placed, marks)})" for point in control.points if not _ok(point, placed)]
    if fault:
        sentences.append(f"{len(fault)} of {len(control.points)} control points could not be placed: {_list(fault)}.")
    for point in points:
        if not point.check and not point.used and point.left_out_m is not None:
            sentences.append(
                f"Control point {point.name} lies {point.left_out_m:.2g} m from where the others put it and is not "
                "used: look at its coordinates, and whether the photos show that point."
            )
    if not fit.fits:
        sentences.append(
            "The control points do not lie to each other as their coordinates say: they miss them by "
            f"{fit.residual:.2g} m. Are names mixed up, or the coordinates degrees (`--set place.control_epsg=4326`)?"
        )
    if fit.open:
        sentences.append(f"The control points only tell the scale: {fit.open}.")
    return sentences


def _too_few(
    control: GroundControl, placed: Mapping[str, PlacedPoint], marks: Mapping[str, _Marks], reason: str
) -> InputError:
    fitted = [point for point in control.points if not point.check]
    fault = [f"{point.name}: {_trouble(point, placed, marks)}" for point in fitted if not _ok(point, placed)]
    checks = f" ({len(control.points) - len(fitted)} more only check)" if len(fitted) < len(control.points) else ""
    return InputError(
        f"The {len(fitted)} control points in {control.origin}{checks} do not tell "
        f"the scale: {reason}{'. ' + _list(fault) if fault else ''}.",
        f"Mark at least {MIN_FOR_SCALE} points (3 for place and direction) in two photos each or more, from apart, "
        "or leave them out: `--no-control`.",
    )


def _ok(point: KnownPoint, placed: Mapping[str, PlacedPoint]) -> bool:
    return placed[point.name].position is not None


def _trouble(point: KnownPoint, placed: Mapping[str, PlacedPoint], marks: Mapping[str, _Marks]) -> str:
    count = len(marks[point.name].pixels)
    if count < 2:
        return f"marked in {count} photo{'' if count == 1 else 's'} with a pose, 2 are needed"
    return f"its marks in {count} photos do not meet, or are seen from one side"


def _list(faults: Sequence[str]) -> str:
    more = len(faults) - NAMED
    return "; ".join(faults[:NAMED]) + (f"; and {more} more" if more > 0 else "")
