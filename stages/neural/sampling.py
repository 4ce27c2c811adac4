"""Where along a ray to look: inside the unit sphere, near the surface of a cached SDF grid.

Shapes: r rays, k samples a ray. Distances are along the ray, scene units.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from stages.blocks import in_blocks
from stages.neural.acceleration import fixed_shapes, points_at_a_time, takes_kernel
from stages.neural.density import FLAT, section_optical_depth
from stages.neural.rendering import weights_from_optical_depth

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int

# Part of the samples spread evenly over the ray, so that a surface the cache has missed can still be found.
EVEN_SHARE = 0.15
# And this much weight in any case, so that a ray that meets nothing has samples too.
_EVEN_FLOOR = 1e-4
# The cache is read at the edges of so many even bins of a ray.
_NUM_BINS = 64
# A ray enters the sphere no nearer than this, scene units: a camera may stand inside.
_NEAR = 0.02
# Part of the unit sphere that a refresh near the surface takes on CUDA: a band of 4 cells to either side of a sphere
# that fills the region has two fifths of it in a grid of 96 cells a side, and less in a finer one.
_NEAREST_SHARE = 0.5


@dataclass(frozen=True)
class Rays:
    """Rays that cross the region of interest.

    Attributes:
        origins, directions: scene frame, directions unit.
        entry, leave: distances at which the ray crosses the unit sphere.
    """

    origins: Float[Tensor, "r 3"]
    directions: Float[Tensor, "r 3"]
    entry: Float[Tensor, " r"]
    leave: Float[Tensor, " r"]

    def __len__(self) -> int:
        return len(self.origins)

    def at(self, distances: Float[Tensor, "r k"]) -> Float[Tensor, "r k 3"]:
        """Points on the rays."""
        return self.origins[:, None] + distances[..., None] * self.directions[:, None]


def intersect_unit_sphere(
    origins: Float[Tensor, "r 3"], directions: Float[Tensor, "r 3"]
) -> tuple[Float[Tensor, " r"], Float[Tensor, " r"], Bool[Tensor, " r"]]:
    """Entry and exit distances of rays through the unit sphere, and whether they hit it."""
    middle = -(origins * directions).sum(1)
    closest = origins + middle[:, None] * directions
    half_squared = 1 - (closest * closest).sum(1)
    half = half_squared.clamp(min=0).sqrt()
    entry, leave = (middle - half).clamp(min=_NEAR), middle + half
    return entry, leave, (half_squared > 1e-4) & (leave > entry + 1e-3)


def stratified(
    num_rows: int, num_strata: int, generator: torch.Generator | None, device: torch.device
) -> Float[Tensor, "{num_rows} {num_strata}"]:
    """Ascending places in [0, 1): one draw in each of even strata; their centres without a generator."""
    if generator is None:
        offset = torch.full((num_rows, num_strata), 0.5, device=device)
    else:
        offset = torch.rand(num_rows, num_strata, generator=generator, device=device)
    return (torch.arange(num_strata, device=device) + offset) / num_strata


def free_outside(sdf: Float[Tensor, "*any"], radius: Float[Tensor, "*any"]) -> Float[Tensor, "*any"]:
    """max(f, |x| - 1) for f and |x|: the solid cut off at the unit sphere.

    What the SDF says outside the sphere is never rendered, and past the grid's cube the cache repeats its border. All
    that is solid lies in the sphere, so that |x| - 1 bounds the distance to it from below.
    """
    return torch.maximum(sdf, radius - 1)


def beyond_too(sdf: Callable[[Tensor], Tensor], points: Float[Tensor, "n 3"]) -> Float[Tensor, " n"]:
    """f at points; outside the unit sphere that of the nearest point of the sphere, and how far that is."""
    radius = torch.linalg.vector_norm(points, dim=1).clamp(min=1)
    return sdf(points / radius[:, None]) + radius - 1


class SdfCache:
    """The SDF on a regular grid over [-1, 1]^3, refreshed now and then; what sampling and visibility read.

    Attributes:
        values: [1, 1, G, G, G] float32, indexed z, y, x as `grid_sample` wants it. Past the cells that touch the unit
            sphere, where nothing is looked for, they stay at |x| - 1.
        inside: flat indices of the corners of those cells, which a refresh evaluates.
    """

    def __init__(self, resolution: int, device: torch.device | str) -> None:
        self.resolution = resolution
        squares = torch.linspace(-1, 1, resolution, device=device) ** 2
        outside = (squares[:, None, None] + squares[:, None] + squares).sqrt() - 1
        self.inside = torch.nonzero(outside.view(-1) < math.sqrt(3) * self.cell).squeeze(1)
        self.values = outside[None, None]

    @property
    def cell(self) -> float:
        """Side of a cell in scene units."""
        return 2.0 / (self.resolution - 1)

    def points(self, rows: Int[Tensor, " m"]) -> Float[Tensor, "m 3"]:
        """Positions of flat grid indices."""
        side = self.resolution
        z, y, x = rows // (side * side), rows // side % side, rows % side
        return torch.stack([x, y, z], 1).float() * self.cell - 1

    @torch.no_grad()
    def refresh(self, sdf: Callable[[Tensor], Tensor], band: float | None = None) -> int:
        """Evaluate sdf([M, 3]) -> [M] in the unit sphere: everywhere, or where |cached f| < band. Returns M.

        On CUDA the band is as wide as a fixed part of the sphere.
        """
        flat = self.values.view(-1)
        rows = self.inside
        if band is not None:
            sizes = flat[rows].abs()
            if fixed_shapes(flat.device):
                nearest = sizes.topk(int(_NEAREST_SHARE * len(rows)), largest=False, sorted=False).indices
            else:
                nearest = torch.nonzero(sizes < band).squeeze(1)
            rows = rows[nearest]

        def evaluate(part: slice) -> None:
            flat[rows[part]] = sdf(self.points(rows[part]))

        in_blocks(evaluate, len(rows), points_at_a_time(flat.device), "points of the sampler's grid")
        return len(rows)

    def lookup(self, points: Float[Tensor, "*any 3"]) -> Float[Tensor, "*any"]:
        """Trilinear f at points, without gradient; positions outside the cube read its border."""
        if not takes_kernel(points):
            return self.lookup_reference(points)
        from stages.neural import kernels

        found = torch.empty(points.shape[:-1])
        kernels.lookup(self.values[0, 0].numpy(), points.detach().reshape(-1, 3).numpy(), found.view(-1).numpy())
        return found

    def lookup_reference(self, points: Float[Tensor, "*any 3"]) -> Float[Tensor, "*any"]:
        """`lookup` in plain torch: the reference of the kernel, and the path on CUDA."""
        values = torch.nn.functional.grid_sample(
            self.values, points.reshape(1, 1, 1, -1, 3), align_corners=True, padding_mode="border"
        )
        return values.reshape(points.shape[:-1])


@torch.no_grad()
def importance_distances(
    cache: SdfCache,
    rays: Rays,
    num_samples: int,
    scale: Float[Tensor, ""] | float,
    generator: torch.Generator | None,
) -> Float[Tensor, "r {num_samples}"]:
    """Sorted sample distances, drawn by inverse CDF from the cache's rendering weights.

    The weights are those of a Laplace density of the given scale, widened to what the cache resolves; a share
    `EVEN_SHARE` is spread evenly. One stratified draw per sample; the strata's centres without a generator.
    """
    places = stratified(len(rays), num_samples, generator, rays.origins.device)
    finest = 0.5 * cache.cell
    scale = scale.clamp(min=finest) if isinstance(scale, Tensor) else max(scale, finest)
    if not takes_kernel(rays.origins):
        return importance_distances_reference(cache, rays, places, scale)
    from stages.neural import kernels

    distances = torch.empty(places.shape)
    given = (each.contiguous().numpy() for each in (rays.origins, rays.directions, rays.entry, rays.leave, places))
    kernels.importance_distances(
        cache.values[0, 0].numpy(), *given, float(scale), FLAT, EVEN_SHARE, _EVEN_FLOOR, _NUM_BINS, distances.numpy()
    )
    return distances


@torch.no_grad()
def importance_distances_reference(
    cache: SdfCache, rays: Rays, places: Float[Tensor, "r k"], scale: Float[Tensor, ""] | float
) -> Float[Tensor, "r k"]:
    """Distances at places in [0, 1) of the weights' CDF, in plain torch.

    The reference of the kernel behind `importance_distances`, and the path on CUDA.
    """
    edges = torch.linspace(0, 1, _NUM_BINS + 1, device=places.device)
    length = (rays.leave - rays.entry)[:, None]
    distances = rays.entry[:, None] + length * edges
    sdf = cache.lookup_reference(rays.at(distances))
    delta = length / _NUM_BINS
    tau = section_optical_depth(sdf[:, :-1], sdf[:, 1:], delta, scale)
    weights, _ = weights_from_optical_depth(tau)
    weights = weights + (EVEN_SHARE * weights.sum(1, keepdim=True) + _EVEN_FLOOR) / _NUM_BINS
    return invert_cdf(distances, weights, places)


def invert_cdf(
    edges: Float[Tensor, "r e"], weights: Float[Tensor, "r e-1"], places: Float[Tensor, "r k"]
) -> Float[Tensor, "r k"]:
    """Positions at places in [0, 1) of the CDF of a histogram: weights, sum > 0, between edges.

    Evenly spread within an interval.
    """
    cdf = torch.nn.functional.pad(torch.cumsum(weights, 1), (1, 0))
    cdf = cdf / cdf[:, -1:]
    index = torch.searchsorted(cdf, places.contiguous(), right=True).clamp(1, weights.shape[1])
    low, high = cdf.gather(1, index - 1), cdf.gather(1, index)
    inside = ((places - low) / (high - low).clamp(min=1e-8)).clamp(0, 1)
    return torch.lerp(edges.gather(1, index - 1), edges.gather(1, index), inside)
