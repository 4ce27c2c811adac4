"""Losses: one pure function per equation, unreduced and unweighted. Weights meet in one sum in `trainer.py`.

Tensors in, tensor out; model queries happen before the call. Shapes: R rays, N points.
"""

from __future__ import annotations

import torch

# Keeps the norm's gradient finite where prediction and photo agree; far below one 8-bit grey level (4e-3).
_NORM_EPSILON = 1e-3
# The relaxed Eikonal term keeps at least this weight, or f stops being a distance and every other term breaks.
_RELAXATION_FLOOR = 0.2
# Slope error from which the planar term pulls linearly: about 6 degrees, so that a sharp edge is not rounded away.
_PLANAR_DELTA = 0.1
# The literal planar term divides by a length, which may be 0.
_LENGTH_FLOOR = 1e-9


def rgb_error(predicted: torch.Tensor, observed: torch.Tensor) -> torch.Tensor:
    """Colour error ||C - C_hat||_2 per ray [R], colours [R, 3] in [0, 1] (paper L_rgb).

    Smoothed near zero: sqrt(|d|^2 + e^2) - e with e = 1e-3. Zero where the colours agree.
    """
    squared = ((predicted - observed) ** 2).sum(-1)
    return torch.sqrt(squared + _NORM_EPSILON**2) - _NORM_EPSILON


def eikonal_error(gradients: torch.Tensor) -> torch.Tensor:
    """(||grad f|| - 1)^2 per point [N] for gradients [N, 3].

    Gropp et al. 2020; the paper's eq. relaxed_eikonal with omega = 1. Zero where f grows at one unit per unit.
    """
    return (torch.linalg.vector_norm(gradients, dim=-1) - 1) ** 2


def sparse_point_error(sdf: torch.Tensor, tolerance: float) -> torch.Tensor:
    """Huber distance of SfM points to the surface [N]: f should vanish there (Geo-NeuS).

    f^2 / (2 tolerance) within the tolerance (scene units), |f| - tolerance / 2 beyond: an outlier pulls no harder
    than its neighbours.
    """
    distance = sdf.abs()
    return torch.where(distance < tolerance, distance**2 / (2 * tolerance), distance - 0.5 * tolerance)


def eikonal_relaxation_literal(
    photo_error: torch.Tensor, planarity: torch.Tensor, gamma: float = 5.0, clip: float = 0.2
) -> torch.Tensor:
    """omega [...] = planarity exp(-gamma min(err, clip)) (paper eq. adaptive_weight as written).

    Differentiable in both, since the paper stops neither: a higher colour error, below the clip, then lowers the
    Eikonal loss. Never above the planarity, which in its literal form is about 1e-3: so is the whole term.
    """
    return planarity * torch.exp(-gamma * photo_error.clamp(max=clip))


def eikonal_relaxation(
    photo_error: torch.Tensor, planarity: torch.Tensor | float = 1.0, gamma: float = 5.0, clip: float = 0.2
) -> torch.Tensor:
    """omega [...] = sg[w + (1 - w) exp(-gamma min(err, clip)) (1 + planarity) / 2], w = 0.2.

    The paper's eq. adaptive_weight. 1 where the photo is met, falling where the colour error err is large, so that
    detail may bend f there. The paper's omega = lambda_pla exp(-gamma err) vanishes with its lambda_pla ~ 1e-3; this
    one never falls below w, which keeps f metric. Detached: else the error could be raised to be rid of the
    constraint.
    """
    decay = torch.exp(-gamma * photo_error.clamp(max=clip))
    return (_RELAXATION_FLOOR + (1 - _RELAXATION_FLOOR) * decay * (0.5 + 0.5 * planarity)).detach()


def planar_error_literal(sdf: torch.Tensor, normals: torch.Tensor, offsets: torch.Tensor) -> torch.Tensor:
    """|f(x_k) / |x_k - x_0| - n_0.(x_k - x_0) / |x_k - x_0|| per neighbour [Q, K] (paper L_planar as written).

    sdf [Q, K] at x_0 + offsets [Q, K, 3], unit normals [Q, 3] at x_0. The paper takes x_k on the viewing ray before
    x_0. Zero for a plane only where f(x_0) = 0; f(x_0) / |x_k - x_0| otherwise, without bound near x_0.
    """
    length = torch.linalg.vector_norm(offsets, dim=2).clamp(min=_LENGTH_FLOOR)
    return (sdf / length - torch.einsum("qc,qkc->qk", normals, offsets) / length).abs()


def planar_error(
    sdf: torch.Tensor, sdf_center: torch.Tensor, normals: torch.Tensor, offsets: torch.Tensor, radius: float
) -> torch.Tensor:
    """Huber of (f(x_k) - f(x_0) - n_0.(x_k - x_0)) / max(|x_k - x_0|, eta/4) per neighbour [Q, K] (paper L_planar).

    How far f is from linear around surface points: sdf [Q, K] at x_0 + offsets [Q, K, 3], sdf_center [Q] and unit
    normals [Q, 3] at x_0, eta = radius. Zero for a plane at any distance. The paper leaves f(x_0) out, divides by
    |x_k - x_0| alone and takes the absolute value: an x_0 that is off by 1e-3 then outweighs the shape.
    """
    linear = sdf_center[:, None] + torch.einsum("qc,qkc->qk", normals, offsets)
    length = torch.linalg.vector_norm(offsets, dim=2).clamp(min=0.25 * radius)
    return torch.nn.functional.huber_loss(sdf / length, linear / length, reduction="none", delta=_PLANAR_DELTA)


def planarity_literal(features: torch.Tensor, center_features: torch.Tensor, epsilon: float = 1e-3) -> torch.Tensor:
    """lambda_pla [Q, K] = epsilon / (|c(x_k) - c(x_0)| + epsilon) (paper lambda_pla^k as written).

    1 for equal features [Q, K, F] and [Q, F], about 1e-3 for features that differ by 1. Differentiable, since the
    paper does not stop it: pulling features apart lowers the loss.
    """
    return epsilon / (torch.linalg.vector_norm(features - center_features[:, None], dim=2) + epsilon)


def planarity(features: torch.Tensor, center_features: torch.Tensor) -> torch.Tensor:
    """lambda_pla [Q, K] = sg[tau / (|c(x_k) - c(x_0)| + tau)], tau the batch's median difference (paper lambda_pla^k).

    Near 1 where the appearance features [Q, K, F] equal those at the centre [Q, F], 1/2 at the median. The paper's
    tau = 1e-3 drives it to ~1e-3 everywhere. Detached: else features would be pulled apart to be rid of the term.
    """
    difference = torch.linalg.vector_norm(features - center_features[:, None], dim=2).detach()
    tau = difference.median().clamp(min=1e-6)
    return tau / (difference + tau)


def outside_error(sdf: torch.Tensor, margin: float) -> torch.Tensor:
    """max(0, margin - f) per point [N] that is known to be free, scene units; zero from the margin on.

    A line of sight is free up to the SfM point at its end: what the first sphere covers of it must go.
    """
    return torch.relu(margin - sdf)


def inside_error(sdf: torch.Tensor, margin: float) -> torch.Tensor:
    """max(0, f + margin) per point [N] that is known to be solid, scene units; zero below -margin.

    Right behind an SfM point there is something. Without this f may touch zero at the points and stay positive behind
    them: a surface that is not there, which the background model is free to paint.
    """
    return torch.relu(sdf + margin)


def mask_error(opacity: torch.Tensor, mask: torch.Tensor) -> torch.Tensor:
    """Binary cross-entropy per ray [R] between the rendered opacity and the mask, both in [0, 1] (NeuS, L_mask)."""
    return torch.nn.functional.binary_cross_entropy(opacity.clamp(1e-3, 1 - 1e-3), mask, reduction="none")


def exposure_error(log_gains: torch.Tensor) -> torch.Tensor:
    """Squared log gain per photo and channel [I, 3]: holds the photos' mean exposure at 1."""
    return log_gains**2
