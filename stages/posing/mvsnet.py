"""Poses in the layout of MVSNet, which BlendedMVS has: `cams/00000000_cam.txt` beside `blended_images/`.

A camera's file holds the word `extrinsic` and cam_from_world [4, 4] with OpenCV axes, then `intrinsic` and [3, 3], then
a line of depths, which is not used.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from stages.errors import InputError
from stages.inputs.texts import read_text
from stages.posing.known import KnownPoses, pinhole, reading

CAMERA = "_cam.txt"
CAMERAS = "cams"
IMAGES = ("blended_images", "images", "image")
SUFFIXES = (".jpg", ".png")


def find_cameras(folder: Path) -> Path | None:
    """The folder of the cameras: `folder` or `cams` in it; None where neither has any."""
    for place in (folder, folder / CAMERAS):
        if next(place.glob(f"*{CAMERA}"), None) is not None:
            return place
    return None


def read_mvsnet(folder: Path) -> KnownPoses:
    """Cameras in `folder` of the images in the folder beside it; those without an image are left out.

    Raises:
        InputError: a camera or its image cannot be read.
    """
    images = next((folder.parent / name for name in IMAGES if (folder.parent / name).is_dir()), None)
    if images is None:
        raise InputError(
            f"There are no images beside {folder}.", f"They belong into {folder.parent / IMAGES[0]}, as published."
        )
    cameras = []
    for file in sorted(folder.glob(f"*{CAMERA}")):
        stem = file.name.removesuffix(CAMERA)
        image = next((found for suffix in SUFFIXES if (found := images / f"{stem}{suffix}").is_file()), None)
        if image is None:
            continue
        pose, intrinsics = _load(file)
        cameras.append(pinhole(image.name, image, intrinsics, pose[:3], file))
    return KnownPoses(folder, tuple(cameras))


def _load(file: Path) -> tuple[np.ndarray, np.ndarray]:
    """Pose [4, 4] and intrinsics [3, 3]."""
    with reading(f"The camera {file}", "`extrinsic` and 16 numbers, `intrinsic` and 9"):
        words = read_text(file).split()
        start = words.index("extrinsic") + 1, words.index("intrinsic") + 1
        pose, intrinsics = (
            np.array(words[first : first + side * side], dtype=np.float64).reshape(side, side)
            for first, side in zip(start, (4, 3), strict=True)
        )
    return pose, intrinsics
