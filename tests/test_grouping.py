"""Places in nested groups of neighbours."""

from __future__ import annotations

import numpy as np
import pytest

from stages.geometry.grouping import Group, groups_in, quartered


def rows(group: Group) -> list[int]:
    return [row for each in group for row in ([each] if isinstance(each, int) else rows(each))]


def grid(side: int) -> np.ndarray:
    x, y = np.meshgrid(np.arange(side), np.arange(side))
    return np.column_stack([x.ravel(), y.ravel(), np.zeros(side * side)]).astype(float)


def test_few_are_one_group():
    assert quartered(grid(2), 8) == (0, 1, 2, 3)
    assert groups_in((0, 1, 2, 3)) == 1


def test_sixteen_are_four_squares():
    found = quartered(grid(4), 8)
    assert groups_in(found) == 5
    for group in found:
        corner = grid(4)[list(group)]
        assert np.ptp(corner, axis=0).tolist() == [1, 1, 0]
    assert sorted(rows(found)) == list(range(16))


@pytest.mark.parametrize("count", [1, 9, 10, 100, 333])
def test_each_is_in_one_group_and_no_group_is_too_large(count):
    found = quartered(np.random.default_rng(0).normal(size=(count, 3)), 8)
    assert sorted(rows(found)) == list(range(count))

    def largest(group: Group) -> int:
        return max(len(group), *(largest(each) for each in group if not isinstance(each, int)), 1)

    assert largest(found) <= 8


def test_what_cannot_be_grouped_is_refused():
    with pytest.raises(ValueError, match="got 0 in groups of 8"):
        quartered(np.zeros((0, 3)), 8)
