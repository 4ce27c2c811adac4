"""The record of a stage and what it is handed when it runs."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

if TYPE_CHECKING:  # pydantic takes a tenth of a second that `hineus --help` need not wait for
    from pydantic import BaseModel


class Progress(Protocol):
    """Told by a stage how far it is. The console draws it; tests and scripts ignore it."""

    def __call__(self, done: float, total: float, note: str = "") -> None: ...


def no_progress(done: float, total: float, note: str = "") -> None:
    """The progress listener that ignores everything."""


@dataclass(frozen=True)
class StageContext:
    """All a running stage may touch.

    Attributes:
        inputs: stage name -> its published folder, for each name in `Stage.needs`. Read only.
        sources: paths outside the workspace ("photos", "masks"), only for stages that name them. Read only.
        out: empty folder that becomes the published one when `run` returns. Write here only.
        scratch: folder that survives a kill and is emptied when the stage is published or its fingerprint
            changes. For checkpoints.
        params: the stage's own settings (one section of the config).
        device: "cpu" or "cuda".
        workers: how many CPU threads to use.
        progress: listener, see `Progress`.
    """

    inputs: Mapping[str, Path]
    sources: Mapping[str, Path]
    out: Path
    scratch: Path
    params: Any
    device: str = "cpu"
    workers: int = 1
    progress: Progress = no_progress


@dataclass(frozen=True)
class Stage:
    """One step of the pipeline: files in, files out.

    Attributes:
        name: folder name in the workspace and subcommand name.
        version: raise it when the same inputs and settings would give another result; enters the fingerprint.
        needs: names of the earlier stages whose published folders `run` reads.
        params: name of the config section handed to `run`; all of it enters the fingerprint.
        run: does the work; returns the numbers a person wants to see (JSON-able). A failure raises.
        sources: names of outside paths ("photos", "masks") whose contents enter the fingerprint.
        summary: one line for `--help` and the progress bar.
    """

    name: str
    version: int
    needs: tuple[str, ...]
    params: str
    run: Callable[[StageContext], dict[str, Any]]
    sources: tuple[str, ...] = field(default=())
    summary: str = ""

    def settings(self, config: BaseModel) -> BaseModel:
        """This stage's section of the whole config."""
        return getattr(config, self.params)
