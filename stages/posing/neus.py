"""Poses in the layout of NeuS and IDR (DTU, BlendedMVS): `cameras_sphere.npz` beside `image/` and `mask/`.

`world_mat_i` [4, 4] projects world points to pixels of the i-th image by name; `scale_mat_i` [4, 4] takes the unit
sphere to the sphere of the world that holds the object.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from stages.artifacts import KnownSphere
from stages.errors import InputError
from stages.inputs.bounded import read_arrays
from stages.posing.known import KnownCamera, KnownPoses, image_size, reading

FILES = ("cameras_sphere.npz", "cameras.npz")
IMAGES, MASKS = "image", "mask"
IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg")
# These matrices count pixel centres at whole numbers, COLMAP at halves. That is by definition, not by measurement: on
# DTU's scan 24 at half size, where it would leave 0.25 px, triangulated points fit best with (-0.12, 0.13) +- 0.03, and
# parts of the circle alone with up to 1 px; from 0 to 0.5 px the mean reprojection error goes from 0.485 to 0.493 px.
PIXEL_SHIFT = 0.5
# COLMAP's cameras have no skew; more than this many pixels across the image would show.
MAX_SKEW_PX = 0.5


def read_neus(file: Path) -> KnownPoses:
    """Cameras of the images in `image/` beside `file`, in the order of their names.

    Raises:
        InputError: the file or the images cannot be read, or their numbers differ.
    """
    names, masks = _files(file.parent / IMAGES), _files(file.parent / MASKS)
    matrices = _load(file)
    count = sum(key.startswith("world_mat_") and "inv" not in key for key in matrices)
    if count != len(names):
        raise InputError(
            f"{file} has {count} cameras, but {file.parent / IMAGES} has {len(names)} images.",
            f"The images of these cameras belong into the folder `{IMAGES}` beside {file.name}.",
        )
    cameras = []
    for i, name in enumerate(names):
        intrinsics, pose = decompose(_matrix(matrices, f"world_mat_{i}", file)[:3])
        size = image_size(file.parent / name, file)
        if abs(intrinsics[0, 1]) * size[1] > MAX_SKEW_PX * intrinsics[1, 1]:
            raise InputError(
                f"world_mat_{i} in {file} has a skew of {intrinsics[0, 1]:.3g} px; COLMAP's cameras have none.",
                "Undistort and rectify these images first.",
            )
        params = (intrinsics[0, 0], intrinsics[1, 1], *(intrinsics[:2, 2] + PIXEL_SHIFT))
        cameras.append(KnownCamera(name, size, "PINHOLE", tuple(map(float, params)), pose))
    world_from_unit = _matrix(matrices, "scale_mat_0", file)
    radius = float(np.cbrt(abs(np.linalg.det(world_from_unit[:3, :3]))))
    region = KnownSphere(center=world_from_unit[:3, 3].copy(), radius=radius, source=f"scale_mat of {file.name}")
    paired = dict(zip(names, (file.parent / mask for mask in masks), strict=True)) if len(masks) == len(names) else {}
    return KnownPoses(file, tuple(cameras), region, paired)


def decompose(projection: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Intrinsics [3, 3] and pose [3, 4] (a rotation and a translation) of a projection [3, 4] of any scale."""
    import cv2

    # A negative scale would come out as negative focal lengths.
    projection = projection * np.sign(np.linalg.det(projection[:, :3]))
    intrinsics, rotation, center = cv2.decomposeProjectionMatrix(projection)[:3]
    center = center[:3] / center[3]
    return intrinsics / intrinsics[2, 2], np.concatenate([rotation, -rotation @ center], 1)


def _files(folder: Path) -> list[str]:
    """Names relative to the folder above of the images in `folder`, sorted."""
    if not folder.is_dir():
        return []
    return [
        f"{folder.name}/{path.name}"
        for path in sorted(folder.iterdir())
        if path.suffix.lower() in IMAGE_SUFFIXES and not path.name.startswith(".")
    ]


def _load(file: Path) -> dict[str, np.ndarray]:
    with reading(str(file), "world_mat_i and scale_mat_i"):
        return read_arrays(file)


def _matrix(matrices: dict[str, np.ndarray], key: str, file: Path) -> np.ndarray:
    matrix = matrices.get(key)
    if matrix is None or matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        found = "missing" if matrix is None else f"{matrix.shape}, or not finite"
        raise InputError(f"{key} in {file} is no 4 x 4 matrix ({found}).", "It needs world_mat_i and scale_mat_i.")
    return matrix
