"""What a file is by its first bytes, whatever its name says; and the one way in which pictures of users are opened."""

from __future__ import annotations

import io
import os
import struct
import warnings
from enum import Enum, auto
from functools import lru_cache, wraps
from pathlib import Path
from typing import Any

from stages.inputs.bounded import check_regular, reason

# By Pillow's names; MPO is read as JPEG. Pillow knows more, some of which start other programs (EPS: Ghostscript).
PHOTO_FORMATS = ("JPEG", "PNG", "TIFF", "BMP", "WEBP", "HEIF", "AVIF")
HEIF_SUFFIXES = frozenset({".heic", ".heif", ".hif", ".heics", ".heifs"})
JPEG_SUFFIXES = frozenset({".jpg", ".jpeg", ".jpe", ".jfif", ".mpo"})
PHOTO_SUFFIXES = HEIF_SUFFIXES | JPEG_SUFFIXES | {".png", ".tif", ".tiff", ".bmp", ".webp", ".avif"}
RAW_SUFFIXES = frozenset({".dng", ".cr2", ".nef", ".nrw", ".arw", ".pef", ".srw", ".rwl", ".3fr", ".iiq"})
RAW_SUFFIXES |= {".cr3", ".orf", ".rw2", ".raf"}
VIDEO_SUFFIXES = frozenset({".mp4", ".mov", ".avi", ".mkv", ".m4v", ".webm", ".mts", ".m2ts", ".3gp"})
VIDEO_SUFFIXES |= {".mpg", ".mpeg", ".wmv", ".ogv"}

# All that FFmpeg may take a video for: no playlists, no lists of files, no devices.
CONTAINERS = "mov,mp4,m4a,3gp,3g2,mj2,matroska,webm,avi,mpegts,mpeg,asf,flv,ogg"

HEAD_BYTES = 512
JPEG_PIXELS_PER_BYTE = 1000  # it takes two bits or more for 64 pixels
# Tags of EXIF and TIFF may all stand for the same bytes; together they may stand for so many times those of the file.
MOST_SHARED = 16
# Of a value, by type.
TAG_BYTES = {1: 1, 2: 1, 3: 2, 4: 4, 5: 8, 6: 1, 7: 1, 8: 2, 9: 4, 10: 8, 11: 4, 12: 8, 13: 4, 16: 8}
TIFF = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
RAW = (b"IIU\0", b"IIRO", b"IIRS", b"MMOR", b"FUJIFILMCCD-RAW")  # Panasonic, Olympus, Fujifilm
HEIF_BRANDS = frozenset({"heic", "heix", "heim", "heis", "hevc", "hevx", "hevm", "hevs", "mif1", "mif2", "msf1"})
AVIF_BRANDS = frozenset({"avif", "avis"})
AUDIO_BRANDS = frozenset(("M4A ", "M4B ", "M4P "))
QUICKTIME_ATOMS = (b"moov", b"mdat", b"wide", b"free", b"skip", b"pnot")
VIDEO = (b"\x1aE\xdf\xa3", b"\0\0\x01\xba", b"0&\xb2u\x8ef\xcf\x11", b"FLV\x01", b"OggS")
TS_PACKETS = ((0, 188), (4, 192))  # MPEG transport streams: where the sync byte is, and every how many
# Pictures that are not read, and what else is found under the names of photos.
UNREAD = {
    b"\0\0\0\x0cjP  ": "a JPEG 2000 image",
    b"\0\0\0\x0cJXL ": "a JPEG XL image",
    b"\xff\x0a": "a JPEG XL image",
    b"8BPS": "a Photoshop document",
    b"v/1\x01": "an OpenEXR image",
    b"#?RADIANCE": "a Radiance HDR image",
}
STRANGE = {
    b"GIF8": "a GIF",
    b"%!PS": "PostScript",
    b"%PDF": "a PDF",
    b"PK\x03\x04": "an archive: unpack it",
    b"Rar!": "an archive: unpack it",
    b"7z\xbc\xaf": "an archive: unpack it",
    b"version https://git-lfs": "a pointer of Git LFS: run `git lfs pull`",
    b"<!DOCTYPE": "a web page",
    b"<html": "a web page",
    b"#EXTM3U": "a playlist",
}


class Kind(Enum):
    """What a file is."""

    PHOTO = auto()
    RAW = auto()
    VIDEO = auto()
    UNREAD = auto()  # a picture of a format that is not read
    OTHER = auto()


def kind_of(file: Path) -> Kind:
    """What `file` is: by its content, where that is a TIFF also by its ending, since most raw files are TIFF.

    Raises:
        OSError: it cannot be read.
    """
    return kind_of_head(read_head_bytes(file), file.suffix.lower())


def kind_of_head(head: bytes, suffix: str) -> Kind:
    """The same of the first `HEAD_BYTES` and the ending in lower case."""
    raw = suffix in RAW_SUFFIXES
    if head.startswith(TIFF):
        return Kind.RAW if raw or head[8:10] == b"CR" else Kind.PHOTO
    if head.startswith((b"\xff\xd8\xff", b"\x89PNG\r\n\x1a\n")) or (head.startswith(b"RIFF") and head[8:12] == b"WEBP"):
        return Kind.PHOTO
    if head.startswith(b"BM") and head[6:10] == bytes(4):  # these two letters alone begin many a text
        return Kind.PHOTO
    if head[4:8] == b"ftyp":
        return _kind_of_brand(head[8:12].decode("latin-1"))
    if head.startswith(RAW) or (raw and head):
        return Kind.RAW
    if any(head.startswith(magic) for magic in UNREAD):
        return Kind.UNREAD
    if head.startswith(VIDEO) or (head.startswith(b"RIFF") and head[8:12] == b"AVI "):
        return Kind.VIDEO
    if head[4:8] in QUICKTIME_ATOMS or any(head[at::step][:3] == b"GGG" for at, step in TS_PACKETS):
        return Kind.VIDEO
    return Kind.OTHER


def _kind_of_brand(brand: str) -> Kind:
    """Of an ISO base media file: HEIF, Canon's raw files, QuickTime, MP4."""
    if brand in HEIF_BRANDS | AVIF_BRANDS:
        return Kind.PHOTO
    if brand == "crx ":
        return Kind.RAW
    return Kind.OTHER if brand in AUDIO_BRANDS else Kind.VIDEO


def in_words(head: bytes) -> str:
    """What a file is that is no photo and no video, as far as its first bytes tell."""
    if not head:
        return "empty"
    known = {**STRANGE, **UNREAD}
    return next((words for magic, words in known.items() if head.startswith(magic)), "damaged, or another format")


def read_head_bytes(file: Path) -> bytes:
    """
    Raises:
        OSError: it cannot be read, or is no regular file.
    """
    check_regular(file)
    with file.open("rb") as stream:
        return stream.read(HEAD_BYTES)


def open_image(file: Path | io.BytesIO) -> Any:
    """A picture of a user's as Pillow's image; nothing is decoded yet.

    Raises:
        OSError: it cannot be read, is of none of `PHOTO_FORMATS`, or a JPEG that is cut off. Damaged files raise nearly
            anything.
    """
    from PIL import Image

    register_formats()
    if isinstance(file, Path):
        check_regular(file)
    image = Image.open(file, formats=PHOTO_FORMATS)
    num_bytes = file.stat().st_size if isinstance(file, Path) else file.getbuffer().nbytes
    if image.format in ("JPEG", "MPO") and image.width * image.height > JPEG_PIXELS_PER_BYTE * num_bytes:
        image.close()
        raise OSError(f"{num_bytes} bytes are too few for {image.width} x {image.height} pixels")
    if image.format == "TIFF":
        image.filename = ""  # or Pillow maps the file, and shuffles pixels that EXIF turns by 90 degrees
    return image


def check_png(file: Path | io.BytesIO) -> None:
    """Hold what the chunks of a PNG claim against the bytes that are there: OpenCV takes memory for all of it.

    Raises:
        ValueError: it is damaged, or no PNG.
    """
    try:
        with open_image(file) as image:
            if image.format != "PNG":
                raise ValueError("it is no PNG")
            image.verify()
    except Exception as error:  # Pillow raises nearly anything on a damaged file
        raise ValueError(reason(error)) from error


@lru_cache
def register_formats() -> None:
    """Teach Pillow HEIF (it has AVIF and WebP built in), and what not to believe.

    Readers judge sizes by the memory that is there, see `stages.capture.photo_reading`; no limit is fixed.
    """
    from PIL import Image, TiffImagePlugin
    from pillow_heif import register_heif_opener

    register_heif_opener()
    Image.MAX_IMAGE_PIXELS = None  # a fixed limit refuses what phones take
    load = TiffImagePlugin.ImageFileDirectory_v2.load

    @wraps(load)
    def load_checked(directory: Any, stream: Any) -> None:
        _check_tags(stream, "<" if directory.prefix == b"II" else ">", directory._bigtiff)
        load(directory, stream)

    TiffImagePlugin.ImageFileDirectory_v2.load = load_checked  # type: ignore[assignment,method-assign]
    warnings.filterwarnings("ignore", category=UserWarning, module=r"PIL\.")  # odd EXIF is no news to users


def _check_tags(stream: Any, order: str, is_big: bool) -> None:
    """Hold the bytes that the tags from here on in a TIFF or EXIF claim against those that there are.

    Raises:
        SyntaxError: they claim far more, see `MOST_SHARED`; Pillow's own error for files that make no sense.
    """
    start = stream.tell()
    total = stream.seek(0, os.SEEK_END)
    stream.seek(start)
    count, entry = (struct.Struct(order + form) for form in (("Q", "HHQ8x") if is_big else ("H", "HHL4x")))
    entries = stream.read(count.size)
    number = min(count.unpack(entries)[0], total // entry.size) if len(entries) == count.size else 0
    claimed = 0
    for _ in range(number):
        data = stream.read(entry.size)
        if len(data) < entry.size:
            break
        _, kind, values = entry.unpack(data)
        claimed += min(values * TAG_BYTES.get(kind, 0), total)
        if claimed > MOST_SHARED * total:
            raise SyntaxError(f"tags of more than {MOST_SHARED} times its {total} bytes")
    stream.seek(start)
