"""What suits a device: numba kernels or plain PyTorch, rows picked out or shapes that stay, products how precise."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from typing import TYPE_CHECKING

import torch
from torch import Tensor

if TYPE_CHECKING:
    from jaxtyping import Bool, Int

log = logging.getLogger(__name__)

# The first GPUs (NVIDIA Ampere) that multiply in bfloat16 and TF32; older ones would do so slowly or not at all.
SHORT_CAPABILITY = (8, 0)
# Devices that work while the host goes on. To ask for a number, or for how many rows pass a test, is to wait for them.
ASYNCHRONOUS = {"cuda"}
# Rays rendered at once where nothing is learned from them, and what they are called where memory runs out.
RAYS_AT_ONCE, RENDERED = 4096, "rays of a picture"


def takes_kernel(*tensors: Tensor) -> bool:
    """Whether the kernels of `stages.neural.kernels` take these: float32 on the CPU, and numba is there."""
    return all(t.device.type == "cpu" and t.dtype == torch.float32 for t in tensors) and _has_numba()


def fixed_shapes(device: torch.device) -> bool:
    """Whether shapes should not depend on the data: on CUDA all rows are computed and those not needed masked out.

    On the CPU only the rows that are needed are computed.
    """
    return device.type in ASYNCHRONOUS


def points_at_a_time(device: torch.device) -> int:
    """How many points to evaluate in one go where there are many: what stays in a core's cache, or fills a GPU."""
    return 1 << 13 if device.type == "cpu" else 1 << 17


def first_rows(chosen: Bool[Tensor, " n"], count: int) -> Int[Tensor, " {count}"]:
    """Indices of the first rows that are chosen, from the start again where they are fewer.

    Without waiting for how many they are. Where none is chosen, the last row.
    """
    upto = torch.cumsum(chosen, 0)
    rank = torch.arange(count, device=chosen.device) % upto[-1].clamp(min=1)
    return torch.searchsorted(upto, rank + 1).clamp(max=len(chosen) - 1)


def is_mixed(precision: str, device: torch.device) -> bool:
    """Whether the setting `train.precision` means mixed precision on this device."""
    if precision == "auto":
        return device.type == "cuda" and torch.cuda.get_device_capability(device) >= SHORT_CAPABILITY
    return precision == "mixed"


@contextmanager
def short_products(wanted: bool, device: torch.device) -> Iterator[None]:
    """Where wanted, float32 products on CUDA take 10 bits of their factors' mantissas and sum in float32 (TF32).

    Not for all of a program: a ray's direction is a product, too, and would be off by half a pixel.
    """
    if not wanted or device.type != "cuda":
        yield
        return
    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision("high")
    try:
        yield
    finally:
        torch.set_float32_matmul_precision(before)


@cache
def _has_numba() -> bool:
    """Says once what goes missing without it."""
    try:
        import stages.compiling  # noqa: F401
    except ImportError as error:
        log.warning("no CPU kernels (%s): training in plain PyTorch, about three times slower", error)
        return False
    return True
