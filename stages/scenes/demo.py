"""The demo: photographs of a made-up object, the whole pipeline, and the distance to the known truth."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from stages import artifacts
from stages.engine.runner import Listener
from stages.engine.stage import Stage
from stages.errors import InputError
from stages.evaluation.protocols.known_object import score_mesh
from stages.reconstruct import Reconstruction, Request, reconstruct
from stages.scenes.demo_photos import PHOTOS, make_demo_photos, photos_are_complete

log = logging.getLogger(__name__)

NUM_PHOTOS = 24
PHOTO_SIZE = (640, 480)
SEED = 0
WORKSPACE = "workspace"
SCORE = "score.json"


@dataclass(frozen=True)
class Demo:
    """A finished demo.

    Attributes:
        score: of `score_mesh`, percent of the object's largest extent.
        seconds: the whole took.
    """

    result: Reconstruction
    score: dict[str, float]
    seconds: float

    def as_dict(self) -> dict[str, Any]:
        """JSON-able: the score, seconds, paths, and the stages' numbers."""
        return {
            "mean_distance_percent": self.score["mean"],
            "accuracy_percent": self.score["accuracy"],
            "completeness_percent": self.score["completeness"],
            "seconds": round(self.seconds, 1),
            "score": self.score,
            **self.result.as_dict(),
        }


def run_demo(
    folder: Path,
    preset: str,
    device: str,
    workers: int | None,
    pipeline: Sequence[Stage],
    listener: Listener | None = None,
    photo_progress: Callable[[int, int], None] | None = None,
) -> Demo:
    """Make the photos, reconstruct them as `hineus run` does, score the mesh.

    Args:
        folder: gets `photos/`, the truth (`gt_mesh.ply`, `transforms.json`), `workspace/` and `score.json`.
        preset, device, workers: see `Request`.
        photo_progress: takes how many photos are done, and how many there will be.

    Raises:
        HineusError: a child by what the user can do.
    """
    started = time.monotonic()
    make_photos(folder, photo_progress)
    request = Request(
        photos=folder / PHOTOS,
        workspace=folder / WORKSPACE,
        no_masks=True,
        preset=preset,
        device=device,
        workers=workers,
    )
    result = reconstruct(request, pipeline, listener)
    ply = artifacts.asset_path(result.workspace.stage_folder("export"), "ply")
    if not ply.exists():
        raise InputError(
            f"Preset {preset} writes no PLY file, which the score needs.",
            "Try `hineus demo --preset demo`.",
        )
    score = score_mesh(ply, artifacts.MODEL.load(result.workspace.stage_folder("sfm")), folder)
    artifacts.write_json(folder / SCORE, score)
    return Demo(result, score, time.monotonic() - started)


def make_photos(folder: Path, progress: Callable[[int, int], None] | None = None) -> None:
    """Render the photos, unless they are all there from an earlier run.

    Raises:
        InputError: the folder cannot be written.
    """
    if photos_are_complete(folder, NUM_PHOTOS, PHOTO_SIZE, SEED):
        log.info("photos: the %d in %s are complete", NUM_PHOTOS, folder / PHOTOS)
        return
    log.info("photos: rendering %d into %s", NUM_PHOTOS, folder / PHOTOS)
    try:
        make_demo_photos(folder, NUM_PHOTOS, PHOTO_SIZE, SEED, progress)
    except OSError as error:
        raise InputError(
            f"The demo's photos cannot be written to {folder}: {error.strerror}.",
            "Choose another place: `hineus demo --workspace DIR`.",
        ) from error
