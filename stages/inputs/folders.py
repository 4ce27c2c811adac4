"""A user's folder: its files under readable names, less what cameras, NAS boxes and programs leave beside photos."""

from __future__ import annotations

import hashlib
import stat
import unicodedata
from collections.abc import Callable, Container, Iterator, Mapping
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path, PurePosixPath

from stages.inputs.bounded import is_hole

WORKSPACE_RECORD = "workspace.json"  # a folder with this file is a workspace of ours

# What is left out by name alone, in lower case: patterns, and what they are in words.
COMPANION_FOLDERS = {
    "__macosx": "what macOS adds to archives",
    "@eadir": "previews of a Synology NAS",
    "@__thumb": "previews of a QNAP NAS",
    "[#@]recycle": "a NAS's recycle bin",
    "[#@]snapshot": "a NAS's snapshots",
    "$recycle.bin": "a recycle bin",
    "system volume information": "files of Windows",
    "lost+found": "files of the file system",
    "*.lrdata": "previews of Lightroom",
    "captureone": "previews and settings of Capture One",
    "thumbnails": "previews",
    "thmbnl": "previews of a camera's videos",
    ".thumbnails": "previews",
    ".picasaoriginals": "what Picasa kept of edited photos",
}
COMPANION_FILES = {
    "*.xmp": "a program's notes on a photo",
    "*.aae": "a phone's notes on a photo",
    "*.pp3": "RawTherapee's notes on a photo",
    "*.dop": "DxO's notes on a photo",
    "*.thm": "the preview of a video",
    "*.lr[vf]": "a small copy of a video",
    "lrv_*.insv": "a small copy of a video",
    "thumbs.db": "previews of Windows",
    "ehthumbs*.db": "previews of Windows",
    "desktop.ini": "settings of Windows",
    "*picasa.ini": "settings of Picasa",
    "*digikam*.db": "digiKam's catalogue",
    "*_original": "ExifTool's copy of a photo",
    "*~": "a copy that an editor made",
    "*.bak": "a copy that a program made",
    "*.orig": "a copy that a program made",
}
# Named aloud even where they are hidden: somebody is waiting for them.
UNFINISHED_FILES = {
    "*.icloud": "only in iCloud: download it first",
    "*.part": "half-copied",
    "*.partial": "half-copied",
    "*.filepart": "half-copied",
    "*.crdownload": "half-downloaded",
    "*.download": "half-downloaded",
}
SMALL_VIDEOS = ("m4root", "sub")  # where Sony's cameras keep small copies of videos
MOST_DEPTH = 64  # folders in each other that are looked into
MOST_BYTES = 200  # of a name that we give, less its suffix: file systems take 255, and more suffixes are added
MOST_SUFFIX, HASH = 8, 8  # characters, the dot among them; digits


@dataclass(frozen=True)
class LeftOut:
    """A file or folder that is left out by its name or kind: its readable path, and why, in words.

    Attributes:
        missed: whether somebody may be waiting for it, so that it is told as what is wrong with the photos.
    """

    name: str
    reason: str
    missed: bool = False


def is_workspace(folder: Path) -> bool:
    """Whether the folder is a workspace, whose pictures are nobody's photos."""
    return (folder / WORKSPACE_RECORD).is_file()


def named_files(folder: Path) -> tuple[dict[str, Path], list[LeftOut]]:
    """Files below `folder` by readable posix path relative to it, sorted; and what was left out.

    Links to folders are followed, each folder once. Hidden files are left out without a word.

    Raises:
        OSError: `folder` itself cannot be read.
    """
    left: list[LeftOut] = []
    named: dict[str, Path] = {}
    for path in _walk(folder, folder.resolve(), set(), folder, left):
        named[unique_name(readable(path.relative_to(folder).as_posix()), named)] = path
    return dict(sorted(named.items())), left


def readable(name: str) -> str:
    """A file's name or path as text that can be written anywhere: the same for all spellings of one name.

    NFC, as macOS does not store it. A byte that is not UTF-8, which Python gives as a lone surrogate, is read as
    Latin-1, which it mostly is; what controls a terminal or ends a line becomes "_".
    """
    text = "".join(chr(ord(c) - 0xDC00) if "\udc80" <= c <= "\udcff" else c for c in name)
    text = unicodedata.normalize("NFC", text)
    return "".join("_" if unicodedata.category(c) in ("Cc", "Cs", "Zl", "Zp") else c for c in text)


def unique_name(name: str, taken: Container[str], key: Callable[[str], str] = str) -> str:
    """`name`, or `name` with "~2", "~3", ... before its suffix where the `key` of it is `taken`."""
    path, number, found = PurePosixPath(name), 1, name
    while key(found) in taken:
        number += 1
        found = path.with_name(f"{path.stem}~{number}{path.suffix}").as_posix()
    return found


def short_name(name: str) -> str:
    """A relative posix path in which the long parts end in "~" and a hash, so that none is too long for a file.

    Whatever its suffix, if it has any, a name is cut alike.
    """
    return "/".join(_cut(part) for part in name.split("/"))


def _cut(part: str) -> str:
    suffix = PurePosixPath(part).suffix
    stem = part.removesuffix(suffix if len(suffix) <= MOST_SUFFIX else "").encode()
    if len(stem) <= MOST_BYTES:
        return part
    start = stem[: MOST_BYTES - HASH - 1].decode(errors="ignore")
    return f"{start}~{hashlib.sha256(stem).hexdigest()[:HASH]}{part[len(stem.decode()) :]}"


# ---------------------------------------------------------------- the walk
def _walk(folder: Path, root: Path, seen: set[tuple[int, int]], top: Path, left: list[LeftOut]) -> Iterator[Path]:
    """Files below `folder`.

    Args:
        root: the real path of `top`, where the walk began. seen: device and inode of folders that were walked.
        left: gets what is left out.
    """
    place = folder.stat()
    if (place.st_dev, place.st_ino) in seen:
        return
    seen.add((place.st_dev, place.st_ino))
    for path in sorted(folder.iterdir()):
        name = readable(path.relative_to(top).as_posix())
        try:
            found = path.stat()
        except OSError:
            if not path.name.startswith("."):
                what = "a link to nothing" if path.is_symlink() else "may not be read"
                left.append(LeftOut(name, what, missed=True))
            continue
        if stat.S_ISDIR(found.st_mode):
            try:
                if (why := _why_not_into(path, root, top)) is None:
                    yield from _walk(path, root, seen, top, left)
                elif why:
                    left.append(LeftOut(name, why))
            except OSError:
                left.append(LeftOut(name, "a folder that may not be read", missed=True))
        elif (reason := _match(UNFINISHED_FILES, path)) is not None:
            left.append(LeftOut(name, reason, missed=True))
        elif path.name.startswith("."):
            continue
        elif (reason := _match(COMPANION_FILES, path)) is not None:
            left.append(LeftOut(name, reason))
        elif is_hole(found):
            left.append(LeftOut(name, f"it claims {found.st_size} bytes and has next to none", missed=True))
        elif stat.S_ISREG(found.st_mode):
            yield path
        else:
            left.append(LeftOut(name, "no file but a pipe, a socket or a device"))


def _match(patterns: Mapping[str, str], path: Path) -> str | None:
    """What the first pattern that fits the name stands for."""
    name = path.name.lower()
    return next((meaning for pattern, meaning in patterns.items() if fnmatchcase(name, pattern)), None)


def _why_not_into(path: Path, root: Path, top: Path) -> str | None:
    """Why a folder is not looked into, None where it is; empty where that is no news."""
    if (reason := _match(COMPANION_FOLDERS, path)) is not None:
        return reason
    if path.name.startswith("."):
        return "a hidden folder"
    if (path.parent.name.lower(), path.name.lower()) == SMALL_VIDEOS:
        return "small copies of videos"
    if is_workspace(path):
        return "a workspace of hineus"
    if len(path.relative_to(top).parts) > MOST_DEPTH:
        return f"more than {MOST_DEPTH} folders deep"
    if path.is_symlink():
        target = path.resolve()
        if root in target.parents:
            return ""  # it is walked where it lies
        if target == root or target in root.parents:
            return "a link to a folder that this one is in"
    return None
