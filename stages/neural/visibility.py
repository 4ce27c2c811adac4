"""Which photos see a surface point (paper: SDF-guided multi-view consistency, Alg. 1).

Shapes: P paths from a surface point to a camera, K samples on a path.

Visibility carries no gradient and reads the cached SDF grid where it can: the network at P K places would cost 24 times
the rendering (512 rays, 48 photos, 64 samples). Space outside the unit sphere is free: nothing is reconstructed there.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch

from stages.neural.acceleration import takes_kernel
from stages.neural.sampling import SdfCache, free_outside

# Paper: sharpness of the sigmoid in eq. sdf_visibility, per scene unit, and the visibility from which a view counts.
SHARPNESS = 100.0
VISIBLE = 0.9


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

    The mesh is made when it is first asked for, and again after the cache has changed. Raises ModuleNotFoundError
    without Open3D.
    """

    def __init__(self, cache: SdfCache) -> None:
        import open3d

        self.open3d: Any = open3d
        self.cache = cache
        self.version = -1
        self.scene: Any = None

    @torch.no_grad()
    def __call__(self, points: torch.Tensor, centers: torch.Tensor, start: torch.Tensor) -> torch.Tensor:
        """V [P] of points [P, 3] from camera centres [P, 3]: 0 where a face crosses the path between them, else 1.

        The path leaves out the distance `start` [P] (`path_margin`) at the point, or its own faces would hide it.
        """
        o3d = self.open3d
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
        o3d = self.open3d
        squares = torch.linspace(-1, 1, self.cache.resolution, device=self.cache.values.device) ** 2
        radius = (squares[:, None, None] + squares[:, None] + squares).sqrt()
        volume = o3d.core.Tensor(free_outside(self.cache.values[0, 0], radius).cpu().numpy())
        mesh = o3d.t.geometry.TriangleMesh.create_isosurfaces(volume, [0.0])
        scene = o3d.t.geometry.RaycastingScene()
        if len(mesh.vertex.positions):
            mesh.vertex.positions = mesh.vertex.positions * self.cache.cell - 1  # from cells
            scene.add_triangles(mesh)
        return scene
