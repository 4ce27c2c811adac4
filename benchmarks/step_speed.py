"""How fast a training step is: the kernels against plain PyTorch, and what each part of the method costs.

python -m benchmarks.step_speed                                      both tables
python -m benchmarks.step_speed kernels                              the first
python -m benchmarks.step_speed parts --variants all --rounds 20     the second, of these variants of the ablation

Medians over repetitions on this machine, all cores, or its GPU where there is one (`--device cpu`: not); what is
compared takes turns, so that a drifting machine hits all.

The scene is a heap of balls seen by 47 cameras. For the kernels its photos are noise, and the networks are those of the
preset `cpu`, or `gpu` on one. For the parts the base learns it for a while, all variants start from what it has
learned, and they are timed at the middle of the training, when every part is at work. Their learning rates are zero
then, which saves no work, and holds all of them in that state. What is done every few steps only, the refresh of the
cached grid, is left out: it is the same for all.
"""

from __future__ import annotations

import argparse
import math
import statistics
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from benchmarks import ball_heap
from benchmarks.ablate import BASE, VARIANTS, settings_of
from benchmarks.pages import markdown_table
from configs.load import load_config
from configs.training import TrainParams
from stages.neural import encodings, fields
from stages.neural.encoding_shapes import HashGrid
from stages.neural.trainer import Trainer, field_shape
from stages.neural.training_photos import Photos

REPETITIONS = 15
POINTS = {"cpu": 1 << 14, "cuda": 1 << 17}
PROGRESS = 0.7  # all levels in use

# What is timed if nothing else is asked for: each part alone and all together, then the paper's forms, then choices.
PARTS = (
    "defaults", "ambiguity", "reflection", "planar", "eikonal", "all",
    "ambiguity-paper", "visibility-paper", "visibility-mesh", "reflection-paper", "planar-paper", "eikonal-paper",
    "all-paper",
    "density-neus", "scale-learned", "gradients-numerical",
    "rays-even", "colors-16", "samples-16", "background-16",
)  # fmt: skip
PARTS_PROGRESS = 0.5  # all parts at work
LEARNING_STEPS = 100
STEPS_PER_TURN = 2


def best_device() -> str:
    return "cuda" if torch.cuda.is_available() else "cpu"


def finish() -> None:
    """Wait until a GPU has done what it was given."""
    if torch.cuda.is_available():
        torch.cuda.synchronize()


def alternate(*functions: Callable[[], object]) -> list[float]:
    """Median seconds of each function, called in turn after one warm-up each."""
    for function in functions:
        function()
    seconds: list[list[float]] = [[] for _ in functions]
    for _ in range(REPETITIONS):
        for function, times in zip(functions, seconds, strict=True):
            finish()
            started = time.perf_counter()
            function()
            finish()
            times.append(time.perf_counter() - started)
    return [statistics.median(times) for times in seconds]


@dataclass(frozen=True)
class Encoder:
    """An implementation of the encoding: `encode` and `encode_features` of `stages.neural.encodings`."""

    name: str
    encode: Callable
    encode_features: Callable

    def use(self) -> None:
        """Let the networks call it."""
        fields.encode, fields.encode_features = self.encode, self.encode_features


REFERENCE = Encoder("PyTorch", encodings.encode_reference, encodings.features_reference)
CHOSEN = Encoder("chosen", encodings.encode, encodings.encode_features)  # as training takes them


def encoders(device: str, grid: HashGrid) -> list[Encoder]:
    """The implementations there are on a device: its kernels first, then plain PyTorch."""
    if encodings.kernels_for(torch.zeros(1, 3, device=device), grid) is None:
        return [REFERENCE]
    return [replace(CHOSEN, name="Triton" if device == "cuda" else "numba"), REFERENCE]


def encoding_pass(encode: Callable, grid: HashGrid, device: str = "cpu") -> Callable[[], None]:
    """Features and spatial gradients of points along rays, and their backward pass."""
    generator, rays = torch.Generator().manual_seed(0), POINTS[device] // 16
    table = torch.randn(grid.num_rows, grid.features, generator=generator).to(device).requires_grad_()
    starts = torch.rand(rays, 1, 3, generator=generator) - 0.5
    steps = 0.02 * torch.randn(rays, 1, 3, generator=generator)
    points = (starts + steps * torch.arange(16)[None, :, None]).reshape(-1, 3).contiguous().to(device)
    cotangent = torch.randn(16 * rays, grid.channels, generator=generator).to(device).requires_grad_()

    def run() -> None:
        features, vjp = encode(points, table, grid, grid.levels)
        table.grad = None
        (features.sum() + vjp(cotangent).sum()).backward()

    return run


def training_step(trainer: Trainer, encoder: Encoder) -> Callable[[], None]:
    """One optimiser step with the given encoder."""

    def run() -> None:
        encoder.use()
        trainer.step(PROGRESS)
        CHOSEN.use()

    return run


def noise_trainer(params: TrainParams, device: str = "cpu") -> Trainer:
    """A trainer on photos of noise: what it learns does not matter here."""
    cameras, rng = ball_heap.dome_of_cameras(), np.random.default_rng(0)
    images = (rng.integers(0, 255, (height, width, 3), dtype=np.uint8) for width, height in cameras.sizes)
    photos = Photos(cameras, images, None, device)
    return Trainer(photos, *ball_heap.sightings(cameras, device), params, device)


def points_of_step(params: TrainParams) -> int:
    """How many points a training step asks the distance of."""
    sampling, losses = params.sampling, params.losses
    sightings = losses.sparse_batch + losses.dense_batch
    return sampling.rays * sampling.samples + 4 * sightings + sampling.free_points


def preset_for(device: str) -> str:
    return "gpu" if device == "cuda" else "cpu"


def cores_of(device: str) -> int:
    """By how many a rate is divided: threads, or one GPU."""
    return 1 if device == "cuda" else torch.get_num_threads()


# ---------------------------------------------------------------- kernels
def print_kernels(device: str) -> None:
    """Table of the encoding's and the step's speed with the kernels and in plain PyTorch."""
    params = load_config(preset_for(device), None, []).train
    grid = field_shape(params, 1, background=False).sdf_grid
    found = encoders(device, grid)
    encoding = alternate(*(encoding_pass(encoder.encode, grid, device) for encoder in found))
    steps = alternate(*(training_step(noise_trainer(params, device), encoder) for encoder in found))
    timed = [
        ("encoding, forward and backward", POINTS[device], encoding),
        ("training step", points_of_step(params), steps),
    ]
    if device == "cuda":
        apart = [noise_trainer(params, device) for _ in found]
        for trainer in apart:
            trainer.replay = None
        seconds = alternate(*(training_step(*pair) for pair in zip(apart, found, strict=True)))
        timed.append(("training step, kernel by kernel", points_of_step(params), seconds))
    rows = []
    for name, count, seconds in timed:
        rates = [count / each / cores_of(device) / 1000 for each in seconds]
        rows.append([name, *(f"{rate:.0f}" for rate in rates), f"{seconds[-1] / seconds[0]:.1f}"])
    print(markdown_table(["what", *(f"{encoder.name}, kpt/s/core" for encoder in found), "ratio"], rows))


# ---------------------------------------------------------------- parts of the method
def variant_trainers(names: Sequence[str], device: str = "cpu") -> dict[str, Trainer]:
    """A trainer a variant, with the device's preset: the first one has learned the scene, the others take it over.

    What a variant has of its own or in another shape is as it was initialised; a learned scale is about what the
    schedule says.
    """
    cameras = ball_heap.dome_of_cameras()
    photos = Photos(cameras, [ball_heap.render(cameras, i) for i in range(len(cameras))], None, device)
    sightings = ball_heap.sightings(cameras, device)
    preset = preset_for(device)
    trainers = {
        name: Trainer(photos, *sightings, load_config(preset, None, settings_of(name, VARIANTS[name])).train, device)
        for name in names
    }
    first, *others = trainers.values()
    for step in range(LEARNING_STEPS):
        first.step(PARTS_PROGRESS * step / LEARNING_STEPS)
    learned = first.fields.state_dict()
    for trainer in others:
        shapes = {name: value.shape for name, value in trainer.fields.state_dict().items()}
        shared = {name: value for name, value in learned.items() if shapes.get(name) == value.shape}
        trainer.fields.load_state_dict(shared, strict=False)
        trainer.cache.values.copy_(first.cache.values)
        if trainer.fields.log_scale is not None:
            torch.nn.init.constant_(trainer.fields.log_scale, math.log(first.moment(PARTS_PROGRESS).width))
    for trainer in trainers.values():
        trainer.cache_step = trainer.step_index
        if trainer.needed.share:
            trainer.needed.look(trainer.cache)
        for group in trainer.optimizer.param_groups:
            group["base_lr"] = 0.0
    return trainers


def time_in_turn(trainers: dict[str, Trainer], rounds: int) -> dict[str, tuple[float, float]]:
    """Median seconds of each trainer's step, wall clock and CPU (all threads), over turns of a few steps each."""
    turns: dict[str, list[tuple[float, float]]] = {name: [] for name in trainers}
    for turn in range(-1, rounds):  # one to warm up
        for name, trainer in trainers.items():
            finish()
            started = time.perf_counter(), time.process_time()
            for _ in range(STEPS_PER_TURN):
                trainer.step(PARTS_PROGRESS)
            finish()
            ended = time.perf_counter(), time.process_time()
            if turn >= 0:
                turns[name].append((ended[0] - started[0], ended[1] - started[1]))
            trainer.cache_step = trainer.step_index  # no refresh
    return {
        name: (
            statistics.median(wall for wall, _ in times) / STEPS_PER_TURN,
            statistics.median(cpu for _, cpu in times) / STEPS_PER_TURN,
        )
        for name, times in turns.items()
    }


def parts_table(seconds: dict[str, tuple[float, float]]) -> str:
    """A row a variant: its step's seconds, wall clock and CPU, and both against the base's."""
    base = seconds[BASE]
    rows = [
        [name, f"{1000 * wall:.0f}", f"{1000 * cpu:.0f}", f"{wall / base[0]:.2f}", f"{cpu / base[1]:.2f}"]
        for name, (wall, cpu) in seconds.items()
    ]
    return markdown_table(["variant", "wall, ms a step", "CPU, ms a step", "wall / base", "CPU / base"], rows)


def share_of_terms(seconds: dict[str, tuple[float, float]]) -> str:
    """What the method's terms take of the step that has them all."""
    wall, cpu = (100 * (1 - base / everything) for base, everything in zip(seconds[BASE], seconds["all"], strict=True))
    return f"The method's terms together take {wall:.0f} % of a step's wall time and {cpu:.0f} % of its CPU time."


def print_parts(names: Sequence[str], rounds: int, device: str) -> None:
    seconds = time_in_turn(variant_trainers(names, device), rounds)
    print(parts_table(seconds))
    if "all" in seconds:
        print(f"\n{share_of_terms(seconds)}")


# ---------------------------------------------------------------- command
def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("table", nargs="?", choices=["kernels", "parts"], help="default: both")
    parser.add_argument("--variants", default=",".join(PARTS), help="names, separated by commas")
    parser.add_argument("--rounds", type=int, default=12, help="turns of each variant")
    parser.add_argument("--device", choices=["cpu", "cuda"], default=best_device(), help="default: %(default)s")
    arguments = parser.parse_args(argv)
    named = arguments.variants.split(",")
    if unknown := [name for name in named if name not in VARIANTS]:
        parser.error(f"no variant {', '.join(unknown)}; there are {', '.join(VARIANTS)}")
    if arguments.rounds < 1:
        parser.error("--rounds needs at least 1")
    if arguments.table != "parts":
        print_kernels(arguments.device)
    if arguments.table is None:
        print()
    if arguments.table != "kernels":
        print_parts(list(dict.fromkeys([BASE, *named])), arguments.rounds, arguments.device)
    return 0


if __name__ == "__main__":
    sys.exit(main())
