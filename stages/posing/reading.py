"""Which format a file or folder of poses has, and its reader."""

from __future__ import annotations

from pathlib import Path

from stages.errors import InputError
from stages.inputs.depth import DEPTH
from stages.posing import colmap_model, meganerf, mvsnet, nero, neus, transforms
from stages.posing.known import KnownPoses, reading

FORMATS = (
    "a COLMAP model, transforms.json (nerfstudio, instant-ngp, Blender), cameras_sphere.npz (NeuS, IDR), "
    "a folder of *-camera.pkl (NeRO) or *_cam.txt (MVSNet, BlendedMVS), or one of Mega-NeRF's with metadata/*.pt"
)


def locate_poses(path: Path) -> Path:
    """The file that holds the poses in `path`, a file or a data set's folder; the folder, of formats with many files.

    Raises:
        InputError: there are none.
    """
    if not path.exists():
        raise InputError(f"There are no poses at {path}.", "Check the path with `ls`.")
    if path.is_file():
        if path.suffix in (".json", ".npz"):
            return path
        if path.suffix in (".bin", ".txt") and colmap_model.find_model(path.parent) == path.parent:
            return path.parent
        if path.name.endswith((nero.CAMERA, mvsnet.CAMERA)):
            return path.parent
        raise InputError(f"{path} is no file of poses.", f"`--poses` takes {FORMATS}.")
    if colmap_model.find_model(path) == path:
        return path
    for name in (*neus.FILES, *transforms.FILES):
        if (path / name).is_file():
            return path / name
    if nero.has_cameras(path) or meganerf.has_metadata(path):
        return path
    if (cameras := mvsnet.find_cameras(path)) is not None:
        return cameras
    model = colmap_model.find_model(path)
    if model is None:
        raise InputError(f"No poses were found in {path}.", f"`--poses` takes {FORMATS}.")
    return model


def masks_beside(poses: Path) -> Path | None:
    """The folder of the masks that the format of `poses` (as located) comes with, if it is there."""
    if poses.suffix == ".npz":
        folder = poses.parent / neus.MASKS
        return folder if folder.is_dir() else None
    if poses.is_dir() and nero.has_cameras(poses) and next(poses.glob(f"*{DEPTH}"), None) is not None:
        return poses
    return transforms.masks_folder(poses) if poses.suffix == ".json" else None


def read_poses(path: Path) -> KnownPoses:
    """Cameras of `path`, a file or folder in any of the formats.

    Raises:
        InputError: it cannot be read, or it is none of them.
    """
    found = locate_poses(path)
    with reading(f"The poses in {found}", FORMATS):
        return _read(found)


def _read(found: Path) -> KnownPoses:
    if found.suffix == ".json":
        return transforms.read_transforms(found)
    if found.suffix == ".npz":
        return neus.read_neus(found)
    if colmap_model.find_model(found) == found:
        return colmap_model.read_colmap(found)
    if meganerf.has_metadata(found):
        return meganerf.read_meganerf(found)
    return mvsnet.read_mvsnet(found) if mvsnet.find_cameras(found) == found else nero.read_nero(found)
