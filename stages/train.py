"""train: posed images -> neural signed distance field. Resumes from its last checkpoint after a kill."""

from __future__ import annotations

import json
import logging
import os
import shutil
import time
from collections.abc import Iterator
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import numpy as np

from stages import artifacts
from stages.artifacts import FIELD, HELD_OUT, METRICS, PINHOLE_PHOTOS, PREVIEWS, SCENE, Pictures
from stages.engine.stage import Stage, StageContext
from stages.errors import ConfigError, InputError, ReconstructionError
from stages.geometry.cameras import PinholeCameras

if TYPE_CHECKING:
    from configs.training import TrainParams

log = logging.getLogger(__name__)

LOG_EVERY = 50  # steps between metric lines
CHECKPOINT_EVERY = 60.0  # seconds
MIN_TRAINING = 3  # photos
METRIC_GRADIENTS = (0.8, 1.2)  # mean lengths of grad f within which f passes for a distance
SETTLED = 500  # steps between looks at that


def run(context: StageContext[TrainParams]) -> dict[str, Any]:
    """Train until the budget of steps or minutes is spent; write field.pt, metrics.jsonl and previews."""
    import torch

    from stages.neural.held_out_psnr import held_out_psnr, left_out
    from stages.neural.sightings import Sightings
    from stages.neural.trained_field import field_state
    from stages.neural.trainer import Trainer
    from stages.neural.training_photos import Photos

    _use_threads(context)
    params, scene = context.params, context.read(SCENE)
    held_out = left_out(len(scene.cameras), params.hold_out)
    _check_hold_out(len(held_out), int(held_out.sum()), params.hold_out)
    images = _load_images(context.read(PINHOLE_PHOTOS), scene.cameras.names)
    photos = Photos(scene.cameras, *images, context.device, ~held_out)
    sightings = Sightings.from_scene(scene, context.device, (~held_out).numpy())
    trainer = Trainer(photos, sightings, params, context.device)

    checkpoint = artifacts.checkpoint_path(context.scratch)
    metrics = artifacts.METRICS.load(context.scratch)
    spent = _resume(trainer, checkpoint, metrics)
    if trainer.step_index == 0:
        _start_from_shape(trainer, scene.cameras)
    started = saved = time.monotonic()
    previewed = _progress(trainer.step_index, spent, params)
    # a line at a time, so that `hineus view` can draw them as they come
    with metrics.open("a", encoding="utf-8", buffering=1) as lines:
        while (progress := _progress(trainer.step_index, spent + time.monotonic() - started, params)) < 1:
            numbers = trainer.step(progress)
            if trainer.step_index % LOG_EVERY == 0:
                numbers_out = {key: float(value) for key, value in numbers.items()}
                _write_metrics(lines, trainer, progress, numbers_out)
                context.progress(progress, 1.0, f"PSNR {numbers_out['psnr']:.1f} dB")
                _check(numbers_out, trainer.step_index)
            now = time.monotonic()
            if now - saved > CHECKPOINT_EVERY:
                _save(trainer, checkpoint, spent + now - started)
                saved = now
            if progress - previewed >= params.preview_every:
                _preview(trainer, context.scratch, progress)
                previewed = progress
    _preview(trainer, context.scratch, 1.0)
    shutil.copytree(artifacts.PREVIEWS.load(context.scratch), context.to_write(PREVIEWS))
    torch.save(field_state(trainer.fields), context.to_write(FIELD))
    context.to_write(METRICS).write_bytes(metrics.read_bytes())
    seconds = spent + time.monotonic() - started
    summary: dict[str, Any] = _last_numbers(context.to_write(METRICS))
    if params.hold_out:
        context.write(HELD_OUT, tuple(scene.cameras.names[i] for i in held_out.nonzero().flatten().tolist()))
        nothing = torch.zeros(0, 3, device=trainer.device)
        psnr = held_out_psnr(photos, lambda batch: trainer.render(batch, 1.0, nothing, None).colors)
        summary |= {"held_out": int(held_out.sum()), "held_out_psnr": psnr and round(psnr, 4)}
    return {
        "steps": trainer.step_index,
        "train_seconds": round(seconds, 1),
        "rays_per_second": round(trainer.step_index * params.sampling.rays / max(seconds, 1e-9)),
        "photos": len(photos),
        "sightings": len(sightings.weights),
        **summary,
    }


def _use_threads(context: StageContext[TrainParams]) -> None:
    """Torch and numba take as many threads as the run was given."""
    import torch

    torch.set_num_threads(context.workers)
    try:
        import numba
    except ImportError:  # training goes without its kernels
        return
    numba.set_num_threads(min(context.workers, numba.config.NUMBA_NUM_THREADS))


def _load_images(
    pictures: Pictures, names: tuple[str, ...]
) -> tuple[Iterator[np.ndarray], Iterator[np.ndarray] | None]:
    """RGB images [H, W, 3] uint8 and masks [H, W] uint8, each read when taken; no masks unless every photo has one."""
    masked = sum(pictures.mask_path(name).exists() for name in names)
    if 0 < masked < len(names):
        log.warning("only %d of %d photos have a mask: training goes without masks", masked, len(names))
    images = (pictures.image(name) for name in names)
    masks = (mask for name in names if (mask := pictures.mask(name)) is not None)
    return images, masks if masked == len(names) else None


def _start_from_shape(trainer: Any, cameras: PinholeCameras) -> None:
    """Where training is not to start from a sphere: bring the SDF to a room, or to the visual hull of the masks."""
    from stages.geometry.hull import room_distances

    params = trainer.params.field
    inside = np.linalg.norm(cameras.centers, axis=1) < params.sphere_radius
    if params.init == "hull":
        error = trainer.start_from(_hull(cameras, trainer.photos))
        log.info("the SDF starts from the masks' visual hull, met to %.4f on average", error)
    elif params.init == "room" or (params.init == "auto" and inside.mean() > 0.5):
        error = trainer.start_from(room_distances())
        log.info("the SDF starts from a room around the cameras, met to %.4f on average", error)


def _hull(cameras: PinholeCameras, photos: Any) -> np.ndarray:
    """Signed distances to the visual hull of the masks of the photos that are trained on.

    Raises:
        InputError: a photo has no mask, or the masks leave nothing.
    """
    from stages.geometry.hull import hull_distances

    advice = "Give a mask for each photo (`--masks FOLDER`), or start from a sphere: `--set train.field.init=sphere`."
    if photos.masks is None:
        raise InputError(
            f"`train.field.init` = hull needs masks for all {len(cameras)} photos, and some have none.", advice
        )
    masks = [photos.mask(i) if training else None for i, training in enumerate(photos.training.tolist())]
    distances = hull_distances(cameras, masks)
    if distances is None:
        raise InputError(f"The {len(cameras)} masks have no visual hull within the region of interest.", advice)
    return distances


def _check_hold_out(num_photos: int, num_held_out: int, every: int) -> None:
    """Raises ConfigError where too few photos are left to train on, or none is left out though some should be."""
    left = num_photos - num_held_out
    if every and (left < MIN_TRAINING or num_held_out == 0):
        found = f"leaves {left} of {num_photos} photos to train on (needed: {MIN_TRAINING} to {num_photos - 1})"
        raise ConfigError(f"`train.hold_out` = {every} {found}.", "Try `--hold-out 8`, or 0 for none.")


def _progress(step: int, seconds: float, params: TrainParams) -> float:
    """Part of the budget that is spent, from 0 to 1: of the minutes where they are set, else of the steps."""
    return seconds / (60 * params.minutes) if params.minutes else step / params.steps


def _write_metrics(lines: IO[str], trainer: Any, progress: float, numbers: dict[str, float]) -> None:
    moment = trainer.moment(progress)
    record = {
        "step": trainer.step_index,
        "progress": round(progress, 5),
        **{key: float(f"{value:.6g}") for key, value in numbers.items()},
        "scale": round(moment.width, 6),
        "levels": moment.levels,
    }
    lines.write(json.dumps(record) + "\n")


def _check(numbers: dict[str, float], step: int) -> None:
    """Raise where the loss is no number; warn where the SDF is no distance, on which every term counts."""
    if not np.isfinite(numbers["loss"]):
        raise ReconstructionError(
            f"Training diverged at step {step}: the loss is {numbers['loss']}.",
            "Lower the learning rates: `--set train.schedule.lr_table=0.005 --set train.schedule.lr_network=0.001`",
        )
    low, high = METRIC_GRADIENTS
    if step % SETTLED == 0 and not low <= numbers["gradient_norm"] <= high:
        log.warning(
            "step %d: the SDF's gradients have a mean length of %.2f, not about 1 (%.1f to %.1f); "
            "`--set train.losses.eikonal=1` holds them, `train.terms.eikonal` relaxes them",
            step, numbers["gradient_norm"], low, high,
        )  # fmt: skip


def _save(trainer: Any, path: Path, seconds: float) -> None:
    """Write the checkpoint beside the old one, then take its place: a kill leaves one of the two whole."""
    import torch

    partial = path.with_suffix(".partial")
    torch.save({"trainer": trainer.state(), "seconds": seconds}, partial)
    os.replace(partial, path)


def _resume(trainer: Any, checkpoint: Path, metrics: Path) -> float:
    """Go on from a checkpoint if there is one; returns the seconds already spent. Later metric lines are cut."""
    import torch

    if not checkpoint.exists():
        metrics.unlink(missing_ok=True)
        return 0.0
    state = torch.load(checkpoint, map_location=trainer.device, weights_only=True)
    trainer.load_state(state["trainer"])
    lines = metrics.read_text(encoding="utf-8").splitlines() if metrics.exists() else []
    # The lines up to the checkpoint were flushed before it was written; a kill may have cut a later one in half.
    kept = lines[: trainer.step_index // LOG_EVERY]
    metrics.write_text("".join(f"{line}\n" for line in kept), encoding="utf-8")
    log.info("training goes on from step %d", trainer.step_index)
    return float(state["seconds"])


def _preview(trainer: Any, folder: Path, progress: float) -> None:
    """Photo, render and normals of one photo, another one each time."""
    from PIL import Image

    path = artifacts.preview_path(folder, trainer.step_index)
    path.parent.mkdir(exist_ok=True)
    image = int(progress * 0.999 * len(trainer.photos))
    Image.fromarray(trainer.preview(image, progress)).save(path)


def _last_numbers(metrics: Path) -> dict[str, float]:
    """Mean of the last few metric lines, for the summary."""
    lines = metrics.read_text(encoding="utf-8").splitlines()[-10:]
    records = [json.loads(line) for line in lines]
    keys = ("psnr", "rgb", "eikonal", "gradient_norm")
    return {key: round(float(np.mean([r[key] for r in records])), 4) for key in keys} if records else {}


TRAIN: Stage[TrainParams] = Stage(
    name="train",
    version=3,
    settings=lambda config: config.train,
    run=run,
    reads=(SCENE, PINHOLE_PHOTOS),
    writes=(FIELD, METRICS, PREVIEWS, HELD_OUT),
    summary="learn a signed distance field and its colours from the posed images",
)
