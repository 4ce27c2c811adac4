"""Losses: one pure function per equation, unreduced and unweighted. Weights meet in one sum in `trainer.py`.

Those of the paper's terms are beside them, in `terms`.

Tensors in, tensor out; model queries happen before the call. Shapes: r rays, n points, i photos.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

if TYPE_CHECKING:
    from jaxtyping import Float

# Keeps the norm's gradient finite where prediction and photo agree; far below one 8-bit grey level (4e-3).
_NORM_EPSILON = 1e-3


def rgb_error(predicted: Float[Tensor, "r 3"], observed: Float[Tensor, "r 3"]) -> Float[Tensor, " r"]:
    """Colour error ||C - C_hat||_2 per ray, colours in [0, 1] (paper L_rgb).

    Smoothed near zero: sqrt(|d|^2 + e^2) - e with e = 1e-3. Zero where the colours agree.
    """
    squared = ((predicted - observed) ** 2).sum(-1)
    return torch.sqrt(squared + _NORM_EPSILON**2) - _NORM_EPSILON


def eikonal_error(gradients: Float[Tensor, "n 3"]) -> Float[Tensor, " n"]:
    """(||grad f|| - 1)^2 per point.

    Gropp et al. 2020; the paper's eq. relaxed_eikonal with omega = 1. Zero where f grows at one unit per unit.
    """
    return (torch.linalg.vector_norm(gradients, dim=-1) - 1) ** 2


def sparse_point_error(sdf: Float[Tensor, " n"], tolerance: float) -> Float[Tensor, " n"]:
    """Huber distance of SfM points to the surface: f should vanish there (Geo-NeuS).

    f^2 / (2 tolerance) within the tolerance (scene units), |f| - tolerance / 2 beyond: an outlier pulls no harder
    than its neighbours.
    """
    distance = sdf.abs()
    return torch.where(distance < tolerance, distance**2 / (2 * tolerance), distance - 0.5 * tolerance)


def outside_error(sdf: Float[Tensor, " n"], margin: float) -> Float[Tensor, " n"]:
    """max(0, margin - f) per point that is known to be free, scene units; zero from the margin on.

    A line of sight is free up to the SfM point at its end: what the first sphere covers of it must go.
    """
    return torch.relu(margin - sdf)


def inside_error(sdf: Float[Tensor, " n"], margin: float) -> Float[Tensor, " n"]:
    """max(0, f + margin) per point that is known to be solid, scene units; zero below -margin.

    Right behind an SfM point there is something. Without this f may touch zero at the points and stay positive behind
    them: a surface that is not there, which the background model is free to paint.
    """
    return torch.relu(sdf + margin)


def mask_error(opacity: Float[Tensor, " r"], mask: Float[Tensor, " r"]) -> Float[Tensor, " r"]:
    """Binary cross-entropy per ray between the rendered opacity and the mask, both in [0, 1] (NeuS, L_mask)."""
    return torch.nn.functional.binary_cross_entropy(opacity.clamp(1e-3, 1 - 1e-3), mask, reduction="none")


def exposure_error(log_gains: Float[Tensor, "i 3"]) -> Float[Tensor, "i 3"]:
    """Squared log gain per photo and channel: holds the photos' mean exposure at 1."""
    return log_gains**2
