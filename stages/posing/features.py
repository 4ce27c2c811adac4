"""SIFT features of photos, written into COLMAP's database.

COLMAP looks for features in the photo at twice its size first, and keeps the largest of all it finds. A photo that is
rich in larger ones keeps none of that first octave, which takes two thirds of the time: there the search begins at the
photo's own size, and finds the same features. Inside masks few photos are rich, so that nobody looks whether they are.
"""

from __future__ import annotations

import shutil
from collections.abc import Collection, Iterable
from pathlib import Path
from typing import Any

import numpy as np

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
    among: Collection[int] | None = None,
) -> None:
    """Write the features of photos of a database that have none yet.

    Args:
        params: `configs.params.SfmParams`.
        workers, cuda, affine: see `stages.posing.settings.feature_options`.
        masks_folder: features are looked for where PHOTO.png in there is not black; everywhere without.
        among: ids of the images; all without.
    """
    import pycolmap

    names = _without_features(database, among)
    if not names:
        return
    reader = pycolmap.ImageReaderOptions()
    if masks_folder is not None:
        reader.mask_path = str(masks_folder)
    options = feature_options(params, workers, cuda, affine)
    if masks_folder is None and not options["extraction_options"].use_gpu:
        _extract_rich(database, images_folder, names, feature_options(params, workers, cuda, affine))
    pycolmap.extract_features(database, images_folder, image_names=names, reader_options=reader, **options)


def _extract_rich(database: Path, images_folder: Path, names: list[str], options: dict[str, Any]) -> None:
    """Write the features of those of the photos that have as many as are kept without the first octave."""
    import pycolmap

    extraction = options["extraction_options"]
    extraction.sift.first_octave = OWN_SIZE
    scratch = database.with_suffix(".own-size.db")
    shutil.copyfile(database, scratch)
    first = names[::TRIED_FIRST]
    others = [name for name in names if name not in set(first)]
    pycolmap.extract_features(scratch, images_folder, image_names=first, **options)
    if others and _rich(scratch, extraction.sift.max_num_features, first):
        pycolmap.extract_features(scratch, images_folder, image_names=others, **options)
    rich = _rich(scratch, extraction.sift.max_num_features, names)
    with (
        pycolmap.Database.open(scratch) as old,
        pycolmap.Database.open(database) as new,
        pycolmap.DatabaseTransaction(new),
    ):
        copy_keypoints(old, new, {i: i for i in rich})
    scratch.unlink()


def _without_features(database: Path, among: Collection[int] | None) -> list[str]:
    import pycolmap

    with pycolmap.Database.open(database) as opened:
        images = {image.image_id: image.name for image in opened.read_all_images()}
        ids = sorted(images if among is None else among)
        return [images[i] for i in ids if not opened.exists_keypoints(i)]


def _rich(database: Path, least: int, names: Collection[str]) -> list[int]:
    """Ids of those of these images that have at least so many features."""
    import pycolmap

    with pycolmap.Database.open(database) as opened:
        ids = sorted(image.image_id for image in opened.read_all_images() if image.name in names)
        return [i for i in ids if opened.num_keypoints_for_image(i) >= least]


def append(source: Path, database: Path, pairs: Iterable[tuple[int, int]]) -> None:
    """Put the features of images, and what matches of them, beside those the images have in another database.

    The pairs (of image ids, the same in both) have to be verified again. What was appended matches nothing by itself:
    features of one and the same spot, each the other's rival, would pass no test. So its descriptors are zero.
    """
    import pycolmap

    pairs = sorted(pairs)
    with (
        pycolmap.Database.open(source) as own,
        pycolmap.Database.open(database) as opened,
        pycolmap.DatabaseTransaction(opened),
    ):
        more = {i: own.read_keypoints(i) for i in sorted({i for pair in pairs for i in pair})}
        before = {i: opened.read_keypoints(i) for i in more}
        for i, keypoints in more.items():
            opened.update_keypoints(i, np.concatenate([before[i], keypoints]))
        _pad_descriptors(opened, {i: len(keypoints) for i, keypoints in more.items()})
        for i, j in pairs:
            matches = [own.read_matches(i, j) + np.array([len(before[i]), len(before[j])], np.uint32)]
            if opened.exists_matches(i, j):
                matches.insert(0, opened.read_matches(i, j))
                opened.delete_matches(i, j)
            if opened.exists_two_view_geometry(i, j):
                opened.delete_two_view_geometry(i, j)
            opened.write_matches(i, j, np.concatenate(matches).astype(np.uint32))


def _pad_descriptors(database: Any, rows: dict[int, int]) -> None:
    """Append so many rows of zeros to the descriptors of images of an open database."""
    found = {image.image_id: database.read_descriptors(image.image_id) for image in database.read_all_images()}
    database.clear_descriptors()  # one image's cannot be replaced
    for image_id, descriptors in found.items():
        if image_id in rows:
            data = np.asarray(descriptors.data)
            descriptors.data = np.concatenate([data, np.zeros((rows[image_id], data.shape[1]), data.dtype)])
        database.write_descriptors(image_id, descriptors)
