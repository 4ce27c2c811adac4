"""Region, ground and up of whole captures: an object on a table, a room, a survey flight, a facade."""

from __future__ import annotations

import json

import numpy as np
import pytest
from rigs import (
    UP,
    capture,
    dome_on_a_table,
    facade,
    flight,
    long_object_on_a_table,
    look_at,
    oblique_flight,
    ring,
    room,
    room_from_its_walls,
    sightings,
)

from stages.geometry.attention import attended
from stages.geometry.normalisation import rotation_onto
from stages.geometry.plane import find_ground
from stages.geometry.region import FROM_ATTENTION, find_region, grown_over
from stages.geometry.similarity import Similarity
from stages.geometry.up import Up, angle_deg, choose_up, estimate_up


def found(rig):
    cameras, points = rig
    up = estimate_up(cameras)
    region = find_region(cameras, points, attended(cameras, points, sightings(cameras, points)))
    return cameras, points, region, up, find_ground(points, cameras.centers, up.direction, region.center, region.radius)


def inside(region, points) -> float:
    return float((np.linalg.norm(points - region.center, axis=1) < region.radius).mean())


# ---------------------------------------------------------------- regions
def test_a_dome_about_an_object():
    _, points, region, _, _ = found(dome_on_a_table())
    assert region.kind == "object"
    assert np.linalg.norm(region.center - [0, 0, 1]) < 0.05
    assert inside(region, points[:600]) == 1  # the ball
    assert 1.0 < region.radius < 2.2


@pytest.mark.parametrize("rig", [room, room_from_its_walls])
def test_a_room(rig):
    _, points, region, _, _ = found(rig())
    assert region.kind == "forward"
    assert np.linalg.norm(region.center - [0, 0, 1.25]) < 0.2
    assert inside(region, points) > 0.97
    assert region.radius < 1.15 * np.linalg.norm([3.0, 2.5, 1.25])


@pytest.mark.parametrize("tilt_deg", [0.5, 3.0, 12.0])
def test_a_survey_flight_without_its_horizon(tilt_deg: float):
    _, points, region, _, _ = found(flight(tilt_deg=tilt_deg))
    assert region.kind == "forward"
    assert np.linalg.norm(region.center[:2]) < 10
    assert inside(region, points[:3300]) > 0.95
    assert region.radius < 150  # half the diagonal is 125; the horizon reaches 2000


def test_a_town_from_an_oblique_flight_though_the_optical_axes_nearly_meet():
    _, points, region, _, _ = found(oblique_flight())
    assert region.kind == "forward"
    assert inside(region, points[np.abs(points[:, :2]).max(1) < 100]) > 0.98  # the town
    assert region.radius < 2 * 143  # 143 encloses the town; few photos show the fields further off


def test_a_facade_without_the_trees_behind():
    _, points, region, _, _ = found(facade())
    assert region.kind == "forward"
    assert inside(region, points[:2500]) > 0.97
    assert region.radius < 13  # half the diagonal is 10.8


# ---------------------------------------------------------------- ground
def test_the_table_under_the_object():
    _, _, _, _, ground = found(dome_on_a_table())
    assert angle_deg(ground.normal, UP) < 0.2
    assert abs(ground.offset) < 0.005
    assert ground.rms < 0.01
    assert 0.4 < ground.share < 0.8


def test_the_table_is_found_in_any_frame():
    cameras, points, region, _, _ = found(dome_on_a_table())
    turn = Similarity(3.0, rotation_onto(UP, np.array([0.6, 0.48, 0.64])), np.array([10.0, -20, 5]))
    there = find_ground(
        turn.apply(points),
        turn.apply(cameras.centers),
        turn.rotation @ UP,
        turn.apply(region.center),
        3 * region.radius,
    )
    back = there.within(turn)
    assert angle_deg(back.normal, UP) < 0.2
    assert abs(back.offset) < 0.005
    np.testing.assert_allclose(back.heights(points), there.heights(turn.apply(points)) / 3, atol=1e-9)


@pytest.mark.parametrize("name", ["no points", "an object alone", "a facade", "only a row", "beneath much else"])
def test_no_ground_where_there_is_none(name: str):
    cameras, points, region, up, _ = found(dome_on_a_table())
    if name == "a facade":
        assert found(facade())[4] is None
        return
    heap = np.random.default_rng(3).uniform([-1, -1, 0], [1, 1, 2], (900, 3))
    points = {
        "no points": np.zeros((0, 3)),
        "an object alone": points[:600],
        "only a row": np.concatenate([points[:600], np.linspace([-2, 0, 0], [2, 0.01, 0], 400)]),
        # the top of a box is not the ground
        "beneath much else": np.concatenate([points[600:1000] + 2 * UP, heap]),
    }[name]
    assert find_ground(points, cameras.centers, up.direction, region.center, region.radius) is None


def test_a_larger_plane_above_the_cameras_is_no_ground():
    cameras, points, region, up, _ = found(dome_on_a_table())
    ceiling = np.random.default_rng(0).uniform([-3, -3, 4.2], [3, 3, 4.2], (4000, 3))
    ground = find_ground(
        np.concatenate([points, ceiling]), cameras.centers, up.direction, region.center, 2 * region.radius
    )
    assert abs(ground.offset) < 0.02


def test_an_object_on_a_table_does_not_grow_over_it():
    cameras, points, region, _, ground = found(dome_on_a_table())
    assert ground is not None
    points = points[:1800]  # the last are wrong ones, which no three photos would agree on
    about = points[attended(cameras, points, sightings(cameras, points))]
    assert (np.abs(about[:, 2]) < 0.1).sum() > 100  # the table is looked at, too
    assert grown_over(region, about, ground) is region


def test_a_long_object_that_fills_the_frame_is_taken_whole_without_its_table():
    cameras, points, region, _, ground = found(long_object_on_a_table())
    assert ground is not None
    assert region.radius < 2.3  # its ends are out of the frame
    about = points[attended(cameras, points, sightings(cameras, points))]
    grown = grown_over(region, about, ground)
    ends = np.array([[-2.5, 0, 0.6], [2.5, 0, 0.6]])
    assert (np.linalg.norm(ends - grown.center, axis=1) < grown.radius).all()
    assert grown.radius < 3.6
    assert grown.source == FROM_ATTENTION
    # other things that stand around it are no part of it
    clutter = np.random.default_rng(1).uniform([6, 6, 0], [9, 9, 2], (300, 3))
    assert grown_over(region, np.concatenate([about, clutter]), ground).radius == grown.radius


# ---------------------------------------------------------------- up
def test_up_of_a_drone_that_flies_to_and_fro():
    for tilt in (0.5, 5.0):
        _, _, _, up, ground = found(flight(tilt_deg=tilt))
        chosen = choose_up(up, None if ground is None else ground.normal)
        assert angle_deg(chosen.direction, UP) < 5


def test_level_ground_refines_the_cameras_up_and_a_slope_does_not():
    held = Up(_leaning(4), "level cameras")
    assert choose_up(held, UP).source == "the ground's plane"
    np.testing.assert_array_equal(choose_up(held, UP).direction, UP)
    assert choose_up(held, _leaning(-20)) is held


def test_ground_is_believed_where_the_cameras_do_not_know():
    cameras = capture([look_at(np.array([x, -5.0, 2.0]), np.zeros(3)) for x in (0.0, 0.01)])
    held = estimate_up(cameras)
    assert not held.sure
    assert angle_deg(held.direction, UP) > 10
    np.testing.assert_array_equal(choose_up(held, UP).direction, UP)


def test_the_cameras_are_believed_where_there_is_no_ground():
    held = Up(_leaning(5), "level cameras")
    assert choose_up(held, _leaning(3)).source == "the ground's plane"
    assert choose_up(held, None) is held


def test_up_of_level_cameras_says_that_it_is_sure():
    up = estimate_up(capture(ring(np.zeros(3), UP)))
    assert up.sure
    assert angle_deg(up.direction, UP) < 0.1


def _leaning(degrees: float) -> np.ndarray:
    return np.array([np.sin(np.radians(degrees)), 0.0, np.cos(np.radians(degrees))])


# ---------------------------------------------------------------- captures with a known object
@pytest.mark.data
@pytest.mark.parametrize("name", ["synth_helmet", "synth_plaster", "synth_spotmetal"])
def test_known_objects_on_a_table_lie_in_the_region(data_dir, name: str):
    import trimesh

    record = json.loads((data_dir / name / "transforms.json").read_text())
    poses = [np.array(frame["w2c_opencv"])[:3] for frame in record["frames"]]
    cameras = capture(poses, (record["w"], record["h"]), record["fl_x"])
    thing = np.asarray(trimesh.load(data_dir / name / "gt_mesh.ply").vertices)
    random = np.random.default_rng(0)
    table = random.uniform(-1.6, 1.6, (2000, 3)) * (1, 1, 0)
    points = np.concatenate([thing[random.integers(0, len(thing), 500)], table])
    _, _, region, up, ground = found((cameras, points))
    far_end = np.linalg.norm(thing - region.center, axis=1).max()
    assert 0.7 < far_end / region.radius < 0.98
    assert angle_deg(ground.normal, UP) < 0.1
    assert angle_deg(up.direction, UP) < 1
