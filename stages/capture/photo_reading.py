"""Reading one photo, of whatever format, as upright 8-bit RGB."""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from stages.capture.exif import ORIENTATION

# What COLMAP's reader takes as it is; the rest is re-encoded.
COLMAP_SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp"})
COLMAP_FORMATS = frozenset({"JPEG", "MPO", "PNG", "TIFF", "BMP"})  # a name may lie: phones write HEIC as .jpg
HEIF_SUFFIXES = frozenset({".heic", ".heif"})
PHOTO_SUFFIXES = COLMAP_SUFFIXES | HEIF_SUFFIXES | {".webp", ".avif"}
RAW_SUFFIXES = frozenset({".dng", ".cr2", ".cr3", ".nef", ".arw", ".orf", ".rw2", ".raf", ".pef", ".srw"})
LOSSY_FORMATS = frozenset({"JPEG", "MPO", "WEBP", "HEIF", "AVIF"})
ANIMATED_FORMATS = frozenset({"WEBP", "AVIF"})  # a HEIF of several pictures is a burst; its first one counts

MIN_SIDE = 64  # a picture smaller than this is an icon or a thumbnail, not a photo


class UnusableError(Exception):
    """This photo is left out, and why."""


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
    try:
        photo = _develop(file) if file.suffix.lower() in RAW_SUFFIXES else _decode(file)
    except (UnusableError, MemoryError):
        raise
    except Exception as error:  # decoders raise nearly anything on a damaged file
        raise unreadable(error) from error
    width, height = photo.rgb.size
    if max(width, height) < MIN_SIDE:
        raise UnusableError(f"only {width} x {height} pixels")
    return photo


def unreadable(error: Exception) -> UnusableError:
    """What a decoder says of a file, without the file's name: that is told beside it."""
    from PIL import UnidentifiedImageError

    if isinstance(error, UnidentifiedImageError):
        return UnusableError("no image, whatever its name says (empty, damaged, or another format)")
    return UnusableError(f"cannot be read ({error})")


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
