"""COLMAP models: the poses of those that are given (cameras, images and points3D, as .bin or .txt), and new ones."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from stages.geometry.cameras import PinholeCameras
from stages.inputs.texts import read_text
from stages.posing.known import KnownCamera, KnownPoses, reading

# Where models lie in a project of COLMAP, in a data set and in a workspace of ours.
PLACES = ("", "sparse/0", "sparse", "colmap/sparse/0", "sfm/model", "model", "0")


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
    return KnownPoses(folder, found)


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
    import pycolmap

    model = pycolmap.Reconstruction(str(folder))
    for image_id in sorted(model.reg_image_ids()):
        image = model.images[image_id]
        yield _known(image.name, model.cameras[image.camera_id], image.cam_from_world())


def _read_text(folder: Path) -> Iterator[KnownCamera]:
    """COLMAP's own reader cuts names at blanks, and knows neither byte-order marks nor encodings."""
    import pycolmap

    cameras = {}
    for line in _lines(folder / "cameras.txt"):
        number, model, width, height, *params = line.split()
        size = {"width": int(width), "height": int(height)}
        cameras[number] = pycolmap.Camera(model=model, params=[float(value) for value in params], **size)
        if not cameras[number].verify_params():
            raise ValueError(f"camera {number} has {len(params)} parameters")
    for line in _lines(folder / "images.txt", every=2):
        _, *pose, camera, name = line.split(maxsplit=9)
        w, x, y, z, *translation = (float(value) for value in pose)
        cam_from_world = pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([x, y, z, w])), np.array(translation))
        yield _known(name.rstrip(), cameras[camera], cam_from_world)


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


def _known(name: str, camera: Any, cam_from_world: Any) -> KnownCamera:
    return KnownCamera(
        name=name,
        size=(camera.width, camera.height),
        model=camera.model_name,
        params=tuple(float(value) for value in camera.params),
        cam_from_world=cam_from_world.matrix(),
    )
