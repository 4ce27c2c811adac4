"""Where refined Gaussians may go, and how they are split and left out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from made_up_gaussians import some_gaussians

from stages.gaussians.refining import (
    ACROSS,
    ALONG,
    AROUND,
    HALF_OFFSET,
    HALF_SIZE,
    Anchors,
    Moments,
    _halves,
    _split_and_prune,
)


def anchors_at(points: np.ndarray) -> Anchors:
    return Anchors(points, np.tile(np.float32([0, 0, 1]), (len(points), 1)), extent=1.0)


def test_what_strays_is_brought_back_to_its_bounds_and_the_rest_stays():
    anchors = anchors_at(np.zeros((4, 3), np.float32))
    near = [0.5 * ACROSS, 0, 0.5 * ALONG]
    centers = np.float32([near, [0, 0, -1], [3, 4, 0], [3, 4, 1]])
    anchors.hold(centers, np.array([0, 1, 2]))
    np.testing.assert_allclose(centers[0], near, rtol=1e-6)
    np.testing.assert_allclose(centers[1], [0, 0, -ALONG], rtol=1e-6)
    np.testing.assert_allclose(centers[2], [0.6 * ACROSS, 0.8 * ACROSS, 0], rtol=1e-6)
    np.testing.assert_array_equal(centers[3], [3, 4, 1])  # not asked for


def test_what_has_no_surface_stays_in_a_ball_around_its_point():
    anchors = Anchors(np.zeros((2, 3)), np.zeros((2, 3)), extent=2.0)
    centers = np.array([[0, 0, 5.0], [0.01, 0.01, 0]], np.float32)
    anchors.hold(centers, np.array([0, 1]))
    np.testing.assert_allclose(centers, [[0, 0, 2 * AROUND], [0.01, 0.01, 0]], rtol=1e-6)


def test_halves_lie_on_both_sides_along_the_longest_axis():
    half = np.sqrt(0.5)
    one = replace(
        some_gaussians(1),
        rotations=np.float32([[half, 0, 0, half]]),  # a quarter turn about z brings x to y
        log_scales=np.log(np.float32([[0.2, 0.1, 0.01]])),
        centers=np.float32([[1, 2, 3]]),
    )
    first, second = _halves(one)
    np.testing.assert_allclose(first.centers, [[1, 2 + 0.2 * HALF_OFFSET, 3]], atol=1e-6)
    np.testing.assert_allclose(second.centers, [[1, 2 - 0.2 * HALF_OFFSET, 3]], atol=1e-6)
    np.testing.assert_allclose(np.exp(first.log_scales), [[0.2 / HALF_SIZE, 0.1, 0.01]], rtol=1e-5)


@pytest.mark.parametrize("room", [0, 1])
def test_the_one_with_most_pull_is_split_and_a_transparent_one_goes(room):
    gaussians = replace(some_gaussians(4), opacity_logits=np.float32([0, 0, -20, 0]))
    moments = Moments.none(gaussians)
    moments.means["centers"][:] = 1
    pull = np.float32([0.1, 5, 9, 0.2])
    found, anchors, after = _split_and_prune(gaussians, anchors_at(gaussians.centers), moments, pull, room)
    assert len(found) == 3 + room
    np.testing.assert_array_equal(found.centers[:2], gaussians.centers[[0, 1] if room == 0 else [0, 3]])
    np.testing.assert_array_equal(anchors.points[-1], gaussians.centers[3 if room == 0 else 1])
    assert after.means["centers"][-1].any() == (room == 0)  # the new ones start without any
