"""What ingest publishes: upright photos, their masks, and what is known of each."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from pathlib import Path

from pydantic import with_config

from stages.artifacts.artifact import Artifact
from stages.artifacts.json_files import PathInside, read_record, write_json
from stages.artifacts.pictures import pictures_of

_RECORDS = "images.json"

LEFT_OUT = "named in ingest.leave_out"  # why a photo was skipped that no stage may see


@with_config(allow_inf_nan=False, extra="forbid")
@dataclass(frozen=True)
class ImageRecord:
    """One photo that was taken in.

    Attributes:
        name: relative posix path under `images/`; the source's own path when the file could be kept as it is.
        source: path of the photo relative to the photo folder.
        width, height: upright size in pixels.
        focal_px: focal length prior in pixels, or None.
        camera: photos with the same value share one camera's intrinsics.
        blur: variance of the Laplacian of the grey image at <= 1 megapixel; low is blurred.
        has_mask: whether `masks/<name>.png` exists.
        sha256: hash of the source file.
        gps: latitude and longitude in degrees (WGS 84) and altitude in metres, where EXIF has all three.
        made_mask: the way of `ingest.auto_mask` in which its mask was made; empty where it came with the photo or
            there is none. What "salient" made is a guess, see `SILHOUETTES`.
        taken: upright width and height in pixels of the source, which may have been reduced; None: as it is.
        frame: views that were taken at once from one place, as those of a 360-degree picture, have the same; empty
            for photos. Their intrinsics are known: no distortion, the principal point in the middle.
        cam_from_frame: [3][3] rotation from what the views of a frame share into this one.
    """

    name: PathInside
    source: str
    width: int
    height: int
    focal_px: float | None
    camera: str
    blur: float
    has_mask: bool
    sha256: str
    gps: tuple[float, float, float] | None = None
    made_mask: str = ""
    taken: tuple[int, int] | None = None
    frame: str = ""
    cam_from_frame: tuple[tuple[float, ...], ...] | None = None


@dataclass(frozen=True)
class SkippedImage:
    """A file that was left out, and why, in words.

    Attributes:
        expected: whether that is no news: it is what cameras and programs leave beside photos.
        sha256: hash of a file that was left out as `LEFT_OUT` says; empty for others.
    """

    source: str
    reason: str
    expected: bool = False
    sha256: str = ""


@dataclass(frozen=True)
class ImageSet:
    """All that ingest found: photos kept (sorted by name) and files left out."""

    images: tuple[ImageRecord, ...]
    skipped: tuple[SkippedImage, ...] = field(default=())


def _save_image_set(folder: Path, image_set: ImageSet) -> None:
    write_json(folder / _RECORDS, asdict(image_set))


def _load_image_set(folder: Path) -> ImageSet:
    return read_record(folder / _RECORDS, ImageSet)


PHOTOS = pictures_of("ingest")
IMAGE_SET = Artifact("ingest", (_RECORDS,), _load_image_set, _save_image_set)
