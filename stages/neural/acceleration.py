"""Which implementation takes a tensor: the numba kernels, or plain PyTorch."""

from __future__ import annotations

import logging
from functools import cache

import torch

log = logging.getLogger(__name__)


def takes_kernel(*tensors: torch.Tensor) -> bool:
    """Whether the kernels of `stages.neural.kernels` take these: float32 on the CPU, and numba is there."""
    return all(t.device.type == "cpu" and t.dtype == torch.float32 for t in tensors) and _has_numba()


@cache
def _has_numba() -> bool:
    """Says once what goes missing without it."""
    try:
        import numba  # noqa: F401
    except ImportError as error:
        log.warning("no CPU kernels (%s): training in plain PyTorch, about three times slower", error)
        return False
    return True
