"""The command line in a forked child, held to limits: what it ended with, what it said, what it took.

The parent imports what is slow to import once; each run is then a process of its own, as in a shell, in milliseconds.
"""

from __future__ import annotations

import logging
import os
import resource
import select
import signal
import sys
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

SECONDS = 30.0  # no bad input may take longer
PEAK_BYTES = 2 << 30  # nor more memory than this
HARD_BYTES = 8 << 30  # of address space for data: so that a test of a bomb is not one
CODES = frozenset(range(7))  # of `stages.errors`, and 0


@dataclass(frozen=True)
class Ended:
    """How a run ended.

    Attributes:
        code: exit code; minus the signal's number where one ended it.
        output: what it printed on stdout and stderr.
        seconds: of wall clock.
        peak_bytes: resident memory at most.
        killed: whether it was still there after the limit of time.
    """

    code: int
    output: str
    seconds: float
    peak_bytes: int
    killed: bool

    def fault(self) -> str:
        """What must not be; empty where the run kept all promises."""
        if self.killed:
            return f"still there after {self.seconds:.0f} s"
        if "Traceback (most recent call last)" in self.output or "Unexpected error" in self.output:
            return "a traceback"
        if self.code not in CODES:
            return f"ended with {self.code}"
        if self.code and "Error" not in self.output and "Usage" not in self.output:
            return f"ended with {self.code} without a sentence"
        if self.peak_bytes > PEAK_BYTES:
            return f"took {self.peak_bytes / (1 << 30):.1f} GiB"
        return ""


def import_what_is_slow() -> None:
    """Import the libraries that a run imports, and start none of their threads."""
    import cv2
    import numba
    import numpy
    import open3d
    import pycolmap
    import scipy.spatial
    import torch
    import trimesh

    import hineus_cli.app

    cv2.setNumThreads(1)
    torch.set_num_threads(1)
    for module in (numba, numpy, open3d, pycolmap, scipy.spatial, trimesh, hineus_cli.app):
        assert module.__name__ in sys.modules


def run_hineus(
    arguments: Sequence[str],
    folder: Path,
    seconds: float = SECONDS,
    environment: Mapping[str, str] | None = None,
    first: Callable[[], None] | None = None,
) -> Ended:
    """`hineus ARGUMENTS` in a child of this process, standing in `folder`.

    Args:
        first: called in the child before the command.
    """

    def main() -> None:
        from hineus_cli.app import main as command

        os.environ.update(environment or {})
        if first is not None:
            first()
        sys.argv = ["hineus", *arguments]
        command()

    return run_in_child(main, folder, seconds)


def run_in_child(main: Callable[[], None], folder: Path, seconds: float = SECONDS) -> Ended:
    """Call `main` in a forked child that stands in `folder`, and wait for it."""
    output = folder.with_name(folder.name + ".output")
    started = time.monotonic()
    child = os.fork()
    if child == 0:
        _become(main, folder, output)
    ended = _await(child, seconds)
    if not ended:
        os.killpg(child, signal.SIGKILL)
    _, status, usage = os.wait4(child, 0)
    text = output.read_text(encoding="utf-8", errors="replace")
    return Ended(os.waitstatus_to_exitcode(status), text, time.monotonic() - started, usage.ru_maxrss * 1024, not ended)


def _await(child: int, seconds: float) -> bool:
    """Whether the child ended in time."""
    descriptor = os.pidfd_open(child)
    try:
        return bool(select.select([descriptor], [], [], seconds)[0])
    finally:
        os.close(descriptor)


def _become(main: Callable[[], None], folder: Path, output: Path) -> None:
    """What the child does; never returns."""
    code = 70
    try:
        os.setsid()
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        resource.setrlimit(resource.RLIMIT_DATA, (HARD_BYTES, HARD_BYTES))
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            signal.signal(number, signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL)
        _fresh_streams(output)
        logging.getLogger().handlers.clear()
        os.chdir(folder)
        main()
        code = 0
    except SystemExit as leave:
        code = leave.code if isinstance(leave.code, int) else 0 if leave.code is None else 1
    except BaseException:
        traceback.print_exc()
    finally:
        for stream in (sys.stdout, sys.stderr):
            stream.flush()
        os._exit(code)


def _fresh_streams(output: Path) -> None:
    nothing, file = os.open(os.devnull, os.O_RDONLY), os.open(output, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o644)
    for descriptor, number in ((nothing, 0), (file, 1), (file, 2)):
        os.dup2(descriptor, number)
    sys.stdin = open(0, encoding="utf-8", closefd=False)  # noqa: SIM115 - for as long as the process is
    sys.stdout = open(1, "w", encoding="utf-8", errors="backslashreplace", closefd=False)  # noqa: SIM115
    sys.stderr = open(2, "w", encoding="utf-8", errors="backslashreplace", buffering=1, closefd=False)  # noqa: SIM115
