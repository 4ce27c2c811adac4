"""`hineus view`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from hineus_cli.at_once import Stopped
from hineus_cli.options import OfWorkspace


def view(
    context: typer.Context,
    workspace: OfWorkspace = Path("."),
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port of the local server; 0: a free one.")] = 0,
    no_browser: Annotated[bool, typer.Option("--no-browser", help="Print the address only.")] = False,
) -> None:
    """Show the report of a workspace in the browser, or a run as it goes and the report once it is there."""
    import threading
    import webbrowser

    from hineus_cli.console import say
    from hineus_cli.viewing import serving, watch

    watched = watch(workspace, context.obj.pipeline)
    try:
        with serving(watched, port) as url:
            typer.echo(url)
            say("Ctrl-C ends it.")
            if not no_browser:
                webbrowser.open(url)
            threading.Event().wait()
    except Stopped as stop:
        raise typer.Exit(0 if stop.by_ctrl_c else stop.exit_code) from None
