"""What train publishes: the field and the scene that it fills, metrics, previews, and which photos were held out."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from stages.artifacts.artifact import Artifact, place_artifact
from stages.artifacts.json_files import read_record, write_json
from stages.artifacts.scene import cameras_of, scene_of

_HELD_OUT = "held_out.json"


def _save_held_out(folder: Path, names: Sequence[str]) -> None:
    write_json(folder / _HELD_OUT, list(names))


def _load_held_out(folder: Path) -> tuple[str, ...]:
    path = folder / _HELD_OUT
    return read_record(path, tuple[str, ...]) if path.exists() else ()


# The scene that everything from here on is in: undistort's, or one whose region was grown.
CAMERAS = cameras_of("train")
SCENE = scene_of("train")
# The trained field, see `stages.neural.trained_field.TrainedField`.
FIELD = place_artifact("train", "field.pt")
# JSON lines, one object a logged step.
METRICS = place_artifact("train", "metrics.jsonl")
# Renders made while training.
PREVIEWS = place_artifact("train", "previews", "previews/*")
# Names of the photos that neither training nor texture use; none where `train.hold_out` is off.
HELD_OUT: Artifact[Sequence[str]] = Artifact("train", (_HELD_OUT,), _load_held_out, _save_held_out, optional=True)


def preview_path(folder: Path, step: int) -> Path:
    """Photo, render and normals side by side at one step."""
    return PREVIEWS.load(folder) / f"{step:07d}.png"


def checkpoint_path(scratch: Path) -> Path:
    return scratch / "checkpoint.pt"
