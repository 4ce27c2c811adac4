"""What dense stereo says of places: depths that photos agree on, depths that other photos deny, or none.

Photos agree where there is a pattern to see. What is polished, or moves, gives depths that others deny: dense stereo
keeps them with a low trust. Where something is plain no depth is found at all. Gathered in a coarse grid, before the
training, that tells what is to be believed where (the paper's ambiguity, asked of geometry).

Shapes: I photos, P places, G cells along the grid's side.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from stages.geometry.cameras import PinholeCameras

if TYPE_CHECKING:
    from jaxtyping import Float, Float32

# Cells along the side of the grid over [-1, 1]^3, and the sides of the boxes that their sums are averaged over, one
# after the other: a mirror's depths lie a few percent behind it.
SIDE, BOXES = 48, (7, 5)
# Every so many-th pixel of a depth map is asked, along each axis: a cell is a dozen pixels wide.
_STRIDE = 3
# Places with fewer depths than this part of what there is on average have none to speak of.
_FEW = 0.05
# Less than one depth leaves in the largest box.
_TRACE = 1e-4
# Trusted depths speak of places in a box of so many cells a side.
_NEAR = 3
# Share of doubt from which a place is taken for shiny, and at which it is for sure. In the middle of a helmet it is
# 0.17, of a plain part 0.3, of a plaster one 0.37, of a mirror 0.61, of two polished ones 0.7 and 0.83.
SHINY = (0.53, 0.68)
# Shiny places smaller than the first box, in cells a side, are holes in what is plain; to larger ones belongs what is
# beside them, as far as the second box is wider: where they stand on the ground, its trusted depths are near.
_SMALLEST, _BESIDE = 5, 9


@dataclass(frozen=True)
class Evidence:
    """What is said of places, in [0, 1]; see `at_places`.

    Attributes:
        shiny: how sure it is that something there is: its depths are denied.
        known: how far photos agree on where the surface is.
    """

    shiny: Float[Tensor, "1 1 g g g"]
    known: Float[Tensor, "1 1 g g g"]

    @staticmethod
    def none(device: torch.device | str) -> Evidence:
        """Nothing is said of any place."""
        return Evidence(*(torch.zeros(1, 1, *3 * [SIDE], device=device) for _ in range(2)))

    @staticmethod
    def of(
        maps: Iterable[tuple[Float32[np.ndarray, "_ _"], Float32[np.ndarray, "_ _"]] | None],
        cameras: PinholeCameras,
        device: torch.device | str,
    ) -> Evidence:
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
        near, trusted = uniform_filter(found, _NEAR), uniform_filter(found - doubted, _NEAR)
        known = trusted / _usual(near)
        for box in BOXES:
            found, doubted = uniform_filter(found, box), uniform_filter(doubted, box)
        usual = _usual(found)
        low, high = SHINY
        shiny = (doubted / (found + _FEW * usual) - low) / (high - low)
        shiny = large_parts(shiny)
        grids = (torch.from_numpy(each.clip(0, 1)).float()[None, None].to(device) for each in (shiny, known))
        return Evidence(*grids)


def at_places(values: Float[Tensor, "1 1 g g g"], points: Float[Tensor, "p 3"]) -> Float[Tensor, " p"]:
    """Values of a grid over [-1, 1]^3, indexed z, y, x, at points; without gradient."""
    found = torch.nn.functional.grid_sample(
        values, points.detach().view(1, 1, 1, -1, 3), align_corners=False, padding_mode="border"
    )
    return found.view(len(points))


def large_parts(values: Float[np.ndarray, "g g g"]) -> Float[np.ndarray, "g g g"]:
    """What is high in boxes of `_SMALLEST` cells a side, and high as far beside them as `_BESIDE` is wider."""
    from scipy.ndimage import grey_dilation, grey_erosion

    grown: Float[np.ndarray, "g g g"] = grey_dilation(grey_erosion(values, _SMALLEST), _BESIDE)
    return grown


def _places(
    depth: Float32[np.ndarray, "h w"], trust: Float32[np.ndarray, "h w"], cameras: PinholeCameras, index: int
) -> tuple[Float[np.ndarray, "p 3"], Float[np.ndarray, " p"]]:
    """Where some of the depths of a photo lie, as far as in the cube, and their trust."""
    kept = slice(_STRIDE // 2, None, _STRIDE)
    v, u = (kept.start + _STRIDE * each for each in np.nonzero(depth[kept, kept] > 0))
    pixels = (np.stack([u, v], 1) + 0.5) * cameras.sizes[index] / depth.shape[::-1]
    places = cameras.unproject(index, pixels, depth[v, u])
    inside = (np.abs(places) < 1).all(axis=1)
    return places[inside], trust[v, u][inside]


def _cells(places: Float[np.ndarray, "p 3"]) -> np.ndarray:
    """Flat index of the cell of each place in the cube, z slowest."""
    x, y, z = ((places + 1) * (SIDE / 2)).astype(int).clip(0, SIDE - 1).T
    return np.ravel_multi_index((z, y, x), 3 * (SIDE,))


def _usual(found: Float[np.ndarray, "g g g"]) -> float:
    """How many depths a cell has, in the middle of those that have a fifth of the mean or more; 1 where there are none.

    Rounding leaves traces in empty cells.
    """
    some = found[found > _TRACE]
    return float(np.median(some[some >= 0.2 * some.mean()])) if len(some) else 1.0
