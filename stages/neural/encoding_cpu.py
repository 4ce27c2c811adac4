"""The hash encoding's kernels on the CPU, tensors in and out: the numba kernels of `stages.neural.kernels`.

What each function computes, and the shapes: `stages.neural.encodings.EncodingKernels`. The Jacobian is held as
[N, 3, C].
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from stages.neural import kernels
from stages.neural.encoding_shapes import HashGrid


def forward(
    points: Tensor, table: Tensor, grid: HashGrid, active_levels: int, with_jacobian: bool
) -> tuple[Tensor, Tensor | None]:
    features = torch.empty(len(points), grid.channels)
    jacobian = torch.empty(len(points), 3, grid.channels) if with_jacobian else None
    kernels.encode_forward(
        points.detach().numpy(), table.detach().numpy(), grid.resolutions, grid.offsets, grid.dense,
        active_levels, features.numpy(), _array(jacobian),
    )  # fmt: skip
    return features, jacobian


def backward(
    points: Tensor,
    grid: HashGrid,
    active_levels: int,
    grad_features: Tensor | None,
    grad_jacobian: tuple[Tensor, Tensor] | None,
    grad_table: Tensor,
) -> None:
    grad_gradients, cotangent = grad_jacobian or (None, None)
    kernels.encode_backward(
        points.detach().numpy(), grid.resolutions, grid.offsets, grid.dense, active_levels,
        _array(grad_features), _array(grad_gradients), _array(cotangent), grad_table.numpy(),
    )  # fmt: skip


def vjp_forward(jacobian: Tensor, cotangent: Tensor) -> Tensor:
    gradients = torch.empty(len(jacobian), 3)
    kernels.vjp_forward(jacobian.numpy(), _array(cotangent.detach()), gradients.numpy())
    return gradients


def vjp_backward(jacobian: Tensor, grad_gradients: Tensor, channels: int) -> Tensor:
    grad_cotangent = torch.empty(len(jacobian), channels)
    kernels.vjp_backward(jacobian.numpy(), _array(grad_gradients), grad_cotangent.numpy())
    return grad_cotangent


def _array(tensor: Tensor | None) -> np.ndarray | None:
    """Row by row in memory: numba compiles for that alone."""
    return None if tensor is None else tensor.contiguous().numpy()
