"""Which file is the mask of which photo, told from their names: those that other programs give, and regular others.

    ODM, Metashape, openMVG, ContextCapture   IMG_1_mask.JPG, IMG_1_mask.png, IMG_1_mask.tif
    openMVS                                   IMG_1.mask.png
    RealityCapture                            IMG_1.jpg.mask.png, or the folder .mask
    COLMAP, OpenSfM, hineus                   masks/IMG_1.jpg.png
    nerfstudio, Meshroom, NeuS                masks/IMG_1.png, mask/IMG_1.png
    MicMac                                    IMG_1_Masq.tif
    instant-ngp                               dynamic_mask_IMG_1.png

All paths are posix paths, relative to the folder of the photos or that of the masks.
"""

from __future__ import annotations

import re
import unicodedata
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path, PurePosixPath

from stages.inputs.formats import PHOTO_SUFFIXES

_WORD = r"(?:masks?|masq|matte|silhouette|alpha)"
_AFTER = re.compile(rf"(?P<photo>.+?)[ ._-]*[(\[]?{_WORD}[)\]]?")
_BEFORE = re.compile(rf"(?:dynamic_)?{_WORD}[ ._-]+(?P<photo>.+)")
_FOLDER = re.compile(r"[._]?masks?(?:[ ._-]\w+)?", re.IGNORECASE)
_PLAIN_FOLDER = re.compile(r"masks?", re.IGNORECASE)  # nerfstudio reduces `masks` to `masks_2`
_PHOTO_FOLDER = re.compile(r"images?|img|imgs|photos?|rgb|input", re.IGNORECASE)
_ONE_FOR_ALL = re.compile(_WORD)
REGULAR = 0.5  # so many of the photos must have a mask before an unknown ending of names counts as one


def is_mask_folder(name: str) -> bool:
    return _FOLDER.fullmatch(name) is not None


def pair(photos: Sequence[str], masks: Sequence[str]) -> dict[str, str]:
    """Photo -> its mask, by the names that programs give, or where there are none by what the names have in common."""
    return pair_by_name(photos, masks) or pair_by_ending(photos, masks)


def pair_by_name(photos: Sequence[str], masks: Iterable[str]) -> dict[str, str]:
    """Photo -> its mask. Where several fit, the one with more of its folders in common with the photo.

    Two masks that fit equally well in different folders are none, nor is a mask that fits photos of several folders.
    """
    by_key: dict[str, list[str]] = {}
    for mask in sorted(masks):
        for key in dict.fromkeys(_photo_names(mask)):
            by_key.setdefault(key, []).append(mask)
    wanted: dict[str, list[tuple[tuple[int, ...], str]]] = {}
    for photo in photos:
        name = _folded(PurePosixPath(photo).name)
        keys = dict.fromkeys((name, PurePosixPath(name).stem))
        fitting = [(_likeness(mask, photo, key == name), mask) for key in keys for mask in by_key.get(key, ())]
        if not fitting:
            continue
        best = max(score for score, _ in fitting)
        first, *others = (mask for score, mask in fitting if score == best)
        if all(_parents(mask) == _parents(first) for mask in others):
            wanted.setdefault(first, []).append((best, photo))
    found: dict[str, str] = {}
    for mask, claims in wanted.items():
        best = max(score for score, _ in claims)
        claiming = [photo for score, photo in claims if score == best]
        if len({_parents(photo) for photo in claiming}) == 1:
            found |= dict.fromkeys(claiming, mask)
    return {photo: found[photo] for photo in photos if photo in found}


def pair_by_ending(photos: Sequence[str], masks: Sequence[str]) -> dict[str, str]:
    """As `pair_by_name`, where all masks are called like their photos but for the same ending or beginning."""
    called = [_folded(PurePosixPath(photo).stem) for photo in photos]
    stems = {stem: photo for stem, photo in zip(called, photos, strict=True) if called.count(stem) == 1}
    parts: Counter[tuple[str, str]] = Counter()
    for name in (_folded(PurePosixPath(mask).stem) for mask in masks):
        parts.update((before, after) for stem in stems for before, found, after in [name.partition(stem)] if found)
    # digits beside a photo's number make another number
    regular = [(count, part) for part, count in parts.items() if not (part[0][-1:].isdigit() or part[1][:1].isdigit())]
    count, (before, after) = max(regular, default=(0, ("", "")))
    if count < max(2, REGULAR * len(photos)):
        return {}
    names = {f"{before}{stem}{after}": photo for stem, photo in stems.items()}
    found = {names.get(_folded(PurePosixPath(mask).stem)): mask for mask in masks}
    return {photo: mask for photo, mask in found.items() if photo is not None}


def set_masks_aside(files: Mapping[str, Path]) -> tuple[dict[str, Path], dict[str, Path], dict[str, Path]]:
    """Of what lies in the photos' own folder: the photos, the mask of each photo that has one, and all masks.

    A file is a mask where its name says so and names a photo: `IMG_1_mask.png` beside `IMG_1.jpg`,
    `masks/IMG_1.png` with `IMG_1.jpg` in another folder.
    """
    in_folder = [path for path in files if any(map(is_mask_folder, _parents(path)))]
    bare = [path for path in files if path not in set(in_folder) and not _says_mask(path)]
    by_folder: dict[tuple[str, ...], set[str]] = {}
    for path in bare:
        name = _folded(PurePosixPath(path).name)
        by_folder.setdefault(_parents(path), set()).update((name, PurePosixPath(name).stem))
    aside = [
        path
        for path in files
        if _says_mask(path)
        and (_is_for_all(path) or by_folder.get(_parents(path), set()) & set(_photo_names(path)))
        and _parents(path) in by_folder
    ]
    for folder in {_parents(path) for path in in_folder}:
        within = [path for path in in_folder if _parents(path) == folder]
        if pair(bare, within):
            aside += within
    masks = {path: files[path] for path in sorted(set(aside))}
    kept = {path: file for path, file in files.items() if path not in masks}
    own = pair(list(kept), [path for path in aside if not _is_for_all(path)])
    return kept, {photo: files[mask] for photo, mask in own.items()}, masks


def _photo_names(mask: str) -> list[str]:
    """What the photo of a mask may be called, with its suffix or without."""
    base = _folded(PurePosixPath(mask).stem)
    decorated = (pattern.fullmatch(base) for pattern in (_AFTER, _BEFORE))
    return [base, *(match["photo"] for match in decorated if match)]


def _says_mask(path: str) -> bool:
    """Whether a name alone says so: `X_mask.png`, `mask_X.png`, `X.jpg.png`, `mask.png`."""
    base = _folded(PurePosixPath(path).stem)
    doubled = PurePosixPath(base).suffix in PHOTO_SUFFIXES
    return doubled or _is_for_all(path) or any(pattern.fullmatch(base) for pattern in (_AFTER, _BEFORE))


def _is_for_all(path: str) -> bool:
    """`mask.tif`: one for a whole folder, as ContextCapture has it."""
    return _ONE_FOR_ALL.fullmatch(_folded(PurePosixPath(path).stem)) is not None


def _folded(name: str) -> str:
    """Names differ in case between programs, and in the composition of accents between systems."""
    return unicodedata.normalize("NFC", name).casefold()


def _parents(path: str) -> tuple[str, ...]:
    return PurePosixPath(path).parent.parts


def _likeness(mask: str, photo: str, whole_name: bool) -> tuple[int, ...]:
    """How well a mask fits a photo whose name it has: folders in common from the end, then the plainest name."""
    of_mask = [name for name in _parents(mask) if not is_mask_folder(name)]
    of_photo = [name for name in _parents(photo) if not _PHOTO_FOLDER.fullmatch(name)]
    common = 0
    for one, other in zip(reversed(of_mask), reversed(of_photo), strict=False):
        if one != other:
            break
        common += 1
    reduced = any(is_mask_folder(name) and not _PLAIN_FOLDER.fullmatch(name) for name in _parents(mask))
    same_case = PurePosixPath(mask).name.startswith(PurePosixPath(photo).stem)
    return common, not reduced, whole_name, same_case
