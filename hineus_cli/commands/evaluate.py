"""`hineus evaluate`: results against truths, by distance or by a benchmark's own protocol, and against photos.

`hineus compare` is `evaluate mesh` of two files as they are.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer

from hineus_cli.options import Device, Json
from hineus_cli.session import print_json
from stages.errors import ConfigError

evaluate_app = typer.Typer(
    no_args_is_help=True,
    help="How good a result is: against a true surface, by a benchmark's protocol, or against held-out photos.",
)

Predicted = Annotated[
    Path, typer.Argument(help="What is judged: mesh file, cloud of points, or workspace.", show_default=False)
]
Data = Annotated[Path, typer.Option(help="Folder of the truth in its published layout.", show_default=False)]
CamerasOption = Annotated[
    Path | None,
    typer.Option(
        help="Poses of what is judged, in any format of `hineus run --poses`; a workspace knows its own.",
        show_default=False,
    ),
]
Matrix = Annotated[
    Path | None,
    typer.Option(help="Text file of 4 x 4 numbers that takes what is judged to the truth's frame.", show_default=False),
]
Seed = Annotated[int, typer.Option(min=0, max=2**31 - 1, help="Of the random numbers that choose points.")]
DistanceMap = Annotated[
    Path | None,
    typer.Option("--map", help="Write what is judged, coloured by its distance to the truth, as PLY.",
                 show_default=False),
]  # fmt: skip


@evaluate_app.command("mesh")
def evaluate_mesh(
    context: typer.Context,
    predicted: Predicted,
    truth: Annotated[Path, typer.Argument(help="True mesh file or cloud of points.", show_default=False)],
    thresholds: Annotated[
        str, typer.Option(help="Of the F-scores: numbers in the truth's unit, or with % of its largest extent.")
    ] = "0.2%,0.5%,1%,2%",
    samples: Annotated[int, typer.Option(min=1, max=20_000_000, help="Points a side, uniform by area.")] = 200_000,
    spacing: Annotated[
        float | None,
        typer.Option(help="Instead: one point a square of this side, in the truth's unit.", show_default=False),
    ] = None,
    seed: Seed = 0,
    true_cameras: Annotated[
        Path | None,
        typer.Option(
            help="Poses in the truth's frame. Aligns by camera centres; `--visible`, `--masks` need them.",
            show_default=False,
        ),
    ] = None,
    cameras: CamerasOption = None,
    matrix: Matrix = None,
    icp: Annotated[
        str | None, typer.Option(help="Then move it onto the truth: rigid or similarity.", show_default=False)
    ] = None,
    visible: Annotated[bool, typer.Option("--visible", help="Only what a camera sees counts.")] = False,
    masks: Annotated[
        Path | None,
        typer.Option(help="Folder of masks: what a photo shows beside its mask does not count.", show_default=False),
    ] = None,
    grow: Annotated[int, typer.Option(min=0, max=1000, help="Pixels by which masks are widened first.")] = 0,
    box: Annotated[
        str | None,
        typer.Option(
            help="Only what lies in it counts: x0,y0,z0,x1,y1,z1, or the truth's own box grown by a part: 4%.",
            show_default=False,
        ),
    ] = None,
    distance_map: DistanceMap = None,
    as_json: Json = False,
) -> None:
    """A surface against a true one: accuracy, completeness, Chamfer, F-scores and normals, both ways."""
    from stages.evaluation.protocols.plain import MOTIONS, MeshOptions, evaluate_mesh

    _check_length("spacing", spacing)
    if icp is not None and icp not in MOTIONS:
        raise ConfigError(f"There is no ICP '{icp}'.", f"Choose {' or '.join(MOTIONS)}.")
    numbers, parts = _thresholds(thresholds)
    corners, margin = _box(box)
    options = MeshOptions(
        thresholds=numbers,
        threshold_parts=parts,
        samples=samples,
        spacing=spacing,
        seed=seed,
        matrix=matrix,
        cameras=cameras,
        true_cameras=true_cameras,
        icp=icp,
        visible=visible,
        masks=masks,
        grow=grow,
        box=corners,
        box_margin=margin,
        distance_map=distance_map,
    )
    _run(context, lambda: evaluate_mesh(predicted, truth, options), _show_surfaces)


def compare(
    context: typer.Context,
    first: Annotated[Path, typer.Argument(help="Mesh file, or workspace: its exported PLY.", show_default=False)],
    second: Annotated[Path, typer.Argument(help="As the first; it is taken for the truth.", show_default=False)],
    icp: Annotated[bool, typer.Option("--icp", help="Move the first onto the second before (rigid).")] = False,
    distance_map: DistanceMap = None,
    as_json: Json = False,
) -> None:
    """How far two meshes, or two workspaces' results, are from each other, both ways: `evaluate mesh` of the files."""
    from stages.evaluation.protocols.plain import MeshOptions, evaluate_mesh
    from stages.evaluation.reading import mesh_path

    options = MeshOptions(icp="rigid" if icp else None, distance_map=distance_map)
    _run(context, lambda: evaluate_mesh(mesh_path(first), mesh_path(second), options), _show_surfaces)


@evaluate_app.command("dtu")
def evaluate_dtu(
    context: typer.Context,
    predicted: Predicted,
    data: Data,
    scan: Annotated[int, typer.Option(help="Number of the scan, e.g. 24.", show_default=False)],
    seed: Seed = 0,
    as_json: Json = False,
) -> None:
    """DTU's protocol: observed cells, plane cut, distances below 20 mm. DATA has ObsMask/ and Points/stl/."""
    from stages.evaluation.protocols.dtu import evaluate_dtu as score

    _run(context, lambda: score(predicted, data, scan, seed), _show_numbers)


@evaluate_app.command("glossy")
def evaluate_glossy(
    context: typer.Context,
    predicted: Predicted,
    data: Data,
    split: Annotated[
        Path | None,
        typer.Option(help="NeRO's synthetic_split_128.pkl, which names the test views; default: all views.",
                     show_default=False),
    ] = None,
    as_json: Json = False,
) -> None:  # fmt: skip
    """GlossySynthetic's protocol: points of what the test views see. DATA is an object's folder, e.g. bell."""
    from stages.evaluation.protocols.glossy import evaluate_glossy as score

    _run(context, lambda: score(predicted, data, split), _show_numbers)


@evaluate_app.command("tanks")
def evaluate_tanks(
    context: typer.Context,
    predicted: Predicted,
    data: Data,
    tau: Annotated[
        float | None, typer.Option(help="Threshold in metres; default: the toolbox's.", show_default=False)
    ] = None,
    cameras: CamerasOption = None,
    matrix: Matrix = None,
    refine: Annotated[bool, typer.Option("--refine/--no-refine", help="The toolbox's rounds of ICP.")] = True,
    seed: Seed = 0,
    as_json: Json = False,
) -> None:
    """Tanks and Temples' protocol: F-score at tau in the crop volume. DATA is a scene's folder, e.g. Ignatius."""
    from stages.evaluation.protocols.tanks import evaluate_tanks as score

    _check_length("tau", tau)
    _run(context, lambda: score(predicted, data, cameras, tau, refine, matrix, seed), _show_numbers)


@evaluate_app.command("views")
def evaluate_views(
    context: typer.Context,
    workspace: Annotated[Path, typer.Argument(help="Workspace made with `--hold-out`.", show_default=False)],
    renders: Annotated[
        Path | None, typer.Option(help="Folder for the photos and their drawings.", show_default=False)
    ] = None,
    device: Device = "auto",
    as_json: Json = False,
) -> None:
    """Held-out photos against drawings of the field, of the textured mesh and of splats."""
    from stages.evaluation.photos.held_out import evaluate_views as score

    _run(context, lambda: score(workspace, renders, device), _show_views)


# ---------------------------------------------------------------- running, showing
def _run(
    context: typer.Context,
    evaluate: Callable[[], dict[str, Any]],
    show: Callable[[dict[str, Any]], None],
) -> None:
    from hineus_cli.console import product, say

    with context.obj.working():
        found = evaluate()
    if context.obj.json:
        print_json(found)
        return
    show(found)
    console = product()
    for line in found["done"]:
        say(line, console=console)


def _show_surfaces(found: dict[str, Any]) -> None:
    from hineus_cli.console import product, table_of

    console = product()
    ways = ("accuracy", "completeness")
    table = table_of("distance", *ways, *(f"{way}, % of the extent" for way in ways))
    for key in ("mean", "rms", "median", "p90", "p95", "p99", "max"):
        values = [found[way][key] for way in ways]
        parts = [f"{100 * value / found['extent']:.3f}" for value in values]
        table.add_row(key, *(f"{value:.5g}" for value in values), *parts)
    console.print(table)
    console.print(
        f"chamfer {found['chamfer']:.5g} ({100 * found['chamfer'] / found['extent']:.3f} % of the extent, "
        f"{found['extent']:.5g}), sum {found['chamfer_sum']:.5g}"
    )
    table = table_of("threshold", "precision %", "recall %", "F-score %")
    for score in found["f_scores"]:
        shares = [f"{score[key]:.2f}" for key in ("precision", "recall", "f_score")]
        table.add_row(f"{score['threshold']:.5g}", *shares)
    console.print(table)
    for way in ways:
        turned = found[f"{way}_normals"]
        if turned is not None:
            console.print(
                f"normals, {way}: mean {turned['mean_deg']:.2f}, median {turned['median_deg']:.2f} degrees, "
                f"consistency {turned['consistency']:.4f}"
            )


def _show_numbers(found: dict[str, Any]) -> None:
    """The plain numbers of a protocol."""
    from hineus_cli.console import product, table_of

    table = table_of("number", f"unit: {found['unit']}, shares in %")
    for key, value in found.items():
        if isinstance(value, int | float):
            table.add_row(key.replace("_", " "), f"{value:.5g}" if isinstance(value, float) else str(value))
    product().print(table)


def _show_views(found: dict[str, Any]) -> None:
    from hineus_cli.console import product, table_of

    rows = [*found["photos"], {"name": "mean", **found["mean"]}]
    columns = [
        (what, region, key)
        for what in ("field", "mesh", "splats")
        if what in found["mean"]
        for region in ("object", "whole")
        for key in ("psnr", "ssim", "lpips")
        if any(row[what][region] is not None and row[what][region][key] is not None for row in rows)
    ]
    table = table_of("photo", *(" ".join(column) for column in columns))
    for row in rows:
        table.add_row(row["name"], *(_cell(row[what][region], key) for what, region, key in columns))
    product().print(table)


def _cell(scores: dict[str, Any] | None, key: str) -> str:
    value = None if scores is None else scores[key]
    return "-" if value is None else f"{value:.2f}" if key == "psnr" else f"{value:.3f}"


# ---------------------------------------------------------------- options
def _thresholds(text: str) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Numbers in the truth's unit, and parts of its extent, of "0.01,2%"."""
    numbers, parts = [], []
    for word in text.split(","):
        try:
            value = float(word.strip().removesuffix("%"))
        except ValueError:
            value = 0.0
        if not 0 < value < math.inf:
            raise ConfigError(
                f"`--thresholds {text}`: '{word}' is no length.", "Try `--thresholds 0.5%,1%`, or `0.01,0.02`."
            )
        if word.strip().endswith("%"):
            parts.append(value / 100)
        else:
            numbers.append(value)
    return tuple(numbers), tuple(parts)


def _check_length(option: str, value: float | None) -> None:
    """
    Raises:
        ConfigError: the value of an option is no length.
    """
    if value is not None and not 0 < value < math.inf:
        raise ConfigError(f"`--{option} {value:g}` is no length.", "Give a number above 0, in the truth's unit.")


def _box(text: str | None) -> tuple[tuple[float, ...] | None, float | None]:
    """Six numbers, or a part of the extent, of "0,0,0,1,1,1" or "4%"."""
    if text is None:
        return None, None
    part = text.strip().endswith("%")
    try:
        numbers = tuple(float(word) for word in text.strip().removesuffix("%").split(","))
    except ValueError:
        numbers = ()
    if part and len(numbers) == 1 and math.isfinite(numbers[0]):
        return None, numbers[0] / 100
    if part or len(numbers) != 6 or not all(low < high for low, high in zip(numbers[:3], numbers[3:], strict=True)):
        raise ConfigError(
            f"`--box {text}` is no box: six numbers are needed, the lowest corner first.",
            "Try `--box 0,0,0,1,1,1`, or `--box 4%` for the truth's own box and a margin.",
        )
    return numbers, None
