"""Where photos find depths that other photos deny: on what is polished, or moves.

Dense stereo keeps such depths with a low trust. Gathered in a coarse grid, they tell shiny places from plain ones,
where no depth is found at all (the paper's ambiguity, asked of geometry once, before training).

Shapes: I photos, P places, G cells along the grid's side.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from stages.geometry.cameras import PinholeCameras

if TYPE_CHECKING:
    from jaxtyping import Float, Float32

# Cells along the side of the grid over [-1, 1]^3, and the sides of the boxes that their sums are averaged over, one
# after the other: a mirror's depths lie a few percent behind it.
SIDE, BOXES = 48, (5, 3)
# Every so many-th pixel of a depth map is asked, along each axis: a cell is a dozen pixels wide.
_STRIDE = 3
# Places with fewer depths than this part of what there is on average have none to speak of.
_FEW = 0.05
# Share of doubt from which a place is taken for shiny, and that at which it is for sure: helmet 0.1, plaster 0.36 and
# polished metal 0.85 on average.
SHINY = (0.5, 0.8)


class Doubt:
    """How far a place is doubted.

    Attributes:
        values: [1, 1, G, G, G], z, y, x as `grid_sample` wants it: share of the depths there that are not trusted.
    """

    def __init__(self, values: Float[Tensor, "1 1 g g g"]) -> None:
        self.values = values

    @staticmethod
    def of(
        maps: Iterable[tuple[Float32[np.ndarray, "_ _"], Float32[np.ndarray, "_ _"]] | None],
        cameras: PinholeCameras,
        device: torch.device | str,
    ) -> Doubt:
        """Of each photo's depths along its optical axis, 0 where unknown, and their trust in [0, 1], of one shape.

        Args:
            maps: one for each camera, in its order; None where a photo has no depths. In the cameras' units.
            cameras: in the scene frame.
        """
        from scipy.ndimage import uniform_filter

        sums = np.zeros((2, SIDE**3))
        for index, pair in enumerate(maps):
            if pair is not None:
                places, trust = _places(*pair, cameras, index)
                cells = _cells(places)
                sums += np.stack([np.bincount(cells, weights, SIDE**3) for weights in (np.ones(len(trust)), 1 - trust)])
        found, doubted = sums.reshape(2, SIDE, SIDE, SIDE)
        for box in BOXES:
            found, doubted = uniform_filter(found, box), uniform_filter(doubted, box)
        few = _FEW * found[found > 0].mean() if found.any() else 1.0
        return Doubt(torch.from_numpy(doubted / (found + few)).float()[None, None].to(device))

    def shiny(self, points: Float[Tensor, "p 3"]) -> Float[Tensor, " p"]:
        """How sure it is that points are on something shiny, in [0, 1], without gradient."""
        found = torch.nn.functional.grid_sample(
            self.values, points.detach().view(1, 1, 1, -1, 3), align_corners=False, padding_mode="border"
        )
        low, high = SHINY
        return ((found.view(-1) - low) / (high - low)).clamp(0, 1)


def _places(
    depth: Float32[np.ndarray, "h w"], trust: Float32[np.ndarray, "h w"], cameras: PinholeCameras, index: int
) -> tuple[Float[np.ndarray, "p 3"], Float[np.ndarray, " p"]]:
    """Where some of the depths of a photo lie, as far as in the cube, and their trust."""
    kept = slice(_STRIDE // 2, None, _STRIDE)
    v, u = (kept.start + _STRIDE * each for each in np.nonzero(depth[kept, kept] > 0))
    pixels = (np.stack([u, v], 1) + 0.5) * cameras.sizes[index] / depth.shape[::-1]
    rays = np.c_[pixels, np.ones(len(u))] @ np.linalg.inv(cameras.intrinsics[index]).T
    places = cameras.centers[index] + (depth[v, u, None] * rays) @ cameras.extrinsics[index, :, :3]
    inside = (np.abs(places) < 1).all(axis=1)
    return places[inside], trust[v, u][inside]


def _cells(places: Float[np.ndarray, "p 3"]) -> np.ndarray:
    """Flat index of the cell of each place in the cube, z slowest."""
    x, y, z = ((places + 1) * (SIDE / 2)).astype(int).clip(0, SIDE - 1).T
    return np.ravel_multi_index((z, y, x), 3 * (SIDE,))
