"""`hineus demo`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hineus_cli.options import Device, Json, Verbose, Workers
from hineus_cli.session import Session, as_argument, print_json

if TYPE_CHECKING:
    from stages.scenes.demo import Demo


def demo(
    context: typer.Context,
    folder: Annotated[Path, typer.Option("--workspace", "-w", help="Where photos and results go.")] = Path("demo"),
    preset: Annotated[str, typer.Option(help="See `hineus presets`.")] = "demo",
    device: Device = "auto",
    workers: Workers = None,
    as_json: Json = False,
    verbose: Verbose = False,
) -> None:
    """Make photos of a known object, reconstruct it, and score the result against the truth."""
    from stages.scenes.demo import run_demo

    session: Session = context.obj
    with session.running(verbose) as progress:
        made = run_demo(folder, preset, device, workers, session.pipeline, progress, progress.bar("photos"))
    _show(made)
    if as_json:
        print_json(made.as_dict())


def _show(made: Demo) -> None:
    from hineus_cli.console import outcome_table, people, say

    console, score = people(), made.score
    console.print(outcome_table(made.result.outcomes, console.width))
    lines = [
        f"distance to the known surface: {score['mean']:.2f} % of the object's extent "
        f"(accuracy {score['accuracy']:.2f} %, completeness {score['completeness']:.2f} %; "
        f"F-score at 1 %: {score['f_one_percent']:.0f} %)",
        f"whole demo: {made.seconds / 60:.1f} minutes",
        f"report: {made.result.report}",
        f"textured model: {made.result.glb} (to see it: `hineus view {as_argument(made.result.workspace.root)}`)",
    ]
    for line in lines:
        say(line)
