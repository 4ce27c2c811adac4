"""What a piece of work costs: wall and CPU seconds, and the peak memory of the process tree."""

from __future__ import annotations

import sys
import threading
import time
from contextlib import suppress
from types import TracebackType

import psutil

if sys.platform != "win32":
    import resource

INTERVAL_S = 0.2
CHILDREN_EVERY = 3  # finding the children reads all of /proc, so it is done on each third sample only


class ResourceMeter:
    """Context manager that measures what happens inside it.

    Attributes (final after exit):
        wall_s: seconds.
        cpu_s: user + system seconds of this process and of the children it has waited for.
        peak_rss: bytes; the highest sum over this process and its children that was sampled.
    """

    wall_s = 0.0
    cpu_s = 0.0
    peak_rss = 0

    def __enter__(self) -> ResourceMeter:
        self._process = psutil.Process()
        self._children: list[psutil.Process] = []
        self._stop = threading.Event()
        self._started, self._cpu, self._own_peak = time.perf_counter(), _cpu_seconds(), _own_peak_rss()
        self._sample(0)
        self._thread = threading.Thread(target=self._watch, name="resource-meter", daemon=True)
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stop.set()
        self._thread.join()
        self._sample(1)
        self.wall_s = time.perf_counter() - self._started
        self.cpu_s = _cpu_seconds() - self._cpu
        # The kernel keeps the exact peak of the whole life of the process. If it rose, it rose in here,
        # perhaps between two samples.
        own_peak = _own_peak_rss()
        if own_peak > self._own_peak:
            self.peak_rss = max(self.peak_rss, own_peak)

    def _watch(self) -> None:
        count = 0
        while not self._stop.wait(INTERVAL_S):
            with suppress(MemoryError):  # which is for what is measured to tell
                self._sample(count)
            count += 1

    def _sample(self, count: int) -> None:
        if count % CHILDREN_EVERY == 0:
            self._children = self._process.children(recursive=True)
        total = self._process.memory_info().rss
        for child in self._children:
            try:
                total += child.memory_info().rss
            except psutil.Error:  # it has ended since it was listed
                continue
        self.peak_rss = max(self.peak_rss, total)


def _cpu_seconds() -> float:
    return time.process_time() + children_cpu_seconds()


def children_cpu_seconds() -> float:
    """User and system seconds of the children that this process has waited for; 0 on Windows, which keeps no count."""
    if sys.platform == "win32":
        return 0.0
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def _own_peak_rss() -> int:
    if sys.platform == "win32":
        return int(psutil.Process().memory_info().peak_wset)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024
