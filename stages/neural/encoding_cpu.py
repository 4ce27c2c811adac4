"""The hash encoding's kernels on the CPU, tensors in and out: the numba kernels of `stages.neural.kernels`.

What each function computes: `stages.neural.encodings.EncodingKernels`. The Jacobian is held as [N, 3, C].
"""

from __future__ import annotations

import torch

from stages.neural import kernels
from stages.neural.encoding_shapes import HashGrid


def forward(
    points: torch.Tensor, table: torch.Tensor, grid: HashGrid, active_levels: int
) -> tuple[torch.Tensor, torch.Tensor]:
    features = torch.empty(len(points), grid.channels)
    jacobian = torch.empty(len(points), 3, grid.channels)
    kernels.encode_forward(
        points.detach().numpy(), table.detach().numpy(), grid.resolutions, grid.offsets, grid.dense,
        active_levels, features.numpy(), jacobian.numpy(),
    )  # fmt: skip
    return features, jacobian


def features_forward(points: torch.Tensor, table: torch.Tensor, grid: HashGrid, active_levels: int) -> torch.Tensor:
    features = torch.empty(len(points), grid.channels)
    kernels.features_forward(
        points.detach().numpy(), table.detach().numpy(), grid.resolutions, grid.offsets, grid.dense,
        active_levels, features.numpy(),
    )  # fmt: skip
    return features


def backward(
    points: torch.Tensor,
    grid: HashGrid,
    active_levels: int,
    grad_features: torch.Tensor | None,
    grad_jacobian: tuple[torch.Tensor, torch.Tensor] | None,
    grad_table: torch.Tensor,
) -> None:
    arguments = (points.detach().numpy(), grid.resolutions, grid.offsets, grid.dense, active_levels)
    if grad_jacobian is None:
        assert grad_features is not None
        kernels.features_backward(*arguments, grad_features.contiguous().numpy(), grad_table.numpy())
        return
    grad_gradients, cotangent = grad_jacobian
    if grad_features is None:
        grad_features = torch.zeros_like(cotangent)
    kernels.encode_backward(
        *arguments, grad_features.contiguous().numpy(), grad_gradients.contiguous().numpy(),
        cotangent.contiguous().numpy(), grad_table.numpy(),
    )  # fmt: skip


def vjp_forward(jacobian: torch.Tensor, cotangent: torch.Tensor) -> torch.Tensor:
    gradients = torch.empty(len(jacobian), 3)
    kernels.vjp_forward(jacobian.numpy(), cotangent.detach().contiguous().numpy(), gradients.numpy())
    return gradients


def vjp_backward(jacobian: torch.Tensor, grad_gradients: torch.Tensor, channels: int) -> torch.Tensor:
    grad_cotangent = torch.empty(len(jacobian), channels)
    kernels.vjp_backward(jacobian.numpy(), grad_gradients.contiguous().numpy(), grad_cotangent.numpy())
    return grad_cotangent
