"""What this process may use: the cores and the memory of the machine, or the less that its container is given."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from pathlib import Path

CONTROL_GROUPS = Path("/sys/fs/cgroup")
OWN_GROUPS = Path("/proc/self/cgroup")


def available_cores() -> int:
    """CPU cores this process may use: by its affinity, and by the quota of its container (`docker run --cpus`)."""
    process_cores = getattr(os, "sched_getaffinity", None)  # Linux only
    cores = len(process_cores(0)) if process_cores else os.cpu_count() or 1
    return max(1, min([cores, *(math.ceil(quota) for quota in _cpu_quotas())]))


def available_memory() -> int:
    """Bytes of memory that can be taken: free on the machine, and left of its container (`docker run --memory`)."""
    import psutil

    return max(0, min([psutil.virtual_memory().available, *(limit - used for limit, used in _memory_limits())]))


def total_memory() -> int:
    """Bytes of memory of the machine, or the less that its container is given."""
    import psutil

    return min([psutil.virtual_memory().total, *(limit for limit, _ in _memory_limits())])


def nearest_existing(folder: Path) -> Path:
    """The folder, or the one above it that is there: on the disk on which it will lie."""
    return next(place for place in (folder, *folder.parents) if place.exists())


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
    """The bytes that each group around this process may use, and those it does use; files in memory do not count."""
    names = (
        ("memory.max", "memory.current", "inactive_file"),
        ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file"),
    )
    for folder in _groups("memory"):
        for limit_file, used_file, droppable in names:
            limit, used = _words(folder / limit_file), _words(folder / used_file)
            if limit and used and limit[0].isdecimal():
                statistics = _words(folder / "memory.stat")
                counts = dict(zip(statistics[::2], statistics[1::2], strict=False))
                yield int(limit[0]), int(used[0]) - int(counts.get(droppable, 0))


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
