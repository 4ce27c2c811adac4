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
    """How each stage of a workspace stands: fresh, stale or missing, and why."""
    from configs.load import load_config
    from configs.params import Config
    from hineus_cli.console import product, status_table
    from stages.engine.fingerprint import SourceDigests
    from stages.engine.status import Present, pipeline_status
    from stages.engine.workspace import Workspace

    opened = Workspace.open(workspace)
    config = load_config(file=opened.config_path) if opened.config_path.exists() else Config()
    sources = {name: None if path is None else Path(path) for name, path in opened.record.sources.items()}
    present = Present(opened, config, SourceDigests(sources, opened.digest_cache))
    statuses = pipeline_status(context.obj.pipeline, present, verify)
    if not as_json:
        console = product()
        console.print(status_table(statuses, console.width))
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
    typer.echo(json.dumps({"workspace": str(opened.root), "sources": dict(opened.record.sources), "stages": stages}))
