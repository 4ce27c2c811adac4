"""`hineus relight`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from hineus_cli.completing import lights
from hineus_cli.options import Json, OfWorkspace, Verbose, picture_size
from hineus_cli.session import Session, print_json


def relight(
    context: typer.Context,
    workspace: OfWorkspace = Path("."),
    light: Annotated[
        str,
        typer.Option(
            help="learned (with the materials), studio, sun, window, or an equirectangular .hdr or .exr file.",
            autocompletion=lights,
        ),
    ] = "studio",
    out: Annotated[Path, typer.Option(help="A .png picture, or an .mp4 turntable.")] = Path("relit.png"),
    turn: Annotated[
        float, typer.Option(min=-360, max=360, help="Turn the light by so many degrees about the vertical.")
    ] = 0.0,
    exposure: Annotated[
        float, typer.Option(min=-20, max=20, metavar="EV", help="Pictures 2^EV times as bright.")
    ] = 0.0,
    size: Annotated[str, typer.Option(metavar="WxH", help="Pixels of a picture.")] = "640x480",
    sides: Annotated[int, typer.Option(min=1, max=12, help="Pictures in a row, from so many sides.")] = 1,
    frames: Annotated[int, typer.Option(min=2, max=3600, help="Of a turntable, 30 a second.")] = 120,
    turn_light: Annotated[bool, typer.Option("--turn-light", help="The light goes around, not the asset.")] = False,
    background: Annotated[str, typer.Option(help="light (blurred), white or transparent.")] = "light",
    renderer: Annotated[
        str, typer.Option(help="hineus, or mitsuba (path traced, extra `bench`): slower, with shadows.")
    ] = "hineus",
    as_json: Json = False,
    verbose: Verbose = False,
) -> None:
    """Show the asset of a workspace in another light, as a picture or a turntable."""
    from stages.relight import Wish
    from stages.relight import relight as drawn

    session: Session = context.obj
    wish = Wish(
        light=light,
        out=out,
        turn_deg=turn,
        exposure_ev=exposure,
        size=picture_size(size),
        sides=sides,
        frames=frames,
        turn_light=turn_light,
        background=background,
        renderer=renderer,
    )
    with session.running(verbose) as progress:
        told = drawn(workspace, wish, progress.bar("pictures"))
    _show(told)
    if as_json:
        print_json(told)


def _show(told: dict[str, Any]) -> None:
    from hineus_cli.console import say

    how = f"{told['frames']} frames, {told['codec']}" if "frames" in told else f"{told['sides']} of its sides"
    say(f"{told['file']}: {how}")
    say(f"light: {told['light']}; exposure: {told['exposure_ev']:+g} EV; tone mapping: {told['tone_mapping']}")
