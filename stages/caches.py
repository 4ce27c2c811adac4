"""Folders that can be written whatever the home and the machine allow: for compiled code, and for temporary files.

Think of containers with `--user`, a home over its quota, `/tmp` on a small RAM disk. What compilers keep is executed
when it is read again, so it lies nowhere that others may write; nor in a workspace or in the current folder, which may
have come from somebody else.
"""

from __future__ import annotations

import atexit
import logging
import os
import shutil
import stat
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path

log = logging.getLogger(__name__)

PROBE = bytes(1 << 22)  # all compiled code takes about 3 MB, and a full quota may still take some bytes
TEMPORARY = "tmp-"  # so begin the names of folders of temporary files


# ---------------------------------------------------------------- compiled code
def compiler_folder(variable: str, name: str) -> Path:
    """Where a compiler keeps its code: what its own environment variable says, which is set otherwise.

    Raises:
        OSError: nothing can be written anywhere.
    """
    given = os.environ.get(variable)
    problem = why_unusable(Path(given).absolute()) if given else None
    if problem:
        log.warning("%s cannot be used: %s", variable, problem)
    if not given or problem:
        os.environ[variable] = str(cache_folder()[0] / name)
    return Path(os.environ[variable])


@cache
def cache_folder() -> tuple[Path, str | None]:
    """The cache of this user (`XDG_CACHE_HOME/hineus`, or what the system has), else one among the temporary files.

    It is made, and a file was written there and read again. The last resort is a folder for this process alone. Second,
    why it is not the first.

    Raises:
        OSError: nothing can be written anywhere.
    """
    try:
        usual = _user_cache().resolve()  # a link that the user made is fine
        problem = why_unusable(usual, private=True)
        if problem is None:
            return usual, None
    except RuntimeError as error:  # neither HOME nor an entry in the list of users
        problem = str(error)
    if (temporary := system_temporary()) is not None:
        shared = temporary / f"hineus-{_user_id()}"
        if why_unusable(shared, private=True) is None:
            log.info("compiled code is kept in %s: %s", shared, problem)
            return shared, problem
    folder = Path(tempfile.mkdtemp(prefix="hineus-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    log.warning("compiled code is not kept, so that each run compiles anew: %s; set XDG_CACHE_HOME", problem)
    return folder, problem


def why_unusable(folder: Path, private: bool = False) -> str | None:
    """Why nothing can be kept in this folder; None, and the folder is made, where it can.

    `private`: what others might write there is a reason, too.
    """
    if not folder.is_absolute():
        return f"{folder} is no absolute path"
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        if private and not _is_ours_alone(folder):
            return f"{folder} belongs to somebody else, or others may write there"
        with tempfile.TemporaryFile(dir=folder) as file:
            file.write(PROBE)
            file.seek(0)
            return None if file.read() == PROBE else f"{folder} does not give back what is written there"
    except OSError as error:
        return f"{folder} cannot be written ({error.strerror})"


def _is_ours_alone(folder: Path) -> bool:
    if os.name == "nt":  # its folders for caches and temporary files are each user's own
        return True
    found = folder.lstat()
    return stat.S_ISDIR(found.st_mode) and found.st_uid == os.geteuid() and not found.st_mode & 0o022


def _user_cache() -> Path:
    from platformdirs import user_cache_path

    return user_cache_path("hineus", appauthor=False)


def _user_id() -> int:
    """Not a name: a container's user may have none."""
    return os.geteuid() if os.name == "posix" else 0


# ---------------------------------------------------------------- temporary files
@contextmanager
def temporary_files(work: Path) -> Iterator[None]:
    """While this lasts they lie in a new folder in `work`, emptied of what killed processes left there.

    `TMPDIR` says so to libraries and other processes.
    """
    system_temporary()  # so that it is known still
    work.mkdir(parents=True, exist_ok=True)
    for left in work.glob(f"{TEMPORARY}*"):
        shutil.rmtree(left, ignore_errors=True)
    before = tempfile.tempdir, os.environ.get("TMPDIR")
    with tempfile.TemporaryDirectory(prefix=TEMPORARY, dir=work, ignore_cleanup_errors=True) as folder:
        tempfile.tempdir = os.environ["TMPDIR"] = folder
        try:
            yield
        finally:
            tempfile.tempdir = before[0]
            _restore("TMPDIR", before[1])


@cache
def system_temporary() -> Path | None:
    """The system's folder for temporary files; None where Python would take the current one, as none can be written."""
    try:
        folder = Path(tempfile.gettempdir())
    except FileNotFoundError:
        return None
    return None if folder == Path.cwd() else folder


def _restore(variable: str, value: str | None) -> None:
    if value is None:
        os.environ.pop(variable, None)
    else:
        os.environ[variable] = value
