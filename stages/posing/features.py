"""SIFT features of photos, written into COLMAP's database.

COLMAP looks for features in the photo at twice its size first, and keeps the largest of all it finds. A photo that is
rich in larger ones keeps none of that first octave, which takes two thirds of the time: there the search begins at the
photo's own size, and finds the same features.
"""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

from stages.posing.adding import copy_keypoints
from stages.posing.settings import feature_options

OWN_SIZE = 0  # COLMAP's first octave: the photo as it is; -1 is at twice its size
# Where none of the first photos, one in so many, is rich, the others are not tried: photos of one capture are alike.
TRIED_FIRST = 8


def extract(
    database: Path,
    images_folder: Path,
    params: Any,
    workers: int,
    cuda: bool,
    affine: bool = False,
    masks_folder: Path | None = None,
) -> None:
    """Write the features of all photos of a database that have none yet.

    Args:
        params: `configs.params.SfmParams`.
        workers, cuda, affine: see `stages.posing.settings.feature_options`.
        masks_folder: features are looked for where PHOTO.png in there is not black; everywhere without.
    """
    import pycolmap

    reader = pycolmap.ImageReaderOptions()
    if masks_folder is not None:
        reader.mask_path = str(masks_folder)
    options = feature_options(params, workers, cuda, affine)
    names = _without_features(database)
    if names and not options["extraction_options"].use_gpu:
        _extract_rich(database, images_folder, reader, names, feature_options(params, workers, cuda, affine))
    pycolmap.extract_features(database, images_folder, image_names=names, reader_options=reader, **options)


def _extract_rich(database: Path, images_folder: Path, reader: Any, names: list[str], options: dict[str, Any]) -> None:
    """Write the features of those of the photos that have as many as are kept without the first octave."""
    import pycolmap

    extraction = options["extraction_options"]
    extraction.sift.first_octave = OWN_SIZE
    scratch = database.with_suffix(".own-size.db")
    shutil.copyfile(database, scratch)
    first = names[::TRIED_FIRST]
    others = [name for name in names if name not in set(first)]
    pycolmap.extract_features(scratch, images_folder, image_names=first, reader_options=reader, **options)
    if others and _rich(scratch, extraction.sift.max_num_features):
        pycolmap.extract_features(scratch, images_folder, image_names=others, reader_options=reader, **options)
    rich = _rich(scratch, extraction.sift.max_num_features)
    with (
        pycolmap.Database.open(scratch) as old,
        pycolmap.Database.open(database) as new,
        pycolmap.DatabaseTransaction(new),
    ):
        copy_keypoints(old, new, {i: i for i in rich})
    scratch.unlink()


def _without_features(database: Path) -> list[str]:
    import pycolmap

    with pycolmap.Database.open(database) as opened:
        images = sorted(opened.read_all_images(), key=lambda image: image.image_id)
        return [image.name for image in images if not opened.exists_keypoints(image.image_id)]


def _rich(database: Path, least: int) -> list[int]:
    """Ids of the images that have at least so many features."""
    import pycolmap

    with pycolmap.Database.open(database) as opened:
        ids = sorted(image.image_id for image in opened.read_all_images())
        return [i for i in ids if opened.num_keypoints_for_image(i) >= least]
