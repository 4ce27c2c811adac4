"""The moments at which a run can be killed: its own calls to the file system, heard by an audit hook, and the clock."""

from __future__ import annotations

import os
import random
import signal
import sys
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

HEARD = ("os.rename", "open", "os.remove", "os.mkdir", "os.rmdir", "os.truncate")


@dataclass(frozen=True)
class Moment:
    """When to die.

    Attributes:
        call: before the n-th of the calls that are heard; None: after `seconds`.
    """

    call: int | None = None
    seconds: float = 0.0

    def __str__(self) -> str:
        return f"before call {self.call}" if self.call is not None else f"after {self.seconds:.3f} s"


def listen(workspace: Path, each: Callable[[str], None]) -> None:
    """Call `each` before every call of this process that changes something in the workspace."""
    inside = str(workspace)

    def hook(event: str, arguments: tuple[Any, ...]) -> None:
        if event not in HEARD or not isinstance(arguments[0], (str, bytes, os.PathLike)):
            return
        path = os.fsdecode(arguments[0])
        if path.startswith(inside) and (event != "open" or _writes(arguments)):
            each(f"{event} {path[len(inside) + 1 :]}")

    sys.addaudithook(hook)


def _writes(arguments: tuple[Any, ...]) -> bool:
    mode, flags = arguments[1], arguments[2]
    return bool(set(str(mode)) & set("wxa+")) or bool(flags & (os.O_WRONLY | os.O_RDWR | os.O_CREAT))


def die_at(moment: Moment, workspace: Path) -> None:
    """Let this process be killed, as by the power cut, at the moment."""
    if moment.call is None:
        threading.Thread(target=_die_after, args=(moment.seconds,), daemon=True).start()
        return
    heard = iter(range(1 << 30))

    def each(_: str) -> None:
        if next(heard) == moment.call:
            os.kill(os.getpid(), signal.SIGKILL)

    listen(workspace, each)


def _die_after(seconds: float) -> None:
    time.sleep(seconds)
    os.kill(os.getpid(), signal.SIGKILL)


def choose_moments(calls: Sequence[str], seconds: float, count: int, chance: random.Random) -> list[Moment]:
    """Around each rename, at checkpoints, then at any call and any time, until there are `count`."""
    renames = [i for i, call in enumerate(calls) if call.startswith("os.rename")]
    checkpoints = [i for i, call in enumerate(calls) if "checkpoint" in call or "scratch" in call]
    aimed = [i for rename in renames for i in (rename, rename + 1)] + checkpoints
    chosen = [Moment(i) for i in dict.fromkeys(aimed) if i < len(calls)]
    chance.shuffle(chosen)
    chosen = chosen[: count - count // 4]
    while len(chosen) < count:
        other = (
            Moment(chance.randrange(len(calls))) if chance.random() < 0.5 else Moment(None, chance.random() * seconds)
        )
        chosen.append(other)
    return chosen
