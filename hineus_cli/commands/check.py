"""`hineus check`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from hineus_cli.options import (
    Balls,
    BlackKeeps,
    ConfigFile,
    Control,
    Device,
    Json,
    Light,
    Masks,
    MovingObject,
    NoMasks,
    Poses,
    Preset,
    Relightable,
    Sets,
    Time,
    Workers,
    WorkspaceOption,
    settings,
)
from hineus_cli.session import print_json
from stages.errors import InputError, SystemRequirementError
from stages.request import Request


def check(
    context: typer.Context,
    photos: Annotated[Path, typer.Argument(help="Folder of photos, or a video.", show_default=False)],
    workspace: WorkspaceOption = None,
    masks: Masks = None,
    no_masks: NoMasks = False,
    black_keeps: BlackKeeps = None,
    poses: Poses = None,
    control: Control = None,
    light: Light = None,
    ball: Balls = None,
    preset: Preset = None,
    config: ConfigFile = None,
    sets: Sets = None,
    device: Device = "auto",
    workers: Workers = None,
    time: Time = None,
    relightable: Relightable = False,
    moving_object: MovingObject = False,
    as_json: Json = False,
) -> None:
    """A quick look before a run: are these photos good, and what will they take? Exits with 0 unless it is no-go."""
    from stages.reconstruct import check_photos

    request = Request(
        photos=photos,
        workspace=workspace,
        masks=masks,
        no_masks=no_masks,
        poses=poses,
        control=control,
        light=light,
        no_light=bool(ball),
        preset=preset,
        config=config,
        sets=settings(
            sets,
            time,
            moving_object=moving_object,
            masks=masks,
            no_masks=no_masks,
            black_keeps=black_keeps,
            relightable=relightable,
            light=light,
            balls=ball,
        ),
        device=device,
        workers=workers,
    )
    done = check_photos(request)
    exit_code = InputError.exit_code if done.refusals else SystemRequirementError.exit_code if done.shortages else 0
    if as_json:
        print_json(done.as_dict(), ok=exit_code == 0)
        raise typer.Exit(exit_code)
    from rich.table import Table
    from rich.text import Text

    from hineus_cli.console import product
    from stages.preflight import facts

    table = Table.grid(padding=(0, 2))
    for what, found in facts(done):
        table.add_row(Text(what, style="bold"), found)
    for what, style, lines in (
        ("warning", "yellow", done.warnings),
        ("no-go", "red", (*done.refusals, *done.shortages)),
    ):
        for line in lines:
            table.add_row(Text(what, style=style), line)
    table.add_row(Text("verdict", style="bold"), done.verdict)
    product().print(table)
    raise typer.Exit(exit_code)
