"""The record of a stage and what it is handed when it runs."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar

from pydantic import BaseModel

from stages.artifacts.artifact import Artifact
from stages.artifacts.own_files import remove
from stages.engine.fingerprint import FileDigests
from stages.engine.manifest import Manifest
from stages.engine.workspace import Record

T = TypeVar("T")
P = TypeVar("P")
P_co = TypeVar("P_co", covariant=True)


class Progress(Protocol):
    """Told by a stage how far it is. The console draws it; tests and scripts ignore it."""

    def __call__(self, done: float, total: float, note: str = "") -> None: ...


def no_progress(done: float, total: float, note: str = "") -> None:
    """The progress listener that ignores everything."""


@dataclass(frozen=True)
class StageContext(Generic[P_co]):
    """All a running stage may touch.

    Attributes:
        inputs: stage name -> its published folder, for each stage whose artifacts are read. For `read` alone.
        sources: paths outside the workspace ("photos", "masks"), only for stages that name them. Read only.
        out: empty folder that becomes the published one when `run` returns. Write here only.
        scratch: folder that survives a kill and is emptied when the stage is published or its fingerprint
            changes. For checkpoints.
        params: the stage's own settings (one section of the config).
        device: "cpu" or "cuda".
        workers: how many CPU threads to use.
        progress: listener, see `Progress`.
        digests: source name -> sha256 of its files, as far as they are known already.
        reads: what `read` may give; None: anything (for a stage that is called by itself).
        manifests: stage name -> its manifest, for `Stage.reads_manifests`.
        record, config: of the workspace, for `Stage.reads_run`.
        previous: the stage's own last publication, for `Stage.continues`; None where there is none to go on from.
    """

    inputs: Mapping[str, Path]
    sources: Mapping[str, Path]
    out: Path
    scratch: Path
    params: P_co
    device: str = "cpu"
    workers: int = 1
    progress: Progress = no_progress
    digests: Mapping[str, FileDigests] = field(default_factory=dict)
    reads: tuple[Artifact[Any], ...] | None = None
    manifests: Mapping[str, Manifest] = field(default_factory=dict)
    record: Record | None = None
    config: BaseModel | None = None
    previous: Path | None = None

    def read(self, artifact: Artifact[T]) -> T:
        """The artifact as an earlier stage published it.

        Raises:
            ValueError: the stage did not declare that it reads it.
        """
        if self.reads is not None and artifact not in self.reads:
            raise ValueError(f"{artifact.name} is read without being declared")
        return artifact.load(self.inputs[artifact.stage])

    def read_previous(self, artifact: Artifact[T]) -> T | None:
        """The stage's own artifact as it published it last; None where there is nothing to go on from."""
        return None if self.previous is None else artifact.load(self.previous)

    def write(self, artifact: Artifact[T], value: T) -> None:
        """Put an artifact of this stage into its folder."""
        artifact.save(self.out, value)

    def empty_folder(self, name: str) -> Path:
        """A folder in `scratch`, emptied of whatever a killed run left."""
        folder = self.scratch / name
        remove(folder)
        folder.mkdir(parents=True)
        return folder

    def to_write(self, artifact: Artifact[T]) -> T:
        """An artifact of this stage whose value is a place: where to write its files."""
        return artifact.load(self.out)


@dataclass(frozen=True)
class Stage(Generic[P]):
    """One step of the pipeline: artifacts in, artifacts out.

    Attributes:
        name: folder name in the workspace, subcommand name, and the config section of its settings.
        version: raise it when the same inputs and settings would give another result; enters the fingerprint.
        settings: its section of the whole config; all of it enters the fingerprint.
        run: does the work; returns the numbers a person wants to see (JSON-able). A failure raises.
        reads: artifacts of earlier stages. Their contents enter the fingerprint, and nothing else of those stages.
        writes: all that it publishes.
        sources: names of outside paths ("photos", "masks") whose contents enter the fingerprint.
        reads_manifests: stages whose manifests it reads: what they cost, and with which settings they were made.
        reads_run: whether it reads what the run was started with: the workspace's record and the whole config.
        continues: whether it may go on from its own last publication, made by this version with these settings. What
            it was given to go on from enters its fingerprint (docs/adr/0013).
        summary: one line for `--help` and the progress bar.
    """

    name: str
    version: int
    settings: Callable[[Any], P]
    run: Callable[[StageContext[P]], dict[str, Any]]
    reads: tuple[Artifact[Any], ...] = ()
    writes: tuple[Artifact[Any], ...] = ()
    sources: tuple[str, ...] = ()
    reads_manifests: tuple[str, ...] = ()
    reads_run: bool = False
    continues: bool = False
    summary: str = ""

    @property
    def needs(self) -> tuple[str, ...]:
        """Names of the earlier stages that must be up to date, in the order in which they are first named."""
        return tuple(dict.fromkeys([artifact.stage for artifact in self.reads] + list(self.reads_manifests)))
