"""What a person sees: console, logging, progress bars, tables. Everything for people goes to stderr.

Only this module configures logging. It is imported inside the commands, since rich takes its time.
"""

from __future__ import annotations

import logging
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from types import TracebackType
from typing import TYPE_CHECKING, Any

from rich.console import Console, ConsoleOptions, RenderableType
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.segment import Segment
from rich.table import Table
from rich.text import Text

from stages.engine.run_log import TRACEBACKS, plain
from stages.engine.runner import Listener, StageOutcome
from stages.engine.stage import Stage
from stages.engine.status import StageStatus
from stages.engine.workspace import show_bytes

if TYPE_CHECKING:
    from stages.artifacts.blocks import Block
    from stages.block_by_block import BlockOutcome
    from stages.block_status import BlockStatus

OURS = ("hineus_cli", "stages", "configs")
CONSOLE_HANDLER = "hineus-console"

PLAIN_WIDTH = 160  # columns where the output is a pipe or a file
PLAIN_EVERY_S = 30.0  # seconds between progress lines there
MAX_NUMBERS = 4  # numbers of a stage in the summary table
WIDE = 110  # columns from which tables show everything; narrower ones keep what explains the result
NARROW = 70  # columns below which they show names and reasons only, and progress has no bar

GIB = 1 << 30

_LEVEL_COLOURS = {"WARNING": "yellow", "ERROR": "red", "CRITICAL": "red"}
_STATE_COLOURS = {"fresh": "green", "stale": "yellow", "missing": "red"}


def people() -> Console:
    """The console for people, on stderr."""
    return _console(stderr=True)


def product() -> Console:
    """The console for what a command is asked to print (a table, settings), on stdout."""
    return _console(stderr=False)


def _console(stderr: bool) -> Console:
    stream = sys.stderr if stderr else sys.stdout
    width = None if stream.isatty() else PLAIN_WIDTH
    # Texts are printed as they are: `[red]` and `:key:` may be names of files.
    return _PlainConsole(stderr=stderr, width=width, highlight=False, soft_wrap=False, markup=False, emoji=False)


class _PlainConsole(Console):
    """Shows all text by `plain`, also in tables and beside bars: there is no other way from us to a terminal."""

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterable[Segment]:
        text = Text(renderable) if isinstance(renderable, str) else renderable
        if isinstance(text, Text) and plain(text.plain) != text.plain:
            text = text.blank_copy(plain(text.plain))
        return super().render(text, options)


def _redraws(console: Console) -> bool:
    """Whether lines that were printed can be drawn again: not in a pipe, even where FORCE_COLOR wants colours there."""
    return console.file.isatty() and not console.is_dumb_terminal


def say(text: str, style: str = "", console: Console | None = None) -> None:
    """One line for people, which only the terminal wraps, so that a command in it can be copied."""
    (console or people()).print(Text(plain(text, kept="\t"), style=style), soft_wrap=True)


# ---------------------------------------------------------------- logging
class _PeopleHandler(logging.Handler):
    """Each record as one line on stderr."""

    def emit(self, record: logging.LogRecord) -> None:
        try:
            say(f"{record.levelname}: {record.getMessage()}", _LEVEL_COLOURS.get(record.levelname, ""))
        except Exception:  # as logging's own handlers do: what cannot be told is no reason to stop
            self.handleError(record)


def set_up_logging(level: int = logging.WARNING) -> None:
    """Warnings of everybody and what our stages say from this level on go to stderr."""
    handler = _PeopleHandler()
    handler.name = CONSOLE_HANDLER
    handler.setLevel(level)
    handler.addFilter(lambda record: record.name != TRACEBACKS)
    root = logging.getLogger()
    for old in [old for old in root.handlers if old.name == CONSOLE_HANDLER]:
        root.removeHandler(old)
    root.addHandler(handler)
    root.setLevel(logging.WARNING)
    for name in OURS:
        logging.getLogger(name).setLevel(logging.DEBUG)


def show_no_tracebacks() -> None:
    """What Python itself would print goes to the log: of warnings a line, of errors in threads, in objects that end and
    in logging the traceback for the log file."""

    def told(message: Warning | str, category: type[Warning], filename: str, lineno: int, *_: Any, **__: Any) -> None:
        logging.getLogger("warnings").warning("%s: %s (%s, line %d)", category.__name__, message, filename, lineno)

    def logged(unraised: Any) -> None:
        error = (unraised.exc_type, unraised.exc_value, unraised.exc_traceback)
        logging.getLogger(TRACEBACKS).error("an error that ended nothing", exc_info=error)

    warnings.showwarning = told
    threading.excepthook = sys.unraisablehook = logged
    logging.raiseExceptions = False


# ---------------------------------------------------------------- errors
def show_error(message: str, hint: str = "") -> None:
    """What happened; then, as the last line, what to do."""
    console = people()
    console.print(Text.assemble(("Error: ", "bold red"), plain(message, kept="\t")), soft_wrap=True)
    if hint:
        say(hint, "cyan", console)


# ---------------------------------------------------------------- progress
def _bars(console: Console) -> Progress:
    roomy = console.width >= NARROW
    times = (TimeElapsedColumn(), TextColumn("left"), TimeRemainingColumn())
    return Progress(
        TextColumn("{task.description:<10}", markup=False),
        *((BarColumn(bar_width=30),) if roomy else ()),
        TaskProgressColumn(),
        *(times if roomy else ()),
        TextColumn("{task.fields[note]}", markup=False),
        console=console,
        disable=not _redraws(console),
    )


class ProgressDisplay(Listener):
    """A bar with an ETA for each stage; in a pipe, a line at its start, its end and now and then between."""

    def __init__(self) -> None:
        self.running: str | None = None
        self._console = people()
        self._bars = _bars(self._console)
        self._task: Any = None
        self._printed_at = 0.0

    def __enter__(self) -> ProgressDisplay:
        self._bars.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._bars.stop()

    def bar(self, what: str) -> Callable[[int, int], None]:
        """For something that is no stage: what takes (done, total) and shows it. Silent in a pipe."""
        task: Any = None

        def show(done: int, total: int) -> None:
            nonlocal task
            task = self._bars.add_task(what, note="") if task is None else task
            self._bars.update(task, completed=done, total=total)

        return show

    def stage_started(self, stage: Stage, reason: str) -> None:
        self.running = stage.name
        self._printed_at = time.monotonic()
        self._line(f"{stage.name}: {stage.summary or 'running'} ({reason})")
        self._task = self._bars.add_task(stage.name, total=None, note="")

    def stage_progress(self, stage: Stage, done: float, total: float, note: str) -> None:
        self._bars.update(self._task, completed=done, total=total, note=note)
        if self._bars.disable and time.monotonic() - self._printed_at > PLAIN_EVERY_S:
            self._printed_at = time.monotonic()
            self._line(f"{stage.name}: {100 * done / max(total, 1e-9):.0f} % {note}".rstrip())

    def stage_finished(self, stage: Stage, outcome: StageOutcome) -> None:
        self.running = None
        if outcome.action == "ran":
            self._bars.update(self._task, completed=1, total=1, note="")
            self._line(f"{stage.name}: done in {outcome.wall_s:.1f} s")
        else:
            self._line(f"{stage.name}: skipped ({outcome.reason})")

    def _line(self, text: str) -> None:
        say(text, "dim", self._console)


# ---------------------------------------------------------------- tables
def table_of(first: str, *numbers: str) -> Table:
    """An empty table: a column of names, and columns of numbers."""
    table = Table(header_style="bold")
    table.add_column(first)
    for heading in numbers:
        table.add_column(heading, justify="right")
    return table


def _stage_table(state: str, width: int, *numbers: str) -> Table:
    """An empty table of stages: name, state, why, and where there is room columns of numbers."""
    table = Table(header_style="bold")
    for heading in ("stage", state):
        table.add_column(heading, no_wrap=True)
    table.add_column("why", overflow="fold")
    for heading in numbers if width >= NARROW else ():
        table.add_column(heading, justify="right", no_wrap=True)
    return table


def outcome_table(outcomes: Sequence[StageOutcome], width: int) -> Table:
    """Stage, what became of it and why, its cost, where there is room its key numbers. The total is of what ran now."""
    table = _stage_table("what", width, "wall s", "CPU s", "peak GiB")
    if width >= WIDE:
        table.add_column("numbers", overflow="fold")

    def add(*cells: str | Text, style: str | None = None) -> None:
        table.add_row(*cells[: len(table.columns)], style=style)

    for outcome in outcomes:
        add(
            outcome.name,
            outcome.action,
            outcome.reason,
            f"{outcome.wall_s:.1f}",
            f"{outcome.cpu_s:.1f}",
            f"{outcome.peak_rss / GIB:.2f}",
            key_numbers(outcome.numbers),
            style="dim" if outcome.action == "skipped" else None,
        )
    ran = [outcome for outcome in outcomes if outcome.action == "ran"]
    table.add_section()
    add(
        "total",
        f"{len(ran)} ran",
        "",
        f"{sum(outcome.wall_s for outcome in ran):.1f}",
        f"{sum(outcome.cpu_s for outcome in ran):.1f}",
        f"{max((outcome.peak_rss for outcome in ran), default=0) / GIB:.2f}",
    )
    return table


def status_table(statuses: Sequence[StageStatus], width: int) -> Table:
    """Stage, how it stands and why, its size and time, where there is room what else it cost and its date."""
    table = _stage_table(
        "state", width, "size", "wall s", *(("CPU s", "peak GiB", "made (UTC)") if width >= WIDE else ())
    )
    for status in statuses:
        made = status.manifest
        cells: list[str | Text] = [
            status.name,
            Text(status.state, style=_STATE_COLOURS[status.state]),
            status.reason,
        ]
        if made:
            cells += [show_bytes(made.size), f"{made.wall_s:.1f}", f"{made.cpu_s:.1f}", f"{made.peak_rss / GIB:.2f}"]
            cells.append(made.created.replace("T", " ").removesuffix("+00:00"))
        table.add_row(*cells[: len(table.columns)])
    return table


def block_table(blocks: Sequence[Block], cell: float) -> Table:
    """Of a plan: name, photos, size of the core on the ground in the plan's unit and in cells, and what is around."""
    table = table_of("block", "photos", "core", "cells")
    table.add_column("neighbours")
    for block in blocks:
        side = block.core[1] - block.core[0]
        table.add_row(
            block.name,
            str(len(block.photos)),
            f"{side[0]:.4g} x {side[1]:.4g}",
            " x ".join(f"{each / cell:.0f}" for each in side),
            ", ".join(block.neighbours),
        )
    return table


def block_outcome_table(outcomes: Sequence[BlockOutcome]) -> Table:
    """Of a run in blocks: name, photos, whether it is done, and the model or what it failed of."""
    table = table_of("block", "photos")
    table.add_column("state", no_wrap=True)
    table.add_column("result", overflow="fold")
    for outcome in outcomes:
        state = Text(outcome.state, style="green" if outcome.state == "done" else "red")
        table.add_row(outcome.name, str(outcome.photos), state, outcome.error or str(outcome.glb or ""))
    return table


def block_status_table(blocks: Sequence[BlockStatus]) -> Table:
    """Of a whole's blocks: name, photos, how many stages are up to date, and which comes next and why."""
    table = table_of("block", "photos", "fresh")
    table.add_column("next", no_wrap=True)
    table.add_column("why", overflow="fold")
    for block in blocks:
        state = "missing" if block.fresh == 0 else "stale" if block.waiting else "fresh"
        fresh = Text(f"{block.fresh} of {block.stages}", style=_STATE_COLOURS[state])
        following = "running" if block.is_running else block.waiting
        table.add_row(block.name, str(block.photos), fresh, following, block.reason)
    return table


def key_numbers(numbers: Mapping[str, Any]) -> str:
    """The first few plain values of what a stage returned, in one line."""
    plain = [(name, value) for name, value in numbers.items() if isinstance(value, (int, float, str)) and value != ""]
    return ", ".join(f"{name.replace('_', ' ')} {_short(value)}" for name, value in plain[:MAX_NUMBERS])


def _short(value: float | str) -> str:
    if isinstance(value, bool) or not isinstance(value, float):
        return str(value)
    return f"{value:.4g}"
