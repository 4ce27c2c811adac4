"""What holds of frames, planes and places whatever the numbers: there and back, and lengths that stay."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rigs import UP, capture, ring

from stages.geometry.cameras import PosedScene
from stages.geometry.earth import EARTH_RADIUS, FLATTENING, east_north_up
from stages.geometry.normalisation import into_frame, rotation_onto, scene_frame
from stages.geometry.place import Place, given_region
from stages.geometry.plane import Plane, fit_plane
from stages.geometry.region import meeting_point
from stages.geometry.similarity import Similarity, align_points

seeds = st.integers(0, 10_000)
numbers = st.floats(-100, 100)
points = st.tuples(numbers, numbers, numbers).map(np.array)
directions = points.filter(lambda v: np.linalg.norm(v) > 1e-3).map(lambda v: v / np.linalg.norm(v))
similarities = st.builds(
    lambda scale, turned, shift: Similarity(scale, rotation_onto(UP, turned), shift),
    st.floats(0.01, 100), directions, points,
)  # fmt: skip
latitudes, longitudes, altitudes = st.floats(-89, 89), st.floats(-180, 180), st.floats(-400, 8000)


def cloud(seed: int, count: int = 20) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(count, 3))


def distances(places: np.ndarray) -> np.ndarray:
    return np.linalg.norm(places[:, None] - places, axis=2)


# ---------------------------------------------------------------- similarities
@given(similarities, seeds)
def test_a_similarity_scales_all_lengths_alike_and_keeps_the_handedness(moved, seed):
    np.testing.assert_allclose(distances(moved.apply(cloud(seed))), moved.scale * distances(cloud(seed)), rtol=1e-6)
    assert np.linalg.det(moved.rotation) == pytest.approx(1)


@given(similarities, similarities)
def test_the_inverse_of_two_steps_goes_back_in_the_other_order(first, second):
    one, other = first.compose(second).inverse(), second.inverse().compose(first.inverse())
    np.testing.assert_allclose(one.matrix(), other.matrix(), rtol=1e-9, atol=1e-6)


@given(similarities, seeds)
def test_aligning_points_finds_what_moved_them(moved, seed):
    found = align_points(cloud(seed), moved.apply(cloud(seed)))
    np.testing.assert_allclose(found.matrix(), moved.matrix(), atol=1e-8 * (100 + moved.scale))


# ---------------------------------------------------------------- cameras
@given(points, st.floats(0.1, 50), directions, seeds)
def test_photos_do_not_change_with_the_frame_and_depths_with_its_scale_only(center, radius, up, seed):
    cameras = capture(ring(np.zeros(3)))
    frame = scene_frame(center, radius, up)
    moved = into_frame(cameras, frame)
    seen = cloud(seed)
    for i in (0, 5):
        pixels, depth = cameras.project(i, seen)
        same_pixels, scene_depth = moved.project(i, frame.inverse().apply(seen))
        np.testing.assert_allclose(same_pixels, pixels, atol=1e-6)
        np.testing.assert_allclose(scene_depth * radius, depth, atol=1e-6)
    np.testing.assert_allclose(frame.apply(moved.centers), cameras.centers, atol=1e-6)
    np.testing.assert_allclose(moved.forward @ frame.rotation.T, cameras.forward, atol=1e-9)


@given(st.lists(st.floats(1, 639), min_size=3, max_size=3), st.lists(st.floats(1, 479), min_size=3, max_size=3))
def test_rays_of_what_two_photos_see_meet_there(columns, rows):
    """The middle of a pixel's ray in one photo, projected into another: the rays of both meet in it."""
    cameras = capture(ring(np.zeros(3)))
    origins, rays = cameras.rays(0, np.array([columns, rows]).T)
    for origin, ray in zip(origins, rays, strict=True):
        place = origin + 4.5 * ray
        pixels, _ = cameras.project(3, place[None])
        other_origin, other_ray = cameras.rays(3, pixels)
        met, misses = meeting_point(np.stack([origin, other_origin[0]]), np.stack([ray, other_ray[0]]))
        np.testing.assert_allclose(met, place, atol=1e-6)
        assert misses.max() < 1e-6


# ---------------------------------------------------------------- planes
@given(directions, numbers, similarities, seeds)
def test_heights_above_a_plane_are_the_same_in_every_frame(normal, offset, world_from_scene, seed):
    plane = Plane(normal, offset, 0.3, 0.5)
    within = plane.within(world_from_scene)
    in_scene = cloud(seed)
    heights = world_from_scene.scale * within.heights(in_scene)
    np.testing.assert_allclose(heights, plane.heights(world_from_scene.apply(in_scene)), atol=1e-8)
    assert within.rms * world_from_scene.scale == pytest.approx(plane.rms)


@given(directions, numbers, seeds)
def test_a_plane_is_found_from_points_on_it(normal, offset, seed):
    on_it = cloud(seed)
    on_it += (offset - on_it @ normal)[:, None] * normal
    found, found_offset = fit_plane(on_it, normal)
    np.testing.assert_allclose(found, normal, atol=1e-6)
    assert found_offset == pytest.approx(offset, abs=1e-4)


# ---------------------------------------------------------------- place
@given(latitudes, longitudes, altitudes)
def test_east_north_and_up_are_as_long_as_the_ellipsoid_says(latitude, longitude, altitude):
    """A metre is a metre: the radii of curvature along the meridian and across it, from a textbook."""
    squared = FLATTENING * (2 - FLATTENING)
    bend = 1 - squared * np.sin(np.radians(latitude)) ** 2
    along, across = EARTH_RADIUS * (1 - squared) / bend**1.5, EARTH_RADIUS / bend**0.5
    step = 1e-4  # degrees, about ten metres
    origin = (latitude, longitude, altitude)
    shifts = np.array([[0, step, 0], [step, 0, 0], [0, 0, 10.0], [0, 0, 0]])
    east, north, up, none = east_north_up(np.array(origin) + shifts, origin)
    radians = np.radians(step)
    np.testing.assert_allclose(east, [radians * (across + altitude) * np.cos(np.radians(latitude)), 0, 0], atol=1e-4)
    np.testing.assert_allclose(north, [0, radians * (along + altitude), 0], atol=1e-4)
    np.testing.assert_allclose(up, [0, 0, 10], atol=1e-7)
    np.testing.assert_allclose(none, 0, atol=1e-7)


@given(latitudes, longitudes, seeds)
def test_distances_do_not_depend_on_the_origin(latitude, longitude, seed):
    places = np.array([latitude, longitude, 300.0]) + cloud(seed) * (1e-3, 1e-3, 50)
    origins = (latitude, longitude, 0.0), (latitude + 0.5, longitude - 0.5, 100.0)
    one, other = (distances(east_north_up(places, origin)) for origin in origins)
    np.testing.assert_allclose(one, other, atol=1e-6)


@given(similarities, points, st.floats(0.1, 10))
def test_the_corners_of_a_given_box_come_back_to_the_world(world_from_poses, low, side):
    region = given_region("box", [*low, *(low + side)], world_from_poses)
    corners = world_from_poses.apply(region.box_corners())
    np.testing.assert_allclose([corners.min(0), corners.max(0)], [low, low + side], atol=1e-6)
    farthest = np.linalg.norm(region.box_corners() - region.center, axis=1).max()
    assert farthest < region.radius < 1.1 * farthest


@given(similarities, st.floats(0.01, 100), directions)
def test_up_of_a_place_is_where_the_world_has_it(world_from_poses, scale, up):
    scene = PosedScene(
        capture(ring(np.zeros(3))), Similarity(scale, np.eye(3), np.ones(3)), np.zeros((0, 3), np.float32),
        np.zeros(0, np.float32), np.zeros((0, 2), np.int32), UP,
    )  # fmt: skip
    place = Place(world_from_poses, up=up)
    in_world = scene.world_from_scene(place).rotation @ scene.up_in(place)
    np.testing.assert_allclose(in_world, up, atol=1e-9)
    np.testing.assert_allclose(scene.up_in(Place(world_from_poses)), UP)
