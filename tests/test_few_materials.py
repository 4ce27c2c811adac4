"""Few materials, chosen by all points together."""

from __future__ import annotations

import numpy as np

from stages.shading.few_materials import MOST_MATERIALS, choose_few, few_colors, heard, neighbors, of_one_kind


def costs_of(which: np.ndarray, noise: float = 0.0) -> np.ndarray:
    """[S, 20]: 0.2 for the planted candidate, 1 for the others."""
    costs = np.ones((len(which), 20))
    costs[np.arange(len(which)), which] = 0.2
    return costs + noise * np.random.default_rng(0).normal(size=costs.shape)


def test_the_planted_ones_are_chosen():
    which = np.repeat([3, 12, 17], [50, 30, 20])
    chosen = choose_few(costs_of(which))
    assert set(chosen) == {3, 12, 17}
    assert chosen[0] == 3  # what fits most comes first


def test_noise_adds_no_material():
    costs = heard(costs_of(np.full(400, 5), noise=0.05), np.random.default_rng(1).integers(0, 400, (400, 16)))
    assert choose_few(costs) == [5]


def test_two_points_of_a_thousand_are_no_material():
    which = np.full(1000, 5)
    which[:2] = 9
    assert choose_few(costs_of(which)) == [5]


def test_there_are_no_more_than_so_many():
    assert len(choose_few(costs_of(np.arange(2000) % (MOST_MATERIALS + 2)))) == MOST_MATERIALS


def test_a_paint_is_of_one_kind_unless_both_serve_it_clearly_better():
    """The first paint looks a little more like the other kind at some points, the second is half of each."""
    costs = np.array([[0.5, 0.52]] * 7 + [[0.52, 0.5]] * 3 + [[0.2, 0.9]] * 5 + [[0.9, 0.2]] * 5)
    paint = np.repeat([4, 7], 10)
    allowed = of_one_kind(costs, np.array([0, 1]), paint, worth=0.1)
    assert (allowed[paint == 4].argmin(1) == 0).all()
    assert (allowed[paint == 7] == costs[paint == 7]).all()


def test_roughnesses_of_one_kind_stay_free():
    costs = np.random.default_rng(0).random((20, 3))
    np.testing.assert_array_equal(of_one_kind(costs, np.zeros(3, int), np.zeros(20, int), worth=0.1), costs)


def test_each_point_is_its_own_first_neighbour_and_others_look_alike():
    rng = np.random.default_rng(0)
    positions = rng.random((200, 3))
    colors = np.where(positions[:, :1] > 0.5, 0.9, 0.1) * np.ones(3)
    near = neighbors(positions, colors)
    assert near.shape == (200, 16)
    assert (near[:, 0] == np.arange(200)).all()
    assert (colors[near] == colors[:, None]).mean() > 0.99


def test_fewer_points_than_neighbours_hear_each_other():
    positions = np.random.default_rng(0).random((5, 3))
    near = neighbors(positions, np.zeros((5, 3)))
    assert near.shape == (5, 5)
    values = np.arange(10.0).reshape(5, 2)
    np.testing.assert_allclose(heard(values, near), np.broadcast_to(values.mean(0), (5, 2)))


def test_hearing_keeps_the_mean_of_a_ring_and_takes_its_noise():
    near = (np.arange(100)[:, None] + np.arange(-2, 3)) % 100
    values = np.random.default_rng(0).normal(size=(100, 1))
    after = heard(values, near)
    assert abs(after.mean() - values.mean()) < 1e-12
    assert after.std() < 0.5 * values.std()


def test_shades_of_one_paint_are_one_and_paints_stay_apart():
    rng = np.random.default_rng(0)
    paints = np.array([[0.6, 0.2, 0.1], [0.1, 0.3, 0.6]])
    which = np.arange(300) % 2
    shaded = (paints[which] * rng.uniform(0.8, 1.25, (300, 1))).astype(np.float32)
    found = few_colors(shaded)
    assert len(np.unique(found, axis=0)) == 2
    np.testing.assert_allclose(found, paints[which], rtol=0.1)
