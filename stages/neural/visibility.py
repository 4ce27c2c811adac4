"""Which photos see a surface point, and how far they disagree on its colour (paper: SDF-guided multi-view consistency).

Shapes: R surface points, I photos, K samples on a path. Nothing here carries a gradient.
"""

from __future__ import annotations

import torch

from stages.neural.photos import Photos
from stages.neural.sampling import SdfCache

# Paper: sharpness of the sigmoid in eq. sdf_visibility, per scene unit, and the visibility from which a view counts.
SHARPNESS = 100.0
VISIBLE = 0.9
# Keeps the colour covariance invertible where photos are nearly grey: one 8-bit level, squared.
_COLOR_VARIANCE_FLOOR = (1 / 255) ** 2


def sdf_visibility_literal(path_sdf: torch.Tensor, sharpness: float = SHARPNESS) -> torch.Tensor:
    """V = prod_k sigmoid(beta f(x_k)) [...] over samples [..., K] on the path from a camera to a surface point.

    The paper's eq. sdf_visibility and Alg. 1 as written. The samples near the surface have f ~ 0 and count 1/2 each,
    so V shrinks as K grows, also for points in plain view.
    """
    return torch.sigmoid(sharpness * path_sdf).prod(-1)


def sdf_visibility(min_sdf: torch.Tensor, sharpness: float = SHARPNESS) -> torch.Tensor:
    """V = sigmoid(beta (min_k f(x_k) + 3 / beta)) [...] from the smallest f on a path that ends short of the surface.

    About 0.95 where the path just touches a surface and more in free space, whatever K; above 0.9 from
    min f = -0.8 / beta on, and 0.05 at -6 / beta.
    """
    return torch.sigmoid(sharpness * min_sdf + 3)


def path_margin(facing: torch.Tensor, scale: float, voxel: float) -> torch.Tensor:
    """How far from the surface a path starts [...], so that the surface itself does not hide the point.

    delta = max(4 b, 2 h) / max(n.d, 0.2), scene units: a path that leaves at a grazing angle needs more length to gain
    the same height over the surface. b Laplace scale, h voxel size, n.d cosine between normal and path.
    """
    return max(4 * scale, 2 * voxel) / facing.clamp(min=0.2)


def smallest_sdf_on_paths(
    cache: SdfCache, points: torch.Tensor, targets: torch.Tensor, start: torch.Tensor, num_samples: int = 32
) -> torch.Tensor:
    """Smallest cached f [P] between distance `start` [P] from points [P, 3] and targets [P, 3] or the unit sphere.

    On the CPU a kernel walks the paths by sphere tracing and stops at the first solid place; elsewhere they are
    sampled evenly.
    """
    if not points.is_cuda:
        from stages.neural import kernels

        smallest = torch.empty(len(points))
        kernels.smallest_on_paths(
            cache.values[0, 0].numpy(), points.numpy(), targets.numpy(), start.numpy(), smallest.numpy()
        )
        return smallest
    offsets = targets - points
    length = torch.linalg.vector_norm(offsets, dim=1)
    directions = offsets / length[:, None]
    middle = -(points * directions).sum(1)
    exit_distance = middle + (middle**2 + 1 - (points**2).sum(1)).clamp(min=0).sqrt()
    end = torch.minimum(length, exit_distance).clamp(min=start)
    share = torch.linspace(0, 1, num_samples, device=points.device)
    distances = start[:, None] + (end - start)[:, None] * share
    return cache.lookup(points[:, None] + distances[..., None] * directions[:, None]).min(1).values


def color_precision(photos: Photos, generator: torch.Generator, num_pixels: int = 100_000) -> torch.Tensor:
    """Inverse [3, 3] of the empirical colour covariance over the training photos, regularised (paper: Sigma^-1)."""
    rows = torch.randint(len(photos.pixels), (num_pixels,), generator=generator, device=photos.device)
    covariance = torch.cov((photos.pixels[rows].float() / 255).T)
    return torch.linalg.inv(covariance + _COLOR_VARIANCE_FLOOR * torch.eye(3, device=photos.device))


def mahalanobis(colors: torch.Tensor, others: torch.Tensor, precision: torch.Tensor) -> torch.Tensor:
    """D_M = sqrt((C_i - C_j)^T Sigma^-1 (C_i - C_j)) [...] for colours [..., 3] (paper eq. ambiguity_factor)."""
    difference = colors - others
    return torch.einsum("...a,ab,...b->...", difference, precision, difference).clamp(min=0).sqrt()


def ambiguity(visibility: torch.Tensor, distance: torch.Tensor) -> torch.Tensor:
    """lambda [R] = mean over the visible views of V_j D_M(C_i, C_j), V and D_M [R, I] (paper eq. ambiguity_factor).

    A view is visible when V_j > 0.9. Zero where no view is.
    """
    seen = (visibility > VISIBLE).to(visibility.dtype)
    return (seen * visibility * distance).sum(1) / seen.sum(1).clamp(min=1)


def trust(lambda_ambiguity: torch.Tensor) -> torch.Tensor:
    """Weight of each ray's colour error [R]: 1 / (1 + lambda), scaled to mean 1 (paper eq. loss_without_ambiguity).

    The mean is held, so that doubt in some rays does not shift the balance against the other terms.
    """
    weights = 1 / (1 + lambda_ambiguity)
    return weights / weights.mean()
