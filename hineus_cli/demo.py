"""The demo: photographs of a made-up object, the whole pipeline, and the distance to the known truth."""

from __future__ import annotations

import logging
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any

from hineus_cli.console import ProgressDisplay, outcome_table, people, progress_of
from stages import artifacts
from stages.errors import InputError
from stages.evaluation.known_object import score_mesh
from stages.reconstruct import Reconstruction, Request, reconstruct
from stages.scenes.figurine import PHOTOS, make_demo_photos, photos_are_complete

log = logging.getLogger(__name__)

NUM_PHOTOS = 24
PHOTO_SIZE = (640, 480)
SEED = 0
WORKSPACE = "workspace"
SCORE = "score.json"


def run_demo(folder: Path, preset: str, device: str, workers: int | None) -> dict[str, Any]:
    """Make the photos, reconstruct them, score the mesh; say where things lie.

    Args:
        folder: gets `photos/`, the truth (`gt_mesh.ply`, `transforms.json`), `workspace/` and `score.json`.
        preset, device, workers: see `reconstruct`.

    Returns:
        JSON-able: the score (percent of the object's largest extent), seconds, paths, and the stages' numbers.

    Raises:
        HineusError: a child by what the user can do.
    """
    started = time.monotonic()
    make_photos(folder)
    request = Request(
        photos=folder / PHOTOS,
        workspace=folder / WORKSPACE,
        no_masks=True,
        preset=preset,
        device=device,
        workers=workers,
    )
    result = run_pipeline_with_progress(request)
    ply = artifacts.ply_path(result.workspace.stage_folder("export"))
    if not ply.exists():
        raise InputError(
            f"Preset {preset} writes no PLY file, which the score needs.",
            "Try `hineus demo --preset demo`.",
        )
    score = score_mesh(ply, artifacts.model_path(result.workspace.stage_folder("sfm")), folder)
    artifacts.write_json(folder / SCORE, score)
    seconds = time.monotonic() - started
    show(result, score, seconds)
    return {
        "mean_distance_percent": score["mean"],
        "accuracy_percent": score["accuracy"],
        "completeness_percent": score["completeness"],
        "seconds": round(seconds, 1),
        "score": score,
        "glb": str(result.glb) if result.glb else None,
        "report": str(result.report) if result.report else None,
        "workspace": str(result.workspace.root),
        "preset": result.preset,
        "device": result.device,
        "stages": [asdict(outcome) for outcome in result.outcomes],
    }


def make_photos(folder: Path) -> None:
    """Render the photos, unless they are all there from an earlier run.

    Raises:
        InputError: the folder cannot be written.
    """
    if photos_are_complete(folder, NUM_PHOTOS, PHOTO_SIZE, SEED):
        log.info("photos: the %d in %s are complete", NUM_PHOTOS, folder / PHOTOS)
        return
    log.info("photos: rendering %d into %s", NUM_PHOTOS, folder / PHOTOS)
    try:
        with progress_of("photos") as progress:
            make_demo_photos(folder, NUM_PHOTOS, PHOTO_SIZE, SEED, progress)
    except OSError as error:
        raise InputError(
            f"The demo's photos cannot be written to {folder}: {error.strerror}.",
            "Choose another place: `hineus demo --workspace DIR`.",
        ) from error


def run_pipeline_with_progress(request: Request) -> Reconstruction:
    """What `hineus run` does, with its progress bars."""
    from stages.pipeline import PIPELINE

    with ProgressDisplay() as progress:
        return reconstruct(request, PIPELINE, progress)


def show(result: Reconstruction, score: dict[str, float], seconds: float) -> None:
    """The summary for people."""
    console = people()
    console.print(outcome_table(result.outcomes, console.width))
    lines = [
        f"distance to the known surface: {score['mean']:.2f} % of the object's extent "
        f"(accuracy {score['accuracy']:.2f} %, completeness {score['completeness']:.2f} %; "
        f"F-score at 1 %: {score['f_one_percent']:.0f} %)",
        f"whole demo: {seconds / 60:.1f} minutes",
        f"textured model: {result.glb}",
        f"report: {result.report}",
    ]
    for line in lines:
        console.print(line, markup=False, soft_wrap=True)
