"""Places in nested groups of neighbours: a tree over what is too much to be looked at together."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from jaxtyping import Float

Group = tuple[Any, ...]
"""Rows (int), or groups of them in place of some."""


def quartered(places: Float[np.ndarray, "n 3"], most: int) -> Group:
    """All places in one group, of at most `most` rows; else of four groups alike, by halving across the longest side.

    Args:
        places: one or more. most: >= 4.

    Raises:
        ValueError: there is no place, or `most` is too small.
    """
    if not len(places) or most < 4:
        raise ValueError(f"expected places in groups of 4 or more, got {len(places)} in groups of {most}")
    return _grouped(places, np.arange(len(places)), most)


def groups_in(group: Group) -> int:
    """How many groups it is, itself and all within."""
    return 1 + sum(groups_in(each) for each in group if not isinstance(each, int))


def _grouped(places: np.ndarray, rows: np.ndarray, most: int) -> Group:
    if len(rows) <= most:
        return tuple(rows.tolist())
    halves = _halves(places, rows)
    return tuple(_grouped(places, quarter, most) for half in halves for quarter in _halves(places, half))


def _halves(places: np.ndarray, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The lower and the upper half along the axis that they are spread over the most."""
    axis = int(np.argmax(np.ptp(places[rows], axis=0)))
    ordered = rows[np.argsort(places[rows, axis], kind="stable")]
    return ordered[: len(rows) // 2], ordered[len(rows) // 2 :]
