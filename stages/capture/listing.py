"""Which files of a folder are photos, which are videos, and why the others are neither."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

from stages.artifacts import SkippedImage
from stages.capture.panoramas import STITCH, UNSTITCHED
from stages.capture.photo_reading import PHOTO_SUFFIXES, RAW_SUFFIXES
from stages.errors import InputError

NAMED = 4  # this many files are named in a sentence
VIDEO_SUFFIXES = frozenset({".mp4", ".mov", ".avi", ".mkv", ".m4v", ".webm", ".mts", ".3gp"})


def is_video(path: Path) -> bool:
    return path.suffix.lower() in VIDEO_SUFFIXES


def list_captures(source: Path, masks_folder: Path | None = None) -> tuple[list[str], list[str], list[SkippedImage]]:
    """Photos, videos (posix paths relative to the folder `source`, sorted), and what is neither with the reason.

    `source` may also be one video: then its own name is the only path, relative to the folder it is in.

    Raises:
        InputError: `source` is not there or is a file of another kind, or `masks_folder` is no folder.
    """
    if not source.exists():
        raise InputError(f"The photo folder {source} does not exist.", "Check the path: hineus run PHOTOS")
    if source.is_file() and is_video(source):
        return [], [source.name], []
    if not source.is_dir():
        raise InputError(f"{source} is a file; a folder of photos or a video is needed.", f"hineus run {source.parent}")
    if masks_folder is not None and not masks_folder.is_dir():
        raise InputError(f"The mask folder {masks_folder} does not exist.", "Check the path given to --masks.")
    inside_masks = masks_folder.resolve() if masks_folder else None
    photos, videos, skipped = [], [], []
    for path in sorted(source.rglob("*")):
        relative = path.relative_to(source)
        if not path.is_file() or any(part.startswith((".", "__MACOSX")) for part in relative.parts):
            continue
        if inside_masks and inside_masks != source.resolve() and inside_masks in path.resolve().parents:
            continue
        name, suffix = relative.as_posix(), path.suffix.lower()
        if suffix in PHOTO_SUFFIXES | RAW_SUFFIXES:
            photos.append(name)
        elif suffix in VIDEO_SUFFIXES:
            videos.append(name)
        else:
            kind = f"{UNSTITCHED[suffix]}: {STITCH}" if suffix in UNSTITCHED else "not an image"
            skipped.append(SkippedImage(name, f"{kind} ({suffix or 'no file extension'})"))
    return _without_companions(photos, videos, skipped)


def _without_companions(
    photos: list[str], videos: list[str], skipped: list[SkippedImage]
) -> tuple[list[str], list[str], list[SkippedImage]]:
    """Leave out what a camera wrote beside a photo: the raw file of a JPEG, the clip of a live photo."""
    raws = {path for path in photos if Path(path).suffix.lower() in RAW_SUFFIXES}
    pictures = {_stem(path): path for path in photos if path not in raws}
    for path in sorted(raws):
        if _stem(path) in pictures:
            skipped.append(SkippedImage(path, f"the raw file of {pictures[_stem(path)]}"))
            photos.remove(path)
    for path in list(videos):
        if _stem(path) in pictures:
            skipped.append(SkippedImage(path, f"the clip of the live photo {pictures[_stem(path)]}"))
            videos.remove(path)
    return photos, videos, skipped


def _stem(path: str) -> str:
    return str(Path(path).with_suffix("")).lower()


def by_reason(skipped: Iterable[SkippedImage]) -> dict[str, list[str]]:
    """Reason -> the files that were left out for it."""
    sources: dict[str, list[str]] = {}
    for item in skipped:
        sources.setdefault(item.reason, []).append(item.source)
    return sources


def name_some(names: Sequence[str]) -> str:
    """The first of these files and how many more there are, for a sentence."""
    more = len(names) - NAMED
    return ", ".join(names[:NAMED]) + (f" and {more} more" if more > 0 else "")
