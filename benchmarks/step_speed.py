"""Points per second of the hash encoding and of a whole training step: CPU kernels against plain PyTorch.

python -m benchmarks.step_speed

Medians over repetitions on this machine, all cores; the two take turns, so that a drifting machine hits both. The
scene is a ball seen by eight cameras, the networks are those of the default settings.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable

import numpy as np
import torch

from configs.params import TrainParams
from stages.geometry.cameras import PinholeCameras, PosedScene
from stages.geometry.similarity import Similarity
from stages.neural import encodings, fields
from stages.neural.photos import Photos
from stages.neural.trainer import Sightings, Trainer

REPETITIONS = 15
POINTS = 16384
PROGRESS = 0.7  # all levels in use


def alternate(*functions: Callable[[], object]) -> list[float]:
    """Median seconds of each function, called in turn after one warm-up each."""
    for function in functions:
        function()
    seconds: list[list[float]] = [[] for _ in functions]
    for _ in range(REPETITIONS):
        for function, times in zip(functions, seconds, strict=True):
            started = time.perf_counter()
            function()
            times.append(time.perf_counter() - started)
    return [statistics.median(times) for times in seconds]


def encoding_pass(encode: Callable, grid: encodings.HashGrid) -> Callable[[], None]:
    """Features and spatial gradients of points along rays, and their backward pass."""
    generator = torch.Generator().manual_seed(0)
    table = torch.randn(grid.num_rows, grid.features, generator=generator).requires_grad_()
    starts = torch.rand(POINTS // 16, 1, 3, generator=generator) - 0.5
    steps = 0.02 * torch.randn(POINTS // 16, 1, 3, generator=generator)
    points = (starts + steps * torch.arange(16)[None, :, None]).reshape(-1, 3).contiguous()
    cotangent = torch.randn(POINTS, grid.channels, generator=generator).requires_grad_()

    def run() -> None:
        features, vjp = encode(points, table, grid, grid.levels)
        table.grad = None
        (features.sum() + vjp(cotangent).sum()).backward()

    return run


def training_step(trainer: Trainer, encode: Callable, encode_features: Callable) -> Callable[[], None]:
    """One optimiser step with the given encoders."""

    def run() -> None:
        fields.encode, fields.encode_features = encode, encode_features
        trainer.step(PROGRESS)

    return run


def ball_trainer(params: TrainParams) -> Trainer:
    """A trainer on noise photos of a ring of cameras: what it learns does not matter here."""
    poses = []
    for angle in np.arange(8) * np.pi / 4:
        center = 3 * np.array([np.cos(angle), np.sin(angle), 0.3])
        forward = -center / np.linalg.norm(center)
        right = np.cross(forward, [0, 0, 1])
        right /= np.linalg.norm(right)
        rotation = np.stack([right, np.cross(forward, right), forward])
        poses.append(np.concatenate([rotation, -rotation @ center[:, None]], 1))
    K = np.array([[400.0, 0, 160], [0, 400, 120], [0, 0, 1]])
    cameras = PinholeCameras(
        tuple(f"{i}.png" for i in range(8)), np.tile([320, 240], (8, 1)), np.tile(K, (8, 1, 1)), np.stack(poses)
    )
    rng = np.random.default_rng(0)
    points = rng.normal(size=(500, 3))
    points *= 0.5 / np.linalg.norm(points, axis=1, keepdims=True)
    observations = np.stack([rng.integers(0, 8, 500), np.arange(500)], 1).astype(np.int32)
    scene = PosedScene(
        cameras, Similarity.identity(), points.astype(np.float32), np.full(500, 0.5, np.float32), observations,
        np.array([0.0, 0, 1]),
    )  # fmt: skip
    photos = Photos(cameras, [rng.integers(0, 255, (240, 320, 3), dtype=np.uint8) for _ in range(8)], None, "cpu")
    return Trainer(photos, Sightings.from_scene(scene, "cpu"), params, "cpu")


def main() -> None:
    params = TrainParams()
    grid = encodings.HashGrid(params.levels, params.level_features, params.log2_rows, params.coarsest, params.finest)
    cores = torch.get_num_threads()
    kernels = (encodings.encode, encodings.encode_features)
    reference = (encodings.encode_reference, encodings._reference_features)
    encoding = alternate(encoding_pass(kernels[0], grid), encoding_pass(reference[0], grid))
    steps = alternate(training_step(ball_trainer(params), *kernels), training_step(ball_trainer(params), *reference))
    step_points = params.rays * params.samples + 4 * params.sparse_batch + params.free_points
    print("| what | kernels, kpt/s/core | PyTorch, kpt/s/core | ratio |")
    print("| --- | --- | --- | --- |")
    for name, count, (fast, slow) in (
        ("encoding, forward and backward", POINTS, encoding),
        ("training step", step_points, steps),
    ):
        rates = [count / seconds / cores / 1000 for seconds in (fast, slow)]
        print(f"| {name} | {rates[0]:.0f} | {rates[1]:.0f} | {slow / fast:.1f} |")


if __name__ == "__main__":
    main()
