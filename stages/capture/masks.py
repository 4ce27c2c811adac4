"""Masks that come with the photos: which file belongs to which photo, how it is read and written."""

from __future__ import annotations

from pathlib import Path, PurePosixPath

import numpy as np

from stages.capture.exif import ORIENTATION
from stages.errors import InputError
from stages.inputs.folders import named_files
from stages.inputs.formats import PHOTO_SUFFIXES, open_image


def match_masks(photos: list[str], folder: Path) -> dict[str, Path]:
    """Photo -> its mask file: same relative path or, where unambiguous, same file name."""
    by_path: dict[str, Path] = {}
    by_name: dict[str, list[Path]] = {}
    for name, path in named_files(folder)[0].items():
        if path.suffix.lower() in PHOTO_SUFFIXES:
            key = PurePosixPath(name).with_suffix("").as_posix()
            by_path.setdefault(key, path)
            by_name.setdefault(PurePosixPath(key).name, []).append(path)
    found: dict[str, Path] = {}
    for photo in photos:
        own = PurePosixPath(photo)
        keys = [photo, str(own.with_suffix("")), f"{own.with_suffix('')}_mask", f"{photo}_mask"]
        match = next((by_path[key] for key in keys if key in by_path), None)
        if match is None:
            flat = [by_name.get(PurePosixPath(key).name, []) for key in keys]
            match = next((paths[0] for paths in flat if len(paths) == 1), None)
        if match is not None:
            found[photo] = match
    return found


def read_mask(
    file: Path, photo: str, size: tuple[int, int], stored_size: tuple[int, int], orientation: int
) -> np.ndarray:
    """Mask [H, W] bool of the upright photo. White (or opaque) is the object.

    A mask drawn on the photo as it is stored is turned with it, where the sizes tell.
    """
    from PIL import Image, ImageOps

    try:
        with open_image(file) as stored:
            stored.load()
            image: Image.Image = stored
            if image.size != size and image.size == stored_size:
                exif = image.getexif()
                exif[ORIENTATION] = orientation
                image.info["exif"] = exif.tobytes()
                image = ImageOps.exif_transpose(image)
            found = image.size
            channel = image.convert("RGBA") if image.mode in ("RGBA", "LA", "PA") else None
            values = np.asarray(image.convert("L"))
    except Exception as error:  # Pillow's decoders raise nearly anything on a damaged file
        raise InputError(f"The mask {file} cannot be read ({error}).", "Write it again as an 8-bit PNG.") from error
    check_size(file, photo, found, size)
    if channel is not None:
        alpha = np.asarray(channel.getchannel("A"))
        if alpha.min() != alpha.max():
            values = alpha
    # half of the brightest value: masks of 0 and 1 are as common as masks of 0 and 255
    return values > values.max() / 2


def check_size(mask: Path, photo: str, found: tuple[int, ...], size: tuple[int, int]) -> None:
    """Raises InputError where the mask's size `found` is not the upright photo's `size`."""
    if found != size:
        raise InputError(
            f"The mask {mask.name} is {found[0]} x {found[1]} pixels, {photo} is {size[0]} x {size[1]}.",
            "Masks need the size of their (upright) photo: make the masks again from these photos.",
        )


def write_mask(mask: np.ndarray, target: Path, size: tuple[int, int]) -> None:
    import cv2

    values = mask.astype(np.uint8) * 255
    if values.shape[::-1] != size:
        values = np.where(cv2.resize(values, size, interpolation=cv2.INTER_AREA) > 127, 255, 0).astype(np.uint8)
    target.parent.mkdir(parents=True, exist_ok=True)
    from PIL import Image

    Image.fromarray(values).save(target)
