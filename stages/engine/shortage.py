"""Errors that say that memory, threads or open files have run out, whichever library they come from, in our terms."""

from __future__ import annotations

import errno
import re
from collections.abc import Iterator

from stages.blocks import is_out_of_memory
from stages.engine.workspace import show_bytes
from stages.errors import SystemRequirementError
from stages.limits import memory_bounds, open_files

_OF_CUDA = re.compile(r"CUDA|CUBLAS|CUDNN", re.IGNORECASE)
_OF_THREADS = re.compile(
    r"can't (start|create).* thread|thread creation failed|resource temporarily unavailable", re.IGNORECASE
)
_OF_FILES = re.compile(r"too many open files", re.IGNORECASE)
_SIZE = re.compile(r"([\d.]+) ?(bytes|[KMGT]iB)")
_UNITS = {"bytes": 1, "KiB": 1 << 10, "MiB": 1 << 20, "GiB": 1 << 30, "TiB": 1 << 40}


class ShortageError(SystemRequirementError):
    """Memory or threads ran out: with fewer threads it may do."""


def shortage(error: BaseException, who: str) -> SystemRequirementError | None:
    """`error` in the user's terms, if it or what caused it says that something ran out; None otherwise.

    Args:
        who: what was running ("Stage sfm").
    """
    for each in _with_causes(error):
        text, number = str(each), getattr(each, "errno", None)
        if number in (errno.EMFILE, errno.ENFILE) or _OF_FILES.search(text):
            return _too_many_files(who)
        if _OF_THREADS.search(text):
            return too_many_threads(who)
        if is_out_of_memory(each):
            return _out_of_cuda(who, text) if _OF_CUDA.search(text) else _out_of_memory(who, text)
    return None


def _with_causes(error: BaseException) -> Iterator[BaseException]:
    """The error, and what it was raised from or while handling; an importing library may say only that it failed."""
    seen: set[int] = set()
    while error is not None and id(error) not in seen:
        seen.add(id(error))
        yield error
        error = error.__cause__ or error.__context__  # type: ignore[assignment]


def _out_of_memory(who: str, text: str) -> ShortageError:
    tightest = min(memory_bounds(), key=lambda bound: bound.left)
    least = f"{show_bytes(wanted)} more were needed" if (wanted := _size_in(text)) else "an allocation failed"
    raise_it = f"raise it with `{tightest.command}`, " if tightest.command else "close other programs, "
    return ShortageError(
        f"{who} ran out of memory: {least}, and {show_bytes(tightest.left)} of the {show_bytes(tightest.limit)} of "
        f"{tightest.name} are left.",
        f"To go on, {raise_it}or take less with `--workers 1`, `--preset tiny` or, of many photos, `--blocks auto`.",
    )


def _out_of_cuda(who: str, text: str) -> SystemRequirementError:
    wanted = _size_in(text)
    least = f": {show_bytes(wanted)} more were needed" if wanted else ""
    return SystemRequirementError(
        f"{who} ran out of the GPU's memory{least}.",
        "End what else uses the GPU (see `nvidia-smi`), choose a smaller preset, or `--device cpu`.",
    )


def too_many_threads(who: str) -> ShortageError:
    return ShortageError(
        f"{who} cannot start another thread or process: the limit of this user or container is reached.",
        "Raise it (`ulimit -u`, `docker run --pids-limit`), or take fewer with `--workers 1`.",
    )


def _too_many_files(who: str) -> SystemRequirementError:
    return SystemRequirementError(
        f"{who} cannot open another file: {open_files()} may be open at once.",
        "Allow more with `ulimit -n 4096`, then run the same command again.",
    )


def _size_in(text: str) -> int | None:
    """The bytes that an allocation asked for, if the error says so: the first size in it."""
    found = _SIZE.search(text)
    return int(float(found[1]) * _UNITS[found[2]]) if found else None
