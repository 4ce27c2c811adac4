"""What `hineus view` shows of a workspace that is cut into blocks: how each of them stands, and its own pages."""

from __future__ import annotations

import json
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from hineus_cli.watching import Answer, Watched, as_json, page_of_ours
from stages import artifacts
from stages.artifacts.blocks import Block, BlockPlan, block_folder, read_plan
from stages.artifacts.own_files import read_tail
from stages.engine.run_log import failure_told
from stages.engine.workspace import Workspace
from stages.errors import HineusError

PAGE = "blocks.html"

BlockState = Literal["waiting", "running", "failed", "done"]


@dataclass(frozen=True)
class WatchedInBlocks:
    """The workspace of the whole, and how it is cut."""

    whole: Watched
    plan: BlockPlan

    def answer(self, address: str) -> Answer | None:
        """What is at "", "state.json" or "report" of the whole, or at "blocks/NAME/" of a block, see `Watched.answer`.

        Raises:
            HineusError: a file of a workspace is none of ours.
            OSError: it cannot be read, or has just gone.
        """
        if address in ("", "live"):
            return page_of_ours(PAGE)
        if address == "state.json":
            return as_json(self.state())
        if address == "report":
            return self.whole.answer(address)
        folder, _, rest = address.partition("/")
        name, slash, rest = rest.partition("/")
        if folder != "blocks" or not slash or name not in {block.name for block in self.plan.blocks}:
            return None
        block = _opened(self.whole, name)
        return None if block is None else block.answer(rest)

    def state(self) -> dict[str, Any]:
        """What the page of blocks asks for every other second."""
        from stages.reporting.ground_plan import ground_plan

        blocks = [_state_of(self.whole, block) for block in self.plan.blocks]
        cores = {block.name: block.core[:, :2] for block in self.plan.blocks}
        return {
            "workspace": str(self.whole.workspace.root),
            "running": self.whole.workspace.in_use(),
            "report": self.whole.report.is_file(),
            "stages": self.whole.stage_states(),
            "blocks": blocks,
            "plan": ground_plan(cores, {block["name"]: block["state"] for block in blocks}),
        }


def watched_in_blocks(whole: Watched) -> WatchedInBlocks | None:
    """None where the workspace is not cut into blocks, or not yet.

    Raises:
        WorkspaceError: its plan cannot be read.
    """
    plan = read_plan(whole.workspace.root)
    return None if plan is None else WatchedInBlocks(whole, plan)


def _opened(whole: Watched, name: str) -> Watched | None:
    """A block's workspace; None where it has not been made yet.

    Raises:
        WorkspaceError: it is no workspace of ours.
    """
    if name not in whole.parts:
        folder = block_folder(whole.workspace.root, name)
        if not folder.exists():
            return None
        whole.parts[name] = Watched(Workspace.open(folder), whole.pipeline)
    return whole.parts[name]


def _state_of(whole: Watched, block: Block) -> dict[str, Any]:
    """How a block stands, by what lies in its workspace: whether that is up to date still takes too long to ask."""
    found: dict[str, Any] = {"name": block.name, "photos": len(block.photos), "stage": "", "progress": None}
    try:
        own = _opened(whole, block.name)
        if own is None:
            return {**found, "state": "waiting", "error": "", "stages": [], "host": ""}
        stages = own.stage_states()
        host = own.workspace.host_at_work() or ""
        at_work = own.workspace.being_written([stage.name for stage in own.pipeline]) if host else None
        error = "" if host else failure_told(own.workspace.log_path) or ""
    except (HineusError, OSError) as problem:
        return {**found, "state": "failed", "error": str(problem), "stages": [], "host": ""}
    if at_work is not None:
        for stage in stages:
            stage["state"] = "running" if stage["name"] == at_work else stage["state"]
    state: BlockState = "running" if host else "failed" if error else "waiting"
    if state == "waiting" and all(stage["state"] == "done" for stage in stages):
        state = "done"
    return {
        **found,
        "state": state,
        "stage": at_work or "",
        "progress": _trained(own) if at_work == "train" else None,
        "error": error,
        "stages": stages,
        "host": host,
    }


def _trained(own: Watched) -> float | None:
    """The part of the training under way that is done, as it has last logged it; None before that."""
    metrics: Path = artifacts.METRICS.load(own.workspace.scratch_folder("train"))
    for line in reversed(read_tail(metrics).splitlines()):
        with suppress(ValueError, KeyError, TypeError, RecursionError):  # being written, or junk
            progress = float(json.loads(line)["progress"])
            return progress if 0 <= progress <= 1 else None
    return None
