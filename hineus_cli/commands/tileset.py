"""`hineus tileset`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from hineus_cli.options import Json
from hineus_cli.session import Session, print_json


def tileset(
    context: typer.Context,
    workspaces: Annotated[
        list[Path],
        typer.Argument(help="Folders of workspaces that have 3D Tiles, or of one in blocks.", show_default=False),
    ],
    out: Annotated[Path, typer.Option(help="The .json file to write.")] = Path("tileset.json"),
    as_json: Json = False,
) -> None:
    """Write one 3D Tiles tileset over those of several workspaces (`export.tiles`), with coarse models over all."""
    from hineus_cli.console import say
    from stages.tilesets import join_tilesets

    session: Session = context.obj
    with session.running() as progress:
        told = join_tilesets(workspaces, out, progress.bar("coarse models"))
    say(f"{told['file']}: {told['tiles']} tilesets, coarse models over them: {told['overviews']}")
    if as_json:
        print_json(told)
