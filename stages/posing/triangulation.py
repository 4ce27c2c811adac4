"""A COLMAP model of known cameras: features and matches are found, points triangulated, the poses held fixed."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from stages.artifacts import ImageRecord
from stages.errors import InputError
from stages.posing.features import extract
from stages.posing.known import MAX_STRETCH, KnownCamera
from stages.posing.pairs import PREEMPTIVE, likely_pairs, match_pairs
from stages.posing.settings import mapping_options, match_options

log = logging.getLogger(__name__)

# Parts of the progress bar.
PART_FEATURES, PART_MATCHES = 0.3, 0.9
DATABASE = "database.db"
# Photos are matched with this many nearest ones where there are too many for all pairs.
NEIGHBOURS = 40


def fitted_camera(known: KnownCamera, photo: str, size: tuple[int, int]) -> Any:
    """The pycolmap camera of a photo that may have been reduced since its pose was found, to `size` pixels.

    Raises:
        InputError: photo and pose have different proportions, or the parameters are not valid.
    """
    import pycolmap

    camera = pycolmap.Camera(model=known.model, width=known.size[0], height=known.size[1], params=list(known.params))
    if not camera.verify_params():
        raise InputError(f"The camera of {known.name} has {len(known.params)} parameters.", "Mend the poses.")
    scale_x, scale_y = size[0] / known.size[0], size[1] / known.size[1]
    if abs(scale_x / scale_y - 1) > MAX_STRETCH:
        raise InputError(
            f"{photo} is {size[0]} x {size[1]} pixels upright, but its pose is for {known.size[0]} x {known.size[1]}.",
            "Give the photos that the poses were found for, not cropped and not turned.",
        )
    if size != known.size:
        camera.rescale(*size)
    camera.has_prior_focal_length = True
    return camera


def triangulate(
    work: Path,
    images_folder: Path,
    cameras: Mapping[str, tuple[KnownCamera, ImageRecord]],
    params: Any,
    threads: int,
    workers: int,
    cuda: bool,
    progress: Callable[[float, float, str], None],
) -> tuple[Any, str]:
    """The model, and how pairs were matched.

    Args:
        work: empty folder.
        cameras: name under `images_folder` -> its camera and record.
        params: `configs.params.SfmParams`.
        threads: for what depends on their number (matching). workers: for the rest.
        cuda: whether to use a GPU.

    Raises:
        InputError: see `fitted_camera`.
    """
    import pycolmap

    database_path = work / DATABASE
    model = _posed_model(database_path, images_folder, cameras)
    progress(0.02, 1, "features")
    extract(database_path, images_folder, params, workers, cuda)
    progress(PART_FEATURES, 1, "matches")
    matcher = _match(database_path, model, params, threads, cuda)
    progress(PART_MATCHES, 1, "points")
    out = work / "points"
    out.mkdir()
    return pycolmap.triangulate_points(
        model, database_path, images_folder, out, options=mapping_options(params, threads)
    ), matcher


def _posed_model(
    database_path: Path, images_folder: Path, cameras: Mapping[str, tuple[KnownCamera, ImageRecord]]
) -> Any:
    """A database of the images and their cameras, and a model of the same ids with all poses and no points."""
    import pycolmap

    shared: dict[tuple[Any, ...], list[str]] = {}
    for name, (known, record) in sorted(cameras.items()):
        key = (known.model, known.params, known.size, record.width, record.height)
        shared.setdefault(key, []).append(name)
    pycolmap.Database.open(database_path).close()  # creates it
    for names in shared.values():
        known, record = cameras[names[0]]
        camera = fitted_camera(known, record.source, (record.width, record.height))
        options = pycolmap.ImageReaderOptions()
        options.camera_model = camera.model_name
        options.camera_params = ",".join(f"{value:.17g}" for value in camera.params)
        pycolmap.import_images(
            database_path,
            images_folder,
            camera_mode=pycolmap.CameraMode.SINGLE,
            image_names=names,
            options=options,
        )
    model = pycolmap.Reconstruction()
    with pycolmap.Database.open(database_path) as database:
        for camera in database.read_all_cameras():
            model.add_camera_with_trivial_rig(camera)
        for image in database.read_all_images():
            pose = cameras[image.name][0].cam_from_world
            model.add_image_with_trivial_frame(
                pycolmap.Image(image.name, pycolmap.Point2DList(), image.camera_id, image.image_id),
                pycolmap.Rigid3d(pycolmap.Rotation3d(pose[:, :3]), pose[:, 3]),
            )
    return model


def _match(database_path: Path, model: Any, params: Any, threads: int, cuda: bool) -> str:
    """Likely pairs of small sets, else neighbours in space: the poses say which these are."""
    import pycolmap

    options = match_options(params, threads, cuda)
    matcher = params.matcher
    if matcher == "auto":
        matcher = PREEMPTIVE if model.num_reg_images() <= params.preemptive_max else "spatial"
    if matcher == PREEMPTIVE:
        match_pairs(database_path, likely_pairs(database_path), options)
        return matcher
    if matcher == "spatial":
        _write_positions(database_path, model)
        options["pairing_options"] = pairing = pycolmap.SpatialPairingOptions()
        pairing.max_num_neighbors = NEIGHBOURS
        pairing.max_distance, pairing.ignore_z = 1e12, False  # the unit of the poses is not known
    getattr(pycolmap, f"match_{matcher}")(database_path, **options)
    return matcher


def _write_positions(database_path: Path, model: Any) -> None:
    """The cameras' own positions in place of those in EXIF."""
    import pycolmap

    with pycolmap.Database.open(database_path) as database:
        database.clear_pose_priors()
        for image in model.images.values():
            database.write_pose_prior(
                pycolmap.PosePrior(
                    corr_data_id=image.data_id,
                    position=np.asarray(image.projection_center()).reshape(3, 1),
                    coordinate_system=pycolmap.PosePriorCoordinateSystem.CARTESIAN,
                )
            )
