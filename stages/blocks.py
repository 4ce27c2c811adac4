"""Work in blocks that shrink where memory runs out: less at once, for the same result."""

from __future__ import annotations

import errno
import gc
import logging
import re
import sys
from collections.abc import Callable
from typing import TypeVar

log = logging.getLogger(__name__)

Result = TypeVar("Result")

# numpy, torch on the CPU and on CUDA, OpenCV, Python, the C++ library, the loader of shared libraries.
_OF_MEMORY = re.compile(
    r"out of memory|bad.?alloc|insufficient memory|not enough memory|(cannot|can't|unable to|failed to) allocate"
    r"|failed to map segment|alloc_failed|error return without exception set",
    re.IGNORECASE,
)
# With fewer rows at once there is little left to gain.
FEWEST_ROWS = 256
# What was enough of each kind of work in this process, once more was too much.
_enough: dict[str, int] = {}


def is_out_of_memory(error: BaseException) -> bool:
    """Whether an error, of whichever library, says that memory has run out."""
    no_memory = isinstance(error, MemoryError) or getattr(error, "errno", None) == errno.ENOMEM
    return no_memory or bool(_OF_MEMORY.search(str(error)))


def with_less(work: Callable[[int], Result], most: int, what: str, least: int = 1) -> Result:
    """`work(most)`; where memory runs out for it, again with half as much, and so on down to `least`.

    What was enough is not exceeded again by the same kind of work.

    Args:
        work: takes how much is to be done at once. May be called several times, and must then start anew.
        what: names the kind of work, with what is counted: "training, rays".
    """
    size = min(most, _enough.get(what, most))
    while True:
        try:
            return work(size)
        except Exception as error:
            if size <= least or not is_out_of_memory(error):
                raise
        # Out here the error, and all that its frames held, is gone.
        _give_back()
        _enough[what] = smaller = max(size // 2, least)
        log.warning("Memory ran out with %d at once (%s): it goes on with %d.", size, what, smaller)
        size = smaller


def in_blocks(
    work: Callable[[slice], Result], count: int, size: int, what: str, least: int = FEWEST_ROWS
) -> list[Result]:
    """What `work` gives for rows 0 to `count`, `size` at a time, or fewer where memory runs out; see `with_less`.

    `work` sees rows again that it failed at, and what it gives of each must not depend on the block.
    """
    results: list[Result] = []
    start = 0
    while start < count:

        def block(rows: int, first: int = start) -> int:
            results.append(work(slice(first, min(first + rows, count))))
            return first + rows

        start = with_less(block, size, what, least)
    return results


def _give_back() -> None:
    """What nothing holds any more: circles of Python's, and what torch keeps of a GPU's memory for later."""
    gc.collect()
    if (torch := sys.modules.get("torch")) is not None and torch.cuda.is_initialized():
        torch.cuda.empty_cache()
