"""Under torchrun the first process runs the command, and the others help it train."""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import TypeVar

Result = TypeVar("Result")


def among_others(command: Callable[[], Result]) -> Result | None:
    """`command()`; in a process that torchrun started beside a first one, what that needs for training instead."""
    if "RANK" not in os.environ or int(os.environ.get("WORLD_SIZE", 1)) < 2:
        return command()
    from stages.engine.guard import allocations_end_at_the_limit
    from stages.neural.ranks import joined
    from stages.train import take_part

    with joined() as ranks:
        if ranks.is_first:
            return command()
        with allocations_end_at_the_limit():
            take_part()
    return None
