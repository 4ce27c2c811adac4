"""Things far apart are two subjects, things side by side are one, and photos of something else are in none."""

from __future__ import annotations

import numpy as np
import pytest
from rigs import capture, ring, sightings

from stages.errors import ConfigError
from stages.geometry.layout import find_layout
from stages.geometry.subjects import find_subjects
from stages.undistort import _chosen

SIZE = 0.5  # diameter of each thing


def things(*photos: int, apart: float):
    """An orbit of so many photos around each of several balls in a row on one floor; with its tracks."""
    random = np.random.default_rng(0)
    middles = [np.array([k * apart, 0, SIZE / 2]) for k in range(len(photos))]
    cameras = capture(
        [pose for m, count in zip(middles, photos, strict=True) for pose in ring(m, count=count, distance=1.2)]
    )
    ball = random.normal(size=(len(photos), 300, 3))
    balls = SIZE / 2 * ball / np.linalg.norm(ball, axis=2, keepdims=True) + np.array(middles)[:, None]
    floor = random.uniform([-2, -2, 0], [apart * len(photos), 2, 0], (int(300 * apart), 3))
    points = np.concatenate([*balls, floor])
    return cameras, points, sightings(cameras, points), middles


def test_two_things_fifteen_diameters_apart_are_two_and_most_photos_come_first():
    cameras, points, observations, middles = things(12, 20, apart=15 * SIZE)
    subjects = find_subjects(cameras, points, observations)
    assert [list(subject.photos) for subject in subjects] == [list(range(12, 32)), list(range(12))]
    for subject, middle in zip(subjects, middles[::-1], strict=True):
        region = find_layout(cameras, points, observations, photos=subject.photos).region
        assert np.linalg.norm(region.center - middle) < 0.1
        assert SIZE / 2 < region.radius < 2 * SIZE


def test_as_many_photos_of_each_no_longer_make_a_region_of_all_the_room():
    cameras, points, observations, _ = things(12, 12, apart=15 * SIZE)
    assert find_layout(cameras, points, observations).region.radius > 10 * SIZE  # what it is without
    subjects = find_subjects(cameras, points, observations)
    region = find_layout(cameras, points, observations, photos=subjects[0].photos).region
    assert region.radius < 2 * SIZE


@pytest.mark.parametrize("apart", [1.0, 2.0, 3.0])
def test_two_things_near_each_other_stay_one(apart: float):
    cameras, points, observations, _ = things(12, 12, apart=apart * SIZE)
    assert len(find_subjects(cameras, points, observations)) == 1


@pytest.mark.parametrize("others", [1, 2])
def test_photos_of_something_else_do_not_move_the_region(others: int):
    cameras, points, observations, middles = things(20, others, apart=15 * SIZE)
    subjects = find_subjects(cameras, points, observations)
    assert [list(subject.photos) for subject in subjects] == [list(range(20))]
    region = find_layout(cameras, points, observations).region
    assert np.linalg.norm(region.center - middles[0]) < 0.1
    assert region.radius < 2 * SIZE


def test_three_things_give_two_warnings_each_with_its_command():
    cameras, points, observations, _ = things(14, 12, 10, apart=15 * SIZE)
    subjects = find_subjects(cameras, points, observations)
    photos, warnings = _chosen(subjects, cameras.names, 1)
    assert list(photos) == list(range(14))
    assert [warning["command"].split()[-1] for warning in warnings] == ["undistort.subject=2", "undistort.subject=3"]
    assert "14 photos are about is reconstructed (000.png to 013.png)" in warnings[0]["sentence"]
    assert "12 others (014.png to 025.png) are about something" in warnings[0]["sentence"]
    second, warnings = _chosen(subjects, cameras.names, 2)
    assert list(second) == list(range(14, 26))
    assert [warning["command"].split()[-1] for warning in warnings] == ["undistort.subject=1", "undistort.subject=3"]
    with pytest.raises(ConfigError, match=r"`undistort.subject` is 4, but the photos are about 3"):
        _chosen(subjects, cameras.names, 4)


def test_without_points_there_is_no_subject_and_nothing_to_choose():
    cameras = capture(ring(np.zeros(3)))
    assert find_subjects(cameras, np.zeros((0, 3)), np.zeros((0, 2), np.int32)) == []
    assert _chosen([], cameras.names, 1) == (None, [])
