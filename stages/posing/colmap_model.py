"""Poses of a COLMAP model: cameras, images and points3D, as .bin or .txt."""

from __future__ import annotations

from pathlib import Path

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
    import pycolmap

    with reading(f"The COLMAP model {folder}", "cameras, images and points3D, as .bin or as .txt"):
        model = pycolmap.Reconstruction(str(folder))
    cameras = []
    for image_id in sorted(model.reg_image_ids()):
        image = model.images[image_id]
        camera = model.cameras[image.camera_id]
        cameras.append(
            KnownCamera(
                name=image.name,
                size=(camera.width, camera.height),
                model=camera.model_name,
                params=tuple(float(value) for value in camera.params),
                cam_from_world=image.cam_from_world().matrix(),
            )
        )
    return KnownPoses(folder, tuple(cameras))
