"""Reading one photo, of whatever format, as upright 8-bit RGB."""

from __future__ import annotations

import io
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from stages.capture.colour import Colours, colours_of, in_srgb
from stages.capture.exif import EXIF_IFD, NO_GPS, ORIENTATION, Gps, camera_key, focal_px, read_gps
from stages.inputs.bounded import reason
from stages.inputs.formats import TIFF, Kind, check_png, kind_of_head, open_image, read_head_bytes
from stages.limits import available_memory

# What COLMAP's reader takes as it is, with the suffixes that it knows; the rest is re-encoded.
COLMAP_SUFFIXES = {
    "JPEG": (".jpg", ".jpeg"),
    "MPO": (".jpg", ".jpeg"),
    "PNG": (".png",),
    "TIFF": (".tif", ".tiff"),
    "BMP": (".bmp",),
}
DAMAGED_UNSEEN = ("TIFF", "BMP")  # where these are damaged, readers differ in what they make of it
COLMAP_COMPRESSIONS = frozenset({"raw", "tiff_lzw", "tiff_adobe_deflate"})  # of TIFF
LOSSY_FORMATS = frozenset({"JPEG", "MPO", "WEBP", "HEIF", "AVIF"})
ANIMATED_FORMATS = frozenset({"WEBP", "AVIF"})  # a HEIF of several pictures is a burst; its first one counts

ORIENTATIONS = range(1, 9)
TURNED, RAW_TURNED = (5, 6, 7, 8), (5, 6)  # EXIF orientations, and LibRaw's flips, that swap width and height
TIFF_WIDTH, TIFF_HEIGHT, DNG_VERSION = 256, 257, 50706
PREVIEW_SIDE = 1000  # pictures are reduced to whole parts not below this; blur that matters still shows
MIN_SIDE = 64  # a picture smaller than this is an icon or a thumbnail, not a photo
THINNEST, LONGEST = 16, 50  # nor is a line, or a strip: pixels, and times the shorter side
GREY_16_BIT = ("I;16", "I;16B", "I;16L", "I")
WITH_ALPHA = ("RGBA", "LA", "PA", "RGBa", "La")

# What reading a picture takes at most; measured: 5.4 (PNG), 7 (HEIF), 9 (turned TIFF), 13 (alpha channel), 16 (WebP).
BYTES_PER_PIXEL = 16
PROGRESSIVE_BYTES = 6  # libjpeg keeps all coefficients of a progressive JPEG, also where it reduces
JPEG_MOST_REDUCED = 8
LARGE_BYTES = 1 << 29  # pictures that take more are read one at a time
GIB = 1 << 30
# A picture that takes more memory than this is refused where its file is too small for that: it is damaged, or was made
# to fill the memory. Photos have a byte for some 50 pixels at worst; drawings and masks have next to none.
MOST_OF_ANY, MOST_PER_BYTE = GIB, 100 * BYTES_PER_PIXEL
_large = threading.Lock()


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
        bytes_to_read: memory that reading it takes.
        colours: what it says of its colours.
        gps: what EXIF says of the place.
        orientation: EXIF's, of the stored pixels.
    """

    source: str
    width: int
    height: int
    camera: str
    has_focal: bool
    bytes_to_read: int
    colours: Colours
    gps: Gps = NO_GPS
    orientation: int = 1

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in pixels."""
        return self.width, self.height

    @property
    def stored_size(self) -> tuple[int, int]:
        """Width and height in pixels before it is turned upright."""
        return (self.height, self.width) if self.orientation in TURNED else (self.width, self.height)


@dataclass(frozen=True)
class Photo:
    """One photo as it was read.

    Attributes:
        rgb: Pillow image, RGB in sRGB, upright, reduced to what was asked for.
        alpha: [H, W] bool, what its alpha channel keeps, not reduced; None where it cuts nothing out.
        exif: Pillow's EXIF of the file.
        size: width and height in pixels, upright, before it was reduced.
        stored_size: the same before it was turned upright.
        orientation: EXIF orientation that was undone.
        lossy: whether the file's format loses detail anyway.
        as_is: the suffixes under which COLMAP reads the same pixels from the file itself; empty where it does not.
        colours: what it said of its colours.
    """

    rgb: Any
    alpha: np.ndarray | None
    exif: Any
    size: tuple[int, int]
    stored_size: tuple[int, int]
    orientation: int
    lossy: bool
    as_is: tuple[str, ...]
    colours: Colours


def read_photo(file: Path, max_side: int) -> Photo:
    """The photo in `file`, reduced to `max_side` pixels along its longest side; a JPEG while it is decoded.

    Raises:
        UnusableError: it is damaged, an animation, too small, too large for the memory that is free, or a raw file
            without rawpy.
    """
    with telling_damage():
        photo = _develop(file, max_side) if _is_raw(file) else _decode(file, max_side)
    check_size(photo.size)
    return photo


def read_head(file: Path, source: str, max_side: int) -> PhotoFile:
    """As `read_photo`, of the file's head only: nothing is decoded.

    Raises:
        UnusableError: it is no photo as far as the head tells, too small, too large for the memory that is free, or a
            raw file without rawpy.
    """
    from PIL import Image

    colours = Colours()
    with telling_damage():
        if _is_raw(file):
            with _opened_raw(file) as raw:
                exif, stored_size = _raw_exif(file, raw), (raw.sizes.width, raw.sizes.height)
                size = stored_size[::-1] if raw.sizes.flip in RAW_TURNED else stored_size
                needed = _bytes_of(stored_size)
        else:
            with open_image(file) as stored:
                exif = _exif_of(partial(Image.Image.getexif, stored))  # in front of the pixels
                stored_size, size = _sizes(stored, exif)
                needed = bytes_to_read(stored, max_side)
                colours = colours_of(stored.info, exif, _flat_mode(stored.mode))
    check_size(size)
    _check_memory(size, needed, file)
    return PhotoFile(
        source=source,
        width=size[0],
        height=size[1],
        camera=camera_key(exif, size, source),
        has_focal=focal_px(exif, stored_size) is not None,
        bytes_to_read=needed,
        colours=colours,
        gps=read_gps(exif),
        orientation=_orientation(exif),
    )


def read_preview(file: Path) -> tuple[np.ndarray, np.ndarray | None]:
    """Pixels [H, W, 3] uint8 of the upright photo, reduced; what its alpha channel keeps, see `Photo`.

    Raises:
        UnusableError: it cannot be decoded, or is a raw file without rawpy.
    """
    from PIL import Image

    with telling_damage():
        if _is_raw(file):  # half a second each; the previews in raw files have any size, or are not there
            return np.asarray(_develop(file, PREVIEW_SIDE).rgb), None
        with open_image(file) as stored, memory_for(stored, file, PREVIEW_SIDE):
            stored.draft(None, (PREVIEW_SIDE, PREVIEW_SIDE))
            image, alpha = _flat_and_alpha(stored)
            image = in_srgb(image.reduce(max(1, min(image.size) // PREVIEW_SIDE)), Colours())
            if stored.format == "TIFF":  # Pillow has turned it already
                return np.asarray(image), alpha
            orientation = orientation_of(stored)
            if alpha is not None:
                alpha = np.asarray(turned(Image.fromarray(alpha), orientation))
            return np.asarray(turned(image, orientation)), alpha


def orientation_of(stored: Any) -> int:
    """EXIF's, of a picture that Pillow opened; 1, which is upright, where it says none."""
    return _orientation(_exif_of(stored.getexif))


def turned(image: Any, orientation: int | None) -> Any:
    """A Pillow image turned upright, as EXIF's orientation says."""
    from PIL import Image, ImageOps

    if orientation in (None, 0, 1):
        return image
    exif = Image.Exif()
    exif[ORIENTATION] = orientation
    tagged = image.copy()
    tagged.info = {"exif": exif.tobytes()}
    tagged._exif = None
    return ImageOps.exif_transpose(tagged)


def _is_raw(file: Path) -> bool:
    head = read_head_bytes(file)
    if kind_of_head(head, file.suffix.lower()) is Kind.RAW:
        return True
    if not head.startswith(TIFF):
        return False
    with open_image(file) as stored:
        return DNG_VERSION in stored.tag_v2  # under another name


def check_size(size: tuple[int, int]) -> None:
    """Raises UnusableError where a picture of this width and height is no photo."""
    if max(size) < MIN_SIDE or min(size) < THINNEST or max(size) > LONGEST * min(size):
        raise UnusableError(f"only {size[0]} x {size[1]} pixels")


@contextmanager
def telling_damage() -> Iterator[None]:
    """What a decoder says of a file, without the file's name: that is told beside it."""
    from PIL import UnidentifiedImageError

    try:
        yield
    except UnusableError:
        raise
    except UnidentifiedImageError as error:
        raise UnusableError("no image, whatever its name says (empty, damaged, or another format)") from error
    except Exception as error:  # decoders raise nearly anything on a damaged file
        raise UnusableError(f"cannot be read ({reason(error)})") from error


def _decode(file: Path, max_side: int) -> Photo:
    from PIL import Image, ImageOps

    with open_image(file) as stored, memory_for(stored, file, max_side):
        if stored.format in ANIMATED_FORMATS and getattr(stored, "n_frames", 1) > 1:
            raise UnusableError("an animation")
        if stored.format == "JPEG":
            _check_end(file)
        exif = _exif_of(stored.getexif)  # a PNG's may stand behind its pixels
        orientation = _orientation(exif)  # before `load`, which turns TIFF
        stored_size, size = _sizes(stored, exif)
        scale = min(1.0, max_side / max(size))
        as_is = _colmap_suffixes(stored, file) if orientation == 1 and scale == 1 else ()
        colours = colours_of(stored.info, exif, _flat_mode(stored.mode))
        stored.draft(None, (max(1, int(stored.width * scale)), max(1, int(stored.height * scale))))
        stored.load()
        image = stored if orientation == 1 else ImageOps.exif_transpose(stored)
        flat, alpha = _flat_and_alpha(image)
        if scale < 1:
            flat = flat.resize([max(1, round(side * scale)) for side in size], Image.Resampling.LANCZOS)
        rgb = in_srgb(flat, colours)
        if rgb is not stored or (stored.format in DAMAGED_UNSEEN and not _is_alike(file, rgb)):
            as_is = ()
        return Photo(
            rgb=rgb,
            alpha=alpha,
            exif=exif,
            size=size,
            stored_size=stored_size,
            orientation=orientation,
            lossy=stored.format in LOSSY_FORMATS,
            as_is=as_is,
            colours=colours,
        )


def _exif_of(read: Callable[[], Any]) -> Any:
    """What `read` gives, EXIF of a picture that Pillow opened; an empty one where it is damaged."""
    from PIL import Image

    try:
        exif = read()
        exif.get_ifd(EXIF_IFD)
    except Exception:  # Pillow raises nearly anything
        return Image.Exif()
    return exif


def _orientation(exif: Any) -> int:
    found = exif.get(ORIENTATION)
    return found if found in ORIENTATIONS else 1


def _sizes(stored: Any, exif: Any) -> tuple[tuple[int, int], tuple[int, int]]:
    """Width and height as they are stored, and upright; Pillow gives the latter of a TIFF, and the former of others."""
    size = stored.size
    if stored.format == "TIFF":
        size = stored.tag_v2[TIFF_WIDTH], stored.tag_v2[TIFF_HEIGHT]
    return size, size[::-1] if _orientation(exif) in TURNED else size


def _colmap_suffixes(stored: Any, file: Path) -> tuple[str, ...]:
    """The suffixes under which COLMAP, and OpenCV, read these pixels, 8-bit RGB, from the file itself."""
    if stored.mode != "RGB" or (stored.tile and "16" in str(stored.tile[0][3])):
        return ()
    if stored.format == "PNG":
        try:
            check_png(file)
        except ValueError:  # behind the pixels
            return ()
    if stored.format == "TIFF" and (stored.is_animated or stored.info.get("compression") not in COLMAP_COMPRESSIONS):
        return ()
    return COLMAP_SUFFIXES.get(stored.format, ())


def _is_alike(file: Path, rgb: Any) -> bool:
    """Whether OpenCV reads the same pixels from a file as Pillow did."""
    import cv2

    flags = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
    pixels = cv2.imdecode(np.fromfile(file, np.uint8), flags)
    return pixels is not None and np.array_equal(pixels[..., ::-1], np.asarray(rgb))


def _flat_mode(mode: str) -> str:
    """Of `_flat_and_alpha`'s image, by the mode of the picture."""
    if mode in (*GREY_16_BIT, "1", "L", "LA", "La"):
        return "L"
    return mode if mode in ("CMYK", "LAB") else "RGB"


def _flat_and_alpha(image: Any) -> tuple[Any, np.ndarray | None]:
    """8-bit image without alpha, see `_flat_mode`; what the alpha channel keeps [H, W] bool, if it cuts anything."""
    from PIL import Image

    mode = _flat_mode(image.mode)
    if image.mode in GREY_16_BIT:  # Pillow's own conversion clips at 255
        return Image.fromarray((np.asarray(image).clip(0, 65535) // 257).astype(np.uint8)), None
    if image.mode == "F":
        raise UnusableError("a floating-point image")
    alpha = None
    if image.mode in WITH_ALPHA or "transparency" in image.info:
        image = image.convert("RGBA")
        opacity = np.asarray(image.getchannel("A"))
        alpha = None if opacity.min() > 127 else opacity > 127
        image = image.convert("RGB")
    return image if image.mode == mode else image.convert(mode), alpha


# ---------------------------------------------------------------- memory
@contextmanager
def memory_for(stored: Any, file: Path, max_side: int, expected: int = 0) -> Iterator[None]:
    """While a picture that Pillow opened is read: large ones take turns.

    Args:
        expected: pixels that it may have, however few bytes its `file` has.

    Raises:
        UnusableError: the memory that is free is not enough, or more than its bytes can stand for.
    """
    needed = bytes_to_read(stored, max_side)
    if needed < LARGE_BYTES:
        yield
        return
    with _large:
        _check_memory(stored.size, needed, file, expected)
        yield


def bytes_to_read(stored: Any, max_side: int) -> int:
    """Memory that reading a picture takes, reduced to `max_side` where its decoder can."""
    if stored.format not in ("JPEG", "MPO"):
        return _bytes_of(stored.size)
    by = min(JPEG_MOST_REDUCED, 1 << (max(1, max(stored.size) // max_side).bit_length() - 1))
    kept = PROGRESSIVE_BYTES * stored.width * stored.height if stored.info.get("progressive") else 0
    return _bytes_of(stored.size) // by**2 + kept


def _bytes_of(size: tuple[int, int]) -> int:
    return BYTES_PER_PIXEL * size[0] * size[1]


def _check_memory(size: tuple[int, int], needed: int, file: Path, expected: int = 0) -> None:
    """Raises UnusableError where reading a picture of `size` takes more memory than is free, or than it may."""
    if needed >= LARGE_BYTES and needed > (free := available_memory()):
        raise UnusableError(
            f"{size[0]} x {size[1]} pixels take {needed / GIB:.1f} GiB of memory to read, {free / GIB:.1f} are free"
        )
    num_bytes = file.stat().st_size
    if needed > max(MOST_OF_ANY, MOST_PER_BYTE * num_bytes, BYTES_PER_PIXEL * expected):
        raise UnusableError(f"{size[0]} x {size[1]} pixels, which its {num_bytes} bytes cannot be")


def _check_end(file: Path) -> None:
    """Raises UnusableError where the last tenth of a JPEG is zeros: the room was there before the copy was cut off."""
    with file.open("rb") as stream:
        end = stream.seek(0, io.SEEK_END)
        stream.seek(end - max(1, end // 10))
        if not stream.read().strip(b"\0"):
            raise UnusableError("half-copied: its end is zeros")


# ---------------------------------------------------------------- raw files
def _develop(file: Path, max_side: int) -> Photo:
    """A raw file with its camera's white balance; without automatic brightness, which would differ between photos."""
    from PIL import Image

    with _opened_raw(file) as raw:
        _check_memory((raw.sizes.width, raw.sizes.height), _bytes_of((raw.sizes.width, raw.sizes.height)), file)
        exif = _raw_exif(file, raw)
        rgb = Image.fromarray(raw.postprocess(use_camera_wb=True, no_auto_bright=True, output_bps=8))
    size = rgb.size
    scale = min(1.0, max_side / max(size))
    if scale < 1:
        rgb = rgb.resize([max(1, round(side * scale)) for side in size], Image.Resampling.LANCZOS)
    return Photo(rgb, None, exif, size, size, 1, lossy=False, as_is=(), colours=Colours())


@contextmanager
def _opened_raw(file: Path) -> Iterator[Any]:
    """rawpy's object, in which LibRaw decodes the file when it is asked to.

    Raises:
        UnusableError: LibRaw cannot read it, or rawpy is not installed.
    """
    rawpy = import_rawpy()
    try:
        with rawpy.imread(str(file)) as raw:
            yield raw
    except rawpy.LibRawError as error:
        said = error.args[0] if error.args else type(error).__name__
        said = said.decode("ascii", "replace") if isinstance(said, bytes) else said
        raise UnusableError(
            f"a camera raw file that is cut off, damaged, or of a camera that LibRaw does not know ({said}): copy it "
            "from the card once more, or develop it to JPEG or TIFF"
        ) from error


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
    with open_image(io.BytesIO(data)) as preview:
        return preview.getexif()
