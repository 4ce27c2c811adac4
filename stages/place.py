"""Place: how the frame of the poses lies in the world: metres, place on Earth, up; and the region that was given.

The world is the frame of the results. Only what needs it reads it: a region given in its coordinates, and the files and
the report in the end. So a distance that is measured later changes no training.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np

from configs.params import PlaceParams
from configs.texts import read_distance, read_region
from stages.artifacts import GIVEN_POSES, GIVEN_REGION, IMAGE_SET, MODEL, PHOTOS, WORLD_PLACE, ImageSet, Pictures
from stages.engine.stage import Stage, StageContext
from stages.errors import ConfigError, InputError
from stages.geometry.cameras import PinholeCameras
from stages.geometry.layout import find_layout
from stages.geometry.place import GivenRegion, Located, Place, given_region, locate
from stages.geometry.similarity import Similarity
from stages.geometry.subjects import find_subjects
from stages.posing.markers import MarkerScale, detect_markers, measure_markers
from stages.posing.undistortion import plan_warp, posed_cameras, registered_photos, sparse_points

log = logging.getLogger(__name__)

MIN_SEEING = 2  # cameras that see a region which the user gave
# Sparse points in it: false ones are anywhere. Without this many in all, as where poses are given, they tell nothing.
MIN_HELD, MIN_JUDGED = 10, 100
MAX_GPS_TILT_DEG = 2.0  # GPS is believed where it knows up to this


def run(context: StageContext[PlaceParams]) -> dict[str, Any]:
    """Find scale, place and up from GPS, markers, a known distance and the settings; read the given region."""
    import pycolmap

    params = context.params
    model = pycolmap.Reconstruction(str(context.read(MODEL)))
    photos = registered_photos(model)
    warps = {camera_id: plan_warp(camera) for camera_id, camera in model.cameras.items()}
    cameras = posed_cameras(photos, [photo.name for photo in photos], warps)
    # The world of poses that were given is theirs, whatever the photos' EXIF says.
    use_gps = params.gps and context.read(GIVEN_POSES) is None
    located = _locate(cameras, context.read(IMAGE_SET)) if use_gps else None
    found = None
    if params.marker_size is not None:
        found = _measure_markers(model, photos, cameras, context.read(PHOTOS), params)
    place = _find_place(cameras, located, found, params)
    up_from = ""
    if params.up != "auto":
        direction = np.eye(3)["xyz".index(params.up[1])] * (1.0 if params.up[0] == "+" else -1.0)
        place, up_from = replace(place, up=direction), "the settings"
    elif located is not None and located.tilt_error_deg <= MAX_GPS_TILT_DEG:
        place, up_from = replace(place, up=np.array([0.0, 0.0, 1.0])), "GPS"
    context.write(WORLD_PLACE, place)
    masked = any(record.has_mask for record in context.read(IMAGE_SET).images)
    context.write(GIVEN_REGION, _given_region(cameras, model, photos, place, params, masked))
    return {
        "units": place.units,
        "scale_from": place.scale_from or "nothing",
        "scale_error_percent": place.scale_error and round(100 * place.scale_error, 3),
        "gps_residual_m": place.gps_residual and round(place.gps_residual, 3),
        **({"up_from": up_from} if up_from else {}),
    }


def _locate(cameras: PinholeCameras, image_set: ImageSet) -> Located | None:
    """The cameras aligned to the photos' GPS positions, where these agree."""
    gps = {record.name: record.gps for record in image_set.images}
    positions = {i: found for i, name in enumerate(cameras.names) if (found := gps.get(name)) is not None}
    if not positions:
        return None
    try:
        located = locate(cameras.centers[list(positions)], np.array(list(positions.values())))
    except ValueError as error:
        log.warning("GPS is not used: %s", error)
        return None
    log.info("GPS: %d of %d positions used, residual %.2g m", located.used, len(positions), located.residual)
    return located


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


def _find_place(
    cameras: PinholeCameras, located: Located | None, found: MarkerScale | None, params: PlaceParams
) -> Place:
    """Scale and place of the world from all that is known: a stated distance over markers over GPS."""
    place = Place(Similarity.identity())
    if located is not None:
        place = Place(
            world_from_poses=located.world_from_poses,
            metric=True,
            scale_from="GPS",
            scale_error=located.scale_error,
            origin=located.origin,
            gps_residual=located.residual,
        )
    if found is not None:
        factor = found.factor / place.world_from_poses.scale
        if place.metric:
            _compare(factor, np.hypot(found.error, place.scale_error or 0), "Markers", "GPS")
        source = f"{found.markers} marker{'s' if found.markers > 1 else ''} ({found.sides} sides)"
        place = place.rescaled(factor, source, found.error)
    if params.known_distance is not None:
        first, second, metres = read_distance(params.known_distance)
        factor = metres / float(np.linalg.norm(np.subtract(first, second)))
        if place.metric:
            _compare(factor, place.scale_error or 0, "The known distance", place.scale_from)
        place = place.rescaled(factor, "a known distance", None)
    centers = place.world_from_poses.apply(cameras.centers)
    middle = np.median(centers, axis=0)
    return place.near(middle, float(np.median(np.linalg.norm(centers - middle, axis=1))))


def _compare(factor: float, error: float, this: str, other: str) -> None:
    """Warn where two sources of scale do not agree within their errors (and a percent)."""
    if abs(factor - 1) > 3 * error + 0.01:
        log.warning("%s and %s disagree on the scale by %.1f %%; the first is used", this, other, 100 * (factor - 1))


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
    version=2,
    settings=lambda config: config.place,
    run=run,
    reads=(IMAGE_SET, PHOTOS, MODEL, GIVEN_POSES),
    writes=(WORLD_PLACE, GIVEN_REGION),
    summary="scale, place and up of the world, from GPS, markers or a known distance",
)
