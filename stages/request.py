"""What is asked of `stages.reconstruct`: it imports nothing, so that the command line can name it and start at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

HOLD_OUT = "train.hold_out"  # the setting that holds out every n-th photo


@dataclass(frozen=True)
class Request:
    """What the user asked for; None is "not said".

    Attributes:
        photos: folder of photos, or a video; a workspace that was run before knows its own.
        workspace: folder; default `<photos' name>_hineus` beside the photos.
        other_photos: the workspace may be used although it was made of other photos; its results are replaced.
        masks: folder of masks; kept from the last run while the photos are the same, unless `no_masks`.
        poses: file or folder of known poses; kept like the masks, unless `no_poses`.
        control: file or folder of ground control points; kept like the masks, unless `no_control`.
        light: environment map of the captured light; kept like the masks, unless `no_light`.
        preset, config, sets: layers of settings. With neither preset nor config, a workspace keeps its own.
        from_stage, until, force: see `run_pipeline`.
        device: "auto", "cpu" or "cuda".
        workers: CPU threads; default all that this process may use.
        wait: until no other process works in the workspace, instead of an error.
    """

    photos: Path | None = None
    workspace: Path | None = None
    other_photos: bool = False
    masks: Path | None = None
    no_masks: bool = False
    poses: Path | None = None
    no_poses: bool = False
    control: Path | None = None
    no_control: bool = False
    light: Path | None = None
    no_light: bool = False
    preset: str | None = None
    config: Path | None = None
    sets: Sequence[str] = ()
    from_stage: str | None = None
    until: str | None = None
    force: Sequence[str] = ()
    device: str = "auto"
    workers: int | None = None
    wait: bool = False
