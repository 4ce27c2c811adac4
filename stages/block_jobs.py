"""A large scene's blocks at once: the steps of `block_by_block` as jobs of Snakemake, here or on a cluster.

Which steps are done, their stages say, as ever: Snakemake is told by markers, which are made anew before each run. A
step that fails is tried once more. Where it fails again, what needs it is left; what would only have come after it is
done without it, in a second run of Snakemake.
"""

from __future__ import annotations

import logging
import re
import shlex
import sys
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from configs.load import load_config
from stages import artifacts
from stages.artifacts.block_jobs import (
    engine_folder,
    engine_log_path,
    log_name,
    mark,
    marker_name,
    read_log,
    write_rules,
    write_steps,
)
from stages.artifacts.blocks import Block, BlockPlan, block_folder
from stages.block_by_block import BlockOutcome, BlockRuns, Step, poses_and_plan, steps_of
from stages.block_status import workspace_status
from stages.engine.runner import Listener
from stages.engine.stage import Stage
from stages.engine.workspace import Workspace
from stages.errors import HineusError, SystemRequirementError
from stages.preflight import memory_asked_for
from stages.request import Request
from stages.workflow import Capacity, check_installed, run_rules

log = logging.getLogger(__name__)

RULES = Path(__file__).parent / "templates" / "Snakefile"
OURSELVES = (sys.executable, "-m", "hineus_cli")  # on a cluster, too: its machines see the same environment
TOLD_LINES = 12  # of Snakemake's output, where it has failed itself
ERROR = re.compile(r"^Error: (?P<message>.*)\n(?P<hint>.*)", re.MULTILINE)


@dataclass(frozen=True)
class Job:
    """How a step is done.

    Attributes:
        command: words of a command that takes `--workers N`.
        memory, gpus: bytes, and how many, that it asks for.
    """

    step: Step
    command: Sequence[str]
    memory: int
    gpus: int = 0

    @property
    def name(self) -> str:
        return self.step.name

    @property
    def kind(self) -> str:
        return self.step.name.partition(" ")[0]

    @property
    def marker(self) -> str:
        return marker_name(self.kind, self.step.block)

    @property
    def log(self) -> str:
        return log_name(self.kind, self.step.block)


def reconstruct_at_once(
    request: Request,
    count: int | None,
    capacity: Capacity,
    pipeline: Sequence[Stage[Any]],
    listener: Listener | None = None,
) -> BlockRuns:
    """As `reconstruct_in_blocks`, with several blocks at once.

    Raises:
        HineusError: the whole has no poses or cannot be cut; Snakemake is not there or has failed itself. What fails
            in a block is in its outcome.
    """
    check_installed(capacity)
    whole, plan = poses_and_plan(request, count, pipeline, listener)
    root = whole.workspace.root
    jobs = _jobs(whole.workspace, plan, request.device)
    with whole.workspace.lock():
        done = {job.name for job in jobs if _is_done(root, job.step, pipeline)}
        failed = run_jobs(jobs, engine_folder(root), capacity, done)
    return BlockRuns(whole, plan, tuple(_outcome(root, block, jobs, failed) for block in plan.blocks))


def run_jobs(jobs: Sequence[Job], folder: Path, capacity: Capacity, done: Collection[str]) -> dict[str, HineusError]:
    """Do what is not `done`; the errors of steps that failed, and of those that need these, by name.

    Args:
        jobs: in an order in which they can be done.
        folder: the engine's, which no other process uses meanwhile.

    Raises:
        SystemRequirementError: no step has failed, but Snakemake has.
    """
    write_rules(folder, RULES.read_text(encoding="utf-8"))
    mark(folder, [job.marker for job in jobs if job.name in done], [job.marker for job in jobs if job.name not in done])
    for job in jobs:
        if job.name not in done:
            (folder / job.log).unlink(missing_ok=True)
    failed: dict[str, HineusError] = {}
    while True:
        _write(jobs, folder, capacity, failed)
        code = run_rules(folder, capacity, engine_log_path(folder), _Telling(jobs, folder).look)
        now_failed = _failed_now(jobs, folder, failed)
        if not now_failed:
            break
        failed |= now_failed
        _spread(jobs, failed)
        if all(_is_marked(folder, job) for job in jobs if job.name not in failed):
            return failed
    if code != 0:
        raise _engine_error(engine_log_path(folder))
    return failed


# ---------------------------------------------------------------- the steps' files
def _write(jobs: Sequence[Job], folder: Path, capacity: Capacity, failed: Collection[str]) -> None:
    """What Snakemake is to do: all but what has failed."""
    markers = {job.name: job.marker for job in jobs}
    steps: dict[str, dict[str, Any]] = {}
    for job in jobs:
        if job.name not in failed:
            before = [name for name in (*job.step.needs, *job.step.after) if name not in failed]
            steps.setdefault(job.kind, {})[job.step.block] = {
                "needs": [markers[name] for name in before],
                "command": shlex.join(job.command),
                "threads": capacity.threads,
                "mem_mb": capacity.memory_mb(job.memory),
                "gpu": job.gpus,
            }
    write_steps(folder, steps)


def _failed_now(jobs: Sequence[Job], folder: Path, failed: Collection[str]) -> dict[str, HineusError]:
    """Steps that could be done, were begun and are not done."""
    marked = {job.name for job in jobs if _is_marked(folder, job)}
    return {
        job.name: _error(folder / job.log)
        for job in jobs
        if job.name not in marked and job.name not in failed and (folder / job.log).exists()
        and {name for name in (*job.step.needs, *job.step.after) if name not in failed} <= marked
    }  # fmt: skip


def _spread(jobs: Sequence[Job], failed: dict[str, HineusError]) -> None:
    """What needs a step that failed has failed of the same."""
    for job in jobs:
        for name in job.step.needs:
            if name in failed:
                failed.setdefault(job.name, failed[name])


def _is_marked(folder: Path, job: Job) -> bool:
    return (folder / job.marker).exists()


def _error(said: Path) -> HineusError:
    """The last error in a step's log."""
    told = list(ERROR.finditer(read_log(said)))
    message, hint = (told[-1]["message"], told[-1]["hint"]) if told else ("It ended without a word.", "")
    return HineusError(message, f"{hint} What it said: {said}.".lstrip())


def _engine_error(said: Path) -> SystemRequirementError:
    last = "\n".join(read_log(said).rstrip().splitlines()[-TOLD_LINES:])
    return SystemRequirementError(
        f"Snakemake, which runs the blocks, has failed:\n{last}", f"All that it said: {said}. Then run the same again."
    )


class _Telling:
    """Says which steps begin and end."""

    def __init__(self, jobs: Sequence[Job], folder: Path) -> None:
        self.jobs, self.folder = jobs, folder
        self.begun = {job.name for job in jobs if (folder / job.log).exists()}
        self.done = {job.name for job in jobs if _is_marked(folder, job)}

    def look(self) -> None:
        for job in self.jobs:
            if job.name not in self.begun and (self.folder / job.log).exists():
                self.begun.add(job.name)
                log.info("%s: begun", job.name)
            if job.name not in self.done and _is_marked(self.folder, job):
                self.done.add(job.name)
                log.info("%s: done (%d of %d)", job.name, len(self.done), len(self.jobs))


# ---------------------------------------------------------------- of a large scene
def _jobs(whole: Workspace, plan: BlockPlan, device: str) -> list[Job]:
    config = load_config(None, whole.config_path)
    images = artifacts.IMAGE_SET.load(whole.stage_folder(artifacts.IMAGE_SET.stage)).images
    size = {image.name: (image.width, image.height) for image in images}
    memory = {block.name: memory_asked_for([size[name] for name in block.photos], config) for block in plan.blocks}
    gpus = int(device.startswith("cuda"))  # auto: what the machines that it comes to happen to have
    return [
        Job(step, [*OURSELVES, *step.command(whole.root)[1:], "--wait", "--device", device], memory[step.block], gpus)
        for step in steps_of(plan)
    ]


def _is_done(root: Path, step: Step, pipeline: Sequence[Stage[Any]]) -> bool:
    """Whether all stages of the step are up to date. What is wrong with a workspace, its own run tells."""
    names = [stage.name for stage in pipeline]
    last = len(names) if step.until is None else names.index(step.until) + 1
    try:
        statuses = workspace_status(Workspace.open(block_folder(root, step.block)), pipeline)
    except HineusError:
        return False
    return all(status.state == "fresh" for status in statuses[:last])


def _outcome(root: Path, block: Block, jobs: Sequence[Job], failed: Mapping[str, HineusError]) -> BlockOutcome:
    error = next((failed[job.name] for job in jobs if job.step.block == block.name and job.name in failed), None)
    folder = block_folder(root, block.name)
    glb = artifacts.asset_path(folder / "export", "glb")
    report = artifacts.PAGE.load(folder / "report")
    return BlockOutcome.of(root, block, error, glb if glb.exists() else None, report if report.exists() else None)
