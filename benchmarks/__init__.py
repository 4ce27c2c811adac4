"""Measurements, each a command: `python -m benchmarks.NAME --help`."""

import stages  # noqa: F401  first: it says how waiting threads wait, which PyTorch and numba read when imported
