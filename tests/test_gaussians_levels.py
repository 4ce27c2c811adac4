"""Fewer Gaussians that cover as much."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from made_up_gaussians import some_gaussians

from stages.gaussians.gaussians import Gaussians
from stages.gaussians.levels_of_detail import levels_of_detail, lightened


def covered(gaussians: Gaussians) -> float:
    """Opacity times area, all together."""
    longest = np.sort(gaussians.log_scales, axis=1)[:, 1:]
    return float((gaussians.opacities * np.exp(longest.sum(1))).sum())


def wall(side: int = 60) -> Gaussians:
    """A square of Gaussians that lie in its plane, thin across it."""
    some = some_gaussians(side**2)
    grid = np.stack(np.meshgrid(*[(np.arange(side) + 0.5) / side] * 2), -1).reshape(-1, 2)
    return replace(
        some,
        centers=np.concatenate([grid, np.zeros((side**2, 1))], axis=1).astype(np.float32),
        rotations=np.tile(np.array([1, 0, 0, 0], np.float32), (side**2, 1)),
        log_scales=np.log(np.tile(np.array([1 / side, 1 / side, 1e-4], np.float32), (side**2, 1))),
    )


@pytest.mark.parametrize("count", [1500, 400, 100])
def test_the_count_is_met_and_the_area_covered_stays(count):
    everything = some_gaussians(3000)
    light = lightened(everything, count)
    assert abs(len(light) - count) <= 1
    assert covered(light) == pytest.approx(covered(everything), rel=0.02)


def test_no_place_of_a_wall_is_left_bare():
    everything = wall()
    everything = replace(everything, opacity_logits=np.full(len(everything), 2.0, np.float32))
    light = lightened(everything, len(everything) // 9)
    counts, _, _ = np.histogram2d(*light.centers[:, :2].T, bins=5, range=[[0, 1]] * 2)
    assert counts.min() >= 0.7 * counts.mean()
    np.testing.assert_allclose(np.exp(light.log_scales[:, :2]), 3 / 60, rtol=1e-4)
    np.testing.assert_allclose(np.exp(light.log_scales[:, 2]), 1e-4, rtol=1e-4)


def test_what_covers_most_stays_as_it_is():
    everything = some_gaussians(1000)
    scales = everything.log_scales.copy()
    scales[17] = np.log(5)
    light = lightened(replace(everything, log_scales=scales), 50)
    (row,) = np.flatnonzero((light.centers == everything.centers[17]).all(1))
    np.testing.assert_array_equal(light.log_scales[row], scales[17])


def test_what_shows_nothing_goes_first():
    everything = some_gaussians(1000)
    logits = np.where(np.arange(1000) < 500, -30, 2).astype(np.float32)
    light = lightened(replace(everything, opacity_logits=logits), 300)
    assert (light.opacity_logits == 2).all()


def test_levels_halve_and_are_the_same_each_time():
    everything = some_gaussians(1000)
    levels, again = (list(levels_of_detail(everything, 3)) for _ in range(2))
    assert [len(level) for level in levels] == pytest.approx([500, 250, 125], abs=1)
    for one, other in zip(levels, again, strict=True):
        assert (one.centers == other.centers).all()
    assert lightened(everything, 1000) is everything
