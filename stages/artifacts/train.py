"""What train publishes: the field, its metrics, previews, and the names of the photos that were held out."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from stages.artifacts.artifact import Artifact, place_artifact
from stages.artifacts.json_files import read_json, write_json

FIELD_FILE = "field.pt"
METRICS_FILE = "metrics.jsonl"
HELD_OUT_FILE = "held_out.json"
PREVIEWS_FOLDER = "previews"
CHECKPOINT = "checkpoint.pt"  # in the stage's scratch folder


def field_path(folder: Path) -> Path:
    """The trained field, see `stages.neural.trained_field.TrainedField`."""
    return folder / FIELD_FILE


def save_held_out(folder: Path, names: Sequence[str]) -> None:
    """Names of the photos that neither training nor texture use."""
    write_json(folder / HELD_OUT_FILE, list(names))


def load_held_out(folder: Path) -> tuple[str, ...]:
    """Names of the photos that `train.hold_out` keeps back from training and texture; none where it is off."""
    path = folder / HELD_OUT_FILE
    return tuple(read_json(path)) if path.exists() else ()


def metrics_path(folder: Path) -> Path:
    """JSON lines, one object a logged step."""
    return folder / METRICS_FILE


def previews_path(folder: Path) -> Path:
    """Folder of the renders made while training."""
    return folder / PREVIEWS_FOLDER


def preview_path(folder: Path, step: int) -> Path:
    """Photo, render and normals side by side at one step."""
    return folder / PREVIEWS_FOLDER / f"{step:07d}.png"


def checkpoint_path(scratch: Path) -> Path:
    return scratch / CHECKPOINT


FIELD = place_artifact("train", FIELD_FILE)
METRICS = place_artifact("train", METRICS_FILE)
PREVIEWS = place_artifact("train", PREVIEWS_FOLDER, f"{PREVIEWS_FOLDER}/*")
HELD_OUT = Artifact("train", (HELD_OUT_FILE,), load_held_out, save_held_out, optional=True)
