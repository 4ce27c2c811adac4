"""`hineus status`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from hineus_cli.options import Json, OfWorkspace


def status(
    context: typer.Context,
    workspace: OfWorkspace = Path("."),
    verify: Annotated[bool, typer.Option("--verify", help="Read every output back and compare its hash.")] = False,
    as_json: Json = False,
) -> None:
    """How each stage of a workspace stands: fresh, stale or missing, and why; and each block of a large scene."""
    from dataclasses import asdict

    from hineus_cli.console import block_status_table, product, status_table
    from stages.block_status import block_statuses, workspace_status
    from stages.engine.workspace import Workspace

    opened = Workspace.open(workspace)
    statuses = workspace_status(opened, context.obj.pipeline, verify)
    blocks = list(block_statuses(opened.root, context.obj.pipeline))
    if not as_json:
        console = product()
        console.print(status_table(statuses, console.width))
        if blocks:
            console.print(block_status_table(blocks))
        return
    stages = [
        {
            "name": each.name,
            "state": each.state,
            "reason": each.reason,
            **{
                key: getattr(each.manifest, key) if each.manifest else None
                for key in ("size", "wall_s", "cpu_s", "peak_rss", "created")
            },
            "numbers": dict(each.manifest.numbers) if each.manifest else None,
            "previous": each.manifest.identity.previous if each.manifest else None,
        }
        for each in statuses
    ]
    answer = {"workspace": str(opened.root), "sources": dict(opened.record.sources), "stages": stages}
    if blocks:
        answer["blocks"] = [{**asdict(each), "workspace": str(each.workspace)} for each in blocks]
    typer.echo(json.dumps(answer))
