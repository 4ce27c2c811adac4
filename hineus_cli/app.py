"""The command line: every command is registered here, and errors become sentences and exit codes here alone.

Modules that are slow to import are imported inside the commands, so that `hineus --help` answers at once.
"""

from __future__ import annotations

import errno
import signal
import sys
from collections.abc import Sequence
from contextlib import suppress
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from hineus_cli.commands.bench import bench
from hineus_cli.commands.check import check
from hineus_cli.commands.demo import demo
from hineus_cli.commands.doctor import doctor
from hineus_cli.commands.evaluate import compare, evaluate_app
from hineus_cli.commands.export_poses import export_colmap, export_transforms
from hineus_cli.commands.run import run, stage_command
from hineus_cli.commands.settings import presets, show_config
from hineus_cli.commands.status import status
from hineus_cli.commands.view import view
from hineus_cli.session import Session, print_json
from hineus_cli.stopping import GOES_ON, Stopped, stopped_by_signals
from stages.engine.stage import Stage
from stages.errors import HineusError
from stages.pipeline import PIPELINE


class HineusGroup(TyperGroup):
    """The command group that turns errors into sentences and exit codes."""

    pipeline: Sequence[Stage] = PIPELINE

    def main(self, *args: Any, **extra: Any) -> Any:
        session = Session(self.pipeline)
        try:
            with stopped_by_signals():
                return super().main(*args, obj=session, **extra)
        except HineusError as error:
            _tell(session, type(error).__name__, error.message, error.hint, error.exit_code)
            sys.exit(error.exit_code)
        except Exception as error:
            from hineus_cli.console import is_output_error

            told = _no_output(error) if is_output_error(error) else _unexpected(session, error)
            _tell(session, type(error).__name__, *told, HineusError.exit_code)
            sys.exit(HineusError.exit_code)

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        # Before any option is looked at: what is wrong with one is told as JSON, too.
        ctx.obj.json = "--json" in args
        return super().parse_args(ctx, args)

    def invoke(self, ctx: Any) -> Any:
        try:
            return super().invoke(ctx)
        except KeyboardInterrupt as interruption:
            stop = interruption if isinstance(interruption, Stopped) else Stopped(signal.SIGINT)
            with suppress(OSError):  # the terminal may be gone
                _tell(ctx.obj, "Stopped", stop.message, GOES_ON, stop.exit_code)
            raise typer.Exit(stop.exit_code) from None


def _unexpected(session: Session, error: Exception) -> tuple[str, str]:
    """Message and hint for an error nobody foresaw; its traceback goes to the log, or to stderr before there is one."""
    stage = session.progress.running if session.progress else None
    where = f" in stage {stage}" if stage else ""
    if session.log_path is not None and session.log_path.exists():
        hint = f"The full traceback is at the end of {session.log_path}."
    else:
        import traceback

        traceback.print_exc()
        hint = "The traceback is above."
    text = " ".join(str(error).split())
    return f"Unexpected error{where}: {type(error).__name__}: {text}", f"{hint} Please report it with that."


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

    for command in (run, check, status, view, compare, bench, doctor, presets, demo):
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
    from hineus_cli.console import flush_output, mend_streams, show_error

    mend_streams()
    try:
        app(prog_name="hineus")
    finally:
        failed = flush_output()
        if failed is not None:
            if failed.errno != errno.EPIPE:  # as with `| head`, where all that was wanted was read
                show_error(*_no_output(failed))
            sys.exit(HineusError.exit_code)


def _no_output(error: Exception) -> tuple[str, str]:
    return f"The output cannot be written: {error}.", "Free some space, or send it elsewhere."
