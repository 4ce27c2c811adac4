"""What this process may use: cores and memory of the machine, or the less that a container or `ulimit` gives it."""

from __future__ import annotations

import math
import os
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

if sys.platform != "win32":
    import resource

CONTROL_GROUPS = Path("/sys/fs/cgroup")
OWN_GROUPS = Path("/proc/self/cgroup")


def available_cores() -> int:
    """CPU cores this process may use: by its affinity, and by the quota of its container (`docker run --cpus`)."""
    process_cores = getattr(os, "sched_getaffinity", None)  # Linux only
    cores = len(process_cores(0)) if process_cores else os.cpu_count() or 1
    return max(1, min([cores, *(math.ceil(quota) for quota in _cpu_quotas())]))


@dataclass(frozen=True)
class MemoryBound:
    """One of the limits of the memory that this process may take.

    Attributes:
        name: of what has the limit, in words.
        limit, used: bytes.
        command: raises it; empty where none does.
    """

    name: str
    limit: int
    used: int
    command: str = ""

    @property
    def left(self) -> int:
        return max(0, self.limit - self.used)


def memory_bounds() -> Iterator[MemoryBound]:
    """Of the machine, of the groups (containers) around this process, and of `ulimit`."""
    import psutil

    machine = psutil.virtual_memory()
    yield MemoryBound("this machine", machine.total, machine.total - machine.available)
    for limit, used in _memory_limits():
        yield MemoryBound("this container", limit, used)
    yield from _memory_ulimit()


def available_memory() -> int:
    """Bytes of memory that can be taken: free on the machine, and left of what this process is allowed."""
    return min(bound.left for bound in memory_bounds())


def total_memory() -> int:
    """Bytes of memory of the machine, or the less that this process is allowed."""
    return min(bound.limit for bound in memory_bounds())


def container_memory_left() -> int | None:
    """Bytes of memory left of this process's container; None where it has no limit below the machine's memory."""
    import psutil

    total = psutil.virtual_memory().total
    return min((max(0, limit - used) for limit, used in _memory_limits() if limit < total), default=None)


def open_files() -> int:
    """How many files this process may have open at once."""
    return resource.getrlimit(resource.RLIMIT_NOFILE)[0] if sys.platform != "win32" else 8192


def largest_file() -> int | None:
    """Bytes that a file may have (`ulimit -f`); None where there is no limit."""
    limit = resource.getrlimit(resource.RLIMIT_FSIZE)[0] if sys.platform != "win32" else -1
    return None if limit < 0 or limit == resource.RLIM_INFINITY else limit


def nearest_existing(folder: Path) -> Path:
    """The folder, or the one above it that is there: on the disk on which it will lie."""
    return next(place for place in (folder, *folder.parents) if place.exists())


def _memory_ulimit() -> Iterator[MemoryBound]:
    """The limit of address space, if one was set for this process: all that is mapped counts, used or not."""
    if sys.platform != "linux":
        return
    import psutil

    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    if limit != resource.RLIM_INFINITY:
        yield MemoryBound("`ulimit -v`", limit, psutil.Process().memory_info().vms, "ulimit -v unlimited")


# ---------------------------------------------------------------- control groups of Linux, versions 1 and 2
def _cpu_quotas() -> Iterator[float]:
    """Cores that each group around this process may use; nothing for those without a limit."""
    for folder in _groups("cpu"):
        # "150000 100000", or "max 100000" without a limit; version 1 has two files, and -1 without a limit
        words = _words(folder / "cpu.max") or [
            *_words(folder / "cpu.cfs_quota_us"),
            *_words(folder / "cpu.cfs_period_us"),
        ]
        if len(words) == 2 and words[0].isdecimal():
            yield int(words[0]) / int(words[1])


def _memory_limits() -> Iterator[tuple[int, int]]:
    """The bytes that each group around this process may use, and those it does use.

    Files that were read do not count, as they are dropped for what needs their room; but libraries that run do.
    """
    names = (("memory.max", "memory.current", ""), ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_"))
    for folder in _groups("memory"):
        for limit_file, used_file, prefix in names:
            limit, used = _words(folder / limit_file), _words(folder / used_file)
            if limit and used and limit[0].isdecimal():
                statistics = _words(folder / "memory.stat")
                counts = {name: int(count) for name, count in zip(statistics[::2], statistics[1::2], strict=False)}
                files = [counts.get(f"{prefix}{kind}_file", 0) for kind in ("inactive", "active")]
                mapped = counts.get("total_mapped_file" if prefix else "file_mapped", 0)
                yield int(limit[0]), int(used[0]) - max(0, sum(files) - mapped)


def _groups(controller: str) -> Iterator[Path]:
    """Folders of the groups that this process is in, each with all above it.

    In a container a path may be the host's: then only the top, which is the container's own, is there.
    """
    for line in _lines(OWN_GROUPS):
        _, controllers, path = line.split(":", 2)
        if controllers and controller not in controllers.split(","):
            continue
        top = CONTROL_GROUPS / controller if controllers else CONTROL_GROUPS
        group = top / path.lstrip("/")
        yield from (folder for folder in (group, *group.parents) if folder == top or top in folder.parents)


def _words(path: Path) -> list[str]:
    return " ".join(_lines(path)).split()


def _lines(path: Path) -> list[str]:
    try:
        return path.read_text(encoding="utf-8").splitlines()
    except OSError:
        return []
