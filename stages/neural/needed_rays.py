"""Which rays a step needs: those that meet the surface, and more of them where the colours are met worse.

A uniform draw over the photos spends most rays on what lies behind the object. The photos are cut into cells, and a
part of the rays goes to cells whose middle ray meets the surface of the sampler's grid, or passes near it, in
proportion to the colour error found there so far.

Shapes: C cells of all photos together, R rays.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from stages.neural.sampling import SdfCache, intersect_unit_sphere
from stages.neural.training_photos import Photos, RayBatch
from stages.neural.visibility import smallest_sdf_on_paths

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int

# Pixels along a cell's side, doubled until there are no more cells than this: 16 for 47 photos of 640 x 480.
_SIDE, _MOST_CELLS = 4, 1 << 16
# A new error's part in a cell's running mean.
_RENEWAL = 0.1
# A ray starts this far inside the unit sphere, scene units, where the walk through the grid would end.
_INSIDE = 1e-3


class NeededRays:
    """Draws rays from the photos by need.

    Attributes:
        share: part of the rays that goes where it is needed; the others keep what is free, and the background, as they
            are.
        errors, known: running mean of the colour error [C] that starts at zero, and how much of it is of rays that were
            drawn, from 0 to 1.
        weights: of the cells in the draw, [C]; zero: only the even share goes there.
    """

    def __init__(self, photos: Photos, share: float) -> None:
        self.photos, self.share = photos, share
        self.side = _SIDE
        while int(_counts(photos, self.side).prod(1).sum()) > _MOST_CELLS:
            self.side *= 2
        self.counts = _counts(photos, self.side)  # columns and rows [I, 2]
        cells = self.counts.prod(1)
        self.first = torch.cumsum(cells, 0) - cells
        self.images = torch.repeat_interleave(torch.arange(len(photos), device=photos.device), cells)
        place = torch.arange(len(self.images), device=photos.device) - self.first[self.images]
        columns = self.counts[self.images, 0]
        boxes = photos.boxes[self.images]
        self.low = boxes[:, :2] + self.side * torch.stack([place % columns, place // columns], 1)
        self.size = torch.minimum(boxes[:, 2:] - self.low, torch.full_like(self.low, self.side))
        self.errors, self.known, self.weights = torch.zeros(3, len(self.images), device=photos.device).unbind()
        self._upto = torch.zeros(len(self.images), dtype=torch.float64, device=photos.device)

    def draw(self, num_rays: int, generator: torch.Generator) -> tuple[RayBatch, Int[Tensor, " r"]]:
        """At most num_rays random rays through the unit sphere, and the cell of each.

        By need where anything is known of it; the others from all photos for training, equally likely.
        """
        images, pixels = self.photos.draw_pixels(num_rays, generator)
        chance = torch.rand(len(images), 4, generator=generator, device=images.device)
        total = self._upto[-1]
        cell = torch.searchsorted(self._upto, chance[:, 0].double() * total, right=True).clamp(max=len(self.images) - 1)
        needed = (chance[:, 1] < self.share) & (total > 0)
        inside = torch.minimum((chance[:, 2:] * self.size[cell]).floor(), self.size[cell] - 1) + self.low[cell]
        images = torch.where(needed, self.images[cell], images)
        pixels = torch.where(needed[:, None], inside, pixels)
        batch = self.photos.rays(images, pixels, limit=num_rays)
        return batch, self.cells(images, pixels)[batch.drawn]

    def cells(self, images: Int[Tensor, " r"], pixels: Float[Tensor, "r 2"]) -> Int[Tensor, " r"]:
        """The cell that each pixel of a photo's box lies in."""
        column, row = ((pixels - self.photos.boxes[images, :2]) / self.side).long().unbind(1)
        return self.first[images] + row * self.counts[images, 0] + column

    @torch.no_grad()
    def learn(self, cells: Int[Tensor, " r"], errors: Float[Tensor, " r"]) -> None:
        """Take the colour errors of rays into their cells' running means; of several in a cell, their mean."""
        sums, counts = torch.zeros_like(self.errors), torch.zeros_like(self.errors)
        sums.index_add_(0, cells, errors.detach())
        counts.index_add_(0, cells, torch.ones_like(errors))
        renewal = _RENEWAL * (counts > 0)
        self.errors.lerp_(sums / counts.clamp(min=1), renewal)
        self.known.lerp_(torch.ones_like(self.known), renewal)

    @torch.no_grad()
    def look(self, cache: SdfCache) -> None:
        """Find the cells that show the surface of the cached SDF, and weigh them by their errors.

        A cell's weight is its area times its error and the mean error: none of the surface is left out. As far as a
        cell's error is not known yet, the mean stands for it, too: to be drawn seldom is no error.
        """
        directions = self.photos.directions(self.images, (self.low + 0.5 * self.size).floor())
        corners = self.photos.directions(self.images, self.low)
        origins = self.photos.centers[self.images]
        entry, leave, crosses = intersect_unit_sphere(origins, directions)
        start, end = (origins + along[:, None] * directions for along in (entry + _INSIDE, leave))
        smallest = smallest_sdf_on_paths(cache, start, end, torch.zeros_like(entry))
        # from the middle ray to the cell's corner, half way through the sphere
        reach = 0.5 * (entry + leave) * torch.linalg.vector_norm(corners - directions, dim=1)
        shown = crosses & (smallest < reach + cache.cell)
        mean = _mean(self.errors, self.known, shown)
        self._weigh(shown * self.size.prod(1) * (self.errors + (1 - self.known) * mean + mean))

    def _weigh(self, weights: Float[Tensor, " c"]) -> None:
        self.weights.copy_(weights)
        torch.cumsum(self.weights.double(), 0, out=self._upto)

    @property
    def tables(self) -> list[Tensor]:
        """All that changes from draw to draw, in place."""
        return [self.errors, self.known, self.weights, self._upto]

    def state(self) -> dict[str, Any]:
        """Everything that the next draw depends on."""
        return {"errors": self.errors, "known": self.known, "weights": self.weights}

    def load_state(self, state: dict[str, Any]) -> None:
        self.errors.copy_(state["errors"])
        self.known.copy_(state["known"])
        self._weigh(state["weights"])


def _mean(errors: Float[Tensor, " c"], known: Float[Tensor, " c"], shown: Bool[Tensor, " c"]) -> Float[Tensor, ""]:
    """Mean colour error of the cells that show the surface; 1 while no ray was drawn there."""
    seen = (known * shown).sum()
    return torch.where(seen > 0, (errors * shown).sum() / seen.clamp(min=1e-12), 1.0)


def _counts(photos: Photos, side: int) -> Int[Tensor, "i 2"]:
    """Columns and rows of cells of each photo's box; none of photos that are not trained on."""
    counts = torch.ceil((photos.boxes[:, 2:] - photos.boxes[:, :2]) / side).long()
    return counts * photos.training[:, None]
