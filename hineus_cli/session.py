"""One invocation of the command line, and how a command answers it."""

from __future__ import annotations

import json
import logging
import shlex
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from hineus_cli.at_once import Stopped
from hineus_cli.stopping import end_children, import_what_takes_signals
from hineus_cli.streams import stdout_kept_clean
from stages.engine.stage import Stage

if TYPE_CHECKING:
    from hineus_cli.console import ProgressDisplay


@dataclass
class Session:
    """The pipeline that is served, and what is needed to tell of a failure; a command finds it as `context.obj`.

    Attributes:
        json: whether stdout gets one JSON object.
    """

    pipeline: Sequence[Stage]
    json: bool = False
    progress: ProgressDisplay | None = None

    @contextmanager
    def working(self, verbose: bool = False) -> Iterator[None]:
        """For what a command calls: it is logged, and stdout is kept clean for the JSON."""
        from hineus_cli.console import set_up_logging

        set_up_logging(logging.DEBUG if verbose else logging.INFO)
        with stdout_kept_clean() if self.json else nullcontext():
            try:
                yield
            except (Stopped, KeyboardInterrupt):
                end_children()
                raise

    @contextmanager
    def running(self, verbose: bool = False) -> Iterator[ProgressDisplay]:
        """As `working`, with a progress bar for each stage."""
        from hineus_cli.console import ProgressDisplay

        import_what_takes_signals()
        with self.working(verbose), ProgressDisplay() as self.progress:
            yield self.progress


def as_argument(path: Path) -> str:
    """A path as a command takes it: short from the current folder, and quoted where the shell needs it."""
    return shlex.quote(str(path.relative_to(Path.cwd()) if path.is_relative_to(Path.cwd()) else path))


def print_json(answer: Mapping[str, Any], ok: bool = True) -> None:
    """One object on stdout."""
    typer.echo(json.dumps({"ok": ok, **answer}))
