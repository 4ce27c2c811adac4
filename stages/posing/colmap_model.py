"""COLMAP models: the poses of those that are given (cameras, images and points3D, as .bin or .txt), and new ones."""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from stages.artifacts import WORLD_PLACE
from stages.geometry.cameras import PinholeCameras
from stages.inputs.bounded import read_bytes
from stages.inputs.texts import read_text
from stages.posing.known import KnownCamera, KnownPoses, reading

# Where models lie in a project of COLMAP, in a data set and in a workspace of ours.
MOST_BYTES = 1 << 34  # of a model's file; of 100 000 photos with 5000 features each they have 12 GB
PLACES = ("", "sparse/0", "sparse", "colmap/sparse/0", "sfm/model", "model", "0")


_Lens = tuple[str, tuple[int, int], tuple[float, ...]]  # COLMAP's name of its model, size, parameters


def find_model(folder: Path) -> Path | None:
    """The folder of the model in `folder`, or None."""
    for place in PLACES:
        if any((folder / place / f"cameras{suffix}").is_file() for suffix in (".bin", ".txt")):
            return folder / place
    return None


def read_colmap(folder: Path) -> KnownPoses:
    """Cameras of all registered images.

    Raises:
        InputError: the model cannot be read.
    """
    with reading(f"The COLMAP model {folder}", "cameras, images and points3D, as .bin or as .txt"):
        read = _read_binary if (folder / "cameras.bin").is_file() else _read_text
        found = tuple(read(folder))
    is_part = (folder / WORLD_PLACE.files[0]).is_file()
    return KnownPoses(folder, found, place=WORLD_PLACE.load(folder) if is_part else None)


def pinhole_model(cameras: PinholeCameras, pixels: Sequence[np.ndarray]) -> Any:
    """A pycolmap model without points. Photo k is image k + 1; photos of the same intrinsics share a camera.

    Args:
        pixels: for each photo the places [p, 2] in it that tracks of points will refer to.
    """
    import pycolmap

    model = pycolmap.Reconstruction()
    camera_ids: dict[tuple[Any, ...], int] = {}
    for i, name in enumerate(cameras.names):
        (width, height), pose = cameras.sizes[i].tolist(), cameras.extrinsics[i]
        params = cameras.intrinsics[i][[0, 1, 0, 1], [0, 1, 2, 2]].tolist()
        key = (width, height, *params)
        if key not in camera_ids:
            camera_ids[key] = len(camera_ids) + 1
            model.add_camera_with_trivial_rig(
                pycolmap.Camera(model="PINHOLE", width=width, height=height, params=params, camera_id=camera_ids[key])
            )
        places = pycolmap.Point2DList([pycolmap.Point2D(xy) for xy in pixels[i]])
        model.add_image_with_trivial_frame(
            pycolmap.Image(name, places, camera_ids[key], i + 1),
            pycolmap.Rigid3d(pycolmap.Rotation3d(pose[:, :3]), pose[:, 3]),
        )
    return model


def _read_binary(folder: Path) -> Iterator[KnownCamera]:
    """COLMAP's own reader takes memory for as many points as a file says that it has, and reads all of them."""
    import pycolmap

    cameras: dict[int, _Lens] = {}
    reader = _Reader(folder / "cameras.bin")
    for _ in range(reader.take("Q")[0]):
        number, model, width, height = reader.take("IiQQ")
        lens = pycolmap.Camera(model=pycolmap.CameraModelId(model), width=1, height=1, params=[])
        count = len(lens.params_info.split(","))
        cameras[number] = (lens.model_name, (width, height), reader.take(f"{count}d"))
    reader, found = _Reader(folder / "images.bin"), []
    for _ in range(reader.take("Q")[0]):
        number, *pose, camera = reader.take("I7dI")
        name = reader.text()
        reader.skip(24 * reader.take("Q")[0])  # its features
        found.append((number, _known(name, cameras[camera], pose)))
    yield from (camera for _, camera in sorted(found, key=lambda each: each[0]))


class _Reader:
    """Takes little-endian numbers and names of a file, one after another, and no more than there are."""

    def __init__(self, file: Path) -> None:
        self._data = read_bytes(file, MOST_BYTES)
        self._at = 0

    def take(self, kinds: str) -> tuple[Any, ...]:
        start = self._at
        self.skip(struct.calcsize(f"<{kinds}"))
        return struct.unpack_from(f"<{kinds}", self._data, start)

    def text(self) -> str:
        """Up to the next zero, which must be there."""
        start, self._at = self._at, self._data.index(b"\0", self._at) + 1
        return self._data[start : self._at - 1].decode("utf-8", "surrogateescape")

    def skip(self, count: int) -> None:
        """
        Raises:
            ValueError: the file ends before.
        """
        if count > len(self._data) - self._at:
            raise ValueError(f"it says that {count} bytes follow, there are {len(self._data) - self._at}")
        self._at += count


def _read_text(folder: Path) -> Iterator[KnownCamera]:
    """COLMAP's own reader cuts names at blanks, and knows neither byte-order marks nor encodings."""
    cameras: dict[str, _Lens] = {}
    for line in _lines(folder / "cameras.txt"):
        number, model, width, height, *params = line.split()
        cameras[number] = (model, (int(width), int(height)), tuple(float(value) for value in params))
    for line in _lines(folder / "images.txt", every=2):
        _, *pose, camera, name = line.split(maxsplit=9)
        yield _known(name.rstrip(), cameras[camera], [float(value) for value in pose])


def _lines(file: Path, every: int = 1) -> Iterator[str]:
    """Lines that are neither empty nor comments; of these the first of `every` so many lines, whatever the others are.

    An image's second line has its points, and is empty where there are none.
    """
    lines = iter(read_text(file).split("\n"))
    for line in lines:
        if line.strip() and not line.startswith("#"):
            yield line
            for _ in range(every - 1):
                next(lines, None)


def _known(name: str, lens: _Lens, pose: Sequence[float]) -> KnownCamera:
    """Of a quaternion (w, x, y, z; its length is free, but for zero) and a translation."""
    from scipy.spatial.transform import Rotation

    w, x, y, z, *translation = pose
    rotation = Rotation.from_quat([x, y, z, w]).as_matrix()
    model, size, params = lens
    return KnownCamera(name, size, model, params, np.column_stack([rotation, translation]))
