"""Which photo each mark of a control point is in, and what that tells before photos have poses."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Mapping

import numpy as np

from stages.errors import InputError
from stages.posing.control import MIN_FOR_PLACE, MIN_FOR_SCALE
from stages.posing.control_files import GroundControl, Sighting
from stages.posing.coordinates import to_geodetic
from stages.posing.known import best_fits, stem

MIN_PHOTOS = 2  # that a point must be marked in
EDGE_PX = 1.0  # a sighting may lie this far outside its photo: programs count pixels from 0, .5 or 1


def match_sightings(
    control: GroundControl, sizes: Mapping[str, tuple[int, int]]
) -> tuple[list[tuple[Sighting, str]], set[str]]:
    """Each sighting with its photo, and the names of photos that are not there.

    Args:
        sizes: photo, as a relative posix path -> upright width and height as it was taken.

    Raises:
        InputError: none is of a photo, one fits several, or one lies outside its photo.
    """
    by_stem: dict[str, list[str]] = defaultdict(list)
    for source in sizes:
        by_stem[stem(source.lower())].append(source)
    found, missing = [], set()
    for mark in control.sightings:
        fitting = photos_named(mark.photo, by_stem[stem(mark.photo.lower())])
        if len(fitting) > 1:
            raise InputError(
                f"{mark.photo} in {control.origin} fits {len(fitting)} photos: {fitting[0]}, {fitting[1]}.",
                "Write the photos' folder before their names.",
            )
        if not fitting:
            missing.add(mark.photo)
            continue
        _check_inside(mark, fitting[0], sizes[fitting[0]])
        found.append((mark, fitting[0]))
    if not found:
        raise InputError(
            f"None of the {len(missing)} photos that {control.origin} marks is among the {len(sizes)} photos: it names "
            f"e.g. {min(missing)}, photos are called e.g. {min(sizes, default='-')}.",
            "Name photos in it as the files are named.",
        )
    return found, missing


def photos_named(name: str, photos: Collection[str]) -> list[str]:
    """The photos that a name may mean: that one, or those that fit it best whatever the case of their letters."""
    if name in photos:
        return [name]
    _, best = best_fits(name.lower(), [photo.lower() for photo in photos])
    return [photo for photo in photos if photo.lower() in best]


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
    count = sum(len(photos_of[name]) >= MIN_PHOTOS for name in fitted)
    marked = f"{count} of {len(fitted)} control points are marked in two photos or more"
    warnings = sentences_on_missing(missing, control)
    if count < MIN_FOR_SCALE:
        return [f"{marked}, {MIN_FOR_SCALE} are needed for the scale, {MIN_FOR_PLACE} for the place."], warnings
    if count < MIN_FOR_PLACE:
        warnings.append(f"{marked}: they tell the scale; {MIN_FOR_PLACE} are needed for place and direction.")
    return [], warnings


def sentences_on_missing(missing: Collection[str], control: GroundControl) -> list[str]:
    names = {mark.photo for mark in control.sightings}
    if not missing:
        return []
    return [f"{len(missing)} of {len(names)} photos with control points are not there, e.g. {min(missing)}."]
