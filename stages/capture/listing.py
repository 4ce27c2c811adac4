"""Which files of a folder are photos, which are videos, and why the others are neither."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Sequence
from pathlib import Path, PurePosixPath

from stages.artifacts import SkippedImage
from stages.capture.panoramas import STITCH, UNSTITCHED
from stages.errors import InputError
from stages.inputs.folders import named_files, readable
from stages.inputs.formats import (
    HEIF_SUFFIXES,
    JPEG_SUFFIXES,
    PHOTO_SUFFIXES,
    RAW_SUFFIXES,
    VIDEO_SUFFIXES,
    Kind,
    in_words,
    kind_of_head,
    read_head_bytes,
)

NAMED = 4  # this many files are named in a sentence
# An edited copy, by the names that Apple's phones (IMG_E1234), Google Photos and people give it.
EDITED = re.compile(r"(?P<start>.*/|)(?:img_e(?P<number>\d{4})|(?P<rest>[^/]+?)[-_ ](?:edited|bearbeitet)(?:\(\d+\))?)")
# Pictures of one shot of Google's phones: PXL_1.RAW-01.COVER.jpg and PXL_1.RAW-02.ORIGINAL.dng.
PART_OF_SHOT = re.compile(r"\.[a-z_]+-\d\d\.(?:cover|original|main)$")

Files = dict[str, Path]


def is_video(path: Path) -> bool:
    """Whether a file is a video, by its name or its content."""
    return path.is_file() and (path.suffix.lower() in VIDEO_SUFFIXES or _kind(path)[0] is Kind.VIDEO)


def list_captures(
    source: Path, masks_folder: Path | None = None, masks: Collection[Path] = ()
) -> tuple[Files, Files, list[SkippedImage]]:
    """Photos and videos by readable posix path relative to the folder `source`, sorted; what is neither, and why.

    A file is what its content says. `source` may also be one video: then its own name is the only path. What lies in
    `masks_folder` is left out; of a folder with other files, too, only the `masks` in it that are given.

    Raises:
        InputError: `source` is not there, may not be read or is a file of another kind, or `masks_folder` is no folder.
    """
    if not source.exists():
        raise InputError(f"The photo folder {source} does not exist.", "Check the path: hineus run PHOTOS")
    if is_video(source):
        return {}, {readable(source.name): source}, []
    if not source.is_dir():
        raise InputError(f"{source} is a file; a folder of photos or a video is needed.", f"hineus run {source.parent}")
    if masks_folder is not None and masks_folder.is_file():
        raise InputError(f"{masks_folder} is a file; a folder of masks is needed.", f"--masks {masks_folder.parent}")
    if masks_folder is not None and not masks_folder.is_dir():
        raise InputError(f"The mask folder {masks_folder} does not exist.", "Check the path given to --masks.")
    inside_masks = masks_folder.resolve() if masks_folder and not masks else None
    if inside_masks and source.resolve().is_relative_to(inside_masks):  # the photos may lie in the masks' folder
        inside_masks = None
    named = {mask.resolve() for mask in masks}
    photos: Files = {}
    videos: Files = {}
    try:
        files, left = named_files(source)
    except OSError as error:
        raise InputError(
            f"The photo folder {source} cannot be read ({error.strerror}).", f"Allow it: `chmod u+rx {source}`."
        ) from error
    skipped = [SkippedImage(item.name, item.reason, expected=not item.missed) for item in left]
    for name, path in files.items():
        if path.resolve() in named or (inside_masks and inside_masks in path.resolve().parents):
            continue
        try:
            kind, words = _kind(path)
        except OSError as error:
            skipped.append(SkippedImage(name, f"cannot be read ({error.strerror})"))
            continue
        suffix = path.suffix.lower()
        if suffix in UNSTITCHED:
            skipped.append(SkippedImage(name, f"{UNSTITCHED[suffix]}: {STITCH}"))
        elif kind in (Kind.PHOTO, Kind.RAW):
            photos[name] = path
        elif kind is Kind.VIDEO:
            videos[name] = path
        elif kind is Kind.UNREAD:
            skipped.append(SkippedImage(name, f"{words}, which is not read: convert it to JPEG, PNG or TIFF"))
        elif suffix in VIDEO_SUFFIXES:
            skipped.append(SkippedImage(name, f"cannot be read as a video ({words})"))
        elif suffix in PHOTO_SUFFIXES | RAW_SUFFIXES:
            skipped.append(SkippedImage(name, f"no image, whatever its name says ({words})"))
        else:
            skipped.append(SkippedImage(name, f"not an image ({suffix or 'no file extension'})", expected=True))
    return _without_companions(photos, videos, skipped)


def _kind(file: Path) -> tuple[Kind, str]:
    """What a file is, and in words what it is where it is no photo and no video.

    Raises:
        OSError: it cannot be read.
    """
    head = read_head_bytes(file)
    return kind_of_head(head, file.suffix.lower()), in_words(head)


def _without_companions(
    photos: Files, videos: Files, skipped: list[SkippedImage]
) -> tuple[Files, Files, list[SkippedImage]]:
    """Leave out what a camera or a program made beside a photo of the same shot."""
    companions = _raw_files(photos) | _second_files(photos)
    pictures = {_shot(path): path for path in photos if path not in companions}
    clips = [*videos, *(item.source for item in skipped if _suffix(item.source) in VIDEO_SUFFIXES)]
    companions |= {
        path: f"the clip of the live photo {pictures[_shot(path)]}" for path in clips if _shot(path) in pictures
    }
    skipped = [item for item in skipped if item.source not in companions]
    skipped += [SkippedImage(path, reason, expected=True) for path, reason in companions.items()]
    return (
        {path: file for path, file in photos.items() if path not in companions},
        {path: file for path, file in videos.items() if path not in companions},
        skipped,
    )


def _raw_files(photos: Files) -> dict[str, str]:
    """Raw files of which the camera's own picture is there, and why they are left out."""
    pictures = {_shot(path): path for path in photos if _suffix(path) not in RAW_SUFFIXES}
    return {
        path: f"the raw file of {pictures[_shot(path)]}"
        for path in photos
        if _suffix(path) in RAW_SUFFIXES and _shot(path) in pictures
    }


def _second_files(photos: Files) -> dict[str, str]:
    """Further pictures of a shot, and why they are left out: edited copies, HEIF beside JPEG, blurred portraits."""
    stems = {_stem(path): path for path in photos}
    jpegs = {_stem(path): path for path in photos if _suffix(path) in JPEG_SUFFIXES}
    found = {}
    for path in photos:
        stem = _stem(path)
        edited = EDITED.fullmatch(stem)
        original = edited and stems.get(
            edited["start"] + (f"img_{edited['number']}" if edited["number"] else edited["rest"])
        )
        if original:
            found[path] = f"an edited copy of {original}"
        elif _suffix(path) in HEIF_SUFFIXES and stem in jpegs:
            found[path] = f"the HEIF of {jpegs[stem]}"
        elif ".portrait-" in stem and stem.endswith(".cover"):
            others = [other for other in photos if other != path and _shot(other) == _shot(path)]
            found |= {path: f"made blurred from {others[0]}"} if others else {}
    return found


def _stem(path: str) -> str:
    return str(PurePosixPath(path).with_suffix("")).lower()


def _shot(path: str) -> str:
    """The same for all that a camera wrote of one shot."""
    return PART_OF_SHOT.sub("", _stem(path))


def _suffix(path: str) -> str:
    return PurePosixPath(path).suffix.lower()


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
