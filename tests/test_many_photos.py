"""The made-up survey: what it shows and hides, its database, and the tables of what was measured on it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from benchmarks import made_up_survey, many_photos
from benchmarks.made_up_survey import FOCAL_PX, RADIAL, SIZE, Survey, fly, hidden, looking, overlaps, project


def test_a_camera_straight_down_and_one_that_is_tilted():
    down = looking(90.0, 0.0, 0.0)
    np.testing.assert_allclose(down, np.array([[1, 0, 0], [0, -1, 0], [0, 0, -1.0]]), atol=1e-12)
    tilted = looking(0.0, 90.0, 0.0)
    np.testing.assert_allclose(tilted[:, 2], [1, 0, 0], atol=1e-12)  # ahead is east
    np.testing.assert_allclose(tilted[:, 1], [0, 0, -1], atol=1e-12)  # down is down
    assert np.linalg.det(looking(17.0, 35.0, 3.0)) == pytest.approx(1)


def test_points_are_where_colmap_projects_them():
    import pycolmap

    camera = pycolmap.Camera(model="SIMPLE_RADIAL", width=SIZE[0], height=SIZE[1],
                             params=[FOCAL_PX, SIZE[0] / 2, SIZE[1] / 2, RADIAL])  # fmt: skip
    rotation, center = looking(30.0, 20.0, 2.0), np.array([3.0, -2.0, 80.0])
    points = np.array([[10.0, 5.0, 0.0], [20.0, 30.0, 12.0]])
    pixels, depth = project(rotation, center, points)
    assert (depth > 50).all()
    np.testing.assert_allclose(pixels, camera.img_from_cam((points - center) @ rotation), atol=1e-6)


def test_a_house_hides_what_is_behind_it_and_not_its_own_roof():
    boxes = np.array([[[-5, -5, 0], [5, 5, 20.0]]])
    center = np.array([0.0, -60.0, 30.0])
    points = np.array([[0, 10, 0], [0, -5, 10], [0, 0, 20], [30, 10, 0.0]])
    assert hidden(center, points, boxes).tolist() == [True, False, False, False]


def test_flights_cross_each_other_and_photos_overlap_along_them():
    rotations, centers = fly(60, np.random.default_rng(0))
    assert rotations.shape == (60, 3, 3)
    assert (rotations[:30, 2, 2] < -0.9).all()  # straight down
    assert (rotations[30:, 2, 2] > -0.95).all()
    assert np.ptp(centers[:, 0]) == pytest.approx(np.ptp(centers[:, 1]), rel=0.5)


def test_photos_that_share_points():
    points = tuple(np.array(each) for each in ([0, 1, 2, -1], [2, 1, -1, -1], [9]))
    survey = Survey(("a", "b", "c"), np.zeros((3, 3, 3)), np.zeros((3, 3)), points)
    assert overlaps(survey).tolist() == [[0, 2, 0], [2, 0, 0], [0, 0, 0]]


def test_a_small_survey_is_a_database_whose_photos_share_what_they_see(tmp_path: Path, monkeypatch):
    import pycolmap

    monkeypatch.setattr(made_up_survey, "DENSITY", 0.02)
    survey = made_up_survey.write_survey(tmp_path / "a.db", photos=4, features=200)
    with pycolmap.Database.open(tmp_path / "a.db") as opened:
        assert sorted(image.name for image in opened.read_all_images()) == list(survey.names)
        assert opened.num_pose_priors() == 4
        for number, points in enumerate(survey.points):
            assert opened.num_keypoints_for_image(number + 1) == len(points) > 20
            assert opened.num_descriptors_for_image(number + 1) == len(points)
    assert overlaps(survey)[0, 1] > 5


def test_part_of_the_true_pairs_that_were_found():
    true = np.array([[0, 1, 1], [1, 0, 0], [1, 0, 0]], bool)
    assert many_photos.found(true, [(1, 2), (2, 3)]) == 0.5


def test_rows_of_both_tables(tmp_path: Path, monkeypatch):
    monkeypatch.setattr(many_photos, "ROWS", tmp_path)
    assert set(many_photos.tables().values()) == {"Not measured yet."}
    pairs = {
        "candidates": 500, "pairs": 100, "true_share": 0.9, "candidates_found": 0.8, "true_found": 0.5,
        "strong_found": 0.95, "choosing_seconds": 3.2, "matching_seconds": 60.4, "peak_rss": 1 << 30,
    }  # fmt: skip
    poses = {"registered": 50, "median_error_m": 0.0154, "median_error_deg": 0.0115, "error_px": 0.58,
             "mapping_seconds": 12.4, "peak_rss": 1 << 29}  # fmt: skip
    for step, row in (("pairs", pairs), ("global", poses), ("incremental", {**poses, "registered": 0})):
        many_photos.row_path(step, 50).write_text(json.dumps(row), encoding="utf-8")
    written = many_photos.tables()
    assert "| 50 | yes | 20 | 4.0 | 90 | 80 | 50 | 95 | 3 | 60 | 1.00 |" in written["many-photos-pairs"]
    assert "| 50 | global | 50 | 1.5 | 0.011 | 0.58 | 12 | 0.50 |" in written["many-photos-poses"]
    assert "| 50 | incremental | 0 | - | - | - | 12 | 0.50 |" in written["many-photos-poses"]
