"""Photos and masks as a pinhole camera would have taken them, and the cameras of a COLMAP model as such."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import PurePosixPath
from typing import Any

import numpy as np

from stages.geometry.cameras import PinholeCameras


@dataclass(frozen=True)
class Warp:
    """How images of one camera become pinhole images.

    Attributes:
        intrinsics: [3, 3] of the pinhole images.
        size: width, height of the pinhole images.
        shrink_to: width, height the photo is first reduced to (area filter), or None.
    """

    intrinsics: np.ndarray
    size: tuple[int, int]
    shrink_to: tuple[int, int] | None


def plan_warp(camera: Any, max_side: int | None = None) -> Warp:
    """The pinhole camera that shows only valid pixels of a COLMAP camera, at most `max_side` pixels along a side."""
    import pycolmap

    options = pycolmap.UndistortCameraOptions()
    options.blank_pixels = 0.0  # crop until no pixel comes from outside the photo
    pinhole = pycolmap.undistort_camera(options, camera)
    scale = min(1.0, max_side / max(pinhole.width, pinhole.height)) if max_side else 1.0
    width, height = max(1, round(pinhole.width * scale)), max(1, round(pinhole.height * scale))
    intrinsics = np.array(pinhole.calibration_matrix())
    intrinsics[0] *= width / pinhole.width
    intrinsics[1] *= height / pinhole.height
    shrink_to = None
    if scale < 1:
        shrink_to = max(1, round(camera.width * scale)), max(1, round(camera.height * scale))
    return Warp(intrinsics, (width, height), shrink_to)


def pinhole_photo(
    camera: Any, pixels: np.ndarray, mask: np.ndarray | None, max_side: int
) -> tuple[np.ndarray, np.ndarray | None]:
    """One photo [H, W, 3] and its mask [H, W] uint8 as images of `pinhole_camera`, the way the stage makes them."""
    import cv2

    warp = plan_warp(camera, max_side)
    maps = warp_maps(camera, warp)
    return warp_image(pixels, warp, maps, cv2.INTER_CUBIC), None if mask is None else warp_mask(mask, warp, maps, 0)


def pinhole_camera(camera: Any, max_side: int) -> tuple[np.ndarray, tuple[int, int]]:
    """Intrinsics [3, 3] and size of the pinhole images of a pycolmap camera."""
    warp = plan_warp(camera, max_side)
    return warp.intrinsics, warp.size


def warp_maps(camera: Any, warp: Warp) -> tuple[np.ndarray, np.ndarray]:
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


def warp_image(pixels: np.ndarray, warp: Warp, maps: tuple[np.ndarray, np.ndarray], interpolation: int) -> np.ndarray:
    import cv2

    if warp.shrink_to is not None:
        pixels = cv2.resize(pixels, warp.shrink_to, interpolation=cv2.INTER_AREA)
    # the outermost pixel centres may fall half a pixel outside the photo's own: repeat its border
    return cv2.remap(pixels, *maps, interpolation, borderMode=cv2.BORDER_REPLICATE)


def warp_mask(mask: np.ndarray, warp: Warp, maps: tuple[np.ndarray, np.ndarray], erode: int) -> np.ndarray:
    """[H, W] uint8, 255 on the object, shrunk by `erode` pixels (not at the image's border)."""
    import cv2

    mask = np.where(warp_image(mask, warp, maps, cv2.INTER_LINEAR) > 127, 255, 0).astype(np.uint8)
    if erode:
        kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * erode + 1, 2 * erode + 1))
        mask = cv2.erode(mask, kernel)
    return mask


def png_names(names: list[str]) -> list[str]:
    """The names with .png as suffix; the whole name is kept where two would become one."""
    plain = [PurePosixPath(name).with_suffix(".png").as_posix() for name in names]
    # case-insensitive file systems must not merge two images
    counts = Counter(short.lower() for short in plain)
    mixed = [s if counts[s.lower()] == 1 else f"{name}.png" for name, s in zip(names, plain, strict=True)]
    return mixed if len({name.lower() for name in mixed}) == len(names) else [f"{name}.png" for name in names]


def registered_photos(model: Any) -> list[Any]:
    """The images of a pycolmap model that have a pose, by name."""
    return sorted((model.images[i] for i in model.reg_image_ids()), key=lambda image: image.name)


def posed_cameras(photos: Sequence[Any], names: Sequence[str], warps: Mapping[int, Warp]) -> PinholeCameras:
    """Pinhole cameras of these images of a pycolmap model, in the frame of its poses.

    Args:
        names: one for each image. warps: by number of the camera.
    """
    return PinholeCameras(
        names=tuple(names),
        sizes=np.array([warps[photo.camera_id].size for photo in photos], dtype=np.int64),
        intrinsics=np.stack([warps[photo.camera_id].intrinsics for photo in photos]),
        extrinsics=np.stack([photo.cam_from_world().matrix() for photo in photos]),
    )


def seen_places(photo: Any) -> tuple[np.ndarray, np.ndarray]:
    """Ids [K] of the sparse points that an image of a pycolmap model shows, and where: [K, 2] pixels of its camera."""
    shown = [place for place in photo.points2D if place.has_point3D()]
    ids = np.array([place.point3D_id for place in shown], dtype=np.int64)
    return ids, np.array([place.xy for place in shown], dtype=np.float64).reshape(-1, 2)


def sparse_points(model: Any, photos: Sequence[Any]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points [P, 3] in the frame of the poses, errors [P], observations [M, 2] (image index, point index)."""
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
