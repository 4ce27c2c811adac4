"""Standard streams that are there, take every text, and stop no run where they cannot be written."""

from __future__ import annotations

import contextlib
import errno
import io
import os
import re
import sys
from collections.abc import Callable, Iterator
from typing import Any

from stages.engine.workspace import DISK_FULL

SIZES = ("COLUMNS", "LINES", "TERMINAL_WIDTH")  # environment variables that tell a terminal's size
NOBODY_READS = (errno.EPIPE, errno.EBADF)  # the reader has gone, or the stream was closed from the start


def mend_streams() -> None:
    """Make standard streams usable, whatever they were started as.

    One that is closed (`>&-`) becomes the null device, before any file gets its number, so that no library prints into
    that file. Writing to `sys.stdout` still fails then, as it should where a command is asked to print something. What
    an encoding does not have (LANG=C, or a file's name that is no UTF-8) is printed as an escape.
    """
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.set_inheritable(os.open(os.devnull, os.O_RDWR), True)  # takes the lowest free number: this one
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        if getattr(sys, name) is None:
            place = os.open(os.devnull, os.O_RDONLY) if name == "stdout" else number
            setattr(sys, name, open(place, "r" if name == "stdin" else "w", closefd=False))  # noqa: SIM115
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    if isinstance(sys.stderr, io.TextIOWrapper) and sys.stderr is sys.__stderr__:  # not one that somebody put there
        sys.stderr = _ForPeople(sys.stderr)
    for name in SIZES:  # programs read numbers there: "junk", "0" or a width of a million columns would end in errors
        if not re.fullmatch("[1-9][0-9]{0,3}", os.environ.get(name, "1")):
            del os.environ[name]


class _ForPeople(io.TextIOWrapper):
    """stderr. Where it takes no more (the terminal was closed, the disk is full) people are told nothing any more.

    A run goes on then, as what it makes does not hang on that. A pipe whose reader has gone is an error, as elsewhere.
    """

    def __init__(self, stream: io.TextIOWrapper) -> None:
        encoding, errors = stream.encoding, stream.errors
        super().__init__(stream.detach(), encoding, errors, line_buffering=True)

    def write(self, text: str) -> int:
        return self._unless_lost(super().write, text)

    def flush(self) -> None:
        self._unless_lost(super().flush)

    def _unless_lost(self, do: Callable[..., Any], *arguments: str) -> Any:
        try:
            return do(*arguments)
        except OSError as error:
            if error.errno == errno.EPIPE:
                raise
            _point_to_null(self)
            return sum(map(len, arguments))


def is_output_error(error: BaseException) -> bool:
    """Whether it says that stdout takes no more: its disk is full, or nobody reads it (any more)."""
    return isinstance(error, OSError) and error.filename is None and error.errno in (*DISK_FULL, *NOBODY_READS)


def flush_output() -> OSError | None:
    """Write what is left for stdout; the error, if that fails, and then what is left is forgotten."""
    try:
        sys.stdout.flush()
    except OSError as error:
        _point_to_null(sys.stdout)  # or Python tries again at its end
        return error
    return None


def _point_to_null(stream: Any) -> None:
    null = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, stream.fileno())
    os.close(null)


@contextlib.contextmanager
def stdout_kept_clean() -> Iterator[None]:
    """What is printed inside, by Python or by a C library, goes to stderr: stdout is for the JSON that follows."""
    sys.stdout.flush()
    saved = os.dup(1)
    try:
        os.dup2(2, 1)
        with contextlib.redirect_stdout(sys.stderr):
            yield
    finally:
        os.dup2(saved, 1)
        os.close(saved)
