"""From signed distance to optical depth along a ray: Laplace density (VolSDF; paper eq. density) or the alpha of NeuS.

Notation: f signed distance (positive outside), b scale in scene units, sigma density per scene unit,
tau optical depth (dimensionless), delta length of a ray section.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import torch
from torch import Tensor

if TYPE_CHECKING:
    from jaxtyping import Float

# Below this change of f over a section, in units of b, the mid-point rule replaces the difference quotient, which
# would lose all its digits in float32; the mid-point's relative error there is (0.05)^2 / 24 ~ 1e-4.
FLAT = 0.05


def laplace_density(sdf: Float[Tensor, "*any"], scale: Float[Tensor, ""] | float) -> Float[Tensor, "*any"]:
    """Density sigma = Psi_b(-f) / b, Psi_b the CDF of the zero-mean Laplace distribution.

    1 / (2b) on the surface, 1 / b deep inside, 0 far outside (paper eq. density with alpha = 1 / b).
    """
    decay = 0.5 * torch.exp(-sdf.abs() / scale)
    return torch.where(sdf >= 0, decay, 1 - decay) / scale


def logistic_section_optical_depth(
    sdf_start: Float[Tensor, "*any"], sdf_end: Float[Tensor, "*any"], scale: Float[Tensor, ""] | float
) -> Float[Tensor, "*any"]:
    """Optical depth tau of ray sections from f at their ends, with the alpha of NeuS (Wang et al. 2021, eq. 13).

    alpha = max((Phi(f_start) - Phi(f_end)) / Phi(f_start), 0), Phi(f) = sigmoid(f / b), and tau = -log(1 - alpha) =
    max(log Phi(f_start) - log Phi(f_end), 0), which keeps its digits deep inside. Zero where f rises along the ray;
    the length of the section does not matter.
    """
    return torch.relu(
        torch.nn.functional.logsigmoid(sdf_start / scale) - torch.nn.functional.logsigmoid(sdf_end / scale)
    )


def _density_integral(sdf: Float[Tensor, "*any"], scale: Float[Tensor, ""] | float) -> Float[Tensor, "*any"]:
    """Integral of b * laplace_density from `sdf` to infinity: its antiderivative, up to sign. Units: scene."""
    return torch.relu(-sdf) + 0.5 * scale * torch.exp(-sdf.abs() / scale)


def _section_mean(
    integral: Callable[[Tensor, Tensor | float], Tensor],
    middle: Float[Tensor, "*any"],
    sdf_start: Float[Tensor, "*any"],
    sdf_end: Float[Tensor, "*any"],
    scale: Float[Tensor, ""] | float,
) -> Float[Tensor, "*any"]:
    """Mean of a function of f over sections, by its antiderivative in f; where f is flat, what it is in the middle.

    Args:
        integral: the antiderivative with the sign of `_density_integral`, of f and the scale.
        middle: the function in the middle of each section.
    """
    change = sdf_end - sdf_start
    flat = change.abs() < FLAT * scale
    quotient = (integral(sdf_start, scale) - integral(sdf_end, scale)) / torch.where(
        flat, torch.ones_like(change), change
    )
    return torch.where(flat, middle, quotient)


def section_optical_depth(
    sdf_start: Float[Tensor, "*any"],
    sdf_end: Float[Tensor, "*any"],
    delta: Float[Tensor, "*#any"],
    scale: Float[Tensor, ""] | float,
) -> Float[Tensor, "*any"]:
    """Optical depth tau of ray sections on which f runs linearly from sdf_start to sdf_end over length delta.

    The exact integral of `laplace_density`, so a section may be far longer than b. Zero where f is large on the
    whole section; delta / b deep inside.
    """
    middle = laplace_density(0.5 * (sdf_start + sdf_end), scale) * scale
    return _section_mean(_density_integral, middle, sdf_start, sdf_end, scale) * delta / scale


def outline_correction(
    sdf_start: Float[Tensor, "*any"],
    sdf_end: Float[Tensor, "*any"],
    delta: Float[Tensor, "*#any"],
    scale: Float[Tensor, ""] | float,
) -> Float[Tensor, "*any"]:
    """What makes of `section_optical_depth` one by which outlines are where f is 0: the density outside counts by how
    fast f changes along the ray, sigma |df/dt| for f > 0.

    `laplace_density` stops a ray that passes beside a surface as far as 3 b from it, so that things come out that much
    smaller than their outlines. Zhang et al. (Towards unbiased volume rendering of neural implicit surfaces with
    geometry priors, CVPR 2023) scale the density inside, too; then what is solid lets light through where f is even.
    """
    middle = 0.5 * (sdf_start + sdf_end)
    outside = torch.where(middle >= 0, laplace_density(middle, scale) * scale, 0.0)
    mean = _section_mean(_outside_integral, outside, sdf_start, sdf_end, scale)
    return mean * ((sdf_end - sdf_start).abs() - delta) / scale


def _outside_integral(sdf: Float[Tensor, "*any"], scale: Float[Tensor, ""] | float) -> Float[Tensor, "*any"]:
    """The part of `_density_integral` that is outside: constant for f < 0."""
    return 0.5 * scale * torch.exp(-torch.relu(sdf) / scale)
