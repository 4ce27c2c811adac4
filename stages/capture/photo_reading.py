"""Reading one photo, of whatever format, as upright 8-bit RGB."""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from stages.capture.exif import ORIENTATION, camera_key, focal_px

# What COLMAP's reader takes as it is; the rest is re-encoded.
COLMAP_SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp"})
COLMAP_FORMATS = frozenset({"JPEG", "MPO", "PNG", "TIFF", "BMP"})  # a name may lie: phones write HEIC as .jpg
HEIF_SUFFIXES = frozenset({".heic", ".heif"})
PHOTO_SUFFIXES = COLMAP_SUFFIXES | HEIF_SUFFIXES | {".webp", ".avif"}
RAW_SUFFIXES = frozenset({".dng", ".cr2", ".cr3", ".nef", ".arw", ".orf", ".rw2", ".raf", ".pef", ".srw"})
LOSSY_FORMATS = frozenset({"JPEG", "MPO", "WEBP", "HEIF", "AVIF"})
ANIMATED_FORMATS = frozenset({"WEBP", "AVIF"})  # a HEIF of several pictures is a burst; its first one counts

TURNED, RAW_TURNED = (5, 6, 7, 8), (5, 6)  # EXIF orientations, and LibRaw's flips, that swap width and height
PREVIEW_SIDE = 1000  # JPEG decodes at 1/2, 1/4 or 1/8 not below this; blur that matters still shows
MIN_SIDE = 64  # a picture smaller than this is an icon or a thumbnail, not a photo


class UnusableError(Exception):
    """This photo is left out, and why."""


@dataclass(frozen=True)
class PhotoFile:
    """What the head of one photo's file says.

    Attributes:
        source: path relative to the photo folder.
        width, height: upright size in pixels.
        camera: photos with the same value share one camera's intrinsics.
        has_focal: whether EXIF gives the focal length.
    """

    source: str
    width: int
    height: int
    camera: str
    has_focal: bool


@dataclass(frozen=True)
class Photo:
    """One photo as it was read.

    Attributes:
        rgb: Pillow image, RGB, upright.
        alpha: [H, W] bool, what its alpha channel keeps; None where it cuts nothing out.
        exif: Pillow's EXIF of the file.
        stored_size: width and height in pixels before it was turned upright.
        orientation: EXIF orientation that was undone.
        lossy: whether the file's format loses detail anyway.
        as_is: whether COLMAP would read the same pixels from the file itself.
    """

    rgb: Any
    alpha: np.ndarray | None
    exif: Any
    stored_size: tuple[int, int]
    orientation: int
    lossy: bool
    as_is: bool


def register_formats() -> None:
    """Teach Pillow HEIC (it has AVIF and WebP built in)."""
    from pillow_heif import register_heif_opener

    register_heif_opener()


def read_photo(file: Path) -> Photo:
    """The photo in `file`; `register_formats` must have been called for HEIC.

    Raises:
        UnusableError: it is damaged, an animation, too small, or a raw file without rawpy.
    """
    with telling_damage():
        photo = _develop(file) if _is_raw(file) else _decode(file)
    _check_side(photo.rgb.size)
    return photo


def read_head(file: Path, source: str) -> PhotoFile:
    """As `read_photo`, of the file's head only: nothing is decoded.

    Raises:
        UnusableError: it is no photo as far as the head tells, too small, or a raw file without rawpy.
    """
    from PIL import Image

    with telling_damage():
        if _is_raw(file):
            with import_rawpy().imread(str(file)) as raw:
                exif, size = _raw_exif(file, raw), (raw.sizes.width, raw.sizes.height)
                size = size[::-1] if raw.sizes.flip in RAW_TURNED else size
        else:
            with Image.open(file) as stored:
                # the PNG plug-in's own `getexif` would decode the pixels, to look behind them
                exif, size = Image.Image.getexif(stored), stored.size
    _check_side(size)
    width, height = size[::-1] if exif.get(ORIENTATION) in TURNED else size
    camera = camera_key(exif, (width, height), source)
    return PhotoFile(source, width, height, camera, has_focal=focal_px(exif, size) is not None)


def read_preview(file: Path) -> np.ndarray:
    """Pixels [H, W, 3] uint8 of the photo, not turned, and reduced where that makes decoding quick.

    Raises:
        UnusableError: it cannot be decoded, or is a raw file without rawpy.
    """
    from PIL import Image

    with telling_damage():
        if _is_raw(file):  # half a second each; the previews in raw files have any size, or are not there
            return np.asarray(_develop(file).rgb)
        with Image.open(file) as stored:
            stored.draft("RGB", (PREVIEW_SIDE, PREVIEW_SIDE))
            return np.asarray(stored.convert("RGB"))


def _is_raw(file: Path) -> bool:
    return file.suffix.lower() in RAW_SUFFIXES


def _check_side(size: tuple[int, int]) -> None:
    if max(size) < MIN_SIDE:
        raise UnusableError(f"only {size[0]} x {size[1]} pixels")


@contextmanager
def telling_damage() -> Iterator[None]:
    """What a decoder says of a file, without the file's name: that is told beside it."""
    from PIL import UnidentifiedImageError

    try:
        yield
    except (UnusableError, MemoryError):
        raise
    except UnidentifiedImageError as error:
        raise UnusableError("no image, whatever its name says (empty, damaged, or another format)") from error
    except Exception as error:  # decoders raise nearly anything on a damaged file
        raise UnusableError(f"cannot be read ({error})") from error


def _decode(file: Path) -> Photo:
    from PIL import Image, ImageOps

    with Image.open(file) as stored:
        if getattr(stored, "n_frames", 1) > 1 and stored.format in ANIMATED_FORMATS:
            raise UnusableError("an animation")
        exif = stored.getexif()
        sixteen_bit = "16" in str(stored.tile[0][3]) if stored.tile else False
        stored.load()
        orientation = exif.get(ORIENTATION, 1)
        image = stored if orientation in (None, 0, 1) else ImageOps.exif_transpose(stored)
        rgb, alpha = _rgb_and_alpha(image)
        unchanged = image is stored and stored.mode == "RGB" and not sixteen_bit
        return Photo(
            rgb=rgb,
            alpha=alpha,
            exif=exif,
            stored_size=stored.size,
            orientation=orientation,
            lossy=stored.format in LOSSY_FORMATS,
            as_is=unchanged and file.suffix.lower() in COLMAP_SUFFIXES and stored.format in COLMAP_FORMATS,
        )


def _rgb_and_alpha(image: Any) -> tuple[Any, np.ndarray | None]:
    """8-bit RGB image and, where the alpha channel cuts something out, the mask [H, W] bool."""
    from PIL import Image

    if image.mode in ("I;16", "I;16B", "I;16L", "I"):  # 16-bit grey: Pillow's own conversion clips at 255
        grey = (np.asarray(image).clip(0, 65535) // 257).astype(np.uint8)
        return Image.fromarray(grey).convert("RGB"), None
    if image.mode == "F":
        raise UnusableError("a floating-point image")
    if image.mode in ("RGBA", "LA", "PA", "RGBa", "La") or "transparency" in image.info:
        image = image.convert("RGBA")
        alpha = np.asarray(image.getchannel("A"))
        return image.convert("RGB"), None if alpha.min() > 127 else alpha > 127
    return image if image.mode == "RGB" else image.convert("RGB"), None


def _develop(file: Path) -> Photo:
    """A raw file with its camera's white balance; without automatic brightness, which would differ between photos."""
    from PIL import Image

    rawpy = import_rawpy()
    with rawpy.imread(str(file)) as raw:
        exif = _raw_exif(file, raw)
        rgb = Image.fromarray(raw.postprocess(use_camera_wb=True, no_auto_bright=True, output_bps=8))
    return Photo(rgb, None, exif, rgb.size, 1, lossy=False, as_is=False)


def import_rawpy() -> Any:
    """The module.

    Raises:
        UnusableError: it is not installed.
    """
    try:
        import rawpy
    except ImportError:
        raise UnusableError("a camera raw file, which needs rawpy: pip install 'hineus[raw]'") from None
    return rawpy


def _raw_exif(file: Path, raw: Any) -> Any:
    """From the file where it is a TIFF at heart (DNG, NEF, CR2, ARW), else from the preview in it (CR3, RAF)."""
    from PIL import Image

    for content in (file.read_bytes, lambda: raw.extract_thumb().data):
        try:
            exif = _exif_in(content())
        except Exception:  # no TIFF, no preview, or one that Pillow cannot read
            continue
        if exif:
            exif[ORIENTATION] = 1  # LibRaw has turned the pixels
            return exif
    return Image.Exif()


def _exif_in(data: bytes) -> Any:
    from PIL import Image

    if data.startswith((b"II*\0", b"MM\0*")):
        exif = Image.Exif()
        exif.load(data)
        return exif
    with Image.open(io.BytesIO(data)) as preview:
        return preview.getexif()
