"""`hineus render`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from hineus_cli.completing import rendered_subjects
from hineus_cli.options import Json, OfWorkspace, Verbose, picture_size
from hineus_cli.session import Session, print_json


def render(
    context: typer.Context,
    workspace: OfWorkspace = Path("."),
    what: Annotated[
        str, typer.Option(help="mesh, with the photos' texture, or splats.", autocompletion=rendered_subjects)
    ] = "mesh",
    path: Annotated[
        str,
        typer.Option(
            metavar="orbit|CAMERAS.json",
            help="Around the model, or a frame for each camera of a transforms.json in the frame of the exported PLY.",
        ),
    ] = "orbit",
    out: Annotated[Path, typer.Option(help="An .mp4 film, or a .png picture.")] = Path("film.mp4"),
    size: Annotated[str, typer.Option(metavar="WxH", help="Pixels of a picture.")] = "1280x720",
    frames: Annotated[int, typer.Option(min=2, max=3600, help="Of an orbit, 30 a second.")] = 240,
    sides: Annotated[int, typer.Option(min=1, max=12, help="Pictures in a row of a .png, evenly along the path.")] = 1,
    as_json: Json = False,
    verbose: Verbose = False,
) -> None:
    """Draw the model of a workspace along a path of cameras: a film of the mesh or of its splats."""
    from stages.render import Film
    from stages.render import render as drawn

    session: Session = context.obj
    film = Film(what=what, path=path, out=out, size=picture_size(size), frames=frames, sides=sides)
    with session.running(verbose) as progress:
        told = drawn(workspace, film, progress.bar("pictures"))
    _show(told)
    if as_json:
        print_json(told)


def _show(told: dict[str, Any]) -> None:
    from hineus_cli.console import say

    how = f"{told['frames']} frames, {told['codec']}" if "frames" in told else f"{told['sides']} pictures"
    say(f"{told['file']}: {told['what']}, {how}")
