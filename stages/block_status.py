"""How a workspace stands, and how the blocks of a large scene do, one line each."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from configs.load import load_config
from configs.params import Config
from stages.artifacts.blocks import block_folder, read_plan
from stages.engine.fingerprint import SourceDigests
from stages.engine.stage import Stage
from stages.engine.status import Present, StageStatus, pipeline_status
from stages.engine.workspace import Workspace
from stages.errors import HineusError


@dataclass(frozen=True)
class BlockStatus:
    """One block.

    Attributes:
        fresh, stages: how many of its stages are up to date, and how many there are.
        waiting: the first that is not; empty where all are. reason: why, in words.
        is_running: whether a process on this machine is at work in it.
    """

    name: str
    workspace: Path
    photos: int
    fresh: int
    stages: int
    waiting: str
    reason: str
    is_running: bool


def workspace_status(workspace: Workspace, pipeline: Sequence[Stage[Any]], verify: bool = False) -> list[StageStatus]:
    """How each stage stands, by the settings and the sources of the last run.

    Args:
        verify: read every output back and compare its hash.
    """
    config = load_config(file=workspace.config_path) if workspace.config_path.exists() else Config()
    sources = {name: None if path is None else Path(path) for name, path in workspace.record.sources.items()}
    present = Present(workspace, config, SourceDigests(sources, workspace.digest_cache))
    return pipeline_status(pipeline, present, verify)


def block_statuses(whole: Path, pipeline: Sequence[Stage[Any]]) -> Iterator[BlockStatus]:
    """Of each block of a workspace, in the plan's order; none where it was not cut into blocks."""
    plan = read_plan(whole)
    for block in plan.blocks if plan else ():
        folder = block_folder(whole, block.name)
        try:
            own = Workspace.open(folder)
            statuses, running = workspace_status(own, pipeline), own.in_use()
        except HineusError as error:
            yield BlockStatus(
                block.name, folder, len(block.photos), 0, len(pipeline), pipeline[0].name, error.message, False
            )
            continue
        waiting = next((status for status in statuses if status.state != "fresh"), None)
        yield BlockStatus(
            name=block.name,
            workspace=folder,
            photos=len(block.photos),
            fresh=sum(status.state == "fresh" for status in statuses),
            stages=len(statuses),
            waiting=waiting.name if waiting else "",
            reason=waiting.reason if waiting else "",
            is_running=running,
        )
