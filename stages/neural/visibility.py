"""Which photos see a surface point, and how far they disagree on its colour (paper: SDF-guided multi-view consistency).

Shapes: R rays, I photos, P paths from a surface point to a camera, K samples on a path.

Visibility carries no gradient and reads the cached SDF grid where it can: the network at P K places would cost 24 times
the rendering (512 rays, 48 photos, 64 samples). Space outside the unit sphere is free: nothing is reconstructed there.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch

from stages.errors import ReconstructionError, SystemRequirementError
from stages.neural.acceleration import takes_kernel
from stages.neural.sampling import SdfCache, free_outside
from stages.neural.training_photos import Photos

# Paper: sharpness of the sigmoid in eq. sdf_visibility, per scene unit, and the visibility from which a view counts.
SHARPNESS = 100.0
VISIBLE = 0.9
# Keeps the colour covariance invertible where photos are nearly grey: one 8-bit level, squared.
_COLOR_VARIANCE_FLOOR = (1 / 255) ** 2
# A covariance whose smallest eigenvalue is this small a part of the largest has no inverse worth the name.
_SINGULAR = 1e-9
# Smallest squared Mahalanobis distance: keeps the root's gradient finite where two colours agree.
_SQUARED_DISTANCE_FLOOR = 1e-12


def sdf_visibility_literal(path_sdf: torch.Tensor, sharpness: float = SHARPNESS) -> torch.Tensor:
    """V = prod_k sigmoid(beta f(x_k)) [...] over samples [..., K] on the path from a camera to a surface point.

    The paper's eq. sdf_visibility and Alg. 1 as written. The samples near the surface have f ~ 0 and count 1/2 each,
    so V shrinks as K grows, also for points in plain view.
    """
    return torch.sigmoid(sharpness * path_sdf).prod(-1)


@torch.no_grad()
def visibility_literal(
    sdf: Callable[[torch.Tensor], torch.Tensor],
    points: torch.Tensor,
    centers: torch.Tensor,
    num_samples: int,
    generator: torch.Generator | None,
    sharpness: float = SHARPNESS,
) -> torch.Tensor:
    """V [P] of surface points [P, 3] from camera centres [P, 3]: the paper's Alg. 1 as written.

    `sdf` gives f [...] at points [..., 3]: the network, as in the paper, or the cached grid for a fraction of the time.

    `num_samples` places drawn uniformly from the whole path, both ends included. On an unobstructed path of length L
    that leaves the surface at a right angle, the mean of V is (1 - ln 2 / (beta L))^K.
    """
    share = torch.rand(len(points), num_samples, 1, generator=generator, device=points.device)
    places = centers[:, None] + share * (points - centers)[:, None]
    path_sdf = free_outside(sdf(places), torch.linalg.vector_norm(places, dim=2))
    return sdf_visibility_literal(path_sdf, sharpness)


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
    cache: SdfCache,
    points: torch.Tensor,
    targets: torch.Tensor,
    start: torch.Tensor,
    num_samples: int = 32,
    sharpness: float = SHARPNESS,
) -> torch.Tensor:
    """Smallest cached f [P] between distance `start` [P] from points [P, 3] and targets [P, 3] or the unit sphere.

    On the CPU a kernel walks the paths by sphere tracing and stops at -10 / sharpness, where V is 1e-3 and the rest of
    the path cannot matter; elsewhere they are sampled evenly.
    """
    if takes_kernel(points):
        from stages.neural import kernels

        smallest = torch.empty(len(points))
        kernels.smallest_on_paths(
            cache.values[0, 0].numpy(), points.numpy(), targets.numpy(), start.numpy(), np.float32(-10 / sharpness),
            smallest.numpy(),
        )  # fmt: skip
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


class MeshVisibility:
    """Visibility by casting rays at a triangle mesh of the cached SDF (Ref-NeuS; the paper's ablation).

    The mesh is made when it is first asked for, and again after the cache has changed. Needs Open3D.
    """

    def __init__(self, cache: SdfCache) -> None:
        self.cache = cache
        self.version = -1
        self.scene: Any = None

    @torch.no_grad()
    def __call__(self, points: torch.Tensor, centers: torch.Tensor, start: torch.Tensor) -> torch.Tensor:
        """V [P] of points [P, 3] from camera centres [P, 3]: 0 where a face crosses the path between them, else 1.

        The path leaves out the distance `start` [P] (`path_margin`) at the point, or its own faces would hide it.
        """
        o3d = _open3d()
        if self.version != self.cache.values._version:  # torch counts the writes to a tensor
            self.scene = self._mesh_scene()
            self.version = self.cache.values._version
        offsets = centers - points
        share = (start / torch.linalg.vector_norm(offsets, dim=1)).clamp(max=1)[:, None]
        rays = torch.cat([points + share * offsets, (1 - share) * offsets], 1)
        hidden = self.scene.test_occlusions(o3d.core.Tensor(rays.cpu().numpy()), tnear=0.0, tfar=1.0)
        return 1 - torch.from_numpy(hidden.numpy()).to(points)

    def _mesh_scene(self) -> Any:
        """Open3D's ray caster of the zero level set (flying edges, Schroeder et al. 2015), scene units."""
        o3d = _open3d()
        squares = torch.linspace(-1, 1, self.cache.resolution, device=self.cache.values.device) ** 2
        radius = (squares[:, None, None] + squares[:, None] + squares).sqrt()
        volume = o3d.core.Tensor(free_outside(self.cache.values[0, 0], radius).cpu().numpy())
        mesh = o3d.t.geometry.TriangleMesh.create_isosurfaces(volume, [0.0])
        scene = o3d.t.geometry.RaycastingScene()
        if len(mesh.vertex.positions):
            mesh.vertex.positions = mesh.vertex.positions * self.cache.cell - 1  # from cells
            scene.add_triangles(mesh)
        return scene


def _open3d() -> Any:
    try:
        import open3d
    except ModuleNotFoundError as error:
        raise SystemRequirementError(
            "train.visibility=mesh needs the Python package open3d, which is not installed.",
            "Run `pip install open3d`, or use `--set train.visibility=stable`.",
        ) from error
    return open3d


def color_precision(
    photos: Photos, generator: torch.Generator, num_pixels: int = 100_000, floor: float = _COLOR_VARIANCE_FLOOR
) -> torch.Tensor:
    """Inverse [3, 3] of the empirical colour covariance over the training photos (paper: Sigma^-1).

    `floor` is added to each channel's variance. The paper adds none (0): photos in shades of one colour then have no
    inverse, a `ReconstructionError`.
    """
    training = torch.nonzero(photos.training).squeeze(1)
    images = training[torch.randint(len(training), (num_pixels,), generator=generator, device=photos.device)]
    place = torch.rand(num_pixels, generator=generator, device=photos.device, dtype=torch.float64)
    rows = photos.first[images] + (place * photos.sizes[images].prod(1)).long()
    if photos.masks is not None:
        rows = rows[photos.masks[rows] > 127]
    covariance = torch.cov((photos.pixels[rows].double() / 255).T) + floor * torch.eye(3, device=photos.device)
    if torch.linalg.matrix_rank(covariance, rtol=_SINGULAR, hermitian=True) < 3:
        raise ReconstructionError(
            "The photos' colours do not span all three channels (grey photos?), so their covariance has no inverse: "
            "train.ambiguity=paper cannot compare them.",
            "Use `--set train.ambiguity=stable`, which regularises it.",
        )
    return torch.linalg.inv(covariance).float()


def mahalanobis(colors: torch.Tensor, others: torch.Tensor, precision: torch.Tensor) -> torch.Tensor:
    """D_M = sqrt((C_i - C_j)^T Sigma^-1 (C_i - C_j)) [...] for colours [..., 3] (paper eq. ambiguity_factor).

    At least 1e-6, without a gradient there. The paper's C_i is the rendered colour, and D_M pulls at it.
    """
    difference = colors - others
    squared = torch.einsum("...a,ab,...b->...", difference, precision, difference)
    return squared.clamp(min=_SQUARED_DISTANCE_FLOOR).sqrt()


def ambiguity(visibility: torch.Tensor, distance: torch.Tensor) -> torch.Tensor:
    """lambda [R] = mean over the visible views of V_j D_M(C_i, C_j), V and D_M [R, I] (paper eq. ambiguity_factor).

    A view is visible when V_j > 0.9. Zero where no view is.
    """
    seen = (visibility > VISIBLE).to(visibility.dtype)
    return (seen * visibility * distance).sum(1) / seen.sum(1).clamp(min=1)


def trust_literal(lambda_ambiguity: torch.Tensor) -> torch.Tensor:
    """Weight of each ray's colour error [R]: 1 / (1 + lambda) (paper eq. loss_without_ambiguity as written).

    Differentiable: where lambda comes from rendered colours, the loss can also be lowered by raising lambda.
    """
    return 1 / (1 + lambda_ambiguity)


def trust(lambda_ambiguity: torch.Tensor) -> torch.Tensor:
    """Weight of each ray's colour error [R]: sg[1 / (1 + lambda)], scaled to mean 1 (paper eq. loss_without_ambiguity).

    The mean is held, so that doubt in some rays does not shift the balance against the other terms. Detached: else the
    error could be lowered by raising the doubt.
    """
    weights = trust_literal(lambda_ambiguity.detach())
    return weights / weights.mean()
