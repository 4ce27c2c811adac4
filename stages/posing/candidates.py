"""Which pairs of many photos may show the same, before features of any two are compared.

Comparing the largest features of all pairs (`stages.posing.pairs`) grows with the square of the photos, so that of
many photos only some pairs are compared: those near each other in space, where photos carry GPS positions; those next
to each other in name, since most captures are a walk or a flight; and those that look alike, wherever they are. These
close the loops of a walk, and make up for positions that are wrong or do not tell what a tilted camera looks at.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from stages.artifacts import ImageRecord
from stages.geometry.earth import east_north_up, middle_position
from stages.posing.looks import signatures
from stages.posing.pairs import in_order, largest_descriptors

if TYPE_CHECKING:
    from jaxtyping import Float

log = logging.getLogger(__name__)

Pairs = set[tuple[int, int]]

NEAREST = 60  # photos near one in space
NEXT_IN_NAME = 20  # photos to each side of one in the order of names
ALIKE = 40  # photos further away in name that look like one
FEATURES = 1200  # of each photo, the largest, that tell what it looks like
ROWS_AT_ONCE = 256  # of photos compared with all


def candidate_pairs(
    database: Path, positions: Mapping[str, Float[np.ndarray, " 3"]], seed: int = 0
) -> list[tuple[int, int]]:
    """Pairs of image ids, sorted, the first of each the smaller one.

    Args:
        database: with features.
        positions: photo -> metres, of those photos whose position is known.
    """
    import pycolmap

    with pycolmap.Database.open(database) as opened:
        ids = {image.name: image.image_id for image in opened.read_all_images()}
        names = sorted(ids)
        looks = signatures([largest_descriptors(opened, ids[name], FEATURES) for name in names], seed)
    placed = [rank for rank, name in enumerate(names) if name in positions]
    near = {
        (placed[i], placed[j])
        for i, j in near_in_space(np.array([positions[names[rank]] for rank in placed]).reshape(-1, 3), NEAREST)
    }
    beside, alike = next_in_order(len(names), NEXT_IN_NAME), alike_and_apart(looks, ALIKE, NEXT_IN_NAME)
    pairs = near | beside | alike
    log.info(
        "%d of all %d pairs of %d photos may show the same: %d near in space (%d photos carry a usable GPS position), "
        "%d next in name, %d alike",
        len(pairs), len(names) * (len(names) - 1) // 2, len(names), len(near), len(placed), len(beside), len(alike),
    )  # fmt: skip
    return sorted(in_order(ids[names[i]], ids[names[j]]) for i, j in pairs)


def positions_of(records: Sequence[ImageRecord]) -> dict[str, Float[np.ndarray, " 3"]]:
    """Photo -> metres east, north and up of their middle, from GPS; none where most photos carry the same position."""
    placed = [record for record in records if record.gps is not None]
    if len({record.gps for record in placed}) < max(2, len(placed) / 2):
        return {}
    positions = np.array([record.gps for record in placed])
    metres = east_north_up(positions, middle_position(positions))
    return {record.name: own for record, own in zip(placed, metres, strict=True)}


def near_in_space(positions: Float[np.ndarray, "n 3"], count: int) -> Pairs:
    """Pairs (i < j) of a place and those nearest to it, height counted as any other direction."""
    from scipy.spatial import cKDTree

    if len(positions) < 2:
        return set()
    _, nearest = cKDTree(positions).query(positions, k=min(count + 1, len(positions)))
    return _pairs_of(nearest)


def next_in_order(number: int, apart: int) -> Pairs:
    """Pairs (i < j) up to so many apart."""
    return {(i, j) for i in range(number) for j in range(i + 1, min(i + 1 + apart, number))}


def alike_and_apart(looks: Float[np.ndarray, "n d"], count: int, apart: int) -> Pairs:
    """Pairs (i < j) of a photo and those that look most like it, of those more than so many apart."""
    pairs, ranks = Pairs(), np.arange(len(looks))
    for start in range(0, len(looks), ROWS_AT_ONCE):
        some = ranks[start : start + ROWS_AT_ONCE]
        likeness = looks[some] @ looks.T
        likeness[np.abs(some[:, None] - ranks) <= apart] = -np.inf
        best = np.argsort(-likeness, axis=1, kind="stable")[:, :count]
        best = np.where(np.isneginf(np.take_along_axis(likeness, best, axis=1)), some[:, None], best)
        pairs |= _pairs_of(best, start)
    return pairs


def _pairs_of(partners: np.ndarray, first: int = 0) -> Pairs:
    """Pairs (i < j) of row i, counted from `first`, and each of its partners but itself."""
    return {in_order(i, j) for i, row in enumerate(partners.tolist(), first) for j in row if i != j}
