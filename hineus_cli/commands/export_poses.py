"""`hineus export-colmap` and `hineus export-transforms`: poses for other programs."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hineus_cli.options import Json
from hineus_cli.session import print_json

if TYPE_CHECKING:
    from stages.export_poses import Writer

Source = Annotated[Path, typer.Argument(help="The workspace's folder.", show_default=False)]
OutFolder = Annotated[Path, typer.Argument(help="New or empty folder to write.", show_default=False)]


def export_colmap(context: typer.Context, workspace: Source, out: OutFolder, as_json: Json = False) -> None:
    """Write the undistorted photos with a COLMAP model of them, for COLMAP, OpenMVS and the like."""
    from stages.posing.exporting import write_colmap

    _export(workspace, out, write_colmap, as_json)


def export_transforms(context: typer.Context, workspace: Source, out: OutFolder, as_json: Json = False) -> None:
    """Write the undistorted photos with nerfstudio's transforms.json and a PLY of the sparse points."""
    from stages.posing.exporting import write_transforms

    _export(workspace, out, write_transforms, as_json)


def _export(workspace: Path, out: Path, write: Writer, as_json: bool) -> None:
    from hineus_cli.console import say
    from stages.export_poses import export_poses

    numbers = export_poses(workspace, out, write)
    say(f"{numbers['images']} images, {numbers['points']} points: {out}")
    if as_json:
        print_json({"folder": str(out.absolute()), **numbers})
