"""The files of a workspace, which may have come from somebody else: nothing is read or written through a link in it.

A link, a pipe, a device, or a second name of a file that is written in place is refused by name. The workspace itself
may be reached through links, and so may photos.
"""

from __future__ import annotations

import errno
import os
import shlex
import shutil
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO, Literal

from stages.errors import WorkspaceError
from stages.inputs.folders import readable

MOST_BYTES = 1 << 26  # of a text of ours: the manifest of 100,000 photos takes less

# Absent on Windows, where making links needs a right that few have. Opening a pipe would wait for its other end.
UNFOLLOWED = getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0)
NO_FILE = (errno.ELOOP, errno.EMLINK, errno.ENXIO, errno.EISDIR)  # what opening a link, a pipe or a folder gives


# ---------------------------------------------------------------- looking
def refuse_foreign(
    place: Path, kind: Literal["file", "folder", "either"] = "either", in_place: bool = False, but: str = ""
) -> None:
    """Refuse what is neither a file nor a folder, at `place` and in it; nothing need be there.

    Args:
        kind: what `place` itself should be.
        in_place: files there are written where they lie, so that a second name of one would be another file's change.
        but: what begins so in the folder `place` is not looked at.

    Raises:
        WorkspaceError: it names the first that is found.
    """
    waiting = [place]
    while waiting:
        path = waiting.pop()
        try:
            found = path.lstat()
            is_folder = stat.S_ISDIR(found.st_mode)
            below = list(path.iterdir()) if is_folder else []
        except OSError:  # whoever needs it tells
            continue
        foreign = not is_folder and (not stat.S_ISREG(found.st_mode) or (in_place and found.st_nlink > 1))
        if foreign or (path == place and kind == ("file" if is_folder else "folder")):
            raise _refusal(path, found)
        waiting += [each for each in below if not (but and path == place and each.name.startswith(but))]


def refuse_link(place: Path) -> None:
    """Refuse a link at `place`, where a folder of ours belongs or nothing is yet.

    Raises:
        WorkspaceError: there is one.
    """
    if place.is_symlink():
        raise _refusal(place, place.lstat())


def inside(folder: Path, name: str) -> Path:
    """Where the file of this name lies in a folder.

    Raises:
        WorkspaceError: the name leads out of the folder.
    """
    if not stays_inside(name):
        raise WorkspaceError(
            f"A record of the workspace names the file {readable(name)}, which is not in {folder}.",
            "If the workspace came from somebody else, do not use it; else make it again from the photos.",
        )
    return folder / name


def stays_inside(name: str) -> bool:
    """Whether a file's relative path leads nowhere but below the folder that it is relative to."""
    path = Path(name)
    return bool(path.parts) and not path.anchor and ".." not in path.parts and "\0" not in name


# ---------------------------------------------------------------- opening
def open_own(path: str | os.PathLike[str], flags: int) -> int:
    """A descriptor of a file of ours, made where the flags say so; `open` takes it as its `opener`.

    Raises:
        WorkspaceError: it is a link or no file, or has a second name where it is opened for writing.
        OSError: it cannot be opened.
    """
    try:
        descriptor = os.open(path, flags | UNFOLLOWED, 0o644)
    except OSError as error:
        if error.errno in NO_FILE:
            raise _refusal(Path(path), os.lstat(path)) from error
        raise
    found = os.fstat(descriptor)
    if not stat.S_ISREG(found.st_mode) or (flags & (os.O_WRONLY | os.O_RDWR) and found.st_nlink > 1):
        os.close(descriptor)
        raise _refusal(Path(path), found)
    return descriptor


def read_own(path: Path) -> bytes:
    """The contents of a text of ours.

    Raises:
        WorkspaceError: it is a link, no file, or larger than any that we write.
        OSError: it is not there, or cannot be read.
    """
    with open(path, "rb", opener=open_own) as file:
        size = os.fstat(file.fileno()).st_size
        if size > MOST_BYTES:
            raise WorkspaceError(
                f"{path} has {size:,} bytes; at most {MOST_BYTES:,} are read.",
                f"It is no file of ours: remove it with `rm {shlex.quote(str(path))}`, and run again.",
            )
        return file.read(size)


def read_tail(path: Path, most: int = 1 << 16) -> bytes:
    """The last bytes of a file of ours, some hundred lines, however long it has grown; empty where there is none.

    Raises:
        WorkspaceError: it is a link, or no file.
    """
    try:
        with open(path, "rb", opener=open_own) as file:
            file.seek(max(0, os.fstat(file.fileno()).st_size - most))
            return file.read(most)
    except FileNotFoundError:
        return b""


@contextmanager
def written_whole(path: Path) -> Iterator[BinaryIO]:
    """A file to write to, beside `path`; at the end it takes its place. A kill leaves one of the two whole."""
    temporary = path.with_name(path.name + ".tmp")
    remove(temporary)  # a link there would be followed
    with temporary.open("xb") as file:
        yield file
        file.flush()
        os.fsync(file.fileno())
    temporary.replace(path)
    sync(path.parent)


def write_own(path: Path, text: str) -> None:
    """Write a small file whole or not at all, and make sure it is on the disk."""
    with written_whole(path) as file:
        file.write(text.encode())


def remove(path: Path) -> None:
    """Remove a file, a link or a folder with all in it; nothing need be there."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def sync(path: Path) -> None:
    """Make sure that a file, or a folder's list of files, is on the disk."""
    if os.name == "nt":  # it syncs neither folders nor files that are open for reading
        return
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _refusal(path: Path, found: os.stat_result) -> WorkspaceError:
    what = {
        stat.S_IFLNK: "is a link, and nothing is read or written through a link inside a workspace",
        stat.S_IFREG: f"has {found.st_nlink} names (hard links), so that writing it would change another file"
        if found.st_nlink > 1
        else "is a file where a folder of the workspace belongs",
        stat.S_IFDIR: "is a folder where a file of the workspace belongs",
    }.get(stat.S_IFMT(found.st_mode), "is a pipe, a socket or a device where a file of the workspace belongs")
    remove = "rm -r" if stat.S_ISDIR(found.st_mode) else "rm"
    return WorkspaceError(
        f"{readable(str(path))} {what}.",
        f"If you do not know it, do not use this workspace; else remove it: `{remove} {shlex.quote(str(path))}`.",
    )
