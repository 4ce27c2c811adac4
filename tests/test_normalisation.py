"""The normalised frame, on captures whose answer is known by construction."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rigs import EAST, NORTH, capture, look_at, ring, scene_without_points

from stages.geometry.cameras import PinholeCameras
from stages.geometry.normalisation import into_frame, regrown, rotation_onto, scene_frame, still_fits
from stages.geometry.region import (
    ATTENDED_MARGIN,
    SEEN_WHOLE_MARGIN,
    enclosing_sphere,
    find_region,
    grown_over,
    meeting_point,
    merged_spheres,
    seen_whole_radii,
)
from stages.geometry.similarity import Similarity
from stages.geometry.up import estimate_up

TARGET = np.array([1.0, -2.0, 3.0])
UP = np.array([0.6, 0.0, 0.8])


def test_object_capture_is_centred_where_the_axes_meet():
    region = find_region(capture(ring(TARGET, UP)), np.zeros((0, 3)))
    assert region.kind == "object"
    np.testing.assert_allclose(region.center, TARGET, atol=1e-6)


def test_radius_is_the_sphere_that_fits_the_short_side_with_margin():
    region = find_region(capture(ring(TARGET, UP, distance=5.0)), np.zeros((0, 3)))
    fits = 5.0 * np.sin(np.arctan(240 / 600))
    assert region.radius == pytest.approx(SEEN_WHOLE_MARGIN * fits, rel=1e-6)


def test_seen_whole_radius_against_projecting_the_sphere():
    cameras = capture([look_at(np.array([0.0, -4.0, 1.0]), np.array([0.3, 0.2, 0.1]), np.array([0.0, 0.0, 1.0]))])
    center = np.array([0.5, 0.0, 0.4])
    radius = seen_whole_radii(cameras, center)[0]
    directions = np.random.default_rng(0).normal(size=(200_000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)

    def inside_frame(scale: float) -> bool:
        pixels, _ = cameras.project(0, center + scale * radius * directions)
        return bool(((pixels >= 0) & (pixels <= (640, 480))).all())

    assert inside_frame(0.999)
    assert not inside_frame(1.01)


def test_seen_whole_radius_is_negative_for_a_center_out_of_view_or_behind():
    pose = look_at(np.zeros(3), np.array([0.0, 5.0, 0.0]), np.array([0.0, 0.0, 1.0]))
    cameras = capture([pose, pose])
    assert (seen_whole_radii(cameras, np.array([9.0, 5.0, 0.0])) < 0).all()
    assert (seen_whole_radii(cameras, np.array([0.0, -5.0, 0.0])) <= 0).all()


def test_what_the_photos_look_at_is_inside_however_large_it_is():
    cameras = capture(ring(TARGET, UP, distance=5.0))
    fits = 5.0 * np.sin(np.arctan(240 / 600))
    shell = np.random.default_rng(0).normal(size=(500, 3))
    shell *= 1.4 * fits / np.linalg.norm(shell, axis=1, keepdims=True)
    shell += 0.5 * fits * EAST  # larger than the frame, and not in its middle
    frusta = find_region(cameras, TARGET + shell)
    region = grown_over(frusta, TARGET + shell, None)
    assert (np.linalg.norm(TARGET + shell - region.center, axis=1) < region.radius).all()
    assert region.radius < 1.25 * ATTENDED_MARGIN * 1.4 * fits
    # one point far off is a wrong one
    stray = np.concatenate([TARGET + shell, [TARGET + 40 * NORTH]])
    assert grown_over(frusta, stray, None).radius == pytest.approx(region.radius, rel=0.02)
    # and a small object does not shrink what the views show
    assert grown_over(frusta, TARGET + 0.3 * shell, None) is frusta
    assert grown_over(frusta, np.zeros((0, 3)), None) is frusta


@given(st.integers(0, 1000), st.integers(4, 60))
@settings(max_examples=20, deadline=None)
def test_the_enclosing_sphere_holds_all_and_is_nearly_the_smallest(seed: int, count: int):
    random = np.random.default_rng(seed)
    directions = random.normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    points = np.concatenate([TARGET + 2 * directions, TARGET - 2 * directions])  # opposite ones: radius 2
    center, radius = enclosing_sphere(points)
    assert (np.linalg.norm(points - center, axis=1) <= radius + 1e-9).all()
    assert 2 - 1e-9 <= radius < 2.05


def test_merged_spheres_touch_both():
    center, radius = merged_spheres((np.zeros(3), 1.0), (np.array([4.0, 0, 0]), 2.0))
    np.testing.assert_allclose(center, [2.5, 0, 0])
    assert radius == 3.5
    assert merged_spheres((np.zeros(3), 3.0), (np.ones(3), 0.5))[1] == 3.0


def test_a_regrown_scene_is_the_same_capture():
    cameras = capture(ring(TARGET, UP))
    points = TARGET + np.random.default_rng(0).normal(size=(20, 3))
    first = scene_frame(TARGET, 2.0, UP)
    scene = replace(
        scene_without_points(into_frame(cameras, first), first),
        points=first.inverse().apply(points).astype(np.float32),
        point_errors=np.zeros(len(points), np.float32),
        growable=True,
        roi_scale=0.8,
    )
    grown = regrown(scene, np.array([0.5, 0.0, 0.0]), 1.5)
    assert (grown.poses_from_scene.scale, grown.growable) == (3.0, False)
    assert grown.roi_scale == pytest.approx(0.8 * (0.5 + 1.5))
    np.testing.assert_allclose(grown.poses_from_scene.apply(grown.points), points, atol=1e-5)
    np.testing.assert_allclose(grown.poses_from_scene.apply(grown.cameras.centers), cameras.centers, atol=1e-9)
    for i in (0, 5):
        before, after = cameras.project(i, points), grown.cameras.project(i, grown.points)
        np.testing.assert_allclose(before[0], after[0], atol=1e-2)


def test_photos_of_something_else_do_not_move_the_center():
    strays = [
        look_at(TARGET + 4 * EAST, TARGET + 4 * EAST + 9 * NORTH, UP),
        look_at(TARGET - 4 * NORTH, TARGET + 9 * EAST, UP),
    ]
    region = find_region(capture(ring(TARGET, UP, count=12) + strays), np.zeros((0, 3)))
    assert np.linalg.norm(region.center - TARGET) < 0.01


def test_meeting_point_equals_least_squares_when_lines_meet_exactly():
    generator = np.random.default_rng(1)
    directions = generator.normal(size=(7, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    origins = TARGET - generator.uniform(1, 5, (7, 1)) * directions
    point, misses = meeting_point(origins, directions)
    np.testing.assert_allclose(point, TARGET, atol=1e-9)
    assert misses.max() < 1e-9


def test_meeting_point_refuses_one_line_and_parallel_lines():
    with pytest.raises(ValueError, match="got 1 lines, expected at least 2"):
        meeting_point(np.zeros((1, 3)), np.array([[0.0, 0.0, 1.0]]))
    with pytest.raises(ValueError, match="parallel"):
        meeting_point(np.eye(3), np.tile([0.0, 0.0, 1.0], (3, 1)))


# ---------------------------------------------------------------- forward-facing
def test_parallel_axes_are_a_forward_capture_about_the_points():
    up = np.array([0.0, 0.0, 1.0])
    poses = [look_at(np.array([x, 0.0, z]), np.array([x, 9.0, z]), up) for x in (-2, -1, 0, 1, 2) for z in (0, 1)]
    points = np.random.default_rng(0).uniform([-3, 7, -1], [3, 9, 2], (2000, 3))
    far = np.array([[500.0, 900.0, 0.0]])  # one wrong point far away
    region = find_region(capture(poses), np.concatenate([points, far]))
    assert region.kind == "forward"
    assert np.linalg.norm(region.center - [0, 8, 0.5]) < 0.2
    assert 3.0 < region.radius < 3.8


def test_cameras_that_look_outwards_are_a_forward_capture():
    up = np.array([0.0, 0.0, 1.0])
    angles = np.radians(np.arange(0, 360, 30))
    outward = [np.array([np.cos(a), np.sin(a), 0.0]) for a in angles]
    poses = [look_at(0.3 * d, 5 * d, up) for d in outward]
    walls = np.random.default_rng(0).uniform(-4, 4, (1000, 3))
    region = find_region(capture(poses), walls)
    assert region.kind == "forward"
    assert np.linalg.norm(region.center) < 0.3


def test_forward_capture_without_points_is_refused():
    up = np.array([0.0, 0.0, 1.0])
    poses = [look_at(np.array([x, 0.0, 0.0]), np.array([x, 9.0, 0.0]), up) for x in (0.0, 1.0)]
    with pytest.raises(ValueError, match="got 0 sparse points"):
        find_region(capture(poses), np.zeros((0, 3)))
    with pytest.raises(ValueError, match="got 1 cameras, expected at least 2"):
        find_region(capture(poses[:1]), np.zeros((0, 3)))


# ---------------------------------------------------------------- silhouettes
def silhouettes(cameras: PinholeCameras, center: np.ndarray, radius: float) -> list[np.ndarray]:
    """Masks of a ball, by distance from each pixel's ray to its centre."""
    masks = []
    for i in range(len(cameras)):
        width, height = cameras.sizes[i]
        x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
        origins, directions = cameras.rays(i, np.stack([x.ravel(), y.ravel()], 1))
        to_ball = center - origins
        along = np.einsum("ni,ni->n", to_ball, directions)
        distance = np.linalg.norm(to_ball - along[:, None] * directions, axis=1)
        masks.append((distance < radius).reshape(height, width))
    return masks


@pytest.mark.slow
@pytest.mark.parametrize("radius", [0.3, 1.2])
def test_masks_give_the_sphere_about_the_object(radius: float):
    up = np.array([0.0, 0.0, 1.0])
    poses = ring(np.zeros(3), up, pitch_deg=10) + ring(np.zeros(3), up, pitch_deg=50)
    cameras = capture(poses, size=(160, 120), focal=150.0)
    ball = np.array([0.2, -0.1, 0.15])
    region = find_region(cameras, np.zeros((0, 3)), masks=silhouettes(cameras, ball, radius))
    assert region.source == "the visual hull of the masks"
    assert np.linalg.norm(region.center - ball) < 0.15 * radius
    assert 1.0 < region.radius / radius < 1.5  # a hull is larger than its object


@pytest.mark.slow
def test_one_wrong_mask_does_not_cut_the_hull():
    up = np.array([0.0, 0.0, 1.0])
    cameras = capture(ring(np.zeros(3), up, count=16), size=(160, 120), focal=150.0)
    masks: list[np.ndarray | None] = list(silhouettes(cameras, np.zeros(3), 1.0))
    good = find_region(cameras, np.zeros((0, 3)), masks=masks)
    masks[3] = np.zeros_like(masks[3])
    bad = find_region(cameras, np.zeros((0, 3)), masks=masks)
    assert bad.radius == pytest.approx(good.radius, rel=0.15)


def test_masks_that_agree_on_nothing_fall_back_to_the_frusta():
    cameras = capture(ring(np.zeros(3), UP), size=(160, 120), focal=150.0)
    region = find_region(cameras, np.zeros((0, 3)), masks=[np.zeros((120, 160), bool)] * len(cameras))
    assert region.source == "the frusta of the cameras"


# ---------------------------------------------------------------- up
@pytest.mark.parametrize("pitch_deg", [0, 25, 60])
@pytest.mark.parametrize("span_deg", [360, 120])
def test_up_of_level_cameras_at_any_pitch(pitch_deg: float, span_deg: float):
    cameras = capture(ring(TARGET, UP, count=20, pitch_deg=pitch_deg, span_deg=span_deg))
    assert estimate_up(cameras).direction @ UP > np.cos(np.radians(0.1))


def test_up_survives_hand_shake_and_a_few_turned_photos():
    generator = np.random.default_rng(2)
    poses = ring(TARGET, UP, count=30)
    for i, pose in enumerate(poses):
        roll = np.radians(90) if i < 3 else np.radians(generator.normal(0, 3))
        turn = np.array([[np.cos(roll), -np.sin(roll), 0], [np.sin(roll), np.cos(roll), 0], [0, 0, 1]])
        poses[i] = turn @ pose
    assert estimate_up(capture(poses)).direction @ UP > np.cos(np.radians(2.5))


def test_up_of_photos_from_one_side_is_the_cameras_own():
    pose = look_at(np.array([0.0, -5.0, 0.0]), np.zeros(3), np.array([0.0, 0.0, 1.0]))
    cameras = capture([pose, pose, pose])
    np.testing.assert_allclose(estimate_up(cameras).direction, [0, 0, 1], atol=1e-9)


unit_vectors = st.tuples(*[st.floats(-1, 1)] * 3).map(np.array).filter(lambda v: np.linalg.norm(v) > 0.1)


@given(unit_vectors, unit_vectors)
@settings(max_examples=100, deadline=None)
def test_rotation_onto_is_proper_and_hits_its_target(source: np.ndarray, target: np.ndarray):
    source, target = source / np.linalg.norm(source), target / np.linalg.norm(target)
    for goal in (target, source, -source):
        rotation = rotation_onto(source, goal)
        np.testing.assert_allclose(rotation @ source, goal, atol=1e-6)
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-6)
        assert np.linalg.det(rotation) == pytest.approx(1.0)


# ---------------------------------------------------------------- the frame
def test_into_scene_keeps_pixels_and_scales_depth():
    cameras = capture(ring(TARGET, UP))
    frame = scene_frame(TARGET, 2.5, UP)
    in_scene = into_frame(cameras, frame)
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (50, 3))
    for i in range(len(cameras)):
        pixels, depth = in_scene.project(i, points)
        world_pixels, world_depth = cameras.project(i, frame.apply(points))
        np.testing.assert_allclose(pixels, world_pixels, atol=1e-8)
        np.testing.assert_allclose(depth * 2.5, world_depth, atol=1e-9)
    np.testing.assert_allclose(frame.apply(in_scene.centers), cameras.centers, atol=1e-9)


def test_scene_frame_turns_up_to_z_and_the_sphere_to_the_unit_sphere():
    frame = scene_frame(TARGET, 2.5, 3.0 * UP)
    np.testing.assert_allclose(frame.apply(np.zeros(3)), TARGET)
    np.testing.assert_allclose(frame.apply(np.array([0.0, 0.0, 1.0])), TARGET + 2.5 * UP, atol=1e-12)
    with pytest.raises(ValueError, match="got radius 0"):
        scene_frame(TARGET, 0.0, UP)
    assert isinstance(frame, Similarity)


@pytest.mark.parametrize(
    ("center", "radius", "tilt_deg", "fits"),
    [
        ((0.0, 0.0, 0.0), 1.0, 0.0, True),
        ((0.05, 0.0, 0.0), 1.0, 3.0, True),
        ((0.0, 0.0, 0.0), 0.85, 0.0, True),
        ((0.2, 0.0, 0.0), 1.0, 0.0, False),  # what is new sticks out
        ((0.0, 0.0, 0.0), 1.2, 0.0, False),
        ((0.0, 0.0, 0.0), 0.7, 0.0, False),  # cells would be wasted
        ((0.0, 0.0, 0.0), 1.0, 8.0, False),
    ],
)
def test_a_region_stays_while_it_holds_the_one_found_anew(center, radius, tilt_deg, fits):
    before = scene_frame(np.array([3.0, -1.0, 2.0]), 2.5, NORTH)
    tilt = np.radians(tilt_deg)
    up = before.rotation @ np.array([np.sin(tilt), 0.0, np.cos(tilt)])
    found = scene_frame(before.apply(np.array(center)), 2.5 * radius, up)
    assert still_fits(before, found) is fits
