"""Poses in the layout of NeRO's GlossySynthetic: per image `7.png`, `7-camera.pkl` and `7-depth.png`.

A camera is a pickled pair: cam_from_world [3, 4] with OpenCV axes, and intrinsics [3, 3] of Blender (the corner of the
image is (0, 0), as in COLMAP). The object lies in the unit sphere.
"""

from __future__ import annotations

import io
import pickle
import pickletools
from pathlib import Path
from typing import Any

import numpy as np

from stages.artifacts import KnownSphere
from stages.inputs.bounded import read_bytes
from stages.inputs.depth import DEPTH
from stages.posing.known import KnownPoses, pinhole, reading

CAMERA = "-camera.pkl"
MOST_PICKLE = 1 << 20  # bytes; a camera has 500


class _Kind:
    """Stands for the dtype of a pickled array."""

    def __init__(self, name: str, *_: Any) -> None:
        self.name, self.order = name, "="

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        self.order = state[1]

    def of(self, data: bytes) -> np.ndarray:
        kind = np.dtype(self.name)
        if kind.kind not in "biuf":
            raise pickle.UnpicklingError(f"it holds an array of {self.name}; numbers are needed")
        return np.frombuffer(data, kind.newbyteorder(">" if self.order == ">" else "<"))


class _Array:
    """Stands for a pickled array. NumPy's own would take memory for any shape, and believe any dtype."""

    def __init__(self, *_: Any) -> None:
        self.values = np.zeros(0)

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        _, shape, kind, by_columns, data = state
        self.values = kind.of(data).reshape(shape, order="F" if by_columns else "C")


def _frombuffer(data: bytes, kind: _Kind, shape: tuple[int, ...], order: str) -> _Array:
    array = _Array()
    array.__setstate__((1, shape, kind, order == "F", data))
    return array


def _encode(text: str, encoding: str) -> bytes:
    """Bytes as Python 2's protocols have them; other codecs make a little into much."""
    if encoding != "latin1":
        raise pickle.UnpicklingError(f"it holds a text in {encoding[:20]}")
    return text.encode(encoding)


# All that a pickled array needs.
STANDS_FOR: dict[tuple[str, str], Any] = {
    ("numpy", "ndarray"): _Array,
    ("numpy", "dtype"): _Kind,
    ("numpy._core.multiarray", "_reconstruct"): _Array,
    ("numpy._core.numeric", "_frombuffer"): _frombuffer,
    ("_codecs", "encode"): _encode,
}


class _ArraysOnly(pickle.Unpickler):
    """A pickle may name any function to call; this one takes arrays and plain values, and refuses the rest."""

    def find_class(self, module: str, name: str) -> Any:
        module = module.replace("numpy.core.", "numpy._core.")  # as NumPy 1 writes it
        if (module, name) not in STANDS_FOR:
            raise pickle.UnpicklingError(f"it holds {module[:40]}.{name[:40]}; only arrays are taken")
        return STANDS_FOR[module, name]


def _unpickled(file: Path) -> Any:
    """What a pickle holds, with `_Array` for arrays."""
    data = read_bytes(file, MOST_PICKLE)
    for code, value, _ in pickletools.genops(data):  # raises where the data end before
        if "PUT" in code.name and int(value or 0) > len(data):
            raise pickle.UnpicklingError(f"it numbers {value} values in {len(data)} bytes")
    return _ArraysOnly(io.BytesIO(data)).load()


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
    with reading(f"The split {file}", "NeRO's configs/synthetic_split_128.pkl"):
        stems = list(_unpickled(file)[0])
        if not all(isinstance(stem, str | int) for stem in stems):
            raise ValueError("names are needed")
        return [str(stem) for stem in stems]


def _load(file: Path) -> tuple[np.ndarray, np.ndarray]:
    """Pose [3, 4] and intrinsics [3, 3]."""
    with reading(f"The camera {file}", "a pose and intrinsics"):
        found = _unpickled(file)
        if not isinstance(found, list | tuple) or not all(isinstance(each, _Array) for each in found[:2]):
            raise ValueError("it holds no arrays")
        pose, intrinsics = (array.values.astype(np.float64) for array in found[:2])
        if pose.shape not in ((3, 4), (4, 4)) or intrinsics.shape != (3, 3):
            raise ValueError(f"it holds arrays {pose.shape} and {intrinsics.shape}, expected (3, 4) and (3, 3)")
    return pose[:3], intrinsics
