"""`hineus bench`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from hineus_cli.options import Blocks, Device, Json, Preset, Sets, Until, Verbose, Workers, hold_out_option
from hineus_cli.session import print_json

if TYPE_CHECKING:
    from stages.evaluation.suites.tables import TextTable


def bench(
    context: typer.Context,
    suite: Annotated[
        str,
        typer.Argument(
            help="dtu, nerf-synthetic, mipnerf360, glossy-synthetic, blendedmvs, urbanscene3d, or known.",
            show_default=False,
        ),
    ],
    data: Annotated[Path, typer.Argument(help="Folder with the suite's scenes as published.", show_default=False)],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for workspaces and results.")] = Path("bench"),
    scenes: Annotated[
        str | None, typer.Option(help="Names of scenes, with commas between; default: all.", show_default=False)
    ] = None,
    preset: Preset = None,
    sets: Sets = None,
    seeds: Annotated[int, typer.Option(min=1, max=1000, help="Runs of each scene, with seeds 0, 1, ...")] = 1,
    until: Until = None,
    hold_out: Annotated[int | None, hold_out_option("from every stage as a test, where the suite names none")] = None,
    masks: Annotated[bool, typer.Option("--masks", help="Use the masks that come with the photos.")] = False,
    truth: Annotated[
        Path | None, typer.Option(help="Folder of the evaluation data, if it lies elsewhere.", show_default=False)
    ] = None,
    peer: Annotated[
        list[str] | None,
        typer.Option(
            help="Another method to score: poisson, pymeshlab-poisson, ball-pivoting, colmap-dense, or "
            "'NAME=COMMAND {photos} {model} {masks} {out}'. Repeatable.",
            show_default=False,
        ),
    ] = None,
    blocks: Blocks = None,
    device: Device = "auto",
    workers: Workers = None,
    as_json: Json = False,
    verbose: Verbose = False,
) -> None:
    """Run a benchmark's scenes, score them by its protocol, and print them beside the paper's figures."""
    from dataclasses import asdict

    from hineus_cli.console import product
    from hineus_cli.options import block_count
    from stages.evaluation.peers.running import parse_peer
    from stages.evaluation.suites.paper import paper_tables
    from stages.evaluation.suites.registry import find_suite
    from stages.evaluation.suites.runs import BenchRequest, run_bench
    from stages.evaluation.suites.scene import Wanted
    from stages.evaluation.suites.tables import tables_of

    session = context.obj
    request = BenchRequest(
        suite=find_suite(suite),
        data=data,
        out=out,
        scenes=tuple(name.strip() for name in scenes.split(",")) if scenes else (),
        seeds=seeds,
        wanted=Wanted(masks, hold_out or 0, truth),
        peers=tuple(parse_peer(text) for text in peer or ()),
        preset=preset,
        sets=tuple(sets or ()),
        until=until,
        device=device,
        workers=workers,
        blocks=None if blocks is None else block_count(blocks) or "auto",
    )
    with session.running(verbose) as progress:
        results = list(run_bench(request, session.pipeline, progress))
    if as_json:
        paper = paper_tables().get(suite)
        print_json(
            {"suite": suite, "results": results, "paper": asdict(paper) if paper else None},
            ok=not any("error" in result for result in results),
        )
    else:
        for table in tables_of(request.suite, results):
            _print(product(), table)
    failed = [result["error"]["exit_code"] for result in results if "error" in result]
    if failed:
        raise typer.Exit(failed[0])


def _print(console: Any, text: TextTable) -> None:
    from rich.table import Table

    table = Table(title=text.title, title_justify="left", caption=text.note, caption_justify="left")
    for i, heading in enumerate(text.header):
        table.add_column(heading, justify="right" if i else "left", overflow="fold")
    for row in text.rows:
        table.add_row(*row, style="bold" if row[0].startswith("ours") else None)
    console.print(table)
