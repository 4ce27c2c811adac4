"""A large scene, block by block: what is to be done as a list of steps, and all of it in this process, one by one.

The steps are plain data, so that another engine can run them, in other processes and on other machines.
"""

from __future__ import annotations

import logging
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

from stages.artifacts.blocks import Block, BlockPlan, block_folder
from stages.divide import divide
from stages.engine.run_log import TRACEBACKS
from stages.engine.runner import Listener
from stages.engine.stage import Stage
from stages.errors import ConfigError, HineusError, ReconstructionError
from stages.place import PLACE
from stages.reconstruct import Reconstruction, reconstruct
from stages.request import Request
from stages.train import TRAIN

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Step:
    """A part of the work: a run of one block's workspace.

    Attributes:
        name: "train b01". block: whose workspace is run. until: the last stage of the run; None: all of them.
        needs: steps without which it cannot be done.
        after: steps that should have ended before, done or failed: what they make is used where it is there.
    """

    name: str
    block: str
    until: str | None
    needs: tuple[str, ...] = ()
    after: tuple[str, ...] = ()

    def command(self, whole: Path) -> list[str]:
        """Words of the command that does it."""
        words = ["hineus", "run", "--workspace", str(block_folder(whole, self.block))]
        return words if self.until is None else [*words, "--until", self.until]


def steps_of(plan: BlockPlan) -> list[Step]:
    """In an order in which they can be done: all blocks learn, then each is made a tile, for which those around it
    must have learned."""
    learn = [Step(_learning(block.name), block.name, TRAIN.name) for block in plan.blocks]
    finish = []
    for block in plan.blocks:
        around = tuple(_learning(name) for name in block.neighbours)
        finish.append(Step(f"finish {block.name}", block.name, None, (_learning(block.name),), around))
    return learn + finish


def _learning(block: str) -> str:
    return f"{TRAIN.name} {block}"


@dataclass(frozen=True)
class BlockOutcome:
    """What became of a block.

    Attributes:
        state: "done", or "failed" with the `error` and what to do, in words.
        glb, report: None where there is none.
    """

    name: str
    workspace: Path
    photos: int
    state: Literal["done", "failed"]
    error: str = ""
    hint: str = ""
    glb: Path | None = None
    report: Path | None = None

    @staticmethod
    def of(whole: Path, block: Block, error: HineusError | None, glb: Path | None, report: Path | None) -> BlockOutcome:
        """Of a block of the plan, which failed where there is an error."""
        return BlockOutcome(
            name=block.name,
            workspace=block_folder(whole, block.name),
            photos=len(block.photos),
            state="failed" if error else "done",
            error=error.message if error else "",
            hint=error.hint if error else "",
            glb=glb,
            report=report,
        )


@dataclass(frozen=True)
class BlockRuns:
    """The runs of a whole's blocks.

    Attributes:
        whole: the run of all photos, up to their poses and place.
    """

    whole: Reconstruction
    plan: BlockPlan
    outcomes: tuple[BlockOutcome, ...]

    def as_dict(self) -> dict[str, Any]:
        """JSON-able."""
        blocks = [{key: str(v) if isinstance(v, Path) else v for key, v in asdict(o).items()} for o in self.outcomes]
        return {**self.whole.as_dict(), "blocks": blocks}

    def failure(self) -> ReconstructionError | None:
        """The error that says which blocks failed; None where none did."""
        failed = [outcome for outcome in self.outcomes if outcome.state == "failed"]
        if not failed:
            return None
        others = "; the others are done" if len(failed) < len(self.outcomes) else ""
        first, root, names = failed[0], self.whole.workspace.root, ", ".join(outcome.name for outcome in failed)
        return ReconstructionError(
            f"{len(failed)} of {len(self.outcomes)} blocks failed ({names}){others}. {first.name}: {first.error}",
            f"{first.hint} The same command goes on with those that failed; one alone: "
            f"`hineus run --workspace {shlex.quote(str(block_folder(root, first.name)))}`.".lstrip(),
        )


def reconstruct_in_blocks(
    request: Request, count: int | None, pipeline: Sequence[Stage[Any]], listener: Listener | None = None
) -> BlockRuns:
    """Do what was asked in blocks: poses of all photos, then each block. A block that fails does not stop the others.

    Args:
        count: blocks; None: as many as the machine's memory asks for.

    Raises:
        HineusError: the whole has no poses or cannot be cut. What fails in a block is in its outcome.
    """
    whole, plan = poses_and_plan(request, count, pipeline, listener)
    root = whole.workspace.root
    steps, failed = steps_of(plan), dict[str, HineusError]()
    runs: dict[str, Reconstruction] = {}
    for number, step in enumerate(steps, 1):
        if any(needed in failed for needed in step.needs):
            failed[step.name] = next(failed[needed] for needed in step.needs if needed in failed)
            continue
        log.info("%s (%d of %d): `%s`", step.name, number, len(steps), shlex.join(step.command(root)))
        asked = Request(
            workspace=block_folder(root, step.block), until=step.until, device=request.device, workers=request.workers
        )
        try:
            runs[step.block] = reconstruct(asked, pipeline, listener)
        except Exception as error:  # whatever a block dies of is its own
            failed[step.name] = told = _told(error)
            log.error("block %s failed: %s %s", step.block, told.message, told.hint)
    return BlockRuns(whole, plan, tuple(_outcomes(root, plan, steps, failed, runs)))


def poses_and_plan(
    request: Request, count: int | None, pipeline: Sequence[Stage[Any]], listener: Listener | None
) -> tuple[Reconstruction, BlockPlan]:
    """What comes before all blocks: poses of all photos, and the cut.

    Raises:
        HineusError: see `reconstruct_in_blocks`.
    """
    for option, value in (("--from", request.from_stage), ("--until", request.until), ("--force", request.force)):
        if value:
            raise ConfigError(
                f"`{option}` does not go with `--blocks`.",
                "Use it on the whole without `--blocks`, or on the workspace of one block.",
            )
    whole = reconstruct(replace(request, until=PLACE.name), pipeline, listener)
    return whole, divide(whole.workspace.root, count)


def _told(error: Exception) -> HineusError:
    if isinstance(error, HineusError):
        return error
    logging.getLogger(TRACEBACKS).error("a block failed", exc_info=error)
    return HineusError(f"{type(error).__name__}: {' '.join(str(error).split())}")


def _outcomes(
    root: Path,
    plan: BlockPlan,
    steps: Sequence[Step],
    failed: Mapping[str, HineusError],
    runs: Mapping[str, Reconstruction],
) -> list[BlockOutcome]:
    errors = {step.block: failed[step.name] for step in reversed(steps) if step.name in failed}
    return [
        BlockOutcome.of(root, block, errors.get(block.name), run.glb if run else None, run.report if run else None)
        for block in plan.blocks
        for run in [runs.get(block.name)]
    ]
