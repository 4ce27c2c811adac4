"""Volume rendering along rays (paper eq. radiance).

Shapes: R rays, K samples a ray, sorted from near to far.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from stages.neural.acceleration import takes_kernel
from stages.neural.density import (
    FLAT,
    logistic_section_optical_depth,
    outline_correction,
    section_optical_depth,
)

if TYPE_CHECKING:
    from jaxtyping import Float

# Keeps the means over a ray finite where it meets nothing.
_OPACITY_FLOOR = 1e-4


def rendering_weights(
    sdf: Float[Tensor, "r k"],
    distances: Float[Tensor, "r k"],
    scale: Float[Tensor, ""] | float,
    outlined: Float[Tensor, "r k"],
    density: str = "laplace",
) -> tuple[Float[Tensor, "r k"], Float[Tensor, " r"]]:
    """Rendering weights of samples with f at distances, and the transmittance behind them.

    `weights_from_optical_depth` of `sample_optical_depths`; on the CPU in one pass each way where the scale is a number
    and the density that of "laplace".
    """
    if density == "laplace" and isinstance(scale, float) and takes_kernel(sdf):
        return _KernelWeights.apply(sdf, distances, outlined, scale)
    return weights_from_optical_depth(sample_optical_depths(sdf, distances, scale, outlined, density))


def sample_optical_depths(
    sdf: Float[Tensor, "r k"],
    distances: Float[Tensor, "r k"],
    scale: Float[Tensor, ""] | float,
    outlined: Float[Tensor, "r k"] | None = None,
    density: str = "laplace",
) -> Float[Tensor, "r k"]:
    """Optical depth of each sample's own stretch of the ray, half way to its neighbours.

    f is taken as piecewise linear between the samples at their distances, and integrated exactly. So sparse
    samples cannot invent a crossing that f does not have, and a crossing between two samples is shared by both.
    The density is that of "laplace", or the logistic one of "neus".

    Args:
        outlined: how far the density of "laplace" gets the `outline_correction`, on the stretch of each sample, in
            [0, 1]; nowhere if not given.
    """
    middle = 0.5 * (sdf[:, 1:] + sdf[:, :-1])
    if density == "neus":
        near_half = logistic_section_optical_depth(sdf[:, :-1], middle, scale)
        far_half = logistic_section_optical_depth(middle, sdf[:, 1:], scale)
    else:
        delta = 0.5 * (distances[:, 1:] - distances[:, :-1])
        near_half = section_optical_depth(sdf[:, :-1], middle, delta, scale)
        far_half = section_optical_depth(middle, sdf[:, 1:], delta, scale)
        if outlined is not None:
            near_half = near_half + outlined[:, :-1] * outline_correction(sdf[:, :-1], middle, delta, scale)
            far_half = far_half + outlined[:, 1:] * outline_correction(middle, sdf[:, 1:], delta, scale)
    return torch.nn.functional.pad(near_half, (0, 1)) + torch.nn.functional.pad(far_half, (1, 0))


def weights_from_optical_depth(tau: Float[Tensor, "r k"]) -> tuple[Float[Tensor, "r k"], Float[Tensor, " r"]]:
    """Rendering weights and the transmittance left behind the last sample.

    w_k = T_k (1 - exp(-tau_k)), T_k = exp(-sum_{j<k} tau_j); the weights and what is left sum to 1.
    """
    total = torch.cumsum(tau, 1)
    transmittance = torch.exp(-torch.nn.functional.pad(total, (1, 0)))
    return transmittance[:, :-1] - transmittance[:, 1:], transmittance[:, -1]


def composite(weights: Float[Tensor, "r k"], values: Float[Tensor, "r k d"]) -> Float[Tensor, "r d"]:
    """Sum over samples of weights times values."""
    return (weights.unsqueeze(-1) * values).sum(1)


def ray_means(
    weights: Float[Tensor, "r k"],
    points: Float[Tensor, "r*k 3"],
    gradients: Float[Tensor, "r*k 3"],
    features: Float[Tensor, "r*k g"],
) -> tuple[Float[Tensor, "r 1"], Float[Tensor, "r 3"], Float[Tensor, "r 3"], Float[Tensor, "r g"]]:
    """Opacity W = sum_k w_k of each ray, and the mean point, unit normal and features of its samples.

    sum_k w_k x_k / W, sum_k w_k n_k / |sum_k w_k n_k|, sum_k w_k z_k / W: where deferred shading asks for one colour.
    A ray that meets nothing has means near 0 and finite gradients.
    """
    normals = torch.nn.functional.normalize(gradients, dim=1)
    values = torch.cat([points, normals, features], 1)
    values = values.view(*weights.shape, values.shape[1])
    opacity = weights.sum(1, keepdim=True)
    means = torch.bmm(weights[:, None], values).squeeze(1) / opacity.clamp(min=_OPACITY_FLOOR)
    point, normal, feature = means.split([3, 3, features.shape[1]], 1)
    return opacity, point, torch.nn.functional.normalize(normal, dim=1), feature


class _KernelWeights(torch.autograd.Function):
    """`rendering_weights` in one pass each way; gradients with respect to f only."""

    @staticmethod
    def forward(ctx, sdf, distances, outlined, scale):
        from stages.neural import kernels

        sdf, distances, outlined = (each.contiguous() for each in (sdf, distances, outlined))
        weights, transmittance = torch.empty(sdf.shape), torch.empty(len(sdf))
        kernels.ray_weights_forward(
            sdf.detach().numpy(), distances.numpy(), outlined.numpy(), scale, FLAT,
            weights.numpy(), transmittance.numpy(),
        )  # fmt: skip
        ctx.save_for_backward(sdf, distances, outlined, weights, transmittance)
        ctx.scale = scale
        return weights, transmittance

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, grad_weights, grad_transmittance):
        from stages.neural import kernels

        sdf, distances, outlined, weights, transmittance = ctx.saved_tensors
        grad_sdf = torch.empty(sdf.shape)
        kernels.ray_weights_backward(
            sdf.numpy(), distances.numpy(), outlined.numpy(), ctx.scale, FLAT, weights.numpy(), transmittance.numpy(),
            grad_weights.contiguous().numpy(), grad_transmittance.contiguous().numpy(), grad_sdf.numpy(),
        )  # fmt: skip
        return grad_sdf, None, None, None
