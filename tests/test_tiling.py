"""A ground plan cut into blocks: nothing is left out, photos go by what they show, weights sum to one."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stages.geometry.tiling import (
    OVERLAP,
    BlockBox,
    cut_plan,
    lattice_cell,
    on_lattice,
    photo_counts,
    photos_of_blocks,
    weights,
    within,
)

PLAN = np.array([[0.0, 0.0], [40.0, 20.0]])


def survey(seed: int = 0, photos: int = 80) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points on a plain 40 x 20 with hills, photos that look down at what is within 4 of them: points, observations
    (photo, point) and the photos' places."""
    rng = np.random.default_rng(seed)
    points = np.column_stack([rng.uniform(0, 40, 4000), rng.uniform(0, 20, 4000), rng.uniform(0, 2, 4000)])
    centers = np.column_stack([rng.uniform(0, 40, photos), rng.uniform(0, 20, photos), np.full(photos, 8.0)])
    near = np.linalg.norm(centers[:, None, :2] - points[None, :, :2], axis=2) < 4
    return points, np.argwhere(near), centers


def boxes_of(count: int, seed: int = 0, cell: float = 0.125) -> list[BlockBox]:
    points, observations, centers = survey(seed)
    cores = cut_plan(PLAN, points, observations, len(centers), lambda parts, _: parts >= count)
    return on_lattice(cores, points, shown_by(observations), cell)


def shown_by(observations: np.ndarray) -> np.ndarray:
    """How many photos show each of the 4000 points."""
    return np.bincount(observations[:, 1], minlength=4000)


@pytest.mark.parametrize("count", [1, 2, 3, 5, 8])
def test_cores_tile_the_plan_on_lattice_planes(count):
    boxes = boxes_of(count)
    assert len(boxes) == count
    areas = [np.prod(box.core[1, :2] - box.core[0, :2]) for box in boxes]
    assert sum(areas) == pytest.approx(800)
    for box in boxes:
        assert (np.mod(np.concatenate([box.core, box.region]), 0.125) == 0).all()
    points = survey()[0]
    assert sum(within(points, box.core[:, :2]) for box in boxes).min() == 1, "a point in no core"
    assert all(within(points, box.core)[within(points, box.core[:, :2])].all() for box in boxes), "a core too low"


def test_regions_overlap_by_the_share_that_is_stated():
    for box in boxes_of(8):
        side = box.core[1] - box.core[0]
        assert (box.margin[:2] >= OVERLAP * side[:2]).all()
        assert (box.margin[:2] <= 0.15 * side[:2]).all()


def test_a_block_is_as_high_as_what_three_photos_show():
    core, counts = [np.array([[0.0, 0.0], [10.0, 10.0]])], np.full(100, 3)
    points = np.random.default_rng(0).uniform((0, 0, 0), (10, 10, 2), (100, 3))
    points[:2, 2], counts[:2] = (-50, 70), 2  # matched wrongly
    low, high = on_lattice(core, points, counts, 0.125)[0].core[:, 2]
    assert -1.5 <= low <= 0
    assert 2 <= high <= 3.5
    counts[5:] = 2
    low, high = on_lattice(core, points, counts, 0.125)[0].core[:, 2]
    assert min(-low - 50, high - 70) > 0, "where few points are surer than others, all count"


def test_the_heaviest_part_is_cut_so_that_all_are_as_much_work():
    points, observations, centers = survey()
    crowd = observations[centers[observations[:, 0], 0] < 10] + [len(centers), 0]  # the left quarter, flown twice
    observations = np.concatenate([observations, crowd])
    cores = cut_plan(PLAN, points, observations, 2 * len(centers), lambda parts, _: parts >= 4)
    assert 12 < min(core[1, 0] for core in cores) < 18, "the first cut is in the middle of the plan, not of the work"
    boxes = on_lattice(cores, points, shown_by(observations), 0.125)
    loads = photos_of_blocks(boxes, points, observations, np.tile(centers, (2, 1))).sum(1)
    assert loads.max() < 2 * loads.min()


def test_no_more_photos_than_are_enough():
    points, observations, centers = survey()
    cores = cut_plan(PLAN, points, observations, len(centers), lambda _, heaviest: heaviest <= 25)
    boxes = on_lattice(cores, points, shown_by(observations), 0.125)
    loads = photos_of_blocks(boxes, points, observations, centers).sum(1)
    assert loads.max() <= 27  # the lattice moves borders by half a cell
    assert len(cores) > 4


def test_photos_go_by_what_they_show_and_not_by_where_they_were_taken():
    points, observations, centers = survey()
    elsewhere = np.array([[2.0, 10.0, 3.0]])  # it stands in the left end and looks at the right one
    shown = np.flatnonzero(points[:, 0] > 34)
    observations = np.concatenate([observations, np.column_stack([np.full(len(shown), len(centers)), shown])])
    centers = np.concatenate([centers, elsewhere])
    boxes = boxes_of(4)
    seen = photos_of_blocks(boxes, points, observations, centers)[:, -1]
    for box, is_seen in zip(boxes, seen, strict=True):
        assert is_seen == (box.core[1, 0] > 34)


def test_no_photo_is_left_out():
    points, observations, centers = survey()
    centers = np.concatenate([centers, [[39.0, 19.0, 5.0], [1.0, 1.0, 5.0]]])  # one shows nothing, one three points
    few = np.flatnonzero(points[:, 0] > 38)[:3]
    observations = np.concatenate([observations, np.column_stack([np.full(3, len(centers) - 1), few])])
    boxes = boxes_of(6)
    seen = photos_of_blocks(boxes, points, observations, centers)
    assert seen.any(0).all()
    nearest = [box.core[1].tolist()[:2] == [40.0, 20.0] for box in boxes].index(True)
    assert np.flatnonzero(seen[:, -2]).tolist() == [nearest]
    assert all(boxes[k].region[1, 0] > 38 for k in np.flatnonzero(seen[:, -1]))


def test_counts_are_of_chosen_points_only():
    observations = np.array([[0, 0], [0, 1], [1, 1], [2, 2]])
    assert photo_counts(observations, np.array([False, True, True]), 4).tolist() == [1, 1, 1, 0]


@given(st.integers(2, 9), st.integers(0, 3))
def test_weights_sum_to_one_and_end_at_the_region(count, seed):
    boxes = boxes_of(count, seed)
    rng = np.random.default_rng(seed)
    points = np.concatenate([rng.uniform(box.core[0], box.core[1], (200, 3)) for box in boxes])
    found = weights(boxes, points)
    np.testing.assert_allclose(found.sum(0), 1.0, atol=1e-12)
    for box, weight in zip(boxes, found, strict=True):
        assert (weight[~within(points, box.region)] == 0).all()
        assert (weight[within(points, box.core)] > 0).all()


def test_weights_are_smooth_and_even_at_a_border():
    core = np.array([[0.0, 0.0, 0.0], [8.0, 8.0, 4.0]])
    margin = np.array([1.0, 1.0, 1.0])
    boxes = [BlockBox(core, margin), BlockBox(core + np.array([8.0, 0, 0]), margin)]
    x = np.linspace(5, 11, 601)
    first, _ = weights(boxes, np.column_stack([x, np.full_like(x, 4.0), np.full_like(x, 2.0)]))
    assert first[300] == pytest.approx(0.5)
    assert first[x < 7].min() == 1.0
    assert first[x > 9].max() == 0.0
    assert np.abs(np.diff(first)).max() < 0.02
    assert (np.diff(first) <= 1e-12).all()


def test_touching_is_by_the_region_and_not_by_the_core():
    core, margin = np.array([[0.0, 0.0, 0.0], [8.0, 8.0, 4.0]]), np.ones(3)
    box = BlockBox(core, margin)
    assert box.touches(BlockBox(core + np.array([8.0, 8.0, 0]), margin))
    assert box.touches(BlockBox(core + np.array([9.0, 0, 50.0]), margin))
    assert not box.touches(BlockBox(core + np.array([9.5, 0, 0]), margin))


@given(st.floats(1e-6, 1e6))
def test_multiples_of_a_cell_are_exact(size):
    from fractions import Fraction

    cell = lattice_cell(size)
    assert size <= cell <= size * (1 + 2**-7)
    assert Fraction(cell * 1_234_567) == Fraction(cell) * 1_234_567


def test_a_cell_of_no_size_is_refused():
    with pytest.raises(ValueError, match="positive"):
        lattice_cell(0.0)
