"""Poses in `transforms.json`: nerfstudio, instant-ngp, Blender (NeRF-synthetic).

A frame's `transform_matrix` is world_from_camera with OpenGL axes (x right, y up, z backward). Intrinsics stand in the
frame or for all of them: fl_x, fl_y, cx, cy, w, h, k1.. p1, p2 and camera_model, or only camera_angle_x.
"""

from __future__ import annotations

import math
import os
import reprlib
from collections.abc import Iterable, Mapping
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from stages.artifacts import KnownSphere
from stages.errors import InputError
from stages.inputs.texts import read_json
from stages.posing.known import SUFFIX, KnownCamera, KnownPoses, check_masks, image_size, nearest_rotation, reading

FILES = ("transforms.json", "transforms_train.json")
SUFFIXES = (".png", ".jpg", ".jpeg", ".PNG", ".JPG", ".JPEG", ".webp")
# NeRF-synthetic's objects lie in the box +-1.5 of the world, as its papers take for granted.
SYNTHETIC_RADIUS = 1.5
OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0])
DISTORTIONS = {
    "PINHOLE": (),
    "OPENCV": ("k1", "k2", "p1", "p2"),
    "FULL_OPENCV": ("k1", "k2", "p1", "p2", "k3"),
    "OPENCV_FISHEYE": ("k1", "k2", "k3", "k4"),
}
# COLMAP's FULL_OPENCV divides by a polynomial in three more, which these files do not have.
DENOMINATOR = (0.0, 0.0, 0.0)


def read_transforms(file: Path) -> KnownPoses:
    """Cameras of all frames. The world is that before `applied_transform`, where there is one.

    Raises:
        InputError: the file cannot be read or lacks something; the sentence names the frame and what it lacks.
    """
    data = _load(file)
    original_from_data = _original_from_data(data, file)
    frames = sorted(data["frames"], key=lambda frame: frame["file_path"])
    cameras = tuple(_camera({**data, **frame}, original_from_data, file) for frame in frames)
    region = None
    if "camera_angle_x" in data and not {"fl_x", "aabb_scale", "applied_transform"} & set(data):
        region = KnownSphere(center=np.zeros(3), radius=SYNTHETIC_RADIUS, source="the box of NeRF-synthetic")
    return KnownPoses(file, cameras, region, masks_of(data["frames"], file))


def masks_of(frames: Iterable[Mapping[str, Any]], file: Path) -> dict[str, Path]:
    """Frame's name -> file of its mask, of frames with a `mask_path`; relative ones are so to the folder of `file`.

    Raises:
        InputError: a `mask_path` is no text.
    """
    masks = {}
    for frame in frames:
        name, said = _name(frame), frame.get("mask_path")
        if said is not None and not isinstance(said, str):
            raise InputError(
                f"`mask_path` of {name} in {file} is {reprlib.repr(said)}, expected a path.", "Mend or remove it."
            )
        if said:
            masks[name] = file.parent / said.replace("\\", "/")
    return masks


def masks_folder(file: Path) -> Path | None:
    """The folder that holds all masks that `file` names; None where it names none.

    Raises:
        InputError: the file cannot be read, or one of its masks is not there.
    """
    masks = masks_of(_load(file)["frames"], file)
    if not masks:
        return None
    check_masks(masks, file)
    return Path(os.path.commonpath([mask.resolve().parent for mask in masks.values()]))


def _name(frame: Mapping[str, Any]) -> str:
    return PurePosixPath(frame["file_path"].replace("\\", "/")).as_posix()


def _load(file: Path) -> dict[str, Any]:
    with reading(str(file), "the JSON of nerfstudio or Blender"):
        data = read_json(file)
    frames = data.get("frames") if isinstance(data, dict) else None
    if not isinstance(frames, list) or not frames:
        raise InputError(f"{file} has no `frames`.", "It needs the JSON of nerfstudio or Blender.")
    for i, frame in enumerate(frames):
        if not isinstance(frame, dict) or not isinstance(frame.get("file_path"), str) or not frame["file_path"]:
            raise InputError(f"Frame {i} of {file} has no `file_path`.", "It names the frame's image.")
    return data


def _original_from_data(data: Mapping[str, Any], file: Path) -> tuple[float, np.ndarray, np.ndarray]:
    """Scale, rotation [3, 3] and translation [3] that undo `applied_transform` and `applied_scale`."""
    applied = _array(data.get("applied_transform", np.eye(4)[:3]), "applied_transform", file)
    scale = float(np.cbrt(np.linalg.det(applied[:3, :3]))) if applied.shape in ((3, 4), (4, 4)) else 0.0
    if scale <= 0:
        raise InputError(
            f"`applied_transform` in {file} is no rotation with a scale and a shift.", "Remove it, if it is wrong."
        )
    rotation = nearest_rotation(applied[:3, :3] / scale, "applied_transform", file)
    factor = _array(data.get("applied_scale", 1.0), "applied_scale", file)
    if factor.shape != () or factor <= 0:
        raise InputError(f"`applied_scale` in {file} is no number above 0.", "Remove it, if it is wrong.")
    scale, shift = scale * float(factor), applied[:3, 3] * float(factor)
    return 1 / scale, rotation.T, -(rotation.T @ shift) / scale


def _camera(
    frame: Mapping[str, Any], original_from_data: tuple[float, np.ndarray, np.ndarray], file: Path
) -> KnownCamera:
    """The camera of a frame, in which stands what is said of all of them, too."""
    name = _name(frame)
    matrix = _array(frame.get("transform_matrix"), f"transform_matrix of {name}", file)
    if matrix.shape not in ((4, 4), (3, 4)):
        raise InputError(f"`transform_matrix` of {name} in {file} is {matrix.shape}, expected (4, 4).", "Mend it.")
    scale, turn, shift = original_from_data
    world_from_cam = turn @ nearest_rotation(matrix[:3, :3], name, file) @ OPENCV_FROM_OPENGL
    center = scale * turn @ matrix[:3, 3] + shift
    rotation = world_from_cam.T
    size, model, params = _intrinsics(frame, name, file)
    return KnownCamera(name, size, model, params, np.concatenate([rotation, -(rotation @ center)[:, None]], 1))


def _intrinsics(frame: Mapping[str, Any], name: str, file: Path) -> tuple[tuple[int, int], str, tuple[float, ...]]:
    """Size, COLMAP's model and its parameters."""

    def value(key: str) -> float | None:
        found = frame.get(key)
        if found is None:
            return None
        if isinstance(found, bool) or not isinstance(found, (int, float)):
            raise InputError(f"`{key}` of {name} in {file} is {reprlib.repr(found)}, expected a number.", "Mend it.")
        return float(found)

    width, height = value("w"), value("h")
    size = (round(width), round(height)) if width and height else image_size(_image(file.parent / name), file)
    focal_x, focal_y = value("fl_x"), value("fl_y")
    angle_x, angle_y = value("camera_angle_x"), value("camera_angle_y")
    for angle in (angle_x, angle_y):
        if angle is not None and not 0 < angle < math.pi:
            raise InputError(f"An angle of view of {name} in {file} is {angle:g}.", "It lies between 0 and pi.")
    if focal_x is None and angle_x is not None:
        focal_x = 0.5 * size[0] / math.tan(0.5 * angle_x)
        if focal_y is None and angle_y is not None:
            focal_y = 0.5 * size[1] / math.tan(0.5 * angle_y)
    if focal_x is None or focal_x <= 0:
        raise InputError(f"{file} gives {name} no focal length.", "It needs `fl_x` or `camera_angle_x`.")
    center_x, center_y = value("cx"), value("cy")
    params: tuple[float, ...] = (
        focal_x,
        focal_x if focal_y is None else focal_y,
        size[0] / 2 if center_x is None else center_x,
        size[1] / 2 if center_y is None else center_y,
    )
    distortion = {key: value(key) or 0.0 for key in ("k1", "k2", "k3", "k4", "p1", "p2")}
    model = _model(frame, distortion, name, file)
    params += tuple(distortion[key] for key in DISTORTIONS[model])
    return size, model, params + DENOMINATOR if model == "FULL_OPENCV" else params


def _model(frame: Mapping[str, Any], distortion: Mapping[str, float], name: str, file: Path) -> str:
    """COLMAP's name of the camera model."""
    said = str(frame.get("camera_model", "OPENCV_FISHEYE" if frame.get("is_fisheye") else "OPENCV"))
    if said == "OPENCV_FISHEYE":
        return said
    if said in ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL") and not distortion["k4"]:
        if distortion["k3"]:
            return "FULL_OPENCV"
        return "OPENCV" if any(distortion.values()) else "PINHOLE"
    raise InputError(
        f"The camera model {said} of {name} in {file} is not supported{' with k4' if distortion['k4'] else ''}.",
        "PINHOLE, OPENCV (k1, k2, k3, p1, p2) and OPENCV_FISHEYE are; undistort the images of others first.",
    )


def _image(path: Path) -> Path:
    """The image, whose suffix may be missing."""
    if SUFFIX.search(path.name):
        return path
    return next((found for suffix in SUFFIXES if (found := path.with_name(path.name + suffix)).is_file()), path)


def _array(value: Any, what: str, file: Path) -> np.ndarray:
    try:
        array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        array = np.array(np.nan)
    if isinstance(value, str) or not np.isfinite(array).all():
        raise InputError(f"`{what}` in {file} is no matrix of numbers.", "Mend it.")
    return array
