"""The ladder of structure from motion: one attempt after another, each taken only while too few photos have a pose.

Pure logic: what an attempt does is a function it is given, see `stages.posing.workbench`.
"""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

log = logging.getLogger(__name__)

# This many attempts in a row that place no further photo end the climb, once enough photos are placed to go on with.
PATIENCE = 3


@dataclass(frozen=True)
class Solution:
    """What an attempt found.

    Attributes:
        registered: names of the photos of the largest model.
        points: its 3D points.
        error_px: its mean reprojection error.
        others: names of the photos of each other model (component).
        model: the largest model itself.
        base: what the attempt matched on, see `stages.posing.workbench`.
    """

    registered: frozenset[str]
    points: int
    error_px: float
    others: tuple[frozenset[str], ...] = ()
    model: Any = field(default=None, compare=False)
    base: Any = None


@dataclass(frozen=True)
class Rung:
    """One attempt that can be made.

    Attributes:
        name: in words.
        attempt: takes the best solution so far (or None) and returns its own, or None where it found no model.
        applies: whether it could bring anything after that solution.
    """

    name: str
    attempt: Callable[[Solution | None], Solution | None]
    applies: Callable[[Solution | None], bool] = lambda best: True


@dataclass(frozen=True)
class Step:
    """What a rung did.

    Attributes:
        rung: its name.
        registered, points, error_px: of the model it found; 0, 0 and None where it found none.
        kept: whether its model was the best so far.
        note: why it failed, or nothing.
    """

    rung: str
    registered: int
    points: int
    error_px: float | None
    kept: bool
    note: str = ""

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        return asdict(self)


def photos_wanted(total: int, share: float) -> int:
    """The number of photos that ends the climb: the given share of them, rounded up."""
    return math.ceil(share * total - 1e-9)  # 0.95 * 20 is a hair over 19


def better(new: Solution | None, old: Solution | None) -> bool:
    """More photos first, then less error."""
    if new is None or old is None:
        return new is not None
    return (len(new.registered), -new.error_px) > (len(old.registered), -old.error_px)


def climb(rungs: Sequence[Rung], wanted: int, enough: int) -> tuple[Solution | None, list[Step]]:
    """Take the rungs in order until `wanted` photos are placed, and keep the best solution.

    The climb also ends after `PATIENCE` rungs in a row that place no further photo, if `enough` are placed.
    An attempt that breaks after the first one counts as one that found nothing, and says why.
    """
    best: Solution | None = None
    steps: list[Step] = []
    fruitless = 0
    for rung in rungs:
        placed = 0 if best is None else len(best.registered)
        if placed >= wanted and steps:
            break
        if fruitless >= PATIENCE and placed >= enough:
            log.info("no further attempts: the last %d placed no further photo", fruitless)
            break
        if not rung.applies(best):
            continue
        if steps:
            log.info("%d photos placed, %d wanted: trying %s", placed, wanted, rung.name)
        found, note, start = None, "", time.monotonic()
        try:
            found = rung.attempt(best)
        except (RuntimeError, ValueError) as error:  # COLMAP's checks
            if not steps:
                raise
            note = " ".join(str(error).split())
            log.warning("%s failed: %s", rung.name, note)
        kept = better(found, best)
        fruitless = 0 if found is not None and len(found.registered) > placed else fruitless + 1
        steps.append(_step(rung.name, found, kept, note))
        log.info("%s (%.1f s)", describe(steps[-1]), time.monotonic() - start)
        best = found if kept else best
    return best, steps


def _step(name: str, found: Solution | None, kept: bool, note: str) -> Step:
    if found is None:
        return Step(name, 0, 0, None, kept, note)
    return Step(name, len(found.registered), found.points, round(found.error_px, 4), kept, note)


def describe(step: Step) -> str:
    """A line for people."""
    if step.error_px is None:
        return f"{step.rung}: {step.note or 'no model'}"
    return f"{step.rung}: {step.registered} photos, {step.points} points, {step.error_px:.2f} px"
