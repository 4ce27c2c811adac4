"""Place: how the frame of the poses lies in the world: metres, place on Earth, up; and the region that was given.

The world is the frame of the results. Only what needs it reads it: a region given in its coordinates, and the files and
the report in the end. So a distance that is measured later changes no training.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from configs.params import PlaceParams
from configs.texts import read_distance, read_region
from stages.artifacts import GIVEN_POSES, GIVEN_REGION, IMAGE_SET, MODEL, PHOTOS, WORLD_PLACE, ImageRecord, Pictures
from stages.engine.stage import Stage, StageContext
from stages.errors import ConfigError, InputError
from stages.geometry.cameras import PinholeCameras
from stages.geometry.earth import east_north_up, from_east_north_up
from stages.geometry.layout import find_layout
from stages.geometry.place import GivenRegion, Located, Place, given_region, locate
from stages.geometry.similarity import Similarity
from stages.geometry.subjects import find_subjects
from stages.geometry.up import Up, angle_deg, estimate_up
from stages.posing.control_files import CONTROL, read_control
from stages.posing.coordinates import to_grid
from stages.posing.markers import MarkerScale, detect_markers, measure_markers
from stages.posing.survey import Survey, survey
from stages.posing.undistortion import plan_warp, posed_cameras, registered_photos, sparse_points

log = logging.getLogger(__name__)

MIN_SEEING = 2  # cameras that see a region which the user gave
# Sparse points in it: false ones are anywhere. Without this many in all, as where poses are given, they tell nothing.
MIN_HELD, MIN_JUDGED = 10, 100
MAX_GPS_TILT_DEG = 2.0  # GPS is believed where it knows up to this
# Up as the photos tell it may lie this far from the true one: slopes, cameras held askew. And what stands on its head.
MAX_UP_DEG, UPSIDE_DOWN_DEG = 25.0, 120.0
MAX_GPS_SHIFT_M = 100.0  # GPS without a fix of its own may be off by this
SIGNS = "look at EXIF's GPSLongitudeRef, GPSLatitudeRef and GPSAltitudeRef"
MIN_GRID_M = 10.0  # a map's grid is compared with metres over no less than this


def run(context: StageContext[PlaceParams]) -> dict[str, Any]:
    """Find scale, place and up from GPS, control points, markers, a distance and the settings; read the region."""
    import pycolmap

    params = context.params
    model = pycolmap.Reconstruction(str(context.read(MODEL)))
    photos = registered_photos(model)
    warps = {camera_id: plan_warp(camera) for camera_id, camera in model.cameras.items()}
    cameras = posed_cameras(photos, [photo.name for photo in photos], warps)
    records = context.read(IMAGE_SET).images
    # The world of poses that were given is theirs, whatever the photos' EXIF says.
    given = context.read(GIVEN_POSES)
    use_gps = params.gps and given is None
    gps = _gps_of(cameras, records)
    located = _locate(cameras, gps) if use_gps else None
    surveyed = _survey(context, model, photos, records) if CONTROL in context.sources else None
    found = None
    if params.marker_size is not None:
        found = _measure_markers(model, photos, cameras, context.read(PHOTOS), params)

    whole = given.place.place() if given is not None and given.place is not None else None
    place = whole or Place(Similarity.identity())
    warnings: list[str] = []
    if located is not None or surveyed is not None:
        seen = _up_of_photos(cameras, model, photos)
    if located is not None:
        place, warnings = _by_gps(located, seen)
    if found is not None:
        place = _by_markers(place, found)
    if surveyed is not None:
        place, more = _by_control(place, surveyed, seen, cameras.centers, gps if use_gps else {})
        warnings = more if surveyed.fit.similarity is not None else warnings + more  # GPS is not believed then
    place = _by_distance(place, params.known_distance)
    if whole is None:  # of which all parts have one world
        place = _in_reach(place, cameras.centers, params.epsg)
    up_from = "" if place.up is None else "GPS" if place.control_residual is None else "the control points"
    up_from = "the whole that this is a part of" if whole is not None else up_from
    if params.up != "auto":
        direction = np.eye(3)["xyz".index(params.up[1])] * (1.0 if params.up[0] == "+" else -1.0)
        place, up_from = replace(place, up=direction), "the settings"
    for warning in warnings:
        log.warning("%s", warning)
    context.write(WORLD_PLACE, place)
    context.write(GIVEN_REGION, _given_region(cameras, model, photos, place, params, any(r.has_mask for r in records)))
    return {
        "units": place.units,
        "scale_from": place.scale_from or "nothing",
        "scale_error_percent": place.scale_error and round(100 * place.scale_error, 3),
        "gps_residual_m": place.gps_residual and round(place.gps_residual, 3),
        **({"control_residual_m": round(place.control_residual, 4)} if place.control_residual is not None else {}),
        **({"up_from": up_from} if up_from else {}),
        **({"warnings": [{"sentence": warning} for warning in warnings]} if warnings else {}),
    }


# ---------------------------------------------------------------- GPS
def _gps_of(cameras: PinholeCameras, records: Sequence[ImageRecord]) -> dict[int, tuple[float, float, float]]:
    """Index of each camera whose photo carries a position, and the position."""
    gps = {record.name: record.gps for record in records}
    return {i: found for i, name in enumerate(cameras.names) if (found := gps.get(name)) is not None}


def _locate(cameras: PinholeCameras, gps: Mapping[int, tuple[float, float, float]]) -> Located | None:
    """The cameras aligned to the photos' GPS positions, where these agree."""
    if not gps:
        return None
    try:
        located = locate(cameras.centers[list(gps)], np.array(list(gps.values())))
    except ValueError as error:
        log.warning("GPS is not used: %s%s", error, _mirrored(cameras, gps))
        return None
    log.info("GPS: %d of %d positions used, residual %.2g m", located.used, len(gps), located.residual)
    return located


def _mirrored(cameras: PinholeCameras, gps: Mapping[int, tuple[float, float, float]]) -> str:
    """The end of a sentence, where the positions would fit in a mirrored world."""
    try:
        locate(cameras.centers[list(gps)], np.array(list(gps.values())) * (1, -1, 1))
    except ValueError:
        return ""
    return f". They fit with one of their signs changed: {SIGNS}"


def _up_of_photos(cameras: PinholeCameras, model: Any, photos: list[Any]) -> Up:
    """Up as the ground or the way the cameras were held tells it, in the frame of the poses."""
    points, _, observations = sparse_points(model, photos)
    try:
        return find_layout(cameras, points, observations).up
    except ValueError:
        return estimate_up(cameras)


def _doubts(up: np.ndarray, seen: Up, what: str) -> tuple[list[str], bool]:
    """What is to be said where `what` has another up than the photos, and whether it stands on its head."""
    angle = angle_deg(up, seen.direction)
    if angle < MAX_UP_DEG or (not seen.sure and angle < UPSIDE_DOWN_DEG):
        return [], False
    return [f"{what} and {seen.source} disagree about up by {angle:.0f} degrees"], angle > UPSIDE_DOWN_DEG


def _by_gps(located: Located, seen: Up) -> tuple[Place, list[str]]:
    """The place that GPS tells, and sentences on what is wrong with it."""
    levelled = located.tilt_error_deg <= MAX_GPS_TILT_DEG
    doubts, upside_down = _doubts(located.up, seen, "GPS")
    if upside_down:
        # positions in one plane fit their mirror image as well, turned over
        place = Place(
            Similarity(located.world_from_poses.scale, np.eye(3), np.zeros(3)),
            metric=True,
            scale_from="GPS",
            scale_error=located.scale_error,
            gps_residual=located.residual,
        )
        return place, [
            f"{doubts[0]}: only the scale is taken from it. One of the positions' signs may be wrong: {SIGNS}."
        ]
    place = Place(
        world_from_poses=located.world_from_poses,
        metric=True,
        scale_from="GPS",
        scale_error=located.scale_error,
        origin=located.origin,
        gps_residual=located.residual,
        up=np.array([0.0, 0.0, 1.0]) if levelled else None,
    )
    advice = "GPS is believed; `--set place.gps=false` does not"
    return place, [f"{doubt}: {advice}." for doubt in doubts if levelled]


# ---------------------------------------------------------------- ground control
def _survey(
    context: StageContext[PlaceParams], model: Any, photos: list[Any], records: Sequence[ImageRecord]
) -> Survey:
    """What the ground control points tell.

    Raises:
        InputError, ConfigError, SystemRequirementError: see `survey`.
    """
    control = read_control(context.sources[CONTROL])
    crs = control.system(context.params.control_epsg)
    found = survey(control, crs, photos, model.cameras, records)
    used, checks = (sum(getattr(point, what) for point in found.points) for what in ("used", "check"))
    more = f" and {checks} to check" if checks else ""
    residual = "" if found.fit.residual is None else f", residual {found.fit.residual:.2g} m"
    total, frame = len(found.points) - checks, crs or "a frame of their own"
    log.info("control points: %d of %d used%s (%s)%s", used, total, more, frame, residual)
    return found


def _by_control(
    place: Place,
    surveyed: Survey,
    seen: Up,
    centers: np.ndarray,
    gps: Mapping[int, tuple[float, float, float]],
) -> tuple[Place, list[str]]:
    """The place that control points tell, and sentences on what is wrong with it; `place` is what all else tells."""
    fit, warnings = surveyed.fit, list(surveyed.warnings)
    used = sum(point.used for point in surveyed.points)
    source = f"{used} control points"
    factor = fit.scale / place.world_from_poses.scale
    if place.metric:
        _compare(
            factor, float(np.hypot(fit.scale_error or 0, place.scale_error or 0)), "Control points", place.scale_from
        )
    if fit.similarity is None:
        return replace(place.rescaled(factor, source, fit.scale_error), control=surveyed.points), warnings
    doubts, upside_down = _doubts(fit.similarity.rotation[2], seen, "The control points")
    advice = (
        "x and y may be interchanged (x is east, y is north), or z points down" if upside_down else "they are believed"
    )
    warnings += [f"{doubt}: {advice}." for doubt in doubts]
    found = Place(
        world_from_poses=fit.similarity,
        metric=True,
        scale_from=source,
        scale_error=fit.scale_error,
        origin=surveyed.origin,
        up=None if upside_down else np.array([0.0, 0.0, 1.0]),
        control=surveyed.points,
        control_residual=fit.residual,
        offset=(0.0, 0.0, 0.0) if surveyed.origin is None else None,
    )
    if surveyed.origin is not None and gps:
        there = east_north_up(np.array(list(gps.values())), surveyed.origin)
        apart = np.median(fit.similarity.apply(centers[list(gps)]) - there, axis=0)
        log.info("the cameras lie %.1f m east, %.1f m north, %.1f m above where GPS has them (median)", *apart)
        if np.hypot(*apart[:2]) > MAX_GPS_SHIFT_M:
            warnings.append(
                f"The control points put the cameras {np.hypot(*apart[:2]) / 1e3:,.1f} km from where GPS has them: is "
                "their coordinate system right (`--set place.control_epsg=32632`)?"
            )
    return found, warnings


def _in_reach(place: Place, centers: np.ndarray, epsg: int | None) -> Place:
    """The same place in the grid of `epsg`, where that is asked for, with its origin near the cameras.

    Raises:
        ConfigError: where on Earth it is is not known, or the grid does not fit.
    """
    centers = place.world_from_poses.apply(centers)
    middle = np.median(centers, axis=0)
    radius = float(np.median(np.linalg.norm(centers - middle, axis=1)))
    if epsg is None:
        return place.near(middle, radius)
    if place.origin is None:
        raise ConfigError(
            f"`place.epsg` = {epsg} asks for a map's coordinates, but where on Earth the scene lies is not known.",
            "It takes GPS, or 3 control points or more in a named coordinate system: `--set place.control_epsg=32632`.",
        )
    corners = np.array([[i, j, k] for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)])
    enu = middle + max(radius, MIN_GRID_M) * corners
    crs = f"EPSG:{epsg}"
    return place.in_grid(crs, enu, to_grid(from_east_north_up(enu, place.origin), crs))


# ---------------------------------------------------------------- what was measured
def _measure_markers(
    model: Any, photos: list[Any], cameras: PinholeCameras, pictures: Pictures, params: PlaceParams
) -> MarkerScale:
    """The scale from markers of known size.

    Raises:
        InputError: none could be measured.
    """
    assert params.marker_size is not None
    seen = []
    for index, photo in enumerate(photos):
        markers = detect_markers(pictures.image(photo.name), params.marker_dictionary)
        lens, K = model.cameras[photo.camera_id], cameras.intrinsics[index]
        focal, middle = K[[0, 1], [0, 1]], K[:2, 2]
        seen.append({number: lens.cam_from_img(quad) * focal + middle for number, quad in markers.items()})
    found = measure_markers(cameras, seen, params.marker_size)
    if found is None:
        count, kind = sum(bool(each) for each in seen), params.marker_dictionary
        raise InputError(
            f"No marker could be measured: {count} of {len(cameras)} photos show any of {kind}, and two that see the "
            "same marker from different sides are needed.",
            "Check `place.marker_dictionary`, or leave markers out: `--set place.marker_size=null`.",
        )
    return found


def _by_markers(place: Place, found: MarkerScale) -> Place:
    """The place with the scale from markers."""
    factor = found.factor / place.world_from_poses.scale
    if place.metric:
        _compare(factor, float(np.hypot(found.error, place.scale_error or 0)), "Markers", place.scale_from)
    source = f"{found.markers} marker{'s' if found.markers > 1 else ''} ({found.sides} sides)"
    return place.rescaled(factor, source, found.error)


def _by_distance(place: Place, known_distance: str | None) -> Place:
    """The place with the scale from a stated distance; control points, which hold more of them, are only compared."""
    if known_distance is None:
        return place
    first, second, metres = read_distance(known_distance)
    factor = metres / float(np.linalg.norm(np.subtract(first, second)))
    if place.control:
        _compare(1 / factor, place.scale_error or 0, "Control points", "the known distance")
        return place
    if place.metric:
        _compare(factor, place.scale_error or 0, "The known distance", place.scale_from)
    return place.rescaled(factor, "a known distance", None)


def _compare(factor: float, error: float, this: str, other: str) -> None:
    """Warn where two sources of scale do not agree within their errors (and a percent)."""
    if abs(factor - 1) > 3 * error + 0.01:
        log.warning("%s and %s disagree on the scale by %.1f %%; the first is used", this, other, 100 * (factor - 1))


# ---------------------------------------------------------------- the region that was given
def _given_region(
    cameras: PinholeCameras, model: Any, photos: list[Any], place: Place, params: PlaceParams, masked: bool
) -> GivenRegion | None:
    """The region of the settings, None where it is to be found.

    Args:
        masked: masks show the object, so that it may have no sparse points.

    Raises:
        ConfigError: fewer than two cameras see it, or hardly any of the sparse points lie in it.
    """
    text = params.region
    form, numbers = read_region(text)
    if form == "auto":
        return None
    region = given_region(form, numbers, place.world_from_poses)
    places = region.center + region.radius * np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)])
    seen = sum(bool(cameras.in_frame(i, places).any()) for i in range(len(cameras)))
    points, _, observations = sparse_points(model, photos)
    held = int(region.holds(points).sum())
    wrong = ""
    if seen < MIN_SEEING:
        wrong = f"is seen by {seen} of {len(cameras)} cameras (need {MIN_SEEING})"
    elif held < MIN_HELD and len(points) >= MIN_JUDGED and not masked:
        wrong = f"holds {held} of {len(points)} sparse points (need {MIN_HELD})"
    if wrong:
        centers = place.world_from_poses.apply(cameras.centers)
        raise ConfigError(
            f"`place.region` = {text} {wrong}.",
            f"It is in the coordinates of the exported PLY, where the cameras stand about "
            f"{_written(np.median(centers, axis=0))}. {_found_region(cameras, points, observations, place)}"
            "`--set place.region=auto` finds it by itself.",
        )
    return region


def _found_region(cameras: PinholeCameras, points: np.ndarray, observations: np.ndarray, place: Place) -> str:
    """The regions that would be found, as settings; empty where none would."""
    subjects = find_subjects(cameras, points, observations)
    found = []
    for photos in [subject.photos for subject in subjects] if len(subjects) > 1 else [None]:
        try:
            region = find_layout(cameras, points, observations, photos=photos).region
        except ValueError:
            continue
        sphere = [*place.world_from_poses.apply(region.center), place.world_from_poses.scale * region.radius]
        found.append(f"`--set 'place.region=sphere {_written(sphere)}'`")
    return f"The photos are about {' and '.join(found)}. " if found else ""


def _written(numbers: Iterable[float]) -> str:
    return " ".join(f"{value:.4g}" for value in numbers)


PLACE: Stage[PlaceParams] = Stage(
    name="place",
    version=3,
    settings=lambda config: config.place,
    run=run,
    reads=(IMAGE_SET, PHOTOS, MODEL, GIVEN_POSES),
    writes=(WORLD_PLACE, GIVEN_REGION),
    sources=(CONTROL,),
    summary="scale, place and up of the world, from GPS, control points, markers or a known distance",
)
