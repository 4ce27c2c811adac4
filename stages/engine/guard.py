"""In a container whose memory is limited, an allocation that is too large fails, which can be told.

Linux would grant it, and kill the process without a word when it is used.
"""

from __future__ import annotations

import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress

from stages.limits import container_memory_left

if sys.platform == "linux":
    import resource

INTERVAL_S = 0.2


@contextmanager
def allocations_end_at_the_limit() -> Iterator[None]:
    """Inside, this process may map no more memory at once than its container has left, where that has a limit."""
    if sys.platform != "linux" or container_memory_left() is None:
        yield
        return
    before, done = resource.getrlimit(resource.RLIMIT_DATA), threading.Event()

    def watch() -> None:
        while not done.wait(INTERVAL_S):
            with suppress(MemoryError):
                _limit(before)

    _limit(before)
    watching = threading.Thread(target=watch, name="memory-guard", daemon=True)
    watching.start()
    try:
        yield
    finally:
        done.set()
        watching.join()
        resource.setrlimit(resource.RLIMIT_DATA, before)


def _limit(before: tuple[int, int]) -> None:
    """What is mapped now, used or not, and what is left may be mapped: but never more than `before` allowed."""
    import psutil

    left = container_memory_left()
    if left is None:
        return
    allowed = [psutil.Process().memory_info().data + left, *(each for each in before if each != resource.RLIM_INFINITY)]
    with suppress(ValueError, OSError):
        resource.setrlimit(resource.RLIMIT_DATA, (min(allowed), before[1]))
