"""Poses in the layout of NeRO's GlossySynthetic: per image `7.png`, `7-camera.pkl` and `7-depth.png`.

A camera is a pickled pair: cam_from_world [3, 4] with OpenCV axes, and intrinsics [3, 3] of Blender (the corner of the
image is (0, 0), as in COLMAP). The object lies in the unit sphere.
"""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

import numpy as np

from stages.artifacts import KnownSphere
from stages.inputs.depth import DEPTH
from stages.posing.known import KnownPoses, pinhole, reading

CAMERA = "-camera.pkl"
# All that a pickled array needs.
ALLOWED = {
    ("numpy", "ndarray"),
    ("numpy", "dtype"),
    ("numpy._core.multiarray", "_reconstruct"),
    ("numpy._core.multiarray", "scalar"),
    ("numpy._core.numeric", "_frombuffer"),
    ("_codecs", "encode"),
}


class _ArraysOnly(pickle.Unpickler):
    """A pickle may name any function to call; this one takes arrays and plain values, and refuses the rest."""

    def find_class(self, module: str, name: str) -> Any:
        module = module.replace("numpy.core.", "numpy._core.")  # as NumPy 1 writes it
        if (module, name) not in ALLOWED:
            raise pickle.UnpicklingError(f"it holds {module}.{name}; only arrays are taken")
        return super().find_class(module, name)


def has_cameras(folder: Path) -> bool:
    return next(folder.glob(f"*{CAMERA}"), None) is not None


def read_nero(folder: Path) -> KnownPoses:
    """Cameras of all images in `folder` that have one.

    Raises:
        InputError: a camera cannot be read.
    """
    cameras, masks = [], {}
    for file in sorted(folder.glob(f"*{CAMERA}"), key=lambda path: (len(path.name), path.name)):
        stem = file.name.removesuffix(CAMERA)
        name = f"{stem}.png"
        pose, intrinsics = _load(file)
        cameras.append(pinhole(name, folder / name, intrinsics, pose, file))
        if (folder / f"{stem}{DEPTH}").is_file():
            masks[name] = folder / f"{stem}{DEPTH}"
    region = KnownSphere(center=np.zeros(3), radius=1.0, source="the unit sphere of GlossySynthetic")
    return KnownPoses(folder, tuple(cameras), region, masks)


def read_split(file: Path) -> list[str]:
    """Stems of the test images of NeRO's `synthetic_split_128.pkl`: a pickled pair of lists, test and training.

    Raises:
        InputError: it cannot be read.
    """
    with reading(f"The split {file}", "NeRO's configs/synthetic_split_128.pkl"), file.open("rb") as stream:
        return [str(stem) for stem in _ArraysOnly(stream).load()[0]]


def _load(file: Path) -> tuple[np.ndarray, np.ndarray]:
    """Pose [3, 4] and intrinsics [3, 3]."""
    with reading(f"The camera {file}", "a pose and intrinsics"), file.open("rb") as stream:
        pose, intrinsics = (np.asarray(array, dtype=np.float64) for array in _ArraysOnly(stream).load()[:2])
        if pose.shape not in ((3, 4), (4, 4)) or intrinsics.shape != (3, 3):
            raise ValueError(f"it holds arrays {pose.shape} and {intrinsics.shape}, expected (3, 4) and (3, 3)")
    return pose[:3], intrinsics
