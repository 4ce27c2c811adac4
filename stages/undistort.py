"""Undistort: poses + photos -> pinhole images, masks warped by the same maps, the normalised scene.

The scene: where the photos were taken and how large (place), what they are about (region), what it stands on
(ground), which way is up.
"""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from configs.texts import read_distance, read_region
from stages import artifacts
from stages.engine.stage import Stage, StageContext
from stages.errors import ConfigError, InputError, ReconstructionError
from stages.geometry.cameras import PinholeCameras, PosedScene
from stages.geometry.markers import detect_markers, measure_markers
from stages.geometry.normalisation import into_scene, scene_frame
from stages.geometry.overview import overview_svg
from stages.geometry.place import Located, Place, locate
from stages.geometry.plane import Plane, find_ground
from stages.geometry.region import RegionOfInterest, find_region, given_region, grown_alone
from stages.geometry.similarity import Similarity
from stages.geometry.up import Up, choose_up, estimate_up

log = logging.getLogger(__name__)

MIN_SEEING = 2  # cameras that see a region which the user gave
PNG_COMPRESSION = 2  # of 9; twice as fast as the default for a few percent of size


@dataclass(frozen=True)
class _Warp:
    """How images of one camera become pinhole images.

    Attributes:
        intrinsics: [3, 3] of the pinhole images.
        size: width, height of the pinhole images.
        shrink_to: width, height the photo is first reduced to (area filter), or None.
    """

    intrinsics: np.ndarray
    size: tuple[int, int]
    shrink_to: tuple[int, int] | None


def run(context: StageContext) -> dict[str, Any]:
    """Warp every registered photo, find the region of interest, write the scene."""
    import cv2
    import pycolmap

    params, ingest = context.params, context.inputs["ingest"]
    model = pycolmap.Reconstruction(str(artifacts.model_path(context.inputs["sfm"])))
    photos = sorted((model.images[i] for i in model.reg_image_ids()), key=lambda image: image.name)
    warps = {camera_id: _plan_warp(camera, params.max_side) for camera_id, camera in model.cameras.items()}
    names = _png_names([photo.name for photo in photos])

    # Maps take 8 bytes a pixel, and where photos share no camera there is a pair for each of them: keep a few.
    @lru_cache(maxsize=max(1, context.workers))
    def maps_of(camera_id: int) -> tuple[np.ndarray, np.ndarray]:
        return _warp_maps(model.cameras[camera_id], warps[camera_id])

    done = 0

    def warp(job: tuple[str, str, int]) -> tuple[np.ndarray | None, dict[int, np.ndarray]]:
        """Writes one image (and its mask); returns the mask and the markers seen."""
        nonlocal done
        source, name, camera_id = job
        maps = maps_of(camera_id)
        pixels = _remap(artifacts.load_image(ingest, source), warps[camera_id], maps, cv2.INTER_CUBIC)
        artifacts.write_png(artifacts.image_path(context.out, name), pixels, PNG_COMPRESSION)
        mask = artifacts.load_mask(ingest, source)
        if mask is not None:
            mask = _warp_mask(mask, warps[camera_id], maps, params.mask_erode)
            artifacts.write_png(artifacts.mask_path(context.out, name), mask, PNG_COMPRESSION)
        done += 1
        context.progress(done, len(photos) + 1, source)
        return mask, detect_markers(pixels, params.marker_dictionary) if params.marker_size else {}

    before = cv2.getNumThreads()
    cv2.setNumThreads(1)  # the pool below is the parallelism
    try:
        with ThreadPoolExecutor(max_workers=max(1, context.workers)) as pool:
            jobs = [(photo.name, name, photo.camera_id) for photo, name in zip(photos, names, strict=True)]
            masks, markers = zip(*pool.map(warp, jobs), strict=True)
    finally:
        cv2.setNumThreads(before)

    cameras = PinholeCameras(
        names=tuple(names),
        sizes=np.array([warps[photo.camera_id].size for photo in photos], dtype=np.int64),
        intrinsics=np.stack([warps[photo.camera_id].intrinsics for photo in photos]),
        cam_from_scene=np.stack([photo.cam_from_world().matrix() for photo in photos]),
    )
    points, errors, observations = _sparse_points(model, photos)
    known = artifacts.load_known_poses(context.inputs["sfm"])
    # The world of poses that were given is theirs, whatever the photos' EXIF says.
    use_gps = params.gps and known is None
    positions = _gps_positions(ingest, [photo.name for photo in photos]) if use_gps else {}
    place, located = _find_place(cameras, positions, markers, params)
    cameras, points = into_scene(cameras, place.world_from_model.inverse()), place.world_from_model.apply(points)
    stated = _stated_region(known, place) if known else None
    region, ground, up = _find_region(cameras, points, masks, stated, located, params)
    world_from_scene = scene_frame(region.center, region.radius, up.direction)
    scene = PosedScene(
        cameras=into_scene(cameras, world_from_scene),
        world_from_scene=world_from_scene,
        points=world_from_scene.inverse().apply(points).astype(np.float32),
        point_errors=errors,
        observations=observations,
        up=np.array([0.0, 0.0, 1.0]),
        kind=region.kind,
        place=place,
        ground=ground and ground.within(world_from_scene),
        box=region.box,
    )
    artifacts.save_scene(context.out, scene)
    artifacts.overview_path(context.out).write_text(overview_svg(scene), encoding="utf-8")
    context.progress(len(photos) + 1, len(photos) + 1, "done")

    inside = np.linalg.norm(scene.points, axis=1) < 1
    return {
        "images": len(photos),
        "width": int(scene.cameras.sizes[:, 0].max()),
        "height": int(scene.cameras.sizes[:, 1].max()),
        "masks": sum(mask is not None for mask in masks),
        "kind": scene.kind,
        "region_from": region.source,
        "up_from": up.source,
        "ground": ground is not None,
        "units": place.units,
        "scale_from": place.scale_from or "nothing",
        "scale_error_percent": place.scale_error and round(100 * place.scale_error, 3),
        "gps_residual_m": place.gps_residual and round(place.gps_residual, 3),
        "points": len(points),
        "points_inside": int(inside.sum()),
        "camera_distance": round(float(np.median(np.linalg.norm(scene.cameras.centers, axis=1))), 3),
    }


# ---------------------------------------------------------------- pinhole images
def _plan_warp(camera: Any, max_side: int) -> _Warp:
    """The pinhole camera that shows only valid pixels of a COLMAP camera."""
    import pycolmap

    options = pycolmap.UndistortCameraOptions()
    options.blank_pixels = 0.0  # crop until no pixel comes from outside the photo
    pinhole = pycolmap.undistort_camera(options, camera)
    scale = min(1.0, max_side / max(pinhole.width, pinhole.height))
    width, height = max(1, round(pinhole.width * scale)), max(1, round(pinhole.height * scale))
    intrinsics = np.array(pinhole.calibration_matrix())
    intrinsics[0] *= width / pinhole.width
    intrinsics[1] *= height / pinhole.height
    shrink_to = None
    if scale < 1:
        shrink_to = max(1, round(camera.width * scale)), max(1, round(camera.height * scale))
    return _Warp(intrinsics, (width, height), shrink_to)


def pinhole_photo(
    camera: Any, pixels: np.ndarray, mask: np.ndarray | None, max_side: int
) -> tuple[np.ndarray, np.ndarray | None]:
    """One photo [H, W, 3] and its mask [H, W] uint8 as images of `pinhole_camera`, the way the stage makes them."""
    import cv2

    warp = _plan_warp(camera, max_side)
    maps = _warp_maps(camera, warp)
    return _remap(pixels, warp, maps, cv2.INTER_CUBIC), None if mask is None else _warp_mask(mask, warp, maps, 0)


def pinhole_camera(camera: Any, max_side: int) -> tuple[np.ndarray, tuple[int, int]]:
    """Intrinsics [3, 3] and size of the pinhole images of a pycolmap camera."""
    warp = _plan_warp(camera, max_side)
    return warp.intrinsics, warp.size


def _warp_maps(camera: Any, warp: _Warp) -> tuple[np.ndarray, np.ndarray]:
    """Positions in the (reduced) photo of each pixel of the pinhole image, x and y [height, width] float32.

    As cv2.remap wants them: pixel centres at integers.
    """
    (width, height), intrinsics = warp.size, warp.intrinsics
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    rays = np.stack(
        [
            (x - intrinsics[0, 2]) / intrinsics[0, 0],
            (y - intrinsics[1, 2]) / intrinsics[1, 1],
            np.ones_like(x),
        ],
        -1,
    ).reshape(-1, 3)
    positions = np.asarray(camera.img_from_cam(rays)).reshape(height, width, 2)

    if warp.shrink_to is not None:
        positions = positions * (np.array(warp.shrink_to) / (camera.width, camera.height))
    maps = (positions - 0.5).astype(np.float32)
    return np.ascontiguousarray(maps[..., 0]), np.ascontiguousarray(maps[..., 1])


def _remap(pixels: np.ndarray, warp: _Warp, maps: tuple[np.ndarray, np.ndarray], interpolation: int) -> np.ndarray:
    import cv2

    if warp.shrink_to is not None:
        pixels = cv2.resize(pixels, warp.shrink_to, interpolation=cv2.INTER_AREA)
    # the outermost pixel centres may fall half a pixel outside the photo's own: repeat its border
    return cv2.remap(pixels, *maps, interpolation, borderMode=cv2.BORDER_REPLICATE)


def _warp_mask(mask: np.ndarray, warp: _Warp, maps: tuple[np.ndarray, np.ndarray], erode: int) -> np.ndarray:
    """[H, W] uint8, 255 on the object, shrunk by `erode` pixels (not at the image's border)."""
    import cv2

    mask = np.where(_remap(mask, warp, maps, cv2.INTER_LINEAR) > 127, 255, 0).astype(np.uint8)
    if erode:
        kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * erode + 1, 2 * erode + 1))
        mask = cv2.erode(mask, kernel)
    return mask


def _png_names(names: list[str]) -> list[str]:
    """The names with .png as suffix; the whole name is kept where two would become one."""
    plain = [PurePosixPath(name).with_suffix(".png").as_posix() for name in names]
    # case-insensitive file systems must not merge two images
    counts = Counter(short.lower() for short in plain)
    mixed = [s if counts[s.lower()] == 1 else f"{name}.png" for name, s in zip(names, plain, strict=True)]
    return mixed if len({name.lower() for name in mixed}) == len(names) else [f"{name}.png" for name in names]


# ---------------------------------------------------------------- the scene
def _sparse_points(model: Any, photos: list[Any]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points [P, 3] in the world frame, errors [P], observations [M, 2] (image index, point index)."""
    index_of = {photo.image_id: i for i, photo in enumerate(photos)}
    ids = sorted(model.points3D)
    points = np.array([model.points3D[i].xyz for i in ids], dtype=np.float64).reshape(-1, 3)
    errors = np.array([model.points3D[i].error for i in ids], dtype=np.float32)
    seen = {
        (index_of[element.image_id], k)
        for k, i in enumerate(ids)
        for element in model.points3D[i].track.elements
        if element.image_id in index_of
    }
    return points, errors, np.array(sorted(seen), dtype=np.int32).reshape(-1, 2)


# ---------------------------------------------------------------- scale and place
def _gps_positions(ingest: Path, names: list[str]) -> dict[int, tuple[float, float, float]]:
    """GPS position of each photo that has one, by the photo's index."""
    gps = {record.name: record.gps for record in artifacts.load_image_set(ingest).images}
    return {i: found for i, name in enumerate(names) if (found := gps.get(name)) is not None}


def _find_place(
    cameras: PinholeCameras,
    positions: dict[int, tuple[float, float, float]],
    markers: Sequence[dict[int, np.ndarray]],
    params: Any,
) -> tuple[Place, Located | None]:
    """Scale and place of the world from all that is known: a stated distance over markers over GPS."""
    place, located = Place(Similarity.identity()), None
    if positions:
        indices = list(positions)
        try:
            located = locate(cameras.centers[indices], np.array([positions[i] for i in indices]))
        except ValueError as error:
            log.warning("GPS is not used: %s", error)
    if located is not None:
        log.info("GPS: %d of %d positions used, residual %.2g m", located.used, len(positions), located.residual)
        place = Place(
            world_from_model=located.world_from_model,
            metric=True,
            scale_from="GPS",
            scale_error=located.scale_error,
            origin=located.origin,
            gps_residual=located.residual,
        )
    if params.marker_size is not None:
        found = measure_markers(cameras, markers, params.marker_size)
        if found is None:
            seen, kind = sum(bool(each) for each in markers), params.marker_dictionary
            raise InputError(
                f"No marker could be measured: {seen} of {len(cameras)} photos show any of {kind}, and two "
                " that see the same marker from different sides are needed.",
                "Check `undistort.marker_dictionary`, or leave markers out: `--set undistort.marker_size=null`.",
            )
        factor = found.factor / place.world_from_model.scale
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
    centers = place.world_from_model.apply(cameras.centers)
    middle = np.median(centers, axis=0)
    return place.near(middle, float(np.median(np.linalg.norm(centers - middle, axis=1)))), located


def _compare(factor: float, error: float, this: str, other: str) -> None:
    """Warn where two sources of scale do not agree within their errors (and a percent)."""
    if abs(factor - 1) > 3 * error + 0.01:
        log.warning("%s and %s disagree on the scale by %.1f %%; the first is used", this, other, 100 * (factor - 1))


# ---------------------------------------------------------------- region, ground, up
def _stated_region(known: dict[str, Any], place: Place) -> RegionOfInterest | None:
    """The sphere that the given poses say the object is in, in the world frame."""
    region, world_from_model = known["region"], place.world_from_model
    if region is None:
        return None
    center = world_from_model.apply(np.array(region["center"]))
    return RegionOfInterest(center, world_from_model.scale * region["radius"], "object", region["source"])


def _find_region(
    cameras: PinholeCameras,
    points: np.ndarray,
    masks: Sequence[np.ndarray | None],
    stated: RegionOfInterest | None,
    located: Located | None,
    params: Any,
) -> tuple[RegionOfInterest, Plane | None, Up]:
    """Region, ground and up in the world frame, that of the cameras and points [P, 3]."""
    held = estimate_up(cameras)
    try:
        region = find_region(cameras, points, masks, stated)
    except ValueError as error:
        raise ReconstructionError(
            f"No region of interest found from {len(cameras)} cameras and {len(points)} points ({error}).",
            "Photograph the object from more sides, try `--set sfm.matcher=exhaustive`, or say where it is: "
            "`--set 'undistort.region=sphere X Y Z RADIUS'`.",
        ) from error
    ground = find_ground(points, cameras.centers, held.direction, region.center, region.radius)
    region = grown_alone(region, points, ground)
    form, numbers = read_region(params.region)
    if form != "auto":
        region = given_region(form, numbers, region.kind)
        _check_seen(region, cameras, params.region)
    else:
        region = replace(region, radius=region.radius * params.roi_scale)
    if params.up != "auto":
        direction = np.eye(3)["xyz".index(params.up[1])] * (1.0 if params.up[0] == "+" else -1.0)
        return region, ground, Up(direction, "the settings")
    normal = None if ground is None else ground.normal
    if located is None:
        return region, ground, choose_up(held, normal, None, 0.0)
    return region, ground, choose_up(held, normal, np.array([0.0, 0.0, 1.0]), located.tilt_error_deg)


def _check_seen(region: RegionOfInterest, cameras: PinholeCameras, text: str) -> None:
    """Raises ConfigError where fewer than two cameras see the given region."""
    places = region.center + region.radius * np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)])
    seen = sum(bool(cameras.in_frame(i, places).any()) for i in range(len(cameras)))
    if seen < MIN_SEEING:
        middle = " ".join(f"{value:.4g}" for value in np.median(cameras.centers, axis=0))
        raise ConfigError(
            f"`undistort.region` = {text} is seen by {seen} of {len(cameras)} cameras (need {MIN_SEEING}).",
            f"It is in the coordinates of the exported PLY, where the cameras stand about {middle}; "
            "`--set undistort.region=auto` finds it by itself.",
        )


UNDISTORT = Stage(
    name="undistort",
    version=4,
    needs=("ingest", "sfm"),
    params="undistort",
    run=run,
    summary="make pinhole images and find the region of interest",
)
