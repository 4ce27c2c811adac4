"""train: posed images -> neural signed distance field. Resumes from its last checkpoint after a kill.

Where few photos came or went since the last training, it goes on from what that has learned (docs/adr/0013).
"""

from __future__ import annotations

import io
import json
import logging
import os
import shutil
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, NamedTuple

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, NonNegativeFloat, PositiveFloat, PositiveInt, ValidationError

from configs.training import TrainParams
from stages import artifacts
from stages.artifacts import (
    CAMERAS,
    DEPTH_MAPS,
    FIELD,
    FIRST_SCENE,
    HELD_OUT,
    METRICS,
    OUTLINES,
    PINHOLE_PHOTOS,
    POINT_CLOUD,
    PREVIEWS,
    SCENE,
    SILHOUETTES,
    Pictures,
)
from stages.artifacts.own_files import remove
from stages.engine.checkpoint import CheckpointDamaged, read_checkpoint, set_aside, write_checkpoint
from stages.engine.manifest import load_manifest
from stages.engine.stage import Stage, StageContext
from stages.errors import InputError, ReconstructionError
from stages.geometry.cameras import PinholeCameras, PosedScene
from stages.geometry.normalisation import regrown
from stages.geometry.point_cloud import PointCloud
from stages.geometry.similarity import Similarity

if TYPE_CHECKING:
    from stages.neural.evidence import Evidence

log = logging.getLogger(__name__)

LOG_EVERY = 50  # steps between metric lines
CHECKPOINT_EVERY = 60.0  # seconds
METRIC_GRADIENTS = (0.8, 1.2)  # mean lengths of grad f within which f passes for a distance
# Part of the budget after which the region is looked at: the shape is there, and little of the time is lost.
LOOK_AT = 0.2
# And part of the steps in the settings after which is settled how many there are to be, by that shape.
SETTLED_AT = 0.05
SETTLED = 500  # steps between looks at that
# A training goes on from the last one where no more than this part of its photos came and went.
MAX_CHANGED = 0.25
# Part of the budget that counts as spent then: where the networks fit as they are, and where only the shape does, whose
# region is another one: the numbers are in docs/adr/0013.
KEPT_NETWORKS, KEPT_SHAPE = 0.7, LOOK_AT
SAME_FRAME = 1e-6  # of the region's radius


def run(context: StageContext[TrainParams]) -> dict[str, Any]:
    """Train until the budget of steps or minutes is spent; write field.pt, the scene, metrics.jsonl and previews.

    How many steps that is depends on how much of the first shape dense points cover.

    A region that was found is looked at once on the way: where its border cuts what the photos are about, it grows, and
    training goes on in the larger one from the shape that it has learned.
    """
    import torch

    from stages.neural.held_out_psnr import held_out_psnr
    from stages.neural.trained_field import field_state

    _use_machine(context)
    training = _Training.begun(context)
    if training.steps is None:
        training.advance(SETTLED_AT)
        training.settle()
    if not training.looked:
        training.advance(LOOK_AT)
        training = training.where_nothing_is_cut()
    training.advance(1.0)

    trainer, params, scene = training.trainer, context.params, training.scene
    _preview(trainer, context.scratch, 1.0)
    shutil.copytree(artifacts.PREVIEWS.load(context.scratch), context.to_write(PREVIEWS))
    torch.save(field_state(trainer.fields), context.to_write(FIELD))
    context.write(SCENE, scene)
    context.to_write(METRICS).write_bytes(training.metrics.read_bytes())
    summary: dict[str, Any] = _last_numbers(context.to_write(METRICS))
    if params.hold_out:
        names = [scene.cameras.names[i] for i in (~trainer.photos.training).nonzero().flatten().tolist()]
        context.write(HELD_OUT, tuple(names))
        psnr = held_out_psnr(trainer.photos, lambda batch: trainer.render(batch, 1.0).colors)
        summary |= {"held_out": len(names), "held_out_psnr": psnr and round(psnr, 4)}
    seconds = training.seconds
    return {
        "steps": trainer.step_index,
        **_since_before(training),
        "train_seconds": round(seconds, 1),
        "rays_per_second": round(training.steps_done * params.sampling.rays / max(seconds, 1e-9)),
        "photos": len(trainer.photos),
        "sightings": len(trainer.sightings),
        "dense_sightings": len(trainer.dense),
        "region_grown": round(training.region.radius if training.region else 1.0, 3),
        **summary,
    }


# ---------------------------------------------------------------- training in one region
class _Region(NamedTuple):
    """A region that has grown: a sphere in the frame of the first one."""

    center: tuple[float, float, float]
    radius: float

    def of(self, scene: PosedScene) -> PosedScene:
        """The first scene with this region."""
        return regrown(scene, np.array(self.center), self.radius)


class _Saved(BaseModel):
    """A checkpoint: see `_Training`. `trainer` is its `state`, `metrics` the lines so far."""

    model_config = ConfigDict(allow_inf_nan=False)

    trainer: dict[str, Any]
    region: tuple[tuple[float, float, float], PositiveFloat] | None
    looked: bool
    head_start: float = Field(ge=0, le=1)
    steps: PositiveInt | None
    seconds: NonNegativeFloat
    metrics: str


@dataclass
class _Training:
    """A trainer in a scene, and how much of the budget is spent.

    Attributes:
        region: the scene's, where it has grown. looked: no more to be asked whether it should.
        head_start: part of the budget that counts as spent, since what another training learned was there.
        steps: the budget, where it is not minutes; None: not settled yet.
        spent: seconds before this process, or this scene.
        started: clock at its start.
    """

    context: StageContext[TrainParams]
    scene: PosedScene
    trainer: Any
    region: _Region | None = None
    looked: bool = False
    head_start: float = 0.0
    steps: int | None = None
    spent: float = 0.0
    started: float = field(default_factory=time.monotonic)

    @classmethod
    def begun(cls, context: StageContext[TrainParams]) -> _Training:
        """From the checkpoint where there is one that fits, in its region; else from what was learned before."""
        scene = context.read(FIRST_SCENE)
        training = cls._resumed(context, scene)
        if training is None:
            training = cls._fresh(context, scene)
            for left in (training.metrics, artifacts.PREVIEWS.load(context.scratch)):
                remove(left)
            training.metrics.touch()
        training.started = time.monotonic()
        return training

    @classmethod
    def _resumed(cls, context: StageContext[TrainParams], scene: PosedScene) -> _Training | None:
        """Where the checkpoint ends; None where there is none, or one of no use, which is set aside."""
        path = artifacts.checkpoint_path(context.scratch)
        try:
            state = read_checkpoint(path)
            saved = None if state is None else _Saved.model_validate(state)
        except CheckpointDamaged as damage:
            set_aside(path, str(damage))
            return None
        except ValidationError:
            set_aside(path, "it is not of this version of training")
            return None
        if saved is None:
            return None
        region = _Region(*saved.region) if saved.region else None
        scene = region.of(scene) if region else scene
        kept = (saved.looked, saved.head_start, saved.steps, saved.seconds)
        training = cls(context, scene, _make_trainer(context, scene), region, *kept)
        if not training.trainer.fits(saved.trainer):
            set_aside(path, "it is of another training")
            return None
        training.trainer.load_state(saved.trainer)
        remove(training.metrics)
        training.metrics.write_text(saved.metrics, encoding="utf-8")
        log.info("training goes on from step %d", training.trainer.step_index)
        return training

    @classmethod
    def _fresh(cls, context: StageContext[TrainParams], scene: PosedScene) -> _Training:
        """At the first step: from the last training of this capture where it helps, else from the first shape."""
        from stages.neural.trained_field import load_field

        before = _last_scene(context, scene)
        if before is None:
            training = cls(context, scene, _make_trainer(context, scene), looked=not scene.growable)
            _start_from_shape(training.trainer, scene.cameras, [context.read(OUTLINES), context.read(SILHOUETTES)])
            return training
        region = _kept_region(scene, before)
        kept = region.of(scene) if region else scene
        trainer = _make_trainer(context, kept)
        if _same_frame(kept, before) and _take_over(trainer, context, kept.contents, before.contents):
            training = cls(context, kept, trainer, region, looked=True, head_start=KEPT_NETWORKS)
        else:
            trainer = _make_trainer(context, scene) if region else trainer
            earlier = load_field(_previous_field(context), context.device)
            error = trainer.start_from(_shape_within(earlier.sdf, scene.poses_from_scene, before.poses_from_scene))
            log.info("the SDF starts from the shape learned before, met to %.4f on average", error)
            training = cls(context, scene, trainer, looked=not scene.growable, head_start=KEPT_SHAPE)
        training.settle()
        trainer.step_index = training.first_step
        log.info(
            "training goes on from what was learned before: %.0f %% of the budget is kept", 100 * training.head_start
        )
        return training

    def where_nothing_is_cut(self) -> _Training:
        """This one, or one in a larger region if the surface learned so far is cut in the middle of many photos.

        It starts from that surface, with as much of the budget spent; this one is of no use any more then.
        """
        self.looked = True
        region = _grown(self)
        if region is None:
            return self
        scene = region.of(self.scene)
        shape = _shape_within(self.trainer.distances, scene.poses_from_scene, self.scene.poses_from_scene)
        progress, self.trainer = self.progress, None  # its photos would be in memory twice
        trainer = _make_trainer(self.context, scene)
        error = trainer.start_from(shape)
        log.info("the SDF starts from the shape learned so far, met to %.4f on average", error)
        training = _Training(self.context, scene, trainer, region, True, self.head_start, spent=self.seconds)
        training.settle()
        trainer.step_index = round(progress * training.budget)
        training.save()
        return training

    def settle(self) -> None:
        """Settle the steps, fewer the more of the surface learned so far dense points cover."""
        from stages.surface.covering import covered_share

        params, scene = self.context.params, self.scene
        if params.minutes:
            self.steps = params.steps
            return
        covered = 0.0
        if params.steps_if_covered < 1:
            vertices, faces = self.trainer.coarse_surface()
            covered = covered_share(vertices, faces, scene.cameras, scene.ground, _cloud(self.context, scene))
        self.steps = max(1, round(params.steps * (1 + covered * (params.steps_if_covered - 1))))
        log.info("dense points cover %.0f %% of the surface: %d steps", 100 * covered, self.steps)

    def save(self) -> None:
        """Write the checkpoint."""
        saved = _Saved(
            trainer=self.trainer.state(),
            region=self.region,
            looked=self.looked,
            head_start=self.head_start,
            steps=self.steps,
            seconds=self.seconds,
            metrics=self.metrics.read_text(encoding="utf-8"),
        )
        write_checkpoint(artifacts.checkpoint_path(self.context.scratch), dict(saved))

    @property
    def metrics(self) -> Path:
        return artifacts.METRICS.load(self.context.scratch)

    @property
    def seconds(self) -> float:
        return self.spent + time.monotonic() - self.started

    @property
    def first_step(self) -> int:
        """Steps that count as taken before the first one here."""
        return 0 if self.context.params.minutes else round(self.head_start * self.budget)

    @property
    def budget(self) -> int:
        """Steps in all: those of the settings until they are settled."""
        return self.context.params.steps if self.steps is None else self.steps

    @property
    def steps_done(self) -> int:
        return int(self.trainer.step_index) - self.first_step

    @property
    def progress(self) -> float:
        """Part of the budget that is spent, from 0 to 1: of the minutes where they are set, else of the steps."""
        params = self.context.params
        if params.minutes:
            return self.head_start + self.seconds / (60 * params.minutes)
        return float(self.trainer.step_index / self.budget)

    def advance(self, until: float) -> None:
        """Train to this part of the budget; checkpoints, previews and metric lines on the way."""
        from stages.neural.ranks import ours

        context, trainer, ranks = self.context, self.trainer, ours()
        saved, every = time.monotonic(), context.params.preview_every
        told = b"" if ranks.alone else _as_told(self)
        # a line at a time, so that `hineus view` can draw them as they come
        with ranks.leading(told), self.metrics.open("a", encoding="utf-8", buffering=1) as lines:
            while (progress := self.progress) < until:
                numbers = ranks.step(trainer.step, progress)
                if trainer.step_index % LOG_EVERY == 0:
                    numbers_out = {key: float(value) for key, value in numbers.items()}
                    _write_metrics(lines, trainer, progress, numbers_out)
                    context.progress(progress, 1.0, f"PSNR {numbers_out['psnr']:.1f} dB")
                    _check(numbers_out, trainer.step_index)
                if progress // every < self.progress // every and self.progress < 1:
                    # before the checkpoint: a run that goes on has it
                    _preview(trainer, context.scratch, progress)
                if time.monotonic() - saved > CHECKPOINT_EVERY:
                    self.save()
                    saved = time.monotonic()


# ---------------------------------------------------------------- several processes
def take_part() -> None:
    """As one of several processes that torchrun started, not the first: help it train, until it has no more to train.

    It says what to train and when to step; all else, and all that is written, is its own.

    Raises:
        HineusError: this process cannot go on, or another one has ended.
    """
    import torch

    from stages.neural.ranks import ours

    ranks, of = ours(), None
    trainer: Any = None
    for training in ranks.trainings():
        told = torch.load(io.BytesIO(training), map_location="cpu", weights_only=True)
        if told["of"] != of:
            of, trainer = told["of"], None  # its photos would be in memory twice
            context, region = _from_told(of)
            _use_machine(context)
            scene = context.read(FIRST_SCENE)
            trainer = _make_trainer(context, region.of(scene) if region else scene)
        trainer.load_state(told["trainer"])
        for progress in ranks.steps():
            trainer.step(progress)


def _as_told(training: _Training) -> bytes:
    """What another process needs to know to take part in a training: what it is of, and how far it is."""
    import torch

    context, message = training.context, io.BytesIO()
    of = {
        "inputs": {stage: str(folder) for stage, folder in context.inputs.items()},
        "params": context.params.model_dump(mode="json"),
        "device": context.device,
        "workers": context.workers,
        "region": training.region and tuple(training.region),
    }
    torch.save({"of": of, "trainer": training.trainer.state()}, message)
    return message.getvalue()


def _from_told(of: dict[str, Any]) -> tuple[StageContext[TrainParams], _Region | None]:
    """The context of a training that takes part and has nowhere to write; its region, where that has grown."""
    context = StageContext(
        inputs={stage: Path(folder) for stage, folder in of["inputs"].items()},
        sources={},
        out=Path(os.devnull),
        scratch=Path(os.devnull),
        params=TrainParams.model_validate(of["params"]),
        device=of["device"],
        workers=of["workers"],
    )
    return context, _Region(*of["region"]) if of["region"] else None


def _make_trainer(context: StageContext[TrainParams], scene: PosedScene) -> Any:
    from stages.neural.held_out_psnr import left_out
    from stages.neural.ranks import ours
    from stages.neural.sightings import Sightings
    from stages.neural.trainer import Trainer
    from stages.neural.training_photos import Photos

    params = context.params
    held_out = left_out(len(scene.cameras), params.hold_out)
    images = _load_images(context.read(PINHOLE_PHOTOS), scene.cameras.names)
    photos = Photos(scene.cameras, *images, context.device, ~held_out)
    training = (~held_out).numpy()
    sightings = Sightings.from_scene(scene, context.device, training)
    dense = Sightings.from_cloud(_cloud(context, scene), scene.cameras.centers, context.device, training)
    return Trainer(photos, sightings, dense, params, context.device, _evidence(context, scene), ours())


def _evidence(context: StageContext[TrainParams], scene: PosedScene) -> Evidence:
    """What the depth maps say of places in the scene frame, where that is asked for."""
    from stages.neural.evidence import Evidence

    if not context.params.evidence:
        return Evidence.none(context.device)
    maps, unit = context.read(DEPTH_MAPS), np.float32(scene.poses_from_scene.scale)
    found = (maps.load(name) for name in scene.cameras.names)
    return Evidence.of((pair and (pair[0] / unit, pair[1]) for pair in found), scene.cameras, context.device)


def _cloud(context: StageContext[TrainParams], scene: PosedScene) -> PointCloud:
    """The dense points in the frame of a scene."""
    return context.read(POINT_CLOUD).within(scene.poses_from_scene)


# ---------------------------------------------------------------- a region that grows
def _grown(training: _Training) -> _Region | None:
    """A larger region, where the surface learned so far is cut in the middle of many photos."""
    from stages.surface.border import border_cut, region_without_cut

    scene = training.scene
    vertices, faces = training.trainer.coarse_surface()
    cut = border_cut(vertices, faces, scene.cameras, scene.ground)
    if cut is None:
        return None
    center, radius = region_without_cut(cut)
    log.info("the region cuts what %d photos have in their middle: it grows to %.2f of its radius", cut.photos, radius)
    x, y, z = center.tolist()
    return _Region((x, y, z), float(radius))


def _shape_within(
    sdf: Callable[[np.ndarray], np.ndarray], poses_from_new: Similarity, poses_from_old: Similarity
) -> np.ndarray:
    """Signed distances [G, G, G] of a trained SDF in the frame of another region; beyond its own, to its border."""
    from stages.geometry.hull import cube

    old_from_new = poses_from_old.inverse().compose(poses_from_new)
    places = old_from_new.apply(cube())
    lengths = np.linalg.norm(places, axis=-1)
    beyond = np.maximum(lengths - 1, 0.0)
    within = places / np.maximum(lengths, 1.0)[..., None]
    distances: np.ndarray = sdf(within.reshape(-1, 3)).reshape(lengths.shape)
    shape: np.ndarray = ((distances + beyond) / old_from_new.scale).astype(np.float32)
    return shape


# ---------------------------------------------------------------- photos that came or went
def _last_scene(context: StageContext[TrainParams], scene: PosedScene) -> PosedScene | None:
    """The scene of the last training, where this one goes on from that; and if not, why, in the log."""
    before = context.read_previous(SCENE)
    if before is None:
        log.info("training starts from the beginning: there is none with these settings to go on from")
        return None
    if not scene.lineage or before.lineage != scene.lineage:
        log.info("training starts anew: the poses, or the settings that made the scene, are others than before")
        return None
    now, then = set(scene.contents), set(before.contents)
    changed = len(now - then) + len(then - now)
    if context.params.hold_out:
        log.info("training starts anew: photos that are held out now may have been seen before")
        return None
    if not little_changed(changed, len(then)):
        log.info("training starts anew: %d of %d photos are new or gone", changed, len(now | then))
        return None
    return before


def _since_before(training: _Training) -> dict[str, Any]:
    """Numbers of what was kept of the last training: the part of the budget, and the steps of all until now."""
    if not training.head_start:
        return {}
    previous = training.context.previous
    before = load_manifest(previous) if previous else None
    numbers = before.numbers if before else {}
    steps = training.steps_done + numbers.get("steps_in_all", numbers.get("steps", 0))
    return {"kept_of_budget": training.head_start, "steps_in_all": steps}


def little_changed(changed: int, before: int) -> bool:
    """Whether so few photos came and went, of those that were trained on, that training goes on."""
    return changed <= MAX_CHANGED * before


def _kept_region(scene: PosedScene, before: PosedScene) -> _Region | None:
    """The region of the last training, where it had grown out of the first region of this scene."""
    if not scene.growable or before.growable:
        return None
    first_from_grown = scene.poses_from_scene.inverse().compose(before.poses_from_scene)
    turned = float(np.abs(first_from_grown.rotation - np.eye(3)).max()) > SAME_FRAME
    if turned or first_from_grown.scale <= 1:
        return None
    x, y, z = first_from_grown.translation.tolist()
    return _Region((x, y, z), first_from_grown.scale)


def _same_frame(scene: PosedScene, before: PosedScene) -> bool:
    moved = scene.poses_from_scene.inverse().compose(before.poses_from_scene).matrix() - np.eye(4)
    return float(np.abs(moved).max()) < SAME_FRAME


def _take_over(trainer: Any, context: StageContext[TrainParams], now: Sequence[str], then: Sequence[str]) -> bool:
    """Set the networks to those of the last training, photos' own parameters by contents; False where shapes differ."""
    from stages.neural.trained_field import load_field

    fields = trainer.fields
    earlier = load_field(_previous_field(context), context.device).fields
    if replace(earlier.shape, num_images=0) != replace(fields.shape, num_images=0):
        return False
    weights = earlier.state_dict()
    row = {contents: i for i, contents in enumerate(then)}
    gains = fields.log_gains.detach().clone()
    for i, contents in enumerate(now):
        if contents in row:
            gains[i] = weights["log_gains"][row[contents]]
    fields.load_state_dict({**weights, "log_gains": gains, "radiance.shiny": fields.radiance.shiny})
    return True


def _previous_field(context: StageContext[TrainParams]) -> Path:
    path = context.read_previous(FIELD)
    assert path is not None  # `_last_scene`
    return path


def _use_machine(context: StageContext[TrainParams]) -> None:
    """Torch and numba take as many threads as the run was given, torchrun's processes a part each, and a GPU each."""
    import torch

    from stages.compiling import numba
    from stages.neural.ranks import ours

    threads = max(1, context.workers // ours().local_size)
    torch.set_num_threads(threads)
    numba.set_num_threads(min(threads, numba.config.NUMBA_NUM_THREADS))
    ours().use(context.device)


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


def _start_from_shape(trainer: Any, cameras: PinholeCameras, beside: Sequence[Pictures] = ()) -> None:
    """Where training is not to start from a sphere: bring the SDF to a room, or to the visual hull of the masks.

    Args:
        beside: where masks lie beside whole photos.
    """
    from stages.geometry.hull import room_distances

    params = trainer.params.field
    inside = np.linalg.norm(cameras.centers, axis=1) < params.sphere_radius
    if params.init == "hull":
        error = trainer.start_from(_hull(cameras, trainer.photos, beside))
        log.info("the SDF starts from the masks' visual hull, met to %.4f on average", error)
    elif params.init == "room" or (params.init == "auto" and inside.mean() > 0.5):
        error = trainer.start_from(room_distances())
        log.info("the SDF starts from a room around the cameras, met to %.4f on average", error)


def _hull(cameras: PinholeCameras, photos: Any, beside: Sequence[Pictures]) -> np.ndarray:
    """Signed distances to the visual hull of the masks of the photos that are trained on.

    Raises:
        InputError: a photo has no mask, or the masks leave nothing.
    """
    from stages.geometry.hull import hull_distances

    advice = "Give a mask for each photo (`--masks FOLDER`), or start from a sphere: `--set train.field.init=sphere`."
    training = photos.training.tolist()

    def mask_of(index: int) -> np.ndarray | None:
        if photos.masks is not None:
            own: np.ndarray = photos.mask(index)
            return own
        found = (pictures.mask(cameras.names[index]) for pictures in beside)
        return next((mask for mask in found if mask is not None), None)

    masks = [mask_of(i) if is_used else None for i, is_used in enumerate(training)]
    if sum(mask is not None for mask in masks) < sum(training):
        raise InputError(
            f"`train.field.init` = hull needs masks for all {len(cameras)} photos, and some have none.", advice
        )
    distances = hull_distances(cameras, masks)
    if distances is None:
        raise InputError(f"The {len(cameras)} masks have no visual hull within the region of interest.", advice)
    return distances


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
    version=11,
    settings=lambda config: config.train,
    run=run,
    reads=(FIRST_SCENE, PINHOLE_PHOTOS, OUTLINES, SILHOUETTES, DEPTH_MAPS, POINT_CLOUD),
    writes=(FIELD, CAMERAS, SCENE, METRICS, PREVIEWS, HELD_OUT),
    continues=True,
    summary="learn a signed distance field and its colours from the posed images",
)
