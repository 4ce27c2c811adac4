"""What photos are about: near points that several photos see, with lines of sight that differ."""

from __future__ import annotations

import numpy as np
import pytest
from rigs import capture, look_at, ring, sightings

from stages.geometry.attention import MAX_BEHIND, MIN_LOOKING, MIN_POINTS, attended, parallax_deg, photos_looking_at

NEAR = np.random.default_rng(0).uniform(-0.5, 0.5, (40, 3))


def row(count: int, step: float = 0.3) -> list[np.ndarray]:
    """Cameras side by side, five before the origin, all looking along +y."""
    return [look_at(np.array([step * i, -5.0, 0]), np.array([step * i, 0.0, 0])) for i in range(count)]


def test_what_lies_far_behind_is_background_and_what_is_beside_the_frame_is_not_seen():
    cameras = capture(row(4))
    behind = np.array([[0.0, 5 * MAX_BEHIND, 0]])
    beside = np.array([[9.0, 0, 0]])
    points = np.concatenate([NEAR, behind, beside])
    looking = photos_looking_at(cameras, points, sightings(cameras, points))
    assert (looking[:40] == 4).all()
    assert looking[40:].tolist() == [0, 0]


def test_background_counts_where_photos_show_nothing_nearer():
    cameras = capture(row(4))
    wall = np.array([0.0, 10, 0]) + NEAR
    assert (photos_looking_at(cameras, wall, sightings(cameras, wall)) == 4).all()


def test_a_photo_with_few_points_says_nothing():
    cameras = capture(row(4))
    few = NEAR[: MIN_POINTS - 1]
    assert not photos_looking_at(cameras, few, sightings(cameras, few)).any()


def test_parallax_is_the_angle_between_lines_of_sight():
    cameras = capture(row(2, step=2.0))
    point = np.array([[1.0, 0, 0]])
    both, one = np.array([[0, 0], [1, 0]]), np.array([[0, 0]])
    assert parallax_deg(cameras, point, both)[0] == pytest.approx(2 * np.degrees(np.arctan2(1, 5)))
    assert parallax_deg(cameras, point, one)[0] == pytest.approx(0, abs=1e-5)


@pytest.mark.parametrize(("photos", "step", "about"), [(MIN_LOOKING, 0.3, True), (2, 0.3, False), (4, 0.01, False)])
def test_it_takes_several_photos_from_different_places(photos: int, step: float, about: bool):
    cameras = capture(row(photos, step))
    assert (attended(cameras, NEAR, sightings(cameras, NEAR)) == about).all()


def test_of_many_photos_a_part_has_to_look():
    cameras = capture(ring(np.zeros(3), count=200))
    points = np.concatenate([NEAR, [[0.0, 0, 0.6]]])
    seen = sightings(cameras, points)
    seen = seen[(seen[:, 1] < 40) | (seen[:, 0] % 66 == 0)]  # the last one in four photos of 200
    found = attended(cameras, points, seen)
    assert found[:40].all()
    assert found[40]
    assert not attended(cameras, points, seen[(seen[:, 1] < 40) | (seen[:, 0] > 66)])[40]
