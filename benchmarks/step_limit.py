"""How fast a training step is with each implementation of the encoding, and how near that is to this machine's limit.

python -m benchmarks.step_limit                  the GPU where there is one, else the CPU
python -m benchmarks.step_limit --device cpu

The networks' step: signed distance, normal and colour of points on rays (16k on a CPU, 128k on a GPU), one backward
pass through all of them and one step of the optimiser, with the networks of the preset `cpu` (`gpu`): no rays are
drawn, no background, nothing else of a training step. The whole step is a training step of that preset, on noise.

The limit: the matrix products of the networks' step and its reads and additions in the table, alone, one after the
other: with those shapes, on the same points, as fast as this machine does them. All else (interpolation, activations,
losses, the optimiser) would have to cost nothing to reach it. On a GPU the products are as short as training has them.

Median seconds over repetitions; what is compared takes turns. On a CPU a run with all threads is set against one with a
single thread; so are two processes with a thread each, to see what the second core adds where nothing has to be shared.
"""

from __future__ import annotations

import argparse
import itertools
import multiprocessing
import resource
import statistics
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import replace

import numba
import numpy as np
import torch
from numba import njit, prange

from benchmarks.pages import markdown_table
from benchmarks.step_speed import (
    CHOSEN,
    POINTS,
    Encoder,
    alternate,
    best_device,
    cores_of,
    encoders,
    noise_trainer,
    points_of_step,
    preset_for,
    training_step,
)
from configs.load import load_config
from configs.training import TrainParams
from stages.neural import encodings, losses
from stages.neural.acceleration import short_products
from stages.neural.encoding_shapes import HashGrid
from stages.neural.fields import Fields, FieldShape
from stages.neural.trainer import field_shape

LOG2_ROWS = {"cpu": (15, 17), "cuda": (17, 19)}
PROCESS_SECONDS = 4.0  # each process of the two works that long


def settings(log2_rows: int, device: str) -> TrainParams:
    """The preset of the device, with tables of 2**log2_rows rows a level."""
    return load_config(preset_for(device), None, [f"train.field.log2_rows={log2_rows}"]).train


def shape_of(log2_rows: int, device: str = "cpu") -> FieldShape:
    """The networks of that preset, without a background and without shading, whose products are few."""
    return replace(field_shape(settings(log2_rows, device), 1, background=False), shaded=False)


def points_on_rays(device: str) -> tuple[torch.Tensor, torch.Tensor]:
    """Points [N, 3], 16 each near the middle of random lines, and the lines' directions [N, 3]."""
    generator, rays = torch.Generator().manual_seed(0), POINTS[device] // 16
    starts = 1.2 * torch.rand(rays, 1, 3, generator=generator) - 0.6
    directions = torch.nn.functional.normalize(torch.randn(rays, 1, 3, generator=generator), dim=2)
    points = starts + 0.02 * directions * torch.arange(16)[:, None]
    directions = directions.expand(-1, 16, -1)
    return tuple(each.reshape(-1, 3).contiguous().to(device) for each in (points, directions))


# ---------------------------------------------------------------- the step
def networks_step(shape: FieldShape, encoder: Encoder = CHOSEN, device: str = "cpu") -> Callable[[], None]:
    """One step of the networks alone."""
    networks = Fields(shape).to(device)
    on_gpu = device == "cuda"
    if on_gpu:
        networks.use_mixed_precision()
    optimizer = torch.optim.Adam(networks.parameters(), lr=1e-3, betas=(0.9, 0.99), eps=1e-15, fused=True)
    points, directions = points_on_rays(device)
    observed = torch.rand(len(points), 3, generator=torch.Generator().manual_seed(1)).to(device)
    table = networks.sdf.table

    def step() -> None:
        encoder.use()
        sdf, features, gradients = networks.sdf(points, shape.sdf_grid.levels)
        normals = torch.nn.functional.normalize(gradients, dim=1)
        colors = networks.radiance.network(points, normals, directions, features)
        loss = losses.rgb_error(colors, observed).mean() + losses.eikonal_error(gradients).mean() + sdf.abs().mean()
        kept = table.grad
        optimizer.zero_grad(set_to_none=True)
        table.grad = None if kept is None else kept.zero_()
        with short_products(on_gpu, points.device):
            loss.backward()
        optimizer.step()
        CHOSEN.use()

    return step


# ---------------------------------------------------------------- the limit
Product = tuple[int, int, int]


def products(shape: FieldShape) -> tuple[list[Product], list[Product]]:
    """The matrix products of one step as (rows, inner, columns), N written as 0: of the distance and of the colour."""
    encoded, width, outputs = shape.sdf_grid.channels, shape.sdf_width, 1 + shape.features
    distance = [
        (0, encoded, width), (0, width, outputs),  # forward
        (0, width, encoded),  # the normal
        (0, encoded, width), (width, 0, encoded),  # the normal's backward
        (0, outputs, width), (outputs, 0, width), (0, width, encoded), (width, 0, encoded),  # the forward's backward
    ]  # fmt: skip
    widths = [shape.features + 3 + 3 + 3 + 1 + 15, *[shape.radiance_width] * shape.radiance_layers, 3]
    color = [
        product
        for before, after in itertools.pairwise(widths)
        for product in ((0, before, after), (0, after, before), (after, 0, before))
    ]
    return distance, color


def product_pass(shape: FieldShape, device: str) -> Callable[[], None]:
    """All matrix products of one step into memory that is there."""
    generator = torch.Generator().manual_seed(0)
    operands = []
    for part, dtype in zip(products(shape), (torch.float32, torch.bfloat16), strict=True):
        dtype = dtype if device == "cuda" else torch.float32
        for sizes in part:
            rows, inner, columns = (size or POINTS[device] for size in sizes)
            left, right = (torch.rand(*size, generator=generator) for size in ((rows, inner), (inner, columns)))
            operands.append(tuple(each.to(device, dtype) for each in (left, right, torch.empty(rows, columns))))

    def run() -> None:
        with short_products(True, torch.device(device)):
            for left, right, out in operands:
                torch.mm(left, right, out=out)

    return run


@njit(parallel=True, fastmath=True)
def _read_rows(table, rows, sums):
    for i in prange(len(rows)):
        a = b = c = d = np.float32(0)
        for k in range(rows.shape[1]):
            row = rows[i, k]
            a += table[row, 0]
            b += table[row, 1]
            c += table[row, 2]
            d += table[row, 3]
        sums[i, 0], sums[i, 1], sums[i, 2], sums[i, 3] = a, b, c, d


@njit(parallel=True, fastmath=True)
def _add_to_rows(table, rows, sums, corners):
    for level in prange(rows.shape[1] // corners):
        for i in range(len(rows)):
            for k in range(level * corners, (level + 1) * corners):
                row = rows[i, k]
                for f in range(4):
                    table[row, f] += sums[i, f]


def table_pass(grid: HashGrid, device: str) -> Callable[[], None]:
    """The reads and the additions of one step: each point's eight rows on every level, once each way."""
    points, _ = points_on_rays(device)
    rows = torch.cat([encodings._corners(points, grid, level)[0] for level in range(grid.levels)], 1)
    if device == "cuda":
        return _table_pass_on_gpu(rows, grid)
    table = np.zeros((grid.num_rows, grid.features), np.float32)
    sums = np.ones((len(points), 4), np.float32)
    places = rows.numpy().astype(np.uint32)

    def run() -> None:
        _read_rows(table, places, sums)
        _add_to_rows(table, places, sums, 8)

    return run


def _table_pass_on_gpu(rows: torch.Tensor, grid: HashGrid) -> Callable[[], None]:
    """Level after level, so that the rows in use are few, as the kernels have it."""
    table = torch.zeros(grid.num_rows, grid.features, device=rows.device)
    one = torch.ones(1, grid.features, device=rows.device)
    levels = [part.contiguous() for part in rows.split(8, 1)]

    def run() -> None:
        for part in levels:
            torch.nn.functional.embedding_bag(part, table, mode="sum")
            table.index_add_(0, part.view(-1), one.expand(part.numel(), -1))

    return run


# ---------------------------------------------------------------- processes
def _steps_in(seconds: float, start, results) -> None:
    """Steps a second of a process with one thread, once all are ready."""
    use_threads(1)
    step = networks_step(shape_of(LOG2_ROWS["cpu"][0]))
    for _ in range(3):
        step()
    start.wait()
    began, count = time.perf_counter(), 0
    while time.perf_counter() - began < seconds:
        step()
        count += 1
    results.put(count / (time.perf_counter() - began))


def rate_of_processes(count: int) -> float:
    """Steps a second of `count` processes together, a thread each."""
    context = multiprocessing.get_context("spawn")
    start, results = context.Barrier(count), context.Queue()
    processes = [context.Process(target=_steps_in, args=(PROCESS_SECONDS, start, results)) for _ in range(count)]
    for process in processes:
        process.start()
    rates = [results.get() for _ in processes]
    for process in processes:
        process.join()
    return sum(rates)


# ---------------------------------------------------------------- command
def use_threads(count: int) -> None:
    """Let PyTorch and the kernels use that many threads."""
    numba.set_num_threads(count)
    torch.set_num_threads(count)  # last: numba's first call may set the number of OpenMP's threads, which they share


def limit_rows(device: str) -> list[list[str]]:
    """Rows of the table with the threads that are in use now: kilo-points a second and core."""
    rows, cores = [], cores_of(device)
    for log2_rows in LOG2_ROWS[device]:
        params, shape = settings(log2_rows, device), shape_of(log2_rows, device)
        found = encoders(device, shape.sdf_grid)
        *steps, matrix, table = alternate(
            *(networks_step(shape, encoder, device) for encoder in found),
            *(training_step(noise_trainer(params, device), encoder) for encoder in found),
            product_pass(shape, device),
            table_pass(shape.sdf_grid, device),
        )
        limit = matrix + table
        for encoder, networks, whole in zip(found, steps, steps[len(found) :], strict=False):
            rates = [
                count / seconds / cores / 1000
                for count, seconds in (
                    (POINTS[device], networks), (points_of_step(params), whole), (POINTS[device], limit),
                )
            ]  # fmt: skip
            place = "GPU" if device == "cuda" else str(cores)
            reached, parts = f"{100 * limit / networks:.0f} %", f"{1000 * matrix:.1f} + {1000 * table:.1f}"
            rows.append([f"2^{log2_rows}", place, encoder.name, *(f"{rate:.3g}" for rate in rates), parts, reached])
    return rows


def peak_memory(device: str) -> str:
    """The most that this process has held so far."""
    resident = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    on_gpu = f", {torch.cuda.max_memory_allocated() / 2**30:.2f} GiB on the GPU" if device == "cuda" else ""
    return f"Peak memory of all of this: {resident:.2f} GiB{on_gpu}."


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", choices=["cpu", "cuda"], default=best_device(), help="default: %(default)s")
    device = parser.parse_args(argv).device
    cores = torch.get_num_threads()
    counts = sorted({1, cores}) if device == "cpu" else [cores]
    header = [
        "rows a level", "threads", "encoding", "networks' step, kpt/s/core", "whole step, kpt/s/core", "limit",
        "products + table, ms", "networks of the limit",
    ]  # fmt: skip
    rows = []
    for threads in counts:
        use_threads(threads)
        rows += limit_rows(device)
    print(markdown_table(header, sorted(rows)))
    print(f"\n{peak_memory(device)}")
    if device == "cuda":
        print(torch.cuda.get_device_name())
        return 0
    seconds = {}
    for threads in counts:
        use_threads(threads)
        seconds[threads] = statistics.median(alternate(networks_step(shape_of(LOG2_ROWS["cpu"][0]))))
    print(f"{cores} threads make the step {seconds[1] / seconds[cores]:.2f} times as fast as one.")
    alone, together = rate_of_processes(1), rate_of_processes(cores)
    print(f"{cores} processes with a thread each do {together / alone:.2f} times the steps of one.")
    return 0


if __name__ == "__main__":
    sys.exit(main())
