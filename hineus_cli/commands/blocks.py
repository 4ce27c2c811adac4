"""`hineus blocks`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from hineus_cli.options import BLOCKS_HELP, Json, OfWorkspace, block_count
from hineus_cli.session import as_argument, print_json


def blocks(
    context: typer.Context,
    workspace: OfWorkspace = Path("."),
    count: Annotated[str, typer.Option(help=BLOCKS_HELP, metavar="N|auto")] = "auto",
    anew: Annotated[
        bool, typer.Option("--anew", help="Remove the blocks that there are, with all that they hold, and cut again.")
    ] = False,
    as_json: Json = False,
) -> None:
    """Cut a large scene, whose photos have poses, into blocks: a plan, and a workspace for each block."""
    from hineus_cli.console import block_table, product
    from stages.artifacts.blocks import block_folder
    from stages.divide import divide

    with context.obj.working():
        plan = divide(workspace, block_count(count), anew)
    root = workspace.absolute()
    if as_json:
        print_json({"workspace": str(root), **plan.model_dump(mode="json")})
        return
    console = product()
    console.print(block_table(plan.blocks, plan.lattice.cell))
    first = as_argument(block_folder(root, plan.blocks[0].name))
    console.print(
        f"One block: `hineus run --workspace {first}`. All of them: `hineus run --blocks {count}`", soft_wrap=True
    )
