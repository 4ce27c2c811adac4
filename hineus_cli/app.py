"""The commands: parse, load the settings, run. The only place that catches HineusError.

Modules that are slow to import are imported inside the commands, so that `hineus --help` answers at once.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Sequence
from contextlib import nullcontext, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.core import TyperGroup

from hineus_cli.bench_app import bench
from hineus_cli.evaluate_app import evaluate_app
from stages.engine.stage import Stage
from stages.errors import HineusError, InputError, SystemRequirementError
from stages.pipeline import PIPELINE

if TYPE_CHECKING:
    from hineus_cli.console import ProgressDisplay
    from stages.reconstruct import Reconstruction, Request

INTERRUPTED = 130

Photos = Annotated[
    Path | None,
    typer.Argument(
        help="Folder of photos, or a video; may be left out for a workspace that knows its own.", show_default=False
    ),
]
WorkspaceOption = Annotated[
    Path | None,
    typer.Option("--workspace", "-w", help="Folder for all results; default: PHOTOS_hineus here.", show_default=False),
]
Masks = Annotated[
    Path | None, typer.Option(help="Folder of masks, named like the photos, white on the object.", show_default=False)
]
Poses = Annotated[
    Path | None,
    typer.Option(
        help="Known poses: a COLMAP model, transforms.json, cameras_sphere.npz, or a folder of *-camera.pkl.",
        show_default=False,
    ),
]
NoPoses = Annotated[bool, typer.Option("--no-poses", help="Forget the poses of the last run and find them.")]
NoMasks = Annotated[bool, typer.Option("--no-masks", help="Forget the masks of the last run.")]
Preset = Annotated[
    str | None,
    typer.Option(help="See `hineus presets`; default: gpu with a CUDA device, else cpu.", show_default=False),
]
ConfigFile = Annotated[
    Path | None, typer.Option("--config", help="YAML file of settings, over the preset.", show_default=False)
]
Sets = Annotated[
    list[str] | None,
    typer.Option("--set", help="One setting, over all else: section.key=value. Repeatable.", show_default=False),
]
Device = Annotated[str, typer.Option(help="auto, cpu or cuda.")]
Workers = Annotated[int | None, typer.Option(min=1, help="CPU threads; default: all.", show_default=False)]
Time = Annotated[
    str | None, typer.Option(help="Training budget, like 5m or 90s: sets train.minutes.", show_default=False)
]
HoldOut = Annotated[
    float | None,
    typer.Option(
        "--hold-out",
        metavar="PERCENT",
        help="Keep this part of the photos back from training and texture, and compare the result with them; 5 is "
        "every 20th: sets train.hold_out.",
        show_default=False,
    ),
]
NoGround = Annotated[bool, typer.Option("--no-ground", help="Cut off the ground or table: sets cleanup.remove_ground.")]
Watertight = Annotated[
    bool, typer.Option("--watertight", help="A closed mesh, as for printing: sets cleanup.keep_closed.")
]
Deterministic = Annotated[
    bool,
    typer.Option("--deterministic", help="The same poses every time, bit for bit, but slower: sfm.deterministic=true."),
]
Json = Annotated[bool, typer.Option("--json", help="Print one JSON object on stdout.")]
Verbose = Annotated[bool, typer.Option("--verbose", "-v", help="Say more.")]


@dataclass
class Session:
    """One invocation: the pipeline it serves, and what is needed to tell of a failure."""

    pipeline: Sequence[Stage]
    json: bool = False
    log_path: Path | None = None
    progress: ProgressDisplay | None = None


class HineusGroup(TyperGroup):
    """The command group that turns errors into sentences and exit codes."""

    pipeline: Sequence[Stage] = PIPELINE

    def main(self, *args: Any, **extra: Any) -> Any:
        session = Session(self.pipeline)
        try:
            return super().main(*args, obj=session, **extra)
        except HineusError as error:
            _tell(session, type(error).__name__, error.message, error.hint, error.exit_code)
            sys.exit(error.exit_code)
        except Exception as error:
            _tell(session, type(error).__name__, *_unexpected(session, error), HineusError.exit_code)
            sys.exit(HineusError.exit_code)

    def invoke(self, ctx: Any) -> Any:
        try:
            return super().invoke(ctx)
        except KeyboardInterrupt:
            from hineus_cli.console import show_error

            show_error("Stopped.", "What was finished is kept: run the same command to go on from there.")
            raise typer.Exit(INTERRUPTED) from None


def _unexpected(session: Session, error: Exception) -> tuple[str, str]:
    """Message and hint for an error nobody foresaw; its traceback goes to the log, or to stderr before there is one."""
    stage = session.progress.running if session.progress else None
    where = f" in stage {stage}" if stage else ""
    if session.log_path is not None and session.log_path.exists():
        hint = f"The full traceback is at the end of {session.log_path}."
    else:
        import traceback

        traceback.print_exc()
        hint = "The traceback is above."
    text = " ".join(str(error).split())
    return f"Unexpected error{where}: {type(error).__name__}: {text}", f"{hint} Please report it with that."


def _tell(session: Session, kind: str, message: str, hint: str, exit_code: int) -> None:
    from hineus_cli.console import show_error

    show_error(message, hint)
    if session.json:
        error = {"type": kind, "message": message, "hint": hint, "exit_code": exit_code}
        typer.echo(json.dumps({"ok": False, "error": error}))


# ---------------------------------------------------------------- run
def run(
    context: typer.Context,
    photos: Photos = None,
    workspace: WorkspaceOption = None,
    masks: Masks = None,
    no_masks: NoMasks = False,
    poses: Poses = None,
    no_poses: NoPoses = False,
    preset: Preset = None,
    config: ConfigFile = None,
    sets: Sets = None,
    from_stage: Annotated[
        str | None, typer.Option("--from", help="Run this stage and all after it, even if fresh.", show_default=False)
    ] = None,
    until: Annotated[str | None, typer.Option(help="Stop after this stage.", show_default=False)] = None,
    force: Annotated[
        list[str] | None, typer.Option(help="Run this stage even if fresh. Repeatable.", show_default=False)
    ] = None,
    device: Device = "auto",
    workers: Workers = None,
    time: Time = None,
    hold_out: HoldOut = None,
    no_ground: NoGround = False,
    watertight: Watertight = False,
    deterministic: Deterministic = False,
    as_json: Json = False,
    verbose: Verbose = False,
) -> None:
    """Photos to a textured asset: run every stage that is not up to date."""
    from stages.reconstruct import Request

    request = Request(
        photos=photos,
        workspace=workspace,
        masks=masks,
        no_masks=no_masks,
        poses=poses,
        no_poses=no_poses,
        preset=preset,
        config=config,
        sets=_settings(sets, deterministic),
        from_stage=from_stage,
        until=until,
        force=tuple(force or ()),
        device=device,
        workers=workers,
        time=time,
        hold_out=hold_out,
        no_ground=no_ground,
        watertight=watertight,
    )
    _run(context.obj, request, as_json, verbose)


def _settings(sets: list[str] | None, deterministic: bool) -> tuple[str, ...]:
    """Those of --set, and what a flag stands for."""
    return (*(sets or ()), *(["sfm.deterministic=true"] if deterministic else []))


def stage_command(stage: Stage) -> Callable[..., None]:
    """The subcommand of one stage: bring what it needs up to date, then run it, then stop."""

    def command(
        context: typer.Context,
        photos: Photos = None,
        workspace: WorkspaceOption = None,
        masks: Masks = None,
        no_masks: NoMasks = False,
        poses: Poses = None,
        no_poses: NoPoses = False,
        preset: Preset = None,
        config: ConfigFile = None,
        sets: Sets = None,
        force: Annotated[bool, typer.Option("--force", help="Run it even if it is fresh.")] = False,
        device: Device = "auto",
        workers: Workers = None,
        time: Time = None,
        hold_out: HoldOut = None,
        no_ground: NoGround = False,
        watertight: Watertight = False,
        deterministic: Deterministic = False,
        as_json: Json = False,
        verbose: Verbose = False,
    ) -> None:
        from stages.reconstruct import Request

        request = Request(
            photos=photos,
            workspace=workspace,
            masks=masks,
            no_masks=no_masks,
            poses=poses,
            no_poses=no_poses,
            preset=preset,
            config=config,
            sets=_settings(sets, deterministic),
            until=stage.name,
            force=(stage.name,) if force else (),
            device=device,
            workers=workers,
            time=time,
            hold_out=hold_out,
            no_ground=no_ground,
            watertight=watertight,
        )
        _run(context.obj, request, as_json, verbose)

    command.__doc__ = f"Stage: {stage.summary or stage.name}."
    return command


def _run(session: Session, request: Request, as_json: bool, verbose: bool) -> None:
    from hineus_cli.console import ProgressDisplay, set_up_logging, stdout_kept_clean
    from stages.reconstruct import choose_folder, reconstruct

    session.json = as_json
    session.log_path = choose_folder(request).absolute() / "hineus.log"
    set_up_logging(verbose)
    with stdout_kept_clean() if as_json else nullcontext(), ProgressDisplay() as session.progress:
        result = reconstruct(request, session.pipeline, session.progress)
    _show(result, as_json)


def _show(result: Reconstruction, as_json: bool) -> None:
    from hineus_cli.console import outcome_table, people

    console = people()
    console.print(outcome_table(result.outcomes, console.width))
    results = {"textured model": result.glb, "report": result.report, "workspace": result.workspace.root}
    for what, path in results.items():
        if path is not None:
            console.print(f"{what}: {path}", markup=False, soft_wrap=True)
    if as_json:
        typer.echo(
            json.dumps(
                {
                    "ok": True,
                    "workspace": str(result.workspace.root),
                    "preset": result.preset,
                    "device": result.device,
                    "workers": result.workers,
                    "stages": [asdict(outcome) for outcome in result.outcomes],
                    "glb": str(result.glb) if result.glb else None,
                    "report": str(result.report) if result.report else None,
                }
            )
        )


# ---------------------------------------------------------------- looking
def status(
    context: typer.Context,
    workspace: Annotated[Path, typer.Argument(help="The workspace's folder.")] = Path("."),
    verify: Annotated[bool, typer.Option("--verify", help="Read every output back and compare its hash.")] = False,
    as_json: Json = False,
) -> None:
    """How each stage of a workspace stands: fresh, stale or missing, and why."""
    from configs.load import load_config
    from configs.params import Config
    from hineus_cli.console import product, status_table
    from stages.engine.fingerprint import SourceDigests
    from stages.engine.status import pipeline_status
    from stages.engine.workspace import Workspace

    session: Session = context.obj
    session.json = as_json
    opened = Workspace.open(workspace)
    config = load_config(file=opened.config_path) if opened.config_path.exists() else Config()
    sources = {name: None if path is None else Path(path) for name, path in opened.record.sources.items()}
    digests = SourceDigests(sources, opened.digest_cache)
    statuses = pipeline_status(session.pipeline, opened, config, digests, verify)
    if not as_json:
        console = product()
        console.print(status_table(statuses, console.width))
        return
    stages = [
        {
            "name": each.name,
            "state": each.state,
            "reason": each.reason,
            "size": each.manifest.size if each.manifest else None,
            "wall_s": each.manifest.wall_s if each.manifest else None,
            "cpu_s": each.manifest.cpu_s if each.manifest else None,
            "peak_rss": each.manifest.peak_rss if each.manifest else None,
            "created": each.manifest.created if each.manifest else None,
            "numbers": dict(each.manifest.numbers) if each.manifest else None,
        }
        for each in statuses
    ]
    typer.echo(json.dumps({"workspace": str(opened.root), "sources": dict(opened.record.sources), "stages": stages}))


def check(
    context: typer.Context,
    photos: Annotated[Path, typer.Argument(help="Folder of photos, or a video.", show_default=False)],
    workspace: WorkspaceOption = None,
    masks: Masks = None,
    preset: Preset = None,
    config: ConfigFile = None,
    sets: Sets = None,
    device: Device = "auto",
    workers: Workers = None,
    time: Time = None,
    as_json: Json = False,
) -> None:
    """A quick look before a run: are these photos good, and what will they take? Exits with 0 unless it is no-go."""
    from rich.table import Table
    from rich.text import Text

    from hineus_cli.console import product
    from stages.preflight import facts
    from stages.reconstruct import Request, check_photos

    session: Session = context.obj
    session.json = as_json
    request = Request(
        photos=photos,
        workspace=workspace,
        masks=masks,
        preset=preset,
        config=config,
        sets=tuple(sets or ()),
        device=device,
        workers=workers,
        time=time,
    )
    done = check_photos(request)
    exit_code = InputError.exit_code if done.refusals else SystemRequirementError.exit_code if done.shortages else 0
    if as_json:
        typer.echo(json.dumps({"ok": exit_code == 0, **done.as_dict()}))
        raise typer.Exit(exit_code)
    table = Table.grid(padding=(0, 2))
    for what, found in facts(done):
        table.add_row(Text(what, style="bold"), Text(found))
    for what, style, lines in (
        ("warning", "yellow", done.warnings),
        ("no-go", "red", (*done.refusals, *done.shortages)),
    ):
        for line in lines:
            table.add_row(Text(what, style=style), Text(line))
    table.add_row(Text("verdict", style="bold"), Text(done.verdict))
    product().print(table)
    raise typer.Exit(exit_code)


def doctor(
    context: typer.Context,
    folder: Annotated[Path, typer.Option(help="Where workspaces would lie; its free disk is shown.")] = Path("."),
    as_json: Json = False,
) -> None:
    """Is this machine fit? Versions, missing libraries, GPU, memory, disk, and what to install."""
    from rich.table import Table
    from rich.text import Text

    from hineus_cli.console import product
    from hineus_cli.doctor import examine

    session: Session = context.obj
    session.json = as_json
    findings = examine(folder.absolute())
    lacking = [finding for finding in findings if finding.state == "missing"]
    if as_json:
        typer.echo(json.dumps({"ok": not lacking, "findings": [asdict(finding) for finding in findings]}))
        if lacking:
            raise typer.Exit(SystemRequirementError.exit_code)
        return
    table = Table(header_style="bold")
    for heading in ("what", "", "found", "advice"):
        table.add_column(heading, overflow="fold")
    colours = {"ok": "green", "note": "yellow", "missing": "red"}
    for finding in findings:
        state = Text(finding.state, style=colours[finding.state])
        table.add_row(finding.what, state, Text(finding.found), Text(finding.advice))
    product().print(table)
    if lacking:
        names = ", ".join(finding.what for finding in lacking)
        advice = dict.fromkeys(finding.advice for finding in lacking if finding.advice)
        raise SystemRequirementError(f"This machine lacks {names}.", "Try: " + "; ".join(advice))


def show_config(
    preset: Preset = None,
    config: ConfigFile = None,
    sets: Sets = None,
    describe: Annotated[bool, typer.Option("--describe", help="Describe every setting instead.")] = False,
) -> None:
    """Print the settings as they would be used, as YAML that `--config` takes; or describe them all."""
    from rich.table import Table
    from rich.text import Text

    from configs.load import config_yaml, describe_settings, load_config, show_value
    from hineus_cli.console import product

    if not describe:
        typer.echo(config_yaml(load_config(preset, config, sets or ())), nl=False)
        return
    table = Table(header_style="bold")
    table.add_column("setting", no_wrap=True)
    table.add_column("default", overflow="fold", max_width=13)
    table.add_column("meaning", overflow="fold")
    for setting in describe_settings():
        values = f"{setting.type}, {setting.bounds}" if setting.bounds else setting.type
        table.add_row(setting.key, show_value(setting.default), Text(f"{setting.description} ({values})"))
    product().print(table)


def presets() -> None:
    """List the presets."""
    from configs.load import preset_names, preset_summary

    for name in preset_names():
        typer.echo(f"{name:<8}{preset_summary(name)}")


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
    from hineus_cli.console import set_up_logging, stdout_kept_clean
    from hineus_cli.demo import WORKSPACE, run_demo

    session: Session = context.obj
    session.json = as_json
    session.log_path = folder.absolute() / WORKSPACE / "hineus.log"
    set_up_logging(verbose)
    with stdout_kept_clean() if as_json else nullcontext():
        result = run_demo(folder=folder, preset=preset, device=device, workers=workers)
    if as_json:
        typer.echo(json.dumps({"ok": True, **result}, default=str))


def compare(
    context: typer.Context,
    first: Annotated[Path, typer.Argument(help="Mesh file or workspace A.", show_default=False)],
    second: Annotated[Path, typer.Argument(help="Mesh file or workspace B.", show_default=False)],
    icp: Annotated[bool, typer.Option("--icp", help="Move A onto B first (rigid); else they share a frame.")] = False,
    distance_map: Annotated[
        Path | None, typer.Option("--map", help="Write A, coloured by distance to B, as PLY.", show_default=False)
    ] = None,
    as_json: Json = False,
) -> None:
    """How far two meshes, or two workspaces' results, are from each other, both ways."""
    from rich.table import Table

    from hineus_cli.console import product
    from stages.evaluation.comparison import compare as compare_meshes

    session: Session = context.obj
    session.json = as_json
    found = compare_meshes(first, second, icp, distance_map)
    if as_json:
        typer.echo(json.dumps({"ok": True, **found}))
        return
    table = Table(header_style="bold")
    table.add_column("distance")
    for heading in ("A to B", "B to A", "A to B, % of the extent", "B to A, % of the extent"):
        table.add_column(heading, justify="right")
    for key, label in (("mean", "mean"), ("median", "median"), ("p95", "95 %"), ("max", "largest")):
        ways = [found[way][key] for way in ("a_to_b", "b_to_a")]
        table.add_row(label, *(f"{d:.4g}" for d in ways), *(f"{100 * d / found['extent']:.3f}" for d in ways))
    console = product()
    console.print(table)
    scores = ", ".join(f"{100 * float(part):g} %: {score:.1f}" for part, score in found["f_scores"].items())
    lines = [f"F-score (percent) within parts of the extent, {found['extent']:.4g}: {scores}"]
    lines.append("alignment: A moved onto B by ICP" if icp else "alignment: none, taken to be in one frame")
    if distance_map is not None:
        lines.append(f"distance map: {distance_map}")
    for line in lines:
        console.print(line, markup=False, soft_wrap=True)


def view(
    context: typer.Context,
    workspace: Annotated[Path, typer.Argument(help="The workspace's folder.")] = Path("."),
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port of the local server; 0: a free one.")] = 0,
    no_browser: Annotated[bool, typer.Option("--no-browser", help="Print the address only.")] = False,
) -> None:
    """Show the report of a workspace in the browser, or a run as it goes and the report once it is there."""
    import threading
    import webbrowser

    from hineus_cli.console import people
    from hineus_cli.viewing import serving, watch

    watched = watch(workspace, context.obj.pipeline)
    with suppress(KeyboardInterrupt), serving(watched, port) as url:
        typer.echo(url)
        people().print("Ctrl-C ends it.")
        if not no_browser:
            webbrowser.open(url)
        threading.Event().wait()


# ---------------------------------------------------------------- poses for other programs
OutFolder = Annotated[Path, typer.Argument(help="New or empty folder to write.", show_default=False)]
OfWorkspace = Annotated[Path, typer.Argument(help="The workspace's folder.", show_default=False)]


def export_colmap(context: typer.Context, workspace: OfWorkspace, out: OutFolder, as_json: Json = False) -> None:
    """Write the undistorted photos with a COLMAP model of them, for COLMAP, OpenMVS and the like."""
    from stages.posing.exporting import write_colmap

    _export_poses(context.obj, workspace, out, write_colmap, as_json)


def export_transforms(context: typer.Context, workspace: OfWorkspace, out: OutFolder, as_json: Json = False) -> None:
    """Write the undistorted photos with nerfstudio's transforms.json and a PLY of the sparse points."""
    from stages.posing.exporting import write_transforms

    _export_poses(context.obj, workspace, out, write_transforms, as_json)


def _export_poses(session: Session, workspace: Path, out: Path, write: Any, as_json: bool) -> None:
    from hineus_cli.console import people
    from stages.evaluation.pose_export import export_poses

    session.json = as_json
    numbers = export_poses(workspace, out, write)
    people().print(f"{numbers['images']} images, {numbers['points']} points: {out}", markup=False, soft_wrap=True)
    if as_json:
        typer.echo(json.dumps({"ok": True, "folder": str(out.absolute()), **numbers}))


# ---------------------------------------------------------------- the table of commands
def _version(wanted: bool) -> None:
    if wanted:
        from importlib import metadata

        typer.echo(f"hineus {metadata.version('hineus')}")
        raise typer.Exit()


def build_app(pipeline: Sequence[Stage] = PIPELINE) -> typer.Typer:
    """The command line over `pipeline`: `run`, one command a stage, and the ones that look."""

    class Group(HineusGroup):
        pass

    Group.pipeline = pipeline
    app = typer.Typer(
        cls=Group,
        no_args_is_help=True,
        add_completion=False,
        pretty_exceptions_enable=False,
        rich_markup_mode="rich",
    )

    @app.callback()
    def hineus(
        version: Annotated[
            bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
        ] = False,
    ) -> None:
        """Photos in, textured 3D asset out. Start with `hineus doctor`, then `hineus run PHOTOS`."""

    for command in (run, check, status, view, compare, bench, doctor, presets, demo):
        app.command()(command)
    app.add_typer(evaluate_app, name="evaluate")
    app.command("config")(show_config)
    app.command("export-colmap")(export_colmap)
    app.command("export-transforms")(export_transforms)
    for stage in pipeline:
        app.command(stage.name, rich_help_panel="One stage (and what it needs)")(stage_command(stage))
    return app


app = build_app()


def main() -> None:
    """The `hineus` command."""
    app(prog_name="hineus")
