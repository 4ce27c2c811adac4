"""Poses in the layout of Mega-NeRF, whose authors refined those of UrbanScene3D: `train/metadata/000000.pt` beside
`train/rgbs/000000.jpg`, and the same under `val`.

A camera's file is torch's: W, H, intrinsics (fx, fy, cx, cy), and c2w [3, 4], world_from_camera with OpenGL axes.
"""

from __future__ import annotations

import io
import pickle
import zipfile
from pathlib import Path

import numpy as np

from stages.inputs.bounded import MOST_ARRAYS, check_unpacked, read_bytes
from stages.posing.known import KnownCamera, KnownPoses, nearest_rotation, reading
from stages.posing.transforms import OPENCV_FROM_OPENGL

METADATA, IMAGES = "metadata", "rgbs"


def has_metadata(folder: Path) -> bool:
    return next((folder / METADATA).glob("*.pt"), None) is not None


def read_meganerf(folder: Path) -> KnownPoses:
    """Cameras of one part of the scene, `train` or `val`. Names have no suffix.

    Raises:
        InputError: a camera cannot be read.
    """
    cameras = []
    for file in sorted((folder / METADATA).glob("*.pt")):
        data = _load(file)
        world_from_cam = nearest_rotation(data["c2w"][:, :3], file.stem, file) @ OPENCV_FROM_OPENGL
        translation = -(world_from_cam.T @ data["c2w"][:, 3:])
        cameras.append(
            KnownCamera(
                name=f"{IMAGES}/{file.stem}",
                size=(int(data["W"]), int(data["H"])),
                model="PINHOLE",
                params=tuple(data["intrinsics"].tolist()),
                cam_from_world=np.concatenate([world_from_cam.T, translation], 1),
            )
        )
    return KnownPoses(folder, tuple(cameras))


def _load(file: Path) -> dict[str, np.ndarray]:
    import torch

    with reading(f"The camera {file}", "W, H, intrinsics and c2w, as Mega-NeRF writes them"):
        stored = io.BytesIO(read_bytes(file, MOST_ARRAYS))
        with zipfile.ZipFile(stored) as archive:  # what PyTorch wrote before version 1.6 is not
            check_unpacked(archive)
        stored.seek(0)
        try:
            data = torch.load(stored, map_location="cpu", weights_only=True)
        except pickle.UnpicklingError as error:  # whose words advise to load it all the same
            raise ValueError("it holds more than tensors and plain values") from error
        shapes = {key: tuple(data[key].shape) for key in ("c2w", "intrinsics")}
        if shapes != {"c2w": (3, 4), "intrinsics": (4,)}:
            raise ValueError(
                f"it holds c2w {shapes['c2w']} and intrinsics {shapes['intrinsics']}, expected (3, 4) and (4,)"
            )
        arrays = {key: data[key] if key in shapes else int(data[key]) for key in ("W", "H", "intrinsics", "c2w")}
        return {key: np.asarray(value, dtype=np.float64) for key, value in arrays.items()}
