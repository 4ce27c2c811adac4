"""One tile of a large surface: the zero level of several blocks' fields, blended, in one block's core.

Neighbouring tiles meet without a seam. Both see the same values on the planes between them, to the last bit: the
fields are blended by weights that depend on the place alone, and along those planes they are asked for in the same
portions, since a network may give a point another last bit in other company. And what moves vertices afterwards fades
out towards the planes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from stages.geometry.tiling import BlockBox, eased, weights
from stages.surface.isosurface import Isosurface, SignedDistance, extract_box, extract_isosurface
from stages.surface.triangle_mesh import compact

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int

# Points along z that are asked for together where tiles meet.
PORTION = 64
# Over so many cells from a tile's side what moves vertices comes in.
FADE_CELLS = 6.0
# What no block has learned is outside of everything, by so many cells.
UNKNOWN_CELLS = 10.0
# Cells along the region in which what lies around a tile is looked at. A photo sees less than it seems to where a house
# beyond the tile is in the way: 96 found 54 % of such places in the made-up town, this 79 % (docs/adr/0022).
AROUND_CELLS = 256


@dataclass(frozen=True)
class BlockField:
    """What a block has learned.

    Attributes:
        box: where.
        sdf: [n, 3] places in the plan's frame, all in the block's region -> signed distances in its unit.
    """

    box: BlockBox
    sdf: Callable[[np.ndarray], np.ndarray]


def blended(fields: Sequence[BlockField], beyond: float) -> Callable[[np.ndarray], np.ndarray]:
    """Signed distance [n] at places [n, 3]: of each block as much as its weight is; `beyond` where none has any.

    Args:
        fields: in an order that is the same for all tiles.
    """
    boxes = [field.box for field in fields]

    def sdf(places: np.ndarray) -> np.ndarray:
        shares = weights(boxes, places)
        known = shares.any(0)
        total = np.where(known, 0.0, beyond)
        for field, share in zip(fields, shares, strict=True):
            here = share > 0
            if here.any():
                total[here] += share[here] * field.sdf(places[here])
        return total

    return sdf


def extract_tile(
    fields: Sequence[BlockField],
    core: Float[np.ndarray, "2 3"],
    cell: float,
    block: int = 64,
    progress: Callable[[int, int], None] | None = None,
) -> Isosurface:
    """The surface in a core, open where it goes on beyond that; vertices float64 in the plan's frame.

    Args:
        fields: of the block itself and of all whose region touches its core, in an order that all tiles share.
        core: its corners are multiples of `cell`.
    """
    low, high = (np.round(corner / cell).astype(np.int64) for corner in core)
    values = TileValues(blended(fields, UNKNOWN_CELLS * cell), low, high, cell)
    return extract_box(values, low, high, cell, block, progress=progress)


def surface_around(
    sdf: SignedDistance, sides: Sequence[tuple[np.ndarray, float]]
) -> tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "f 3"]]:
    """Vertices and faces of what a block has learned beyond its tile: coarse, and part of no tile.

    A tile is open where others go on. From there one looks under its ground, unless this is in the way; and photos that
    look over the border show the houses beyond it, not this tile's ground behind them. It reaches as far as the block's
    ball does, half a tile or so. Faces that cross the border are left out: they would lie before the tile's own.

    Args:
        sdf: of the block, in its scene frame. sides: planes (normal, offset) with the tile above them.
    """
    surface = extract_isosurface(sdf, AROUND_CELLS)
    beyond = heights_above(surface.vertices, sides) < 0
    return compact(surface.vertices, surface.faces[beyond[surface.faces].all(1)])


class TileValues:
    """The field at lattice points: on a tile's upright sides in portions that are the same for the tile beside it."""

    def __init__(self, sdf: Callable[[np.ndarray], np.ndarray], low: np.ndarray, high: np.ndarray, cell: float) -> None:
        self._sdf, self._low, self._high, self._cell = sdf, low, high, cell
        self._portions: dict[tuple[int, int, int], np.ndarray] = {}

    def __call__(self, index: Int[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        values = np.empty(len(index), dtype=np.float32)
        beside = self._at_a_side(index)
        if not beside.all():
            values[~beside] = self._sdf(index[~beside] * self._cell)
        rows = index[beside]
        portions, which = np.unique(np.column_stack([rows[:, :2], rows[:, 2] // PORTION]), axis=0, return_inverse=True)
        found = np.stack([self._portion((x, y, z)) for x, y, z in portions.tolist()] or [np.empty(PORTION)])
        values[beside] = found[which.reshape(-1), rows[:, 2] % PORTION]
        return values

    def _at_a_side(self, index: Int[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
        plan = index[:, :2]
        at: np.ndarray = ((plan == self._low[:2]) | (plan == self._high[:2])).any(1)
        return at

    def _portion(self, key: tuple[int, int, int]) -> np.ndarray:
        """Values [PORTION] above one another, from a multiple of it on."""
        if key not in self._portions:
            x, y, z = key
            index = np.array([[x, y, PORTION * z]]) + np.outer(np.arange(PORTION), [0, 0, 1])
            self._portions[key] = self._sdf(index * self._cell).astype(np.float32)
        return self._portions[key]


def fading(
    vertices: Float[np.ndarray, "v 3"], sides: Sequence[tuple[np.ndarray, float]], cell: float
) -> Float[np.ndarray, " v"]:
    """How much of a movement vertices get: nothing on a tile's sides, all of it from `FADE_CELLS` cells away on.

    Args:
        sides: planes (normal, offset) with the tile above them, and `cell`, in the frame of the vertices.
    """
    return eased(heights_above(vertices, sides) / (FADE_CELLS * cell))


def heights_above(
    vertices: Float[np.ndarray, "v 3"], sides: Sequence[tuple[np.ndarray, float]]
) -> Float[np.ndarray, " v"]:
    """Distance of vertices from the nearest of a tile's sides; infinite where there are none."""
    rows = [vertices @ normal - offset for normal, offset in sides]
    nearest: np.ndarray = np.min([np.full(len(vertices), np.inf), *rows], axis=0)
    return nearest
