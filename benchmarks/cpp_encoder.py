"""Whether C++ would be faster than numba: the encoding's kernels in both, alone and in a step.

python -m benchmarks.cpp_encoder

Compiles `cpp_encoder.cpp` with `g++ -O3 -march=native -ffast-math -fopenmp` (or `CXX`), checks it against the
reference and times both in turn, with one thread and with all: forward with Jacobian, product with it, backward of
2^14 points; the networks' step of `benchmarks.step_limit`; a whole training step of the preset `cpu`. Nothing of it is
used by the pipeline, which needs no compiler.
"""

from __future__ import annotations

import argparse
import ctypes
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import torch

from benchmarks.run_sets import markdown_table
from benchmarks.step_limit import LOG2_ROWS, networks_step, settings, shape_of, use_threads
from benchmarks.step_speed import CHOSEN, Encoder, alternate, ball_trainer, encoding_pass, training_step
from stages.neural import encoding_cpu, encodings
from stages.neural.encodings import HashGrid

SOURCE = Path(__file__).with_suffix(".cpp")
FLAGS = ("-O3", "-march=native", "-ffast-math", "-fopenmp", "-shared", "-fPIC")


def compiled(folder: Path) -> ctypes.CDLL:
    """The source as a library. Raises where there is no compiler, or where it refuses."""
    library = folder / "cpp_encoder.so"
    subprocess.run([os.environ.get("CXX", "g++"), *FLAGS, "-o", str(library), str(SOURCE)], check=True)
    return ctypes.CDLL(str(library))


class CppKernels:
    """`stages.neural.encodings.EncodingKernels` in C++, but for the products with the Jacobian, which stay numba's."""

    vjp_forward = staticmethod(encoding_cpu.vjp_forward)
    vjp_backward = staticmethod(encoding_cpu.vjp_backward)

    def __init__(self, library: ctypes.CDLL) -> None:
        self.library = library

    def forward(self, points, table, grid, active_levels):
        jacobian = torch.empty(len(points), 3, grid.channels)
        return self._encode(points, table, grid, active_levels, jacobian), jacobian

    def features_forward(self, points, table, grid, active_levels):
        return self._encode(points, table, grid, active_levels, None)

    def backward(self, points, grid, active_levels, grad_features, grad_jacobian, grad_table):
        grad_gradients, cotangent = grad_jacobian or (None, None)
        if grad_features is None:
            grad_features = torch.zeros_like(cotangent)
        given = [t if t is None else t.contiguous() for t in (grad_features, grad_gradients, cotangent, grad_table)]
        self.library.encode_backward(
            _address(points), *_levels(grid), active_levels, ctypes.c_int64(len(points)), grid.channels,
            *(_address(tensor) for tensor in given),
        )  # fmt: skip

    def _encode(self, points, table, grid, active_levels, jacobian):
        features = torch.empty(len(points), grid.channels)
        self.library.encode_forward(
            _address(points), _address(table), *_levels(grid), active_levels, ctypes.c_int64(len(points)),
            grid.channels, _address(features), _address(jacobian),
        )  # fmt: skip
        return features


def _address(tensor: torch.Tensor | None) -> ctypes.c_void_p:
    return ctypes.c_void_p(None if tensor is None else tensor.data_ptr())


def _levels(grid: HashGrid) -> list[ctypes.c_void_p]:
    """Resolutions and offsets (int64), and which levels are dense (a byte each)."""
    return [ctypes.c_void_p(array.ctypes.data) for array in (grid.resolutions, grid.offsets, grid.dense)]


def cpp_encoder(library: ctypes.CDLL) -> Encoder:
    kernels = CppKernels(library)

    def encode_features(points, table, grid, active_levels):
        return encodings._KernelFeatures.apply(points, table, grid, active_levels, kernels)

    return Encoder("C++", partial(encodings.encode_with, kernels), encode_features)


def rows_with(encoder: Encoder, threads: int) -> list[list[str]]:
    """Rows of the table: milliseconds of both, and how many times as fast C++ is."""
    use_threads(threads)
    rows = []
    for log2_rows in LOG2_ROWS["cpu"]:
        shape, params = shape_of(log2_rows), settings(log2_rows, "cpu")
        for name, pair in (
            ("encoding", [encoding_pass(each.encode, shape.sdf_grid) for each in (CHOSEN, encoder)]),
            ("networks' step", [networks_step(shape, each) for each in (CHOSEN, encoder)]),
            ("whole step", [training_step(ball_trainer(params), each) for each in (CHOSEN, encoder)]),
        ):
            numba, cpp = alternate(*pair)
            times = (f"{1000 * numba:.1f}", f"{1000 * cpp:.1f}", f"{numba / cpp:.2f}")
            rows.append([f"2^{log2_rows}", str(threads), name, *times])
    return rows


def main(argv: Sequence[str] | None = None) -> int:
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args(argv)
    with tempfile.TemporaryDirectory() as folder:
        try:
            library = compiled(Path(folder))
        except (OSError, subprocess.CalledProcessError) as error:
            print(f"C++ could not be compiled: {error}", file=sys.stderr)
            return 1
        grid = shape_of(LOG2_ROWS["cpu"][0]).sdf_grid
        print(f"Off from the reference by {encodings.disagreement(CppKernels(library), grid, 'cpu'):.1e} at most.\n")
        counts = sorted({1, torch.get_num_threads()})
        rows = [row for threads in counts for row in rows_with(cpp_encoder(library), threads)]
    header = ["rows a level", "threads", "what", "numba, ms", "C++, ms", "numba / C++"]
    print(markdown_table(header, rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
