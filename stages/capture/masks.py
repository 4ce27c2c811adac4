"""Masks that come with the photos: where they lie, how one is read and written."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from stages.artifacts import SkippedImage
from stages.capture.listing import name_some
from stages.capture.mask_doubts import MaskLook, is_black_and_white, look
from stages.capture.mask_fit import outline_fit
from stages.capture.mask_names import is_mask_folder, pair
from stages.capture.photo_reading import (
    Photo,
    PhotoFile,
    UnusableError,
    bytes_to_read,
    memory_for,
    orientation_of,
    turned,
)
from stages.errors import InputError
from stages.inputs.bounded import reason
from stages.inputs.depth import DEPTH, read_depth
from stages.inputs.folders import named_files, readable
from stages.inputs.formats import PHOTO_SUFFIXES, open_image

# A mask's edges may be soft: this much of its range from black or white counts as neither, and as many such pixels as
# are black (or white) are a photo, a depth map or labels. Masks of the development sets have 0 to 0.02 of them.
SOFT, MAX_UNCLEAR = 0.1, 0.5
# Pixels that a mask may have, however well it was packed: as many as its photo, or times those up to this many; and
# that a photo may have for which it is scaled, which may be known from poses alone.
LARGER, LARGE_MASK, LARGEST = 4, 1 << 26, 1 << 28
JPEG_NOISE = 8  # a black picture may have values up to this in a JPEG
MIN_CONTRAST = 0.25  # of the brightest value: less is a picture of one value, and its noise
ASIDE = "masks among the photos"
EMPTY = "its mask is empty"
MASK_NOT_PHOTO = "black and white, as a mask is: move it to a folder of its own and give `--masks FOLDER`"


@dataclass(frozen=True)
class Mask:
    """A mask as it was read.

    Attributes:
        kept: [H, W] bool, True on the object, of the upright photo's size.
        stored_size: width and height in pixels of its file, turned as the photo.
    """

    kept: np.ndarray
    stored_size: tuple[int, int]


def match_masks(photos: list[str], folder: Path, not_masks: Collection[Path] = ()) -> dict[str, Path]:
    """Photo -> its mask file in `folder`, see `mask_names`; `not_masks`: files that are photos, which may lie there."""
    taken = {path.resolve() for path in not_masks}
    files = _pictures(folder)
    names = [name for name, path in files.items() if path.resolve() not in taken]
    return {photo: files[name] for photo, name in pair(photos, names).items()}


def pair_masks(
    photos: list[str], folder: Path, of_poses: Mapping[str, Path], not_masks: Collection[Path] = ()
) -> dict[str, Path]:
    """As `match_masks`; or as a file of poses pairs photos and masks, where `folder` is that of its masks."""
    if of_poses and lie_in(folder, of_poses.values()):
        return {photo: of_poses[photo] for photo in photos if photo in of_poses}
    return match_masks(photos, folder, not_masks)


def lie_in(folder: Path, files: Iterable[Path]) -> bool:
    return all(file.resolve().is_relative_to(folder.resolve()) for file in files)


def _pictures(folder: Path) -> dict[str, Path]:
    """By readable path, see `named_files`."""
    return {name: path for name, path in named_files(folder)[0].items() if path.suffix.lower() in PHOTO_SUFFIXES}


def unused_folder(source: Path, photos: list[str]) -> Path | None:
    """A folder of masks of these photos near the folder `source` of photos, where nobody has named it."""
    with suppress(OSError):  # folders that may not be listed
        beside = sorted(path for path in source.resolve().parent.iterdir() if path != source.resolve())
        for folder in (source / ".mask", *beside):
            if is_mask_folder(folder.name) and folder.is_dir() and match_masks(photos, folder):
                return folder
    return None


def choose_masks(
    photos: Mapping[str, Path],
    own: Mapping[str, Path],
    masks_folder: Path | None,
    use_own: bool,
    of_poses: Mapping[str, Path],
) -> dict[str, Path]:
    """Photo -> its mask file: of `masks_folder` if that is given, else of those among the photos.

    Args:
        photos: photo -> its file. own: photo -> the file of its mask, as `set_masks_aside` found them.
        of_poses: the same, as a file of poses names them; see `pair_masks`.
    """
    if masks_folder is not None:
        return pair_masks(list(photos), masks_folder, of_poses, list(photos.values()))
    return {photo: mask for photo, mask in own.items() if use_own and photo in photos}


def unused_masks(
    aside: Mapping[str, Path], used: Iterable[Path], use_own: bool, masks_folder: Path | None
) -> list[SkippedImage]:
    """Those of the masks among the photos that are not used, and why."""
    taken = {file.resolve() for file in used}
    reason = f"{ASIDE} that are of none of them, or one for all, which is no object's outline"
    if masks_folder is not None:
        reason = f"{ASIDE}, while --masks names others"
    elif not use_own:
        reason = f"{ASIDE}, not used (`--no-masks`; `--set ingest.own_masks=true` uses them)"
    return [SkippedImage(mask, reason, expected=True) for mask, file in aside.items() if file.resolve() not in taken]


def missing_masks(photos: Sequence[str], files: Mapping[str, Path], folder: Path | None) -> InputError | None:
    """What to say where photos have no mask in the `folder` that the user gave."""
    missing = [photo for photo in photos if photo not in files]
    if folder is None or not missing:
        return None
    message = f"{len(missing)} of {len(photos)} photos have no mask in {folder}: {name_some(missing)}."
    if not files:
        names = list(_pictures(folder))
        others = [name for name in names if name not in photos]
        holds = f"{len(others)} pictures, e.g. {others[0]}" if others else "no pictures"
        message += " It holds the photos only." if names and not others else f" It holds {holds}."
    wanted = Path(missing[0]).with_suffix(".png").as_posix()
    return InputError(message, f"Add {wanted} and the like, move those photos away, or run with `--no-masks`.")


def tell_masks(looks: Sequence[MaskLook]) -> str:
    """Which masks are used, in a sentence."""
    first = looks[0]
    scaled = [look for look in looks if look.size != look.photo_size]
    of_photo = "" if first.photo in first.file else f" for {first.photo}"
    said = f"{len(looks)} are used, e.g. {first.file}{of_photo}; `--no-masks` leaves them out"
    if scaled:
        (width, height), (wide, high) = scaled[0].size, scaled[0].photo_size
        said += f". {len(scaled)} are scaled to their photos ({width} x {height} to {wide} x {high})"
    return said


def of_sphere(panorama: str) -> InputError:
    """What to say where a 360-degree picture has a mask, or one is wanted."""
    return InputError(
        f"{panorama} is a 360-degree picture: masks of those cannot be used, nor their alpha channels.",
        "Run without: `--no-masks`; or leave those pictures out: `--set 'ingest.leave_out=[NAME, ...]'`.",
    )


def given_mask(
    photo: str,
    file: Path | None,
    alpha: np.ndarray | None,
    shape: Photo | PhotoFile,
    black_keeps: bool,
    pixels: np.ndarray,
) -> tuple[Mask, MaskLook] | None:
    """The mask that comes with a photo, and a look at it: that of its `file`, else its `alpha` channel.

    Args:
        alpha: [H, W] bool, True where it is opaque. pixels: [h, w, 3] uint8, the upright photo at any size.

    Raises:
        UnusableError: the mask keeps nothing, or the photo is a mask itself.
        InputError: see `load_mask`.
    """
    if is_black_and_white(pixels):
        raise UnusableError(MASK_NOT_PHOTO)
    if file is not None:
        mask = load_mask(file, photo, shape.size, shape.stored_size, shape.orientation, black_keeps, pixels)
        called = readable(file.name)
    elif alpha is not None:
        mask, called = Mask(alpha, shape.size), f"alpha channel of {photo}"
    else:
        return None
    if not mask.kept.any():
        raise UnusableError(f"{EMPTY} ({called})")
    return mask, look(photo, called, mask.kept, mask.stored_size, pixels)


def load_mask(
    file: Path,
    photo: str,
    size: tuple[int, int],
    stored_size: tuple[int, int],
    orientation: int,
    black_keeps: bool = False,
    pixels: np.ndarray | None = None,
) -> Mask:
    """Mask of the upright photo, scaled where it has the photo's shape. White (or opaque) is the object.

    A depth image (see `stages.inputs.depth`) keeps what is near.

    A mask drawn on the photo as it is stored is turned with it, where the sizes tell, or the upright photo's
    `pixels` [h, w, 3] of any size do.

    Args:
        size, stored_size: width and height in pixels of the photo, upright and in its file.
        orientation: EXIF's, of the photo.
        black_keeps: whether black is the object, as some programs have it.

    Raises:
        InputError: it cannot be read, or not with the memory that is free, has another shape than the photo, or is not
            black and white.
    """
    if size[0] * size[1] > LARGEST:
        raise InputError(f"{photo} is {size[0]} x {size[1]} pixels, too many for a mask.", "Reduce the photos.")
    if file.name.endswith(DEPTH):
        return _near(file, photo, size)
    try:
        with open_image(file) as stored, memory_for(stored, file, max(stored.size), _expected(size)):
            return _judged(stored, file, photo, size, orientation, black_keeps, pixels)
    except InputError:
        raise
    except UnusableError as error:
        raise InputError(
            f"The mask {file} cannot be read: {error}.", "Write it smaller: its shape is enough."
        ) from error
    except Exception as error:  # Pillow's decoders raise nearly anything on a damaged file
        raise InputError(
            f"The mask {file} cannot be read ({reason(error)}).", "Write it again as an 8-bit PNG."
        ) from error


def _expected(size: tuple[int, int]) -> int:
    """Pixels that the mask of a photo of this size may have."""
    pixels = size[0] * size[1]
    return max(pixels, min(LARGER * pixels, LARGE_MASK))


def _judged(
    stored: Any,
    file: Path,
    photo: str,
    size: tuple[int, int],
    orientation: int,
    black_keeps: bool,
    pixels: np.ndarray | None,
) -> Mask:
    """As `load_mask`, of a picture that Pillow opened."""
    from PIL import Image

    stored.load()
    own_orientation = orientation_of(stored)
    image = Image.fromarray(_grey(stored))
    candidates = [turned(image, own_orientation), image, turned(image, orientation)]
    fitting = [found for found in candidates if found.size == size]
    fitting = fitting or [found for found in candidates if _same_shape(found.size, size)] or [image]
    check_size(file, photo, fitting[0].size, size)
    kept = _black_and_white(np.asarray(fitting[0]), stored.format == "JPEG", file, photo)
    if black_keeps:
        np.logical_not(kept, out=kept)
    if own_orientation == 1 and len(fitting) > 2 and pixels is not None:  # as large either way
        kept = _better_turned(kept, turned(Image.fromarray(kept), orientation), pixels)
    found = kept.shape[1], kept.shape[0]
    return Mask(kept if found == size else resized(kept, size), found)


def _near(file: Path, photo: str, size: tuple[int, int]) -> Mask:
    """What a depth image shows of the object; raises InputError as `load_mask`."""
    try:
        kept = np.isfinite(read_depth(file))
    except (OSError, ValueError) as error:
        raise InputError(f"{error}.", "Leave depth out with `--no-masks`.") from error
    check_size(file, photo, (kept.shape[1], kept.shape[0]), size)
    return Mask(kept, size)


def bytes_to_read_masks(files: Iterable[Path]) -> int:
    """Memory that reading the largest of these masks takes; those that cannot be opened take none."""
    most = 0
    for file in files:
        with suppress(Exception), open_image(file) as stored:  # Pillow raises nearly anything on a damaged file
            most = max(most, bytes_to_read(stored, max(stored.size)))
    return most


def _sees_through(image: Any) -> bool:
    return "transparency" in image.info


def _grey(image: Any) -> np.ndarray:
    """[H, W]: the alpha channel where it cuts anything out, else the brightness, of any number of bits."""
    if image.mode == "P":
        image = image.convert("RGBA" if _sees_through(image) else "RGB")
    if image.mode in ("RGBA", "LA", "PA", "RGBa", "La"):
        alpha = np.asarray(image.convert("RGBA").getchannel("A"))
        if alpha.min() != alpha.max():
            return alpha
    if image.mode.startswith(("I", "F")):  # 16 and 32 bits, which Pillow's own conversion would cut off at 255
        return np.nan_to_num(np.array(image, dtype=np.float32), copy=False)
    return np.asarray(image.convert("L"))


def _black_and_white(values: np.ndarray, noisy: bool, file: Path, photo: str) -> np.ndarray:
    """[H, W] bool, True on the brighter of two values; masks of 0 and 1 are as common as masks of 0 and 255.

    Raises:
        InputError: there are not two.
    """
    darkest, brightest = float(values.min()), float(values.max())
    if noisy and brightest <= JPEG_NOISE:
        return np.zeros(values.shape, bool)
    if brightest - darkest < MIN_CONTRAST * brightest:
        return np.ones(values.shape, bool)
    across = max(brightest - darkest, 1e-9)  # thresholds in the picture's own numbers: no copies of large pictures
    black = float((values < darkest + SOFT * across).mean())
    white = float((values > brightest - SOFT * across).mean())
    neither = 1 - black - white
    if neither > MAX_UNCLEAR * (neither + min(black, white)):
        raise InputError(
            f"{file}, taken for the mask of {photo}, is not black and white: {neither:.0%} of its pixels are neither "
            f"(need less than {min(black, white):.1%}, as many as are {'white' if white < black else 'black'}). "
            "It looks like a photo, a depth map or labels.",
            "Name the folder of the masks with `--masks FOLDER`, or run without: `--no-masks`.",
        )
    return values > darkest + across / 2


def _better_turned(kept: np.ndarray, other: Any, pixels: np.ndarray) -> np.ndarray:
    """The one of two masks whose outline meets the photo's edges better."""
    other_kept = np.asarray(other)
    fits = [outline_fit(mask, pixels) for mask in (kept, other_kept)]
    if None in fits or other_kept.shape != kept.shape:
        return kept
    return other_kept if fits[1].own > fits[0].own and fits[1].fits else kept  # type: ignore[union-attr]


def _same_shape(found: tuple[int, int], size: tuple[int, int]) -> bool:
    """Whether one is the other scaled, both sides rounded."""
    across, down = found[0] / size[0], found[1] / size[1]
    return abs(across - down) * max(size) <= max(1.0, across)


def check_size(mask: Path, photo: str, found: tuple[int, int], size: tuple[int, int]) -> None:
    """Raises InputError where the mask's size `found` has another shape than the upright photo's `size`."""
    if _same_shape(found, size):
        return
    lies = " (it lies on its side)" if _same_shape(found[::-1], size) else ""
    raise InputError(
        f"The mask {mask.name} is {found[0]} x {found[1]} pixels, {photo} is {size[0]} x {size[1]}{lies}.",
        "Masks need the size of their (upright) photo, or its shape: make the masks again from these photos, or run "
        "without: `--no-masks`.",
    )


def resized(mask: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """A mask [H, W] bool at `size` (width, height); pixels that are half covered are not kept."""
    import cv2

    smaller = size[0] < mask.shape[1]
    values = mask.astype(np.uint8) * 255
    return cv2.resize(values, size, interpolation=cv2.INTER_AREA if smaller else cv2.INTER_LINEAR) > 127


def write_mask(mask: np.ndarray, target: Path, size: tuple[int, int]) -> None:
    from PIL import Image

    values = (mask if mask.shape[::-1] == size else resized(mask, size)).astype(np.uint8) * 255
    target.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(values).save(target)
