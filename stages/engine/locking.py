"""A lock on an open file that the system frees however the process ends: on Windows, too."""

from __future__ import annotations

import sys

FAR = 1 << 30  # a byte behind all text: on Windows nobody else could read what is locked


def take(descriptor: int) -> None:
    """Lock the file alone, without waiting.

    Raises:
        BlockingIOError: another process has it.
        OSError: the file system has no locks.
    """
    if sys.platform == "win32":
        import msvcrt
        import os

        os.lseek(descriptor, FAR, os.SEEK_SET)
        try:
            msvcrt.locking(descriptor, msvcrt.LK_NBLCK, 1)
        except PermissionError as error:
            raise BlockingIOError(error.errno, error.strerror) from error
    else:
        import fcntl

        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
