"""The ground plan of a large scene, cut into blocks that a process can hold: a kd-tree over photos and points.

All is in the plan's frame: up is +Z, and every border lies on planes of one lattice, whose points are whole multiples
of its cell. Cores tile the plan without gaps; a block learns its region, which is its core and some of its neighbours'.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int, Integer

# A region goes beyond its core by this part of the core's side, on each side: neighbours share twice as much.
OVERLAP = 0.125
# A cut leaves no part narrower than this part of the side that it cuts.
NARROWEST = 0.25
# A photo sees a block that holds this part of the points it shows, and so many at least.
SEEN_SHARE, SEEN_POINTS = 0.05, 8
# How high a block is say points that so many photos show, where this part of its points are such: two photos that are
# matched wrongly meet somewhere all the same, far under the ground as a rule.
SURE_PHOTOS, SURE_SHARE = 3, 0.1
# Axes across which tiles meet.
UPRIGHT = (0, 1)
# Bits of the cell's mantissa: so few that multiples of it are exact, whatever program computes them.
CELL_BITS = 8


@dataclass(frozen=True)
class BlockBox:
    """Where a block lies: its core, and by how much its region goes beyond that.

    Attributes:
        core: lowest and highest corner.
        margin: along x, y and z, on either side.
    """

    core: Float[np.ndarray, "2 3"]
    margin: Float[np.ndarray, " 3"]

    @property
    def region(self) -> Float[np.ndarray, "2 3"]:
        """Lowest and highest corner of what the block learns."""
        return self.core + np.array([[-1.0], [1.0]]) * self.margin

    def touches(self, other: BlockBox) -> bool:
        """Whether the other's region reaches this core, on the ground plan."""
        low, high = other.region[:, :2]
        return bool((low <= self.core[1, :2]).all() and (high >= self.core[0, :2]).all())


# ---------------------------------------------------------------- who sees what
def photo_counts(
    observations: Integer[np.ndarray, "m 2"], chosen: Bool[np.ndarray, " p"], num_photos: int
) -> Int[np.ndarray, " n"]:
    """How many of the chosen points each photo shows; rows of `observations` are (photo, point)."""
    return np.bincount(observations[chosen[observations[:, 1]], 0], minlength=num_photos)


def sees(inside: Integer[np.ndarray, "*b n"], total: Integer[np.ndarray, " n"]) -> Bool[np.ndarray, "*b n"]:
    """Which photos see a block, given how many of their points lie in its region, and how many they have in all."""
    return (inside > 0) & (inside >= np.minimum(np.maximum(SEEN_SHARE * total, SEEN_POINTS), total))


def photos_of_blocks(
    boxes: list[BlockBox],
    points: Float[np.ndarray, "p 3"],
    observations: Integer[np.ndarray, "m 2"],
    centers: Float[np.ndarray, "n 3"],
) -> Bool[np.ndarray, "b n"]:
    """Which blocks each photo belongs to: all that it sees, by the points it shows and not by where it was taken.

    A photo that sees none well enough belongs to the one of which it shows most, and one that shows no point at all to
    the one that it was taken nearest to: none is left out.
    """
    inside = np.stack([photo_counts(observations, within(points, box.region), len(centers)) for box in boxes])
    seen = sees(inside, np.bincount(observations[:, 0], minlength=len(centers)))
    middles = np.stack([box.core.mean(0)[:2] for box in boxes])
    for photo in np.flatnonzero(~seen.any(0)):
        away = np.linalg.norm(middles - centers[photo, :2], axis=1)
        seen[int(np.lexsort((away, -inside[:, photo]))[0]), photo] = True
    return seen


def within(points: Float[np.ndarray, "p 3"], box: Float[np.ndarray, "2 d"]) -> Bool[np.ndarray, " p"]:
    """Which points lie in a box, its faces included; of a box of two axes on the plan."""
    axes = box.shape[1]
    return ((points[:, :axes] >= box[0]) & (points[:, :axes] <= box[1])).all(1)


# ---------------------------------------------------------------- the kd-tree
@dataclass(order=True)
class _Leaf:
    """A part of the plan: how many photos see it (negative, so that the heap gives the heaviest first), and where it
    lies; the `rows` of observations whose points its grown core holds."""

    load: int
    order: int
    core: np.ndarray
    rows: np.ndarray


def cut_plan(
    plan: Float[np.ndarray, "2 2"],
    points: Float[np.ndarray, "p 3"],
    observations: Integer[np.ndarray, "m 2"],
    num_photos: int,
    is_enough: Callable[[int, int], bool],
) -> list[Float[np.ndarray, "2 2"]]:
    """Cores on the ground plan, by cutting the part that most photos see until it is enough.

    The cut goes across the longer side, at the median of the points, each weighted by the photos that show it; a photo
    has one vote, shared by all points that it shows. So both parts are as much work.

    Args:
        plan: lowest and highest corner of what is cut.
        is_enough: told (parts, photos that see the heaviest of them). Parts that hold no point are not cut.
    """
    total = np.bincount(observations[:, 0], minlength=num_photos)
    votes = np.bincount(observations[:, 1], 1.0 / total[observations[:, 0]], minlength=len(points))

    def leaf(core: np.ndarray, rows: np.ndarray) -> _Leaf:
        grown = core + np.array([[-1.0], [1.0]]) * OVERLAP * (core[1] - core[0])
        rows = rows[within(points[rows[:, 1]], grown)]
        inside = np.bincount(rows[:, 0], minlength=num_photos)
        return _Leaf(-int(sees(inside, total).sum()), next(numbers), core, rows)

    numbers = iter(range(1 << 30))
    heap, done = [leaf(np.asarray(plan, dtype=np.float64), observations)], list[_Leaf]()
    while heap and not is_enough(len(heap) + len(done), -heap[0].load):
        heaviest = heapq.heappop(heap)
        held = np.unique(heaviest.rows[:, 1])
        held = held[within(points[held], heaviest.core)]
        if len(held) < 2 * SEEN_POINTS:
            done.append(heaviest)
            continue
        for core in _halves(heaviest.core, points[held], votes[held]):
            heapq.heappush(heap, leaf(core, heaviest.rows))
    return [each.core for each in sorted(heap + done, key=lambda each: each.core[0].tolist())]


def _halves(
    core: Float[np.ndarray, "2 2"], points: Float[np.ndarray, "p 3"], votes: Float[np.ndarray, " p"]
) -> tuple[np.ndarray, np.ndarray]:
    """The two parts of a core."""
    axis = int(np.argmax(core[1] - core[0]))
    order = np.argsort(points[:, axis], kind="stable")
    half = np.searchsorted(np.cumsum(votes[order]), votes.sum() / 2)
    low, high = core[:, axis]
    room = NARROWEST * (high - low)
    at = float(np.clip(points[order[min(half, len(order) - 1)], axis], low + room, high - room))
    left, right = core.copy(), core.copy()
    left[1, axis] = right[0, axis] = at
    return left, right


# ---------------------------------------------------------------- on the lattice
def lattice_cell(size: float) -> float:
    """A cell no smaller than `size`, with so few bits that all multiples of it are exact.

    Raises:
        ValueError: it is not positive.
    """
    if not size > 0:
        raise ValueError(f"expected a positive size of cells, got {size}")
    mantissa, exponent = math.frexp(size)
    return math.ldexp(math.ceil(math.ldexp(mantissa, CELL_BITS)), exponent - CELL_BITS)


def on_lattice(
    cores: list[Float[np.ndarray, "2 2"]],
    points: Float[np.ndarray, "p 3"],
    shown_by: Integer[np.ndarray, " p"],
    cell: float,
) -> list[BlockBox]:
    """Boxes whose faces are planes of the lattice: cores that tile the plan as before, as high as their points.

    Args:
        points: those that are to be reconstructed. shown_by: how many photos show each.
    """
    sure = shown_by >= SURE_PHOTOS
    lowest, highest = np.min([core[0] for core in cores], 0), np.max([core[1] for core in cores], 0)
    boxes = []
    for core in cores:
        side = core[1] - core[0]
        grown = core + np.array([[-1.0], [1.0]]) * OVERLAP * side
        held = within(points, grown)
        surely_held = held & sure
        heights = points[surely_held if surely_held.sum() >= SURE_SHARE * held.sum() else held, 2]
        heights = heights if len(heights) else points[:, 2]
        margin = np.maximum(np.ceil(OVERLAP * np.append(side, side.max()) / cell), 1) * cell
        low = np.append(np.where(core[0] == lowest, np.floor(core[0] / cell), np.round(core[0] / cell)) * cell,
                        np.floor(heights.min() / cell) * cell - margin[2])  # fmt: skip
        high = np.append(np.where(core[1] == highest, np.ceil(core[1] / cell), np.round(core[1] / cell)) * cell,
                         np.ceil(heights.max() / cell) * cell + margin[2])  # fmt: skip
        boxes.append(BlockBox(np.stack([low, high]), margin))
    return boxes


# ---------------------------------------------------------------- a partition of unity
def weights(boxes: list[BlockBox], points: Float[np.ndarray, "p 3"]) -> Float[np.ndarray, "b p"]:
    """How much each block has a say at points: smooth, 0 beyond its region, and 1 in sum wherever there is any region.

    Each region has a bump, which rises over twice its margin from nothing at its faces, by 3 t^2 - 2 t^3 along each
    axis; the weights are the bumps' shares of their sum. So deep inside a core its own block alone has a say, and at
    the border between two alike both have the same.
    """
    bumps = np.stack([_bump(box, points) for box in boxes])
    total = bumps.sum(0)
    return bumps / np.where(total > 0, total, 1.0)


def _bump(box: BlockBox, points: Float[np.ndarray, "p 3"]) -> Float[np.ndarray, " p"]:
    low, high = box.region
    inward = np.minimum(points - low, high - points) / (2 * box.margin)
    return eased(inward).prod(1)


def eased(t: Float[np.ndarray, " *n"]) -> Float[np.ndarray, " *n"]:
    """3 t^2 - 2 t^3 from 0 to 1; 0 before and 1 after."""
    t = np.clip(t, 0.0, 1.0)
    return t * t * (3 - 2 * t)
