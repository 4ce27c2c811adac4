"""`hineus run`, and the command of each stage."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Annotated

import typer

from hineus_cli.completing import stage_names
from hineus_cli.options import (
    Blocks,
    Executor,
    Jobs,
    Json,
    Until,
    Verbose,
    block_count,
    refuse_without_blocks,
    with_options_of_a_run,
)
from hineus_cli.session import Session, as_argument, print_json
from stages.engine.stage import Stage
from stages.request import Request

if TYPE_CHECKING:
    from stages.reconstruct import Reconstruction


@with_options_of_a_run
def run(
    context: typer.Context,
    request: Request,
    from_stage: Annotated[
        str | None,
        typer.Option(
            "--from",
            help="Run this stage and all after it, even if fresh.",
            show_default=False,
            autocompletion=stage_names,
        ),
    ] = None,
    until: Until = None,
    force: Annotated[
        list[str] | None,
        typer.Option(help="Run this stage even if fresh. Repeatable.", show_default=False, autocompletion=stage_names),
    ] = None,
    blocks: Blocks = None,
    jobs: Jobs = None,
    executor: Executor = None,
    wait: Annotated[
        bool, typer.Option("--wait", help="Wait until no other process works in the workspace, instead of an error.")
    ] = False,
    as_json: Json = False,
    verbose: Verbose = False,
) -> None:
    """Photos to a textured asset: run every stage that is not up to date."""
    asked = replace(request, from_stage=from_stage, until=until, force=tuple(force or ()), wait=wait)
    if blocks is None:
        refuse_without_blocks(jobs, executor)
        _run(context.obj, asked, verbose)
    else:
        _run_in_blocks(context.obj, asked, block_count(blocks), jobs, executor, verbose)


def stage_command(stage: Stage) -> Callable[..., None]:
    """The subcommand of one stage: bring what it needs up to date, then run it, then stop."""

    @with_options_of_a_run
    def command(
        context: typer.Context,
        request: Request,
        force: Annotated[bool, typer.Option("--force", help="Run it even if it is fresh.")] = False,
        as_json: Json = False,
        verbose: Verbose = False,
    ) -> None:
        sets = (*turned_on(stage), *request.sets)
        _run(context.obj, replace(request, sets=sets, until=stage.name, force=(stage.name,) if force else ()), verbose)

    command.__doc__ = f"Stage: {stage.summary or stage.name}."
    return command


def turned_on(stage: Stage) -> tuple[str, ...]:
    """What is set where a stage that is off by default is asked for by its name."""
    from configs.params import Config

    section = Config.model_fields.get(stage.name)
    fields = getattr(section.annotation, "model_fields", {}) if section is not None else {}
    return (f"{stage.name}.enabled=true",) if "enabled" in fields else ()


def _run(session: Session, request: Request, verbose: bool) -> None:
    from stages.reconstruct import reconstruct

    with session.running(verbose) as progress:
        result = reconstruct(request, session.pipeline, progress)
    _show(result)
    if session.json:
        print_json(result.as_dict())


def _run_in_blocks(
    session: Session, request: Request, count: int | None, jobs: int | None, executor: str | None, verbose: bool
) -> None:
    from hineus_cli.console import block_outcome_table, people, say
    from stages.block_by_block import reconstruct_in_blocks
    from stages.block_jobs import reconstruct_at_once
    from stages.workflow import LOCAL, Capacity

    with session.running(verbose) as progress:
        if executor is None and jobs in (None, 1):
            result = reconstruct_in_blocks(request, count, session.pipeline, progress)
        else:
            capacity = Capacity(jobs or 1, executor or LOCAL, request.workers)
            result = reconstruct_at_once(request, count, capacity, session.pipeline, progress)
    people().print(block_outcome_table(result.outcomes))
    if failure := result.failure():
        raise failure
    say(f"blocks: {result.whole.workspace.root} (to see how they stand: `hineus status "
        f"{as_argument(result.whole.workspace.root)}`)")  # fmt: skip
    if session.json:
        print_json(result.as_dict())


def _show(result: Reconstruction) -> None:
    """The table, and as the last line the file that a person wants, with the command that opens it."""
    from hineus_cli.console import outcome_table, people, say

    console, root = people(), result.workspace.root
    console.print(outcome_table(result.outcomes, console.width))
    done = {outcome.name for outcome in result.outcomes}
    if result.report is not None and "report" in done:
        say(f"report: {result.report}")
    if result.glb is not None and "export" in done:
        say(f"textured model: {result.glb} (to see it: `hineus view {as_argument(root)}`)")
    else:
        say(f"workspace: {root} (to go on: `hineus run --workspace {as_argument(root)}`)")
