"""How near the networks' step comes to what this machine can do, and what its cores add.

python -m benchmarks.step_limit

The step: signed distance, normal and colour of 16k points on rays, one backward pass through all of them and one step
of the optimiser; eight levels of four features, a hidden layer of 64 for the distance, two for the colour. No rays are
drawn, no background, nothing else of a training step.

The limit: the matrix products of that step and its reads and additions in the table, alone, one after the other: with
those shapes, on the same points, as fast as this machine does them. All else (interpolation, activations, losses, the
optimiser) would have to cost nothing to reach it.

Median seconds over repetitions; what is compared takes turns. A run with all threads is set against one with a single
thread; so are two processes with a thread each, to see what the second core adds where nothing has to be shared.
"""

from __future__ import annotations

import argparse
import itertools
import multiprocessing
import statistics
import sys
import time
from collections.abc import Callable, Sequence

import numba
import numpy as np
import torch
from numba import njit, prange

from benchmarks.run_sets import markdown_table
from benchmarks.step_speed import POINTS, alternate
from stages.neural import encodings, fields, losses
from stages.neural.encodings import HashGrid
from stages.neural.fields import Fields, FieldShape

LOG2_ROWS = (15, 17)
PROCESS_SECONDS = 4.0  # each process of the two works that long


def shape_of(log2_rows: int) -> FieldShape:
    """The networks of the `cpu` preset, with tables of 2**log2_rows rows a level."""
    return FieldShape(HashGrid(log2_rows=log2_rows), 1, 64, 2, 64, True, 15, 0.5, None, 1)


def points_on_rays() -> tuple[torch.Tensor, torch.Tensor]:
    """Points [N, 3], 16 each near the middle of random lines, and the lines' directions [N, 3]."""
    generator = torch.Generator().manual_seed(0)
    starts = 1.2 * torch.rand(POINTS // 16, 1, 3, generator=generator) - 0.6
    directions = torch.nn.functional.normalize(torch.randn(POINTS // 16, 1, 3, generator=generator), dim=2)
    points = starts + 0.02 * directions * torch.arange(16)[:, None]
    return points.reshape(-1, 3).contiguous(), directions.expand(-1, 16, -1).reshape(-1, 3).contiguous()


# ---------------------------------------------------------------- the step
def networks_step(shape: FieldShape, kernels: bool = True) -> Callable[[], None]:
    """One step of the networks alone, with the kernels or in plain PyTorch."""
    networks = Fields(shape)
    optimizer = torch.optim.Adam(networks.parameters(), lr=1e-3, betas=(0.9, 0.99), eps=1e-15, fused=True)
    points, directions = points_on_rays()
    observed = torch.rand(POINTS, 3, generator=torch.Generator().manual_seed(1))
    table = networks.sdf.table
    encode = encodings.encode if kernels else encodings.encode_reference

    def step() -> None:
        fields.encode = encode
        sdf, features, gradients = networks.sdf(points, shape.sdf_grid.levels)
        colors = networks.radiance(points, torch.nn.functional.normalize(gradients, dim=1), directions, features)
        loss = losses.rgb_error(colors, observed).mean() + losses.eikonal_error(gradients).mean() + sdf.abs().mean()
        kept = table.grad
        optimizer.zero_grad(set_to_none=True)
        table.grad = None if kept is None else kept.zero_()
        loss.backward()
        optimizer.step()
        fields.encode = encodings.encode

    return step


# ---------------------------------------------------------------- the limit
def products(shape: FieldShape) -> list[tuple[int, int, int]]:
    """The matrix products of one step as (rows, inner, columns), N written as 0."""
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
    return distance + color


def product_pass(shape: FieldShape) -> Callable[[], None]:
    """All matrix products of one step into memory that is there."""
    generator = torch.Generator().manual_seed(0)
    operands = []
    for sizes in products(shape):
        rows, inner, columns = (size or POINTS for size in sizes)
        left, right = (torch.rand(*size, generator=generator) for size in ((rows, inner), (inner, columns)))
        operands.append((left, right, torch.empty(rows, columns)))

    def run() -> None:
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


def table_pass(grid: HashGrid) -> Callable[[], None]:
    """The reads and the additions of one step: each point's eight rows on every level, once each way."""
    points, _ = points_on_rays()
    rows = torch.cat([encodings._corners(points, grid, level)[0] for level in range(grid.levels)], 1)
    rows = rows.numpy().astype(np.uint32)
    table = np.zeros((grid.num_rows, grid.features), np.float32)
    sums = np.ones((POINTS, 4), np.float32)

    def run() -> None:
        _read_rows(table, rows, sums)
        _add_to_rows(table, rows, sums, 8)

    return run


# ---------------------------------------------------------------- processes
def _steps_in(seconds: float, start, results) -> None:
    """Steps a second of a process with one thread, once all are ready."""
    use_threads(1)
    step = networks_step(shape_of(LOG2_ROWS[0]))
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
    torch.set_num_threads(count)
    numba.set_num_threads(count)


def limit_rows(threads: int) -> list[list[str]]:
    """Rows of the table for a number of threads: kilo-points a second and core."""
    use_threads(threads)
    rows = []
    for log2_rows in LOG2_ROWS:
        shape = shape_of(log2_rows)
        step, plain, matrix, table = alternate(
            networks_step(shape), networks_step(shape, kernels=False), product_pass(shape), table_pass(shape.sdf_grid)
        )
        rates = [POINTS / seconds / threads / 1000 for seconds in (step, plain, matrix + table)]
        parts = f"{1000 * matrix:.1f} + {1000 * table:.1f}"
        reached = f"{100 * (matrix + table) / step:.0f} %"
        cells = [f"2^{log2_rows}", str(threads), *(f"{rate:.0f}" for rate in rates), parts, reached]
        rows.append(cells)
    return rows


def main(argv: Sequence[str] | None = None) -> int:
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args(argv)
    cores = torch.get_num_threads()
    counts = sorted({1, cores})
    header = [
        "rows a level", "threads", "step, kpt/s/core", "in PyTorch", "limit", "products + table, ms", "of the limit",
    ]  # fmt: skip
    rows = [row for threads in counts for row in limit_rows(threads)]
    print(markdown_table(header, sorted(rows)))
    seconds = {}
    for threads in counts:
        use_threads(threads)
        seconds[threads] = statistics.median(alternate(networks_step(shape_of(LOG2_ROWS[0]))))
    print(f"\n{cores} threads make the step {seconds[1] / seconds[cores]:.2f} times as fast as one.")
    alone, together = rate_of_processes(1), rate_of_processes(cores)
    print(f"{cores} processes with a thread each do {together / alone:.2f} times the steps of one.")
    return 0


if __name__ == "__main__":
    sys.exit(main())
