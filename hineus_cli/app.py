"""The command line: every command is registered here, and errors become sentences and exit codes here alone.

Modules that are slow to import are imported inside the commands, so that `hineus --help` answers at once.
"""

from __future__ import annotations

import errno
import signal
import sys
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any, NoReturn

import typer
from typer.core import TyperGroup

from hineus_cli.at_once import Stopped
from hineus_cli.commands.bench import bench
from hineus_cli.commands.blocks import blocks
from hineus_cli.commands.check import check
from hineus_cli.commands.demo import demo
from hineus_cli.commands.doctor import doctor
from hineus_cli.commands.evaluate import compare, evaluate_app
from hineus_cli.commands.export_poses import export_colmap, export_transforms
from hineus_cli.commands.relight import relight
from hineus_cli.commands.render import render
from hineus_cli.commands.run import run, stage_command
from hineus_cli.commands.settings import presets, show_config
from hineus_cli.commands.status import status
from hineus_cli.commands.tileset import tileset
from hineus_cli.commands.view import view
from hineus_cli.session import Session, print_json
from hineus_cli.stopping import GOES_ON, stopped_by_signals
from hineus_cli.streams import flush_output, is_output_error, mend_streams
from stages.engine.run_log import where_traceback_is
from stages.engine.shortage import shortage
from stages.engine.stage import Stage
from stages.engine.system import requirement_error
from stages.engine.workspace import DISK_FULL
from stages.errors import ConfigError, HineusError, WorkspaceError
from stages.pipeline import PIPELINE
from stages.together import among_others

USAGE_ERROR: Any = typer.BadParameter.__base__  # click's, which newer versions of typer bring with them


class HineusGroup(TyperGroup):
    """The command group that turns errors into sentences and exit codes."""

    pipeline: Sequence[Stage] = PIPELINE

    def main(self, *args: Any, **extra: Any) -> Any:
        session = Session(self.pipeline)
        try:
            with stopped_by_signals():
                sys.exit(super().main(*args, **extra | {"obj": session, "standalone_mode": False}))
        except Stopped as stop:
            with suppress(OSError):  # the terminal may be gone
                _tell(session, "Stopped", stop.message, GOES_ON, stop.exit_code)
            sys.exit(stop.exit_code)
        except HineusError as error:
            _end(session, type(error).__name__, error)
        except Exception as error:
            if type(error).__name__ == "NoArgsIsHelpError":  # the help is printed by then
                sys.exit(ConfigError.exit_code)
            _end(session, type(error).__name__, _in_our_terms(session, error))

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        # Before any option is looked at: what is wrong with one is told as JSON, too.
        ctx.obj.json = "--json" in args
        return super().parse_args(ctx, args)

    def invoke(self, ctx: Any) -> Any:
        from hineus_cli.console import set_up_logging

        set_up_logging()
        try:
            _refuse_no_folder()
            return among_others(lambda: super(HineusGroup, self).invoke(ctx))
        except KeyboardInterrupt:  # where signals are not ours, as in a thread
            raise Stopped(signal.SIGINT) from None


def _refuse_no_folder() -> None:
    try:
        Path.cwd()
    except OSError:
        raise WorkspaceError("The folder you are in is no longer there.", "Go to another one with `cd`.") from None


def _in_our_terms(session: Session, error: Exception) -> HineusError:
    """What is told of an error that is none of ours; the traceback of one that nobody foresaw is kept in a file."""
    if is_output_error(error):
        flush_output()  # or its end is told once more
        return _no_output(error)
    if isinstance(error, USAGE_ERROR):
        command = error.ctx.command_path if error.ctx else "hineus"
        return ConfigError(" ".join(error.format_message().split()), f"See `{command} --help`.")
    if isinstance(error, typer.Abort) and isinstance(error.__cause__, EOFError):  # typer takes it for Ctrl-D
        error = error.__cause__
    if isinstance(error, OSError) and error.errno in DISK_FULL:
        return WorkspaceError(
            f"The disk is full: {error.filename} cannot be written ({error.strerror}).",
            "Free some space and try again.",
        )
    if lacking := requirement_error(error, "This command") or shortage(error, "This command"):
        return lacking
    stage = session.progress.running if session.progress else None
    where = f" in stage {stage}" if stage else ""
    what = " ".join([f"{type(error).__name__}:", *str(error).split()]).rstrip(":")
    return HineusError(f"Unexpected error{where}: {what}.", f"{where_traceback_is(error)} Please report it with that.")


def _end(session: Session, kind: str, error: HineusError) -> NoReturn:
    _tell(session, kind, error.message, error.hint, error.exit_code)
    sys.exit(error.exit_code)


def _tell(session: Session, kind: str, message: str, hint: str, exit_code: int) -> None:
    from hineus_cli.console import show_error

    show_error(message, hint)
    if session.json:
        error = {"type": kind, "message": message, "hint": hint, "exit_code": exit_code}
        with suppress(OSError):  # which may be what is to be told
            print_json({"error": error}, ok=False)


# ---------------------------------------------------------------- the table of commands
def _version(wanted: bool) -> None:
    if wanted:
        from importlib import metadata

        typer.echo(f"hineus {metadata.version('hineus')}")
        raise typer.Exit()


def build_app(pipeline: Sequence[Stage] = PIPELINE) -> typer.Typer:
    """The command line over `pipeline`: `run`, one command a stage, and the ones that look."""

    class Group(HineusGroup):
        pass

    Group.pipeline = pipeline
    app = typer.Typer(
        cls=Group,
        no_args_is_help=True,
        pretty_exceptions_enable=False,
        rich_markup_mode="rich",
    )

    @app.callback()
    def hineus(
        version: Annotated[
            bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
        ] = False,
    ) -> None:
        """Photos in, textured 3D asset out. Start with `hineus doctor`, then `hineus run PHOTOS`."""

    for command in (run, check, status, blocks, view, relight, render, tileset, compare, bench, doctor, presets, demo):
        app.command()(command)
    app.add_typer(evaluate_app, name="evaluate")
    app.command("config")(show_config)
    app.command("export-colmap")(export_colmap)
    app.command("export-transforms")(export_transforms)
    for stage in pipeline:
        app.command(stage.name, rich_help_panel="One stage (and what it needs)")(stage_command(stage))
    return app


app = build_app()


def main() -> None:
    """The `hineus` command."""
    mend_streams()
    from hineus_cli.console import show_error, show_no_tracebacks

    show_no_tracebacks()
    try:
        app(prog_name="hineus")
    finally:
        failed = flush_output()
        if failed is not None:
            if failed.errno != errno.EPIPE:  # as with `| head`, where all that was wanted was read
                error = _no_output(failed)
                show_error(error.message, error.hint)
            sys.exit(HineusError.exit_code)


def _no_output(error: Exception) -> HineusError:
    return HineusError(f"The output cannot be written: {error}.", "Free some space, or send it elsewhere.")
