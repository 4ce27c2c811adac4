"""`hineus doctor`."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from hineus_cli.options import Json
from hineus_cli.session import print_json
from stages.errors import SystemRequirementError

COLOURS = {"ok": "green", "note": "yellow", "missing": "red"}


def doctor(
    context: typer.Context,
    folder: Annotated[Path, typer.Option(help="Where workspaces would lie; its free disk is shown.")] = Path("."),
    as_json: Json = False,
) -> None:
    """Is this machine fit? Versions, missing libraries, GPU, memory, disk, and what to install."""
    from stages.machine_check import examine

    findings = examine(folder.absolute())
    lacking = [finding for finding in findings if finding.state == "missing"]
    if as_json:
        print_json({"findings": [asdict(finding) for finding in findings]}, ok=not lacking)
        raise typer.Exit(SystemRequirementError.exit_code if lacking else 0)
    from rich.table import Table
    from rich.text import Text

    from hineus_cli.console import product

    table = Table(header_style="bold")
    for heading in ("what", "", "found", "advice"):
        table.add_column(heading, overflow="fold")
    for finding in findings:
        state = Text(finding.state, style=COLOURS[finding.state])
        table.add_row(finding.what, state, finding.found, finding.advice)
    product().print(table)
    if lacking:
        names = ", ".join(finding.what for finding in lacking)
        advice = dict.fromkeys(finding.advice for finding in lacking if finding.advice)
        raise SystemRequirementError(f"This machine lacks {names}.", "Try: " + "; ".join(advice))
