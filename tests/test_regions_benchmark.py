"""The benchmark of regions: its simulated points, what is seen of a subject, how a sphere is scored, its tables."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from benchmarks import region_cuts, regions
from benchmarks.captures import kinds, photos
from benchmarks.captures.model import Capture
from benchmarks.captures.shapes import block, flat, lump, sheet
from benchmarks.captures.subject import fit, seen_points
from benchmarks.captures.tracks import FALSE_SHARE, MAX_ERROR_PX, simulate
from benchmarks.captures.walks import orbit, shot
from stages.evaluation.protocols.known_object import load_known_object
from stages.geometry.region import enclosing_sphere
from stages.geometry.similarity import Similarity

BALL = (lump((0, 0, 1), (1, 1, 1), 0.8),)


def ball_on_a_floor(*more) -> Capture:
    shots = orbit((0, 0, 1), 3.0, (1.5, 2.0), np.random.default_rng(2))
    return Capture(BALL, (flat((0, 0, 0), 20, 20, 0.5), *more), shots)


# ---------------------------------------------------------------- simulated points
def test_observations_are_of_points_in_the_frame_near_the_true_surfaces():
    posed = simulate(ball_on_a_floor(), np.random.default_rng(0))
    assert len(posed.points) > 500
    image, point = posed.observations.T
    assert set(point) == set(range(len(posed.points)))
    inside = 0
    for i in range(len(posed.cameras)):
        pixels, depths = posed.cameras.project(i, posed.points[point[image == i]])
        margin = MAX_ERROR_PX * 3
        inside += ((depths > 0) & (pixels > -margin).all(1) & (pixels < posed.cameras.sizes[i] + margin).all(1)).sum()
    assert inside / len(image) > 1 - 2 * FALSE_SHARE
    from_ball = np.abs(np.linalg.norm(posed.points - [0, 0, 1], axis=1) - 0.5)
    off = np.minimum(from_ball, np.abs(posed.points[:, 2]))
    assert np.median(off) < 0.01
    assert 0.002 < (off > 0.2).mean() < 3 * FALSE_SHARE  # the false ones


def test_the_same_random_numbers_give_the_same_points():
    first, again = (simulate(ball_on_a_floor(), np.random.default_rng(5)) for _ in range(2))
    np.testing.assert_array_equal(first.points, again.points)
    np.testing.assert_array_equal(first.observations, again.observations)


def test_nothing_is_found_where_there_is_no_texture_or_behind_a_wall():
    def on_ball(capture: Capture) -> int:
        points = simulate(capture, np.random.default_rng(0)).points
        return int((np.linalg.norm(points - [0, 0, 1], axis=1) < 0.55).sum())

    whole = on_ball(ball_on_a_floor())
    assert on_ball(ball_on_a_floor().plain(0.0)) < 0.05 * whole
    walls = [sheet((x, y, 2), (x, y, 0), (4, 4), 0.5) for x, y in ((2, 0), (-2, 0), (0, 2), (0, -2))]
    assert on_ball(ball_on_a_floor(*walls)) < 0.05 * whole


# ---------------------------------------------------------------- score
def test_a_sphere_that_holds_the_subject_scores_all_of_it_and_one_of_half_the_size_less():
    points = seen_points(ball_on_a_floor())
    center, radius = enclosing_sphere(points)
    whole, half = fit(points, center, 1.001 * radius), fit(points, center, 0.5 * radius)
    assert whole.inside == 100
    assert whole.sphere_ratio == pytest.approx(1.003, abs=1e-3)
    assert half.inside < 50
    assert half.sphere_ratio == pytest.approx(0.125)


def test_the_smallest_sphere_about_a_box():
    corners = np.array([[x, y, z] for x in (0, 2) for y in (0, 3) for z in (0, 6)], dtype=float)
    center, radius = enclosing_sphere(corners)
    np.testing.assert_allclose(center, [1, 1.5, 3], atol=0.02)
    assert radius == pytest.approx(3.5, abs=0.01)


def test_only_what_two_photos_see_is_asked_for():
    behind = np.array([shot((x, -3, 1.2), (0, 0, 1), np.random.default_rng(1)) for x in (-0.2, 0, 0.2)])
    seen = seen_points(replace(ball_on_a_floor(), cam_from_world=behind))
    assert (seen[:, 1] < 0.15).all()  # the front
    single = replace(ball_on_a_floor(), cam_from_world=behind[:1])
    with pytest.raises(ValueError, match="no photo shows"):
        seen_points(single)
    hidden = ball_on_a_floor(block((0, 0, 1), (1.4, 1.4, 1.4), 0.5))
    with pytest.raises(ValueError, match="no photo shows"):
        seen_points(hidden)


# ---------------------------------------------------------------- captures
@pytest.mark.parametrize("name", [name for name in kinds.KINDS if "," not in name])
def test_photos_of_each_capture_show_its_subject_and_give_points(name: str):
    capture = kinds.make(name)
    subject = seen_points(capture, 1000)
    assert len(subject) > 300
    posed = simulate(capture, np.random.default_rng(0), 200)
    _, radius = enclosing_sphere(subject)
    assert len(posed.points) > 150
    # cameras stand in the open: not within the subject, nor before a wall's back
    depths = np.linalg.norm(
        posed.points[posed.observations[:, 1]] - posed.cameras.centers[posed.observations[:, 0]], axis=1
    )
    assert np.median(depths) > 0.05 * radius


def test_a_plain_capture_differs_from_its_original_in_texture_alone():
    original, plain = kinds.make("trophy"), kinds.make("trophy, plain")
    np.testing.assert_array_equal(original.cam_from_world, plain.cam_from_world)
    assert plain.subject[0].texture == pytest.approx(kinds.PLAIN * original.subject[0].texture)
    assert plain.surroundings[0].texture == original.surroundings[0].texture


@pytest.mark.parametrize("name", ["boulder", "car"])
def test_a_subject_that_no_photo_shows_whole_is_in_its_region(name: str):
    capture = kinds.make(name)
    capture = replace(capture, focal=2.2 * capture.focal)
    subject, posed = seen_points(capture, 1000), simulate(capture, np.random.default_rng(0), 300)
    assert max(capture.cameras.in_frame(i, subject).mean() for i in range(len(capture.cameras))) < 0.6
    region = regions.region_of(posed)
    assert fit(subject, region.center, region.radius).inside == 100


# ---------------------------------------------------------------- tables
def _row(name: str, inside: float, volume: float) -> regions.Row:
    return regions.Row(regions.MADE_UP, name, "what", inside, volume, 9.0, "object", "words", 0.5, 1000)


def test_a_summary_counts_whole_subjects_only_and_a_row_shows_before_and_now():
    before = {"a": _row("a", 99.99, 2.0), "b": _row("b", 100.0, 6.0)}
    now = {"a": _row("a", 100.0, 3.0), "b": _row("b", 100.0, 5.0)}
    lines = regions.summary_table(now, before).splitlines()
    assert lines[2] == "| made-up | 0.1.0 | 1 of 2 | 99.99 | 4.0 | 6.0 |"
    assert lines[3] == "| made-up | now | 2 of 2 | 100 | 4.0 | 5.0 |"
    table = regions.capture_table([now["a"]], before).splitlines()
    assert table[2] == "| a | what | 99.99 | 2.0 | 100 | 3.0 | 9 | 0.50 | object |"


def test_results_survive_their_file(tmp_path, monkeypatch):
    monkeypatch.setattr(regions, "RESULTS", tmp_path)
    rows = {"a": _row("a", 99.0, 2.0)}
    regions.save_rows(rows, "now")
    assert regions.load_rows("now") == rows
    assert regions.load_rows("older") == {}


# ---------------------------------------------------------------- photos
@pytest.mark.slow
def test_rendered_photos_show_the_subject_where_the_stated_cameras_have_it(tmp_path, monkeypatch):
    """A plain white ball on a black floor: its middle is bright, the photo's corner below is not."""
    pytest.importorskip("mitsuba")
    monkeypatch.setattr(photos, "LONG_SIDE", 64)
    ball, floor = (
        (lump((0, 0, 1), (1, 1, 1), 0.0, (0.9, 0.9, 0.9)),),
        (flat((0, 0, 0), 40, 40, 0.0, (0.02, 0.02, 0.02)),),
    )
    shots = orbit((0, 0, 1), 3.0, (2.5,), np.random.default_rng(2), count=3)
    photos.render(Capture(ball, floor, shots), "ball", tmp_path)
    known = load_known_object(tmp_path)
    np.testing.assert_allclose(known.cameras.extrinsics, shots[:, :3], atol=1e-6)
    assert known.vertices[:, 2].min() == pytest.approx(0.5, abs=0.01)
    for i in range(3):
        pixels = np.asarray(Image.open(tmp_path / "images" / f"{i:03d}.jpg")).mean(2)
        column, row = known.cameras.project(i, np.array([[0, 0, 1.0]]))[0][0].astype(int)
        assert pixels[row, column] > 3 * pixels[-4:, :4].mean()


# ---------------------------------------------------------------- regions that cut
def test_a_surface_is_cut_at_the_region_and_has_both_sides():
    beam = block((0, 0, 0), (4.0, 0.5, 0.5), 1.0)
    capture = Capture((beam,), (), kinds.make("trophy").cam_from_world)
    vertices, faces = region_cuts.surface_in(capture, Similarity(2.0, np.eye(3), np.array([1.0, 0, 0])))
    assert 0.95 < np.linalg.norm(vertices, axis=1).max() < 1
    assert vertices[:, 0].max() == pytest.approx(0.5)  # the block ends at 2 metres
    corners = vertices[faces]
    assert np.linalg.norm(corners - np.roll(corners, 1, 1), axis=2).max() <= region_cuts.LONGEST_EDGE
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    np.testing.assert_allclose(normals.sum(0), 0, atol=1e-9)


@pytest.mark.slow
def test_a_region_that_holds_half_a_relief_is_found_to_cut_it():
    rows = {(row.scale, row.moved): row for row in region_cuts.look("relief")}
    assert len(rows) == len(region_cuts.REGIONS)
    assert rows[1.0, 0.0].radius == 1.0
    assert rows[0.6, 0.0].inside < 95
    assert rows[0.6, 0.0].photos >= 3
    assert rows[0.6, 0.0].inside_then == 100


def test_the_table_of_cuts_counts_captures():
    def row(inside: float, radius: float, then: float) -> region_cuts.Row:
        return region_cuts.Row("a", 0.8, 0.0, inside, 5, radius, then)

    rows = [row(90, 1.5, 100), row(90, 1.5, 95), row(90, 1.0, 90), row(100, 1.0, 100), row(100, 1.2, 100)]
    line = next(line for line in region_cuts.cuts_table(rows).splitlines() if line.startswith("| 0.8"))
    assert line == "| 0.8 of the radius | 3 | 2 | 1 | 2 | 1 |"
