"""What outlines say beside the photos' colours: a line of sight on the mask is free until it comes to where the object
may be, and meets it there.

Shapes: M lines of sight, S of them drawn for a step, K places of the walk along each.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from torch import Tensor

from stages.geometry.cameras import PinholeCameras
from stages.geometry.outlines import mask_depth, object_space, outline_errors
from stages.geometry.point_cloud import PointCloud
from stages.neural import losses
from stages.neural.sampling import intersect_unit_sphere

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int, Shaped

# Lines that are kept to be drawn from, and which part of them runs this near inside the outline, pixels.
MOST_LINES, RIM_SHARE, RIM = 1 << 20, 0.5, 4.0
# Steps of the walk along a line: two for three cells of the object's space along the sphere's diameter.
WALK = 128


class Drawn(NamedTuple):
    """Lines of a step.

    Attributes:
        places: three on each: two that are free, then one that is in the object.
        known: which lines come to where the object may be, and do not begin there.
    """

    places: Float[Tensor, "places 3"]
    known: Bool[Tensor, " s"]


@dataclass(frozen=True)
class Silhouettes:
    """Lines of sight that end on the object: M of them.

    Attributes:
        origins: of all photos, projection centres.
        photos: of each line.
        directions: of each line, unit.
        space: where the object may be, cells of a grid over [-1, 1]^3; axes x, y, z.
    """

    origins: Float[Tensor, "i 3"]
    photos: Int[Tensor, " m"]
    directions: Float[Tensor, "m 3"]
    space: Bool[Tensor, "g g g"]

    def __len__(self) -> int:
        return len(self.photos)

    @staticmethod
    def none(device: torch.device | str) -> Silhouettes:
        """Of photos without outlines."""
        nothing = torch.zeros(0, 3, device=device)
        return Silhouettes(
            nothing, nothing[:, 0].long(), nothing, torch.zeros(1, 1, 1, dtype=torch.bool, device=device)
        )

    @staticmethod
    def from_masks(
        cameras: PinholeCameras,
        masks: Sequence[Shaped[np.ndarray, "_ _"] | None],
        cloud: PointCloud,
        device: torch.device | str,
    ) -> Silhouettes:
        """Of masks of the photos, not zero on the object, as far as they agree on the dense points.

        Args:
            cameras: in the scene frame, as are the points.
            masks: None for photos without, and for those that are not trained on.
        """
        if all(mask is None for mask in masks):
            return Silhouettes.none(device)
        depths = [None if mask is None else mask_depth(mask) for mask in masks]
        errors = outline_errors(cameras, depths, cloud)
        space = object_space(cameras, depths, errors.outer)
        photos, pixels = _pixels(depths, errors.inner)
        directions = np.zeros((len(photos), 3), np.float32)
        for i in np.unique(photos):
            rows = photos == i
            directions[rows] = cameras.rays(int(i), pixels[rows] + 0.5)[1]
        origins = torch.from_numpy(cameras.centers).float().to(device)
        of_photos, ways = (torch.from_numpy(each).to(device) for each in (photos, directions))
        return Silhouettes(origins, of_photos, ways, torch.from_numpy(space).to(device))

    def draw(self, count: int, step: float, lookup: Callable[[Tensor], Tensor], generator: torch.Generator) -> Drawn:
        """Places along S random lines; S is at most `count`.

        Free are a random place between the unit sphere and a `step` (scene units) before where the object may begin,
        and that of the smallest f there. In the object is that of the smallest f where it may be: what is there
        already is found, however thin, and nothing is asked for beside it.

        Args:
            lookup: places [s, k, 3] -> f [s, k] as it is known, without gradient.
        """
        total, device = len(self.photos), self.directions.device
        count = min(count, total)
        chosen = torch.randint(max(total, 1), (count,), generator=generator, device=device)
        chance = torch.rand(count, 2, generator=generator, device=device)
        origins, directions = self.origins[self.photos[chosen]], self.directions[chosen]
        entry, leave, crosses = intersect_unit_sphere(origins, directions)
        width = (leave - entry)[:, None] / WALK
        along = entry[:, None] + (torch.arange(WALK, device=device) + chance[:, :1]) * width
        places = origins[:, None] + along[..., None] * directions[:, None]
        inside = self._inside(places)
        first = torch.gather(along, 1, inside.long().argmax(1, keepdim=True)) - step
        free = along < first
        sdf = lookup(places)
        worst, best = (sdf.masked_fill(~where, torch.inf).argmin(1) for where in (free, inside))
        anywhere = (chance[:, 1] * free.sum(1)).long()
        rows = torch.arange(count, device=device)
        chosen_places = torch.cat([places[rows, column] for column in (anywhere, worst, best)])
        return Drawn(chosen_places, crosses & inside.any(1) & free.any(1))

    def _inside(self, places: Float[Tensor, "s k 3"]) -> Bool[Tensor, "s k"]:
        """Whether the object may be there."""
        side = len(self.space)
        x, y, z = ((places + 1) * (0.5 * side)).long().clamp(0, side - 1).unbind(2)
        return self.space[x, y, z]


def _pixels(
    depths: Sequence[Float[np.ndarray, "_ _"] | None], inner: Float[np.ndarray, " i"]
) -> tuple[Int[np.ndarray, " m"], Int[np.ndarray, "m 2"]]:
    """Photos and pixels (x, y) that are surely of the object: as many of each photo, a part near its outline."""
    generator = np.random.default_rng(0)
    most = MOST_LINES // max(len(depths), 1)
    photos, pixels = [np.zeros(0, np.int64)], [np.zeros((0, 2), np.int64)]
    for i, depth in enumerate(depths):
        if depth is None or not np.isfinite(inner[i]):
            continue
        rows, columns = np.nonzero(depth > inner[i])
        near = depth[rows, columns] < inner[i] + RIM
        shares = np.where(near, RIM_SHARE / max(near.sum(), 1), (1 - RIM_SHARE) / max((~near).sum(), 1))
        if len(rows):
            picks = generator.choice(len(rows), most, p=shares / shares.sum())
            photos.append(np.full(most, i))
            pixels.append(np.stack([columns[picks], rows[picks]], 1))
    return np.concatenate(photos), np.concatenate(pixels)


def outline_loss(sdf: Float[Tensor, " places"], known: Bool[Tensor, " s"], margin: float) -> Float[Tensor, ""]:
    """Mean error of f at the places of `Silhouettes.draw`: free before the object's space, and met within it.

    max(0, margin - f) at the free ones, and max(0, f) at the one in the object: zero where the line touches it, for a
    line near the outline does no more.
    """
    if not len(known):
        return sdf.sum()
    anywhere, worst, best = sdf.view(3, len(known))
    free = losses.outside_error(anywhere, margin) + losses.outside_error(worst, margin)
    return (known * (free + losses.inside_error(best, 0.0))).mean()
