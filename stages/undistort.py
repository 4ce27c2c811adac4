"""Undistort: poses + photos -> pinhole images, masks warped by the same maps, the normalised scene."""

from __future__ import annotations

import logging
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache
from pathlib import PurePosixPath
from typing import Any

import numpy as np

from stages import artifacts
from stages.engine.stage import Stage, StageContext
from stages.errors import ReconstructionError
from stages.geometry import normalisation
from stages.geometry.cameras import PinholeCameras, PosedScene

log = logging.getLogger(__name__)

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

    def warp(job: tuple[str, str, int]) -> np.ndarray | None:
        """Writes one image (and its mask) and returns the mask."""
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
        return mask

    before = cv2.getNumThreads()
    cv2.setNumThreads(1)  # the pool below is the parallelism
    try:
        with ThreadPoolExecutor(max_workers=max(1, context.workers)) as pool:
            jobs = [(photo.name, name, photo.camera_id) for photo, name in zip(photos, names, strict=True)]
            masks = list(pool.map(warp, jobs))
    finally:
        cv2.setNumThreads(before)

    world_cameras = PinholeCameras(
        names=tuple(names),
        sizes=np.array([warps[photo.camera_id].size for photo in photos], dtype=np.int64),
        intrinsics=np.stack([warps[photo.camera_id].intrinsics for photo in photos]),
        cam_from_scene=np.stack([photo.cam_from_world().matrix() for photo in photos]),
    )
    points, errors, observations = _sparse_points(model, photos)
    scene, region = _normalise(world_cameras, points, errors, observations, masks, params)
    artifacts.save_scene(context.out, scene)
    context.progress(len(photos) + 1, len(photos) + 1, "done")

    inside = np.linalg.norm(scene.points, axis=1) < 1
    return {
        "images": len(photos),
        "width": int(scene.cameras.sizes[:, 0].max()),
        "height": int(scene.cameras.sizes[:, 1].max()),
        "masks": sum(mask is not None for mask in masks),
        "kind": scene.kind,
        "region_from": region.source,
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


def _normalise(
    cameras: PinholeCameras,
    points: np.ndarray,
    errors: np.ndarray,
    observations: np.ndarray,
    masks: list[np.ndarray | None],
    params: Any,
) -> tuple[PosedScene, normalisation.RegionOfInterest]:
    try:
        region = normalisation.find_region(cameras, points, masks)
    except ValueError as error:
        raise ReconstructionError(
            f"No region of interest found from {len(cameras)} cameras and {len(points)} points ({error}).",
            "Photograph the object from more sides, or try `--set sfm.matcher=exhaustive`.",
        ) from error
    if params.up == "auto":
        up = normalisation.estimate_up(cameras)
    else:
        up = np.eye(3)["xyz".index(params.up[1])] * (1.0 if params.up[0] == "+" else -1.0)
    world_from_scene = normalisation.scene_frame(region.center, region.radius * params.roi_scale, up)
    scene = PosedScene(
        cameras=normalisation.into_scene(cameras, world_from_scene),
        world_from_scene=world_from_scene,
        points=world_from_scene.inverse().apply(points).astype(np.float32),
        point_errors=errors,
        observations=observations,
        up=np.array([0.0, 0.0, 1.0]),
        kind=region.kind,
    )
    return scene, region


UNDISTORT = Stage(
    name="undistort",
    version=1,
    needs=("ingest", "sfm"),
    params="undistort",
    run=run,
    summary="make pinhole images and find the region of interest",
)
