"""Options that several commands have, and the one way from those of a run to its request."""

from __future__ import annotations

import inspect
import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer

from hineus_cli.completing import devices, preset_names, setting_keys, stage_names
from stages.errors import ConfigError
from stages.request import HOLD_OUT, Request

_TIME = re.compile(r"^(?:(?P<h>[\d.]+)h)?(?:(?P<m>[\d.]+)m(?:in)?)?(?:(?P<s>[\d.]+)s)?$")


def minutes(text: str) -> float:
    """ "90s", "5m", "1h30m" or "5" (minutes) as minutes.

    Raises:
        ConfigError: it is none of these, or not positive.
    """
    refusal = ConfigError(f"--time {text} is no length of time.", "Try `--time 5m`, `--time 90s` or `--time 1h30m`.")
    found = _TIME.match(text.strip())
    try:
        if found and any(found.groups()):
            hours, mins, seconds = (float(found[unit] or 0) for unit in "hms")
            total = 60 * hours + mins + seconds / 60
        else:
            total = float(text)
    except ValueError:
        raise refusal from None
    if not 0 < total < float("inf"):
        raise refusal
    return total


def every_nth(text: str) -> int:
    """ "8", for every 8th photo, or "0" for none.

    Raises:
        ConfigError: it is neither 0 nor a whole number from 2 on.
    """
    if not re.fullmatch(r"0|[1-9]\d{0,8}", text.strip()) or int(text) == 1:
        raise ConfigError(
            f"--hold-out {text[:40]}: N must be a whole number from 2 on, for every N-th photo, or 0 for none; "
            "it is not a percentage.",
            "Try `--hold-out 8`: every 8th photo, 12 % of them.",
        )
    return int(text)


Photos = Annotated[
    Path | None,
    typer.Argument(
        help="Folder of photos, or a video; may be left out for a workspace that knows its own.", show_default=False
    ),
]
OfWorkspace = Annotated[Path, typer.Argument(help="The workspace's folder.")]
WorkspaceOption = Annotated[
    Path | None,
    typer.Option(
        "--workspace",
        "-w",
        help="Folder for all results; default: PHOTOS_hineus beside the photos.",
        show_default=False,
    ),
]
OtherPhotos = Annotated[
    bool,
    typer.Option(
        "--other-photos", help="Use a workspace that was made of other photos, too: its results are replaced."
    ),
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
NoMasks = Annotated[
    bool,
    typer.Option(
        "--no-masks", help="Use no masks: forget those of the last run, and leave out those among the photos."
    ),
]
BlackKeeps = Annotated[
    bool | None,
    typer.Option(
        "--masks-black-keeps/--masks-white-keeps",
        help="Whether black or white is the object in masks: sets ingest.masks_keep.",
        show_default=False,
    ),
]
Control = Annotated[
    Path | None,
    typer.Option(
        help="Ground control: a CSV of name, x, y, z, photo, px, py, OpenDroneMap's gcp_list.txt, or a folder "
        "of two tables, of points and of marks.",
        show_default=False,
    ),
]
NoControl = Annotated[bool, typer.Option("--no-control", help="Forget the ground control points of the last run.")]
Light = Annotated[
    Path | None,
    typer.Option(
        help="The light that the photos were taken in, where it was captured: an equirectangular .hdr or .exr. "
        "Materials are learned with it: sets materials.enabled.",
        show_default=False,
    ),
]
Balls = Annotated[
    list[str] | None,
    typer.Option(
        "--ball",
        metavar="KIND:PHOTO:X,Y,RADIUS",
        help="A ball in a photo that tells the light, chrome or grey, and the circle around it in pixels, like "
        "chrome:IMG_0012.jpg:1520,840,120. Repeatable. Sets materials.balls and materials.enabled.",
        show_default=False,
    ),
]
NoLight = Annotated[
    bool, typer.Option("--no-light", help="Forget the light, or the balls, of the last run and learn it.")
]
Preset = Annotated[
    str | None,
    typer.Option(
        help="See `hineus presets`; default: gpu with a CUDA device, else cpu.",
        show_default=False,
        autocompletion=preset_names,
    ),
]
ConfigFile = Annotated[
    Path | None, typer.Option("--config", help="YAML file of settings, over the preset.", show_default=False)
]
Sets = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        help="One setting, over all else: section.key=value. Repeatable.",
        show_default=False,
        autocompletion=setting_keys,
    ),
]
Until = Annotated[
    str | None, typer.Option(help="Stop after this stage.", show_default=False, autocompletion=stage_names)
]
Device = Annotated[str, typer.Option(help="auto, cpu or cuda.", autocompletion=devices)]
Workers = Annotated[int | None, typer.Option(min=1, max=1024, help="CPU threads; default: all.", show_default=False)]
Time = Annotated[
    float | None,
    typer.Option(
        parser=minutes,
        metavar="TIME",
        help="Training budget, like 5m or 90s: sets train.minutes.",
        show_default=False,
    ),
]


BLOCKS_HELP = (
    "Blocks that the scene is cut into, each for one process: a number, or auto, as this machine's memory asks for."
)
Blocks = Annotated[
    str | None,
    typer.Option(
        "--blocks", metavar="N|auto", help=f"A large scene, block by block. {BLOCKS_HELP}", show_default=False
    ),
]


Jobs = Annotated[
    int | None,
    typer.Option(
        min=1,
        max=100_000,
        help="With --blocks: how many blocks are worked on at once; default: 1. More need hineus[cluster].",
        show_default=False,
    ),
]
Executor = Annotated[
    str | None,
    typer.Option(
        metavar="local|slurm",
        help="With --blocks: where Snakemake runs them. Its other executors go by the names of their plugins. "
        "All machines must see the workspace, the photos and this environment.",
        show_default=False,
    ),
]


def refuse_without_blocks(jobs: int | None, executor: str | None) -> None:
    """
    Raises:
        ConfigError: one of these is given.
    """
    for option, value in (("--jobs", jobs), ("--executor", executor)):
        if value is not None:
            raise ConfigError(
                f"`{option}` says how blocks are run, and there are none.",
                f"Add `--blocks auto`, or leave out `{option}`.",
            )


def block_count(text: str) -> int | None:
    """ "auto", which is None, or a number of blocks.

    Raises:
        ConfigError: it is neither.
    """
    if text.strip() == "auto":
        return None
    if not re.fullmatch(r"[1-9]\d{0,4}", text.strip()):
        raise ConfigError(f"{text[:40]} is no number of blocks.", "Try `--blocks auto`, or `--blocks 4`.")
    return int(text)


def hold_out_option(what_for: str) -> Any:
    """`--hold-out N`, which means the same in every command."""
    text = f"Hold every N-th photo out {what_for}. 8: every 8th, 12 %; 0: none."
    return typer.Option("--hold-out", parser=every_nth, metavar="N", help=text, show_default=False)


HoldOut = Annotated[
    int | None, hold_out_option(f"from training and texture, and compare the result with it: sets {HOLD_OUT}")
]
NoGround = Annotated[bool, typer.Option("--no-ground", help="Cut off the ground or table: sets cleanup.remove_ground.")]
Watertight = Annotated[
    bool, typer.Option("--watertight", help="A closed mesh, as for printing: sets cleanup.keep_closed.")
]
Relightable = Annotated[
    bool,
    typer.Option(
        "--relightable",
        help="Base colour without light in it, roughness, metalness, and the light of the photos: sets "
        "materials.enabled.",
    ),
]
Splats = Annotated[
    bool,
    typer.Option(
        "--splats",
        help="Gaussian splats on the surface, whose colours change with the direction: sets splats.enabled.",
    ),
]
Deterministic = Annotated[
    bool,
    typer.Option(
        "--deterministic",
        help="From scratch, the same poses every time, bit for bit, but slower: sfm.deterministic=true.",
    ),
]
MovingObject = Annotated[
    bool,
    typer.Option(
        "--moving-object",
        help="The object was moved between photos, as turned over for a second pass: only what its masks show counts; "
        "without --masks, a network makes them. Sets sfm.masks, undistort.masks, place.gps and ingest.auto_mask.",
    ),
]
Json = Annotated[bool, typer.Option("--json", help="Print one JSON object on stdout.")]
Verbose = Annotated[bool, typer.Option("--verbose", "-v", help="Say more.")]


def settings(
    sets: list[str] | None,
    time: float | None = None,
    hold_out: int | None = None,
    no_ground: bool = False,
    watertight: bool = False,
    deterministic: bool = False,
    no_masks: bool = False,
    black_keeps: bool | None = None,
    moving_object: bool = False,
    masks: Path | None = None,
    relightable: bool = False,
    light: Path | None = None,
    balls: list[str] | None = None,
    no_light: bool = False,
    splats: bool = False,
) -> tuple[str, ...]:
    """Those of --set, then what other options stand for; an option that was not given says nothing.

    Raises:
        ConfigError: the light is given as a file and by balls.
    """
    if light is not None and balls:
        raise ConfigError("Both `--light` and `--ball` are given.", "Leave one of them away.")
    chosen = masks is not None or any(text.startswith("ingest.auto_mask=") for text in sets or ())
    stood_for = {
        "train.minutes": time,
        HOLD_OUT: hold_out,
        "cleanup.remove_ground": no_ground or None,
        "cleanup.keep_closed": watertight or None,
        "materials.enabled": relightable or light is not None or bool(balls) or None,
        # what is given last counts, be it balls or a file
        "materials.balls": balls or ([] if light is not None or no_light else None),
        "splats.enabled": splats or None,
        "sfm.deterministic": deterministic or None,
        "sfm.masks": "always" if moving_object else None,
        "undistort.masks": "alone" if moving_object else None,
        "place.gps": False if moving_object else None,  # the cameras' places against the object are others
        "ingest.auto_mask": "object" if moving_object and not chosen else None,
        "ingest.own_masks": False if no_masks else None,
        "ingest.masks_keep": None if black_keeps is None else "black" if black_keeps else "white",
    }
    given = (f"{key}={json.dumps(value)}" for key, value in stood_for.items() if value is not None)
    return (*(sets or ()), *given)


def of_a_run(
    photos: Photos = None,
    workspace: WorkspaceOption = None,
    other_photos: OtherPhotos = False,
    masks: Masks = None,
    no_masks: NoMasks = False,
    black_keeps: BlackKeeps = None,
    poses: Poses = None,
    no_poses: NoPoses = False,
    control: Control = None,
    no_control: NoControl = False,
    light: Light = None,
    ball: Balls = None,
    no_light: NoLight = False,
    preset: Preset = None,
    config: ConfigFile = None,
    sets: Sets = None,
    device: Device = "auto",
    workers: Workers = None,
    time: Time = None,
    hold_out: HoldOut = None,
    no_ground: NoGround = False,
    watertight: Watertight = False,
    relightable: Relightable = False,
    splats: Splats = False,
    deterministic: Deterministic = False,
    moving_object: MovingObject = False,
) -> Request:
    """What `hineus run` and every stage's command ask for; which stages they run is their own."""
    return Request(
        photos=photos,
        workspace=workspace,
        other_photos=other_photos,
        masks=masks,
        no_masks=no_masks,
        poses=poses,
        no_poses=no_poses,
        control=control,
        no_control=no_control,
        light=light,
        no_light=no_light or bool(ball),
        preset=preset,
        config=config,
        sets=settings(
            sets,
            time,
            hold_out,
            no_ground,
            watertight,
            deterministic,
            no_masks,
            black_keeps,
            moving_object,
            masks,
            relightable,
            light,
            ball,
            no_light,
            splats,
        ),
        device=device,
        workers=workers,
    )


def with_options_of_a_run(command: Callable[..., None]) -> Callable[..., None]:
    """A command whose parameter `request` is, on the command line, the options of `of_a_run`."""
    shared = inspect.signature(of_a_run, eval_str=True).parameters
    own = inspect.signature(command, eval_str=True).parameters

    def asked(**given: Any) -> None:
        request = of_a_run(**{name: given.pop(name) for name in shared})
        command(request=request, **given)

    parameters = [each for name in own for each in (shared.values() if name == "request" else [own[name]])]
    asked.__name__, asked.__doc__ = command.__name__, command.__doc__
    asked.__annotations__ = {each.name: each.annotation for each in parameters}
    asked.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]  # what typer reads
    return asked


def picture_size(text: str) -> tuple[int, int]:
    """ "640x480" as width and height.

    Raises:
        ConfigError: it is no size.
    """
    found = re.fullmatch(r"(\d{1,5})x(\d{1,5})", text.strip().lower())
    if not found:
        raise ConfigError(f"--size {text[:40]} is no size.", "Try `--size 1280x720`: width and height in pixels.")
    return int(found[1]), int(found[2])
