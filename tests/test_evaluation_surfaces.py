"""Surfaces against a truth: planes and spheres whose distances are known, slow loops, and what is cut away."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from stages.drawing.rendering import look_at
from stages.evaluation import alignment, culling
from stages.evaluation.protocols.blendedmvs import THRESHOLDS, blended_score
from stages.evaluation.surfaces import OneWay, Sampling, Surface, draw_points, measure, turning
from stages.evaluation.thinning import one_a_cube, thin
from stages.geometry.cameras import PinholeCameras

FEW = Sampling(20_000)


def sphere(radius: float = 1.0, center=(0.0, 0, 0), subdivisions: int = 5) -> Surface:
    mesh = trimesh.creation.icosphere(subdivisions, radius)
    return Surface(mesh.vertices + np.array(center), np.asarray(mesh.faces))


def square(height: float = 0.0, side: float = 2.0) -> Surface:
    corners = 0.5 * side * np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) + [0, 0, height]
    return Surface(corners, np.array([[0, 1, 2], [0, 2, 3]]))


def bar() -> Surface:
    """A box with three different sides: nothing turns it into itself."""
    mesh = trimesh.creation.box((1.0, 2.0, 0.5)).subdivide().subdivide()
    return Surface(np.asarray(mesh.vertices), np.asarray(mesh.faces))


def motion(turn_deg: float, shift, scale: float = 1.0) -> np.ndarray:
    matrix = trimesh.transformations.rotation_matrix(np.radians(turn_deg), (0, 0, 1))
    matrix[:3, :3] *= scale
    matrix[:3, 3] = shift
    return matrix


# ---------------------------------------------------------------- distances
def test_a_plane_beside_a_plane_is_its_offset_away():
    found = measure(square(0.03), square(), [0.02, 0.04], FEW)
    for way in (found.accuracy, found.completeness):
        assert [way.mean, way.rms, way.median, way.p90, way.p99, way.max] == pytest.approx([0.03] * 6)
        assert way.points == FEW.count
    assert (found.chamfer, found.chamfer_sum) == pytest.approx((0.03, 0.06))
    assert [(f.precision, f.recall, f.f_score) for f in found.f_scores] == [(0, 0, 0), (100, 100, pytest.approx(100))]
    assert found.extent == 2
    assert found.accuracy_normals is not None
    assert found.accuracy_normals.mean_deg == pytest.approx(0, abs=1e-3)
    assert found.accuracy_normals.consistency == pytest.approx(1)


def test_a_sphere_one_percent_too_large_is_one_percent_of_its_radius_away():
    found = measure(sphere(1.01), sphere(), sampling=FEW)
    assert found.accuracy.mean == pytest.approx(0.01, rel=0.01)
    assert found.completeness.mean == pytest.approx(0.01, rel=0.01)
    # 0.2, 0.5, 1 and 2 % of the diameter
    assert [each.f_score for each in found.f_scores] == pytest.approx([0, 50, 100, 100], abs=50)
    assert [each.threshold for each in found.f_scores] == pytest.approx([0.004, 0.01, 0.02, 0.04])


def test_what_is_missing_shows_in_recall_and_what_is_too_much_in_precision():
    half = Surface(square().points * [0.5, 1, 1], square().faces)
    lacking, extra = measure(half, square(), [1e-3], FEW), measure(square(), half, [1e-3], FEW)
    assert (lacking.f_scores[0].precision, lacking.f_scores[0].recall) == pytest.approx((100, 50), abs=1.5)
    assert (extra.f_scores[0].precision, extra.f_scores[0].recall) == pytest.approx((50, 100), abs=1.5)
    assert lacking.completeness.mean == pytest.approx(0.125, rel=0.03)  # half are 0 to 0.5 away
    assert lacking.accuracy.max == pytest.approx(0, abs=1e-6)


def test_points_as_truth_give_what_a_slow_loop_gives():
    rng = np.random.default_rng(0)
    points, normals = rng.normal(size=(40, 3)), rng.normal(size=(40, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    others = rng.normal(size=(30, 3))
    found = measure(Surface(others, None, normals[:30]), Surface(points, None, normals), [0.5])
    nearest = [min(range(40), key=lambda j: np.linalg.norm(points[j] - p)) for p in others]
    distances = np.array([np.linalg.norm(points[j] - p) for p, j in zip(others, nearest, strict=True)])
    assert found.accuracy.mean == pytest.approx(distances.mean())
    assert found.accuracy.p95 == pytest.approx(np.percentile(distances, 95))
    assert found.f_scores[0].precision == pytest.approx(100 * np.mean([d < 0.5 for d in distances]))
    angles = [np.degrees(np.arccos(abs(normals[i] @ normals[j]))) for i, j in enumerate(nearest)]
    assert found.accuracy_normals is not None
    assert found.accuracy_normals.mean_deg == pytest.approx(np.mean(angles))
    assert found.accuracy_normals.median_deg == pytest.approx(np.median(angles))
    assert measure(Surface(others), Surface(points, None, normals)).accuracy_normals is None


def test_normals_tell_the_angle_whichever_way_they_point():
    tilted = square()
    slope = np.tan(np.radians(20))
    tilted = Surface(tilted.points + np.outer(tilted.points[:, 0], [0, 0, slope]), tilted.faces[:, ::-1])
    found = measure(tilted, square(), sampling=FEW)
    assert found.accuracy_normals is not None
    assert found.accuracy_normals.median_deg == pytest.approx(20, abs=0.01)
    assert found.accuracy_normals.consistency == pytest.approx(np.cos(np.radians(20)), abs=1e-4)
    assert turning(None, np.ones((1, 3))) is None


def test_sampling_is_even_repeatable_and_as_dense_as_asked():
    drawn = draw_points(square(), Sampling(spacing=0.02, seed=3))
    assert len(drawn.points) == 10_000
    assert np.histogram2d(*drawn.points.T[:2], bins=4)[0] == pytest.approx(np.full((4, 4), 625), rel=0.2)
    np.testing.assert_array_equal(drawn.points, draw_points(square(), Sampling(spacing=0.02, seed=3)).points)
    assert not np.array_equal(drawn.points, draw_points(square(), Sampling(spacing=0.02, seed=4)).points)
    cloud = Surface(drawn.points, None, np.tile([0.0, 0, 1], (10_000, 1)))
    assert len(draw_points(cloud, Sampling(100)).points) == 100
    thinned = draw_points(cloud, Sampling(spacing=0.5))
    assert len(thinned.points) <= 25
    assert thinned.normals == pytest.approx(np.tile([0.0, 0, 1], (len(thinned.points), 1)))
    with pytest.raises(ValueError, match="area"):
        draw_points(Surface(np.zeros((3, 3)), np.array([[0, 1, 2]])), FEW)


def test_a_far_away_surface_is_measured_as_well():
    far = (1e5, -2e5, 3e4)
    assert measure(sphere(1, far), sphere(1, far), sampling=Sampling(5000)).accuracy.max < 1e-4


def test_a_selection_is_drawn_more_densely_and_an_empty_one_is_refused():
    drawn = draw_points(square(), Sampling(4000), lambda points: points[:, 0] > 0.8)
    assert len(drawn.points) == pytest.approx(4000, rel=0.1)
    assert drawn.points[:, 0].min() > 0.8
    with pytest.raises(ValueError, match="none of 4000 points counts"):
        draw_points(square(), Sampling(4000), lambda points: points[:, 0] > 8)


def test_blended_mvs_has_its_own_thresholds():
    found = blended_score(square(0.03), square(), FEW)
    assert [each.threshold for each in found.f_scores] == pytest.approx([2 * part for part in THRESHOLDS])
    assert [each.f_score for each in found.f_scores] == pytest.approx([0, 0, 100])


def test_one_way_has_its_closed_forms():
    found = OneWay.of(np.arange(101.0))
    assert (found.mean, found.median, found.p90, found.p95, found.p99, found.max) == (50, 50, 90, 95, 99, 100)
    assert found.rms == pytest.approx(np.sqrt(np.mean(np.arange(101.0) ** 2)))


# ---------------------------------------------------------------- thinning
def test_thinned_points_keep_their_distance_as_in_the_slow_loop():
    points = np.random.default_rng(0).random((400, 3)) - 0.5
    kept: list[np.ndarray] = []
    for point in points:
        if all(np.linalg.norm(point - other) > 0.15 for other in kept):
            kept.append(point)
    np.testing.assert_array_equal(thin(points, 0.15), kept)
    assert len(thin(np.zeros((0, 3)), 0.1)) == 0


def test_one_point_a_cube_is_their_mean():
    pairs = np.array([[0.0, 0, 0], [0.1, 0, 0], [5, 0, 0], [5.1, 0.2, 0]])
    found = one_a_cube(pairs, 1.0)
    np.testing.assert_allclose(found[np.argsort(found[:, 0])], [[0.05, 0, 0], [5.05, 0.1, 0]])


# ---------------------------------------------------------------- what counts
def views(*eyes) -> PinholeCameras:
    found = [look_at(np.array(eye, float), np.zeros(3), np.array([0.0, 0, 1]), 64, 64, 60) for eye in eyes]
    return PinholeCameras(
        tuple(f"{i}.png" for i in range(len(found))),
        *(np.concatenate([getattr(one, name) for one in found]) for name in ("sizes", "intrinsics", "extrinsics")),
    )


def test_a_camera_sees_the_near_side_only():
    ball = sphere(subdivisions=4)
    occluder = (ball.points, ball.faces)
    points = draw_points(ball, Sampling(4000)).points
    cameras = views((4, 0, 0))
    # A ball of radius 1 from 4 away: its rim is at x = 1 / 4, give or take the size of its faces.
    clear = np.abs(np.abs(points[:, 0]) - 0.25) > 0.06
    assert (culling.seen(points, cameras, occluder) == (points[:, 0] > 0.25))[clear].all()
    both = views((4, 0, 0), (-4, 0, 0))
    assert (culling.seen(points, both, occluder) == (np.abs(points[:, 0]) > 0.25))[clear].all()
    assert culling.seen(points, cameras).all()
    assert not culling.seen(points + np.array([20, 0, 0]), cameras).any()  # behind it


def test_masks_cut_what_any_photo_shows_beside_them():
    cameras = views((4, 0, 0), (0, 4, 0))
    left = np.zeros((64, 64), bool)
    left[:, :32] = True
    points = np.array([[0, -0.5, 0], [0, 0.5, 0], [-0.5, 0, 0], [0.5, 0, 0], [90, 90, 0.0]])
    pixels = [cameras.project(i, points)[0][:, 0] for i in range(2)]
    expected = [all(not 0 <= x[p] < 64 or x[p] < 32 for x in pixels) for p in range(4)]
    found = culling.inside_masks(points, cameras, [(0, left), (1, left)])
    assert found.tolist() == [*expected, True]  # the last is in no image
    assert not all(expected)
    assert culling.inside_masks(points, cameras, [(0, left), (1, left)], grow=32).all()
    assert culling.inside_box(points, np.array([[-1, 0, -1], [1, 1, 1]])).tolist() == [False, True, True, True, False]


# ---------------------------------------------------------------- alignment
@pytest.mark.parametrize(("scale", "scaled"), [(1.0, False), (1.04, True)])
def test_icp_finds_the_way_back_and_the_scale_where_it_may(scale, scaled):
    moved = bar().moved(motion(6, (0.05, -0.04, 0.03), scale))
    found = alignment.by_icp(moved, bar(), scaled)
    np.testing.assert_allclose(found.apply(moved.points), bar().points, atol=5e-3)
    assert found.scale == pytest.approx(1 / scale, abs=5e-3)


def test_icp_looks_at_what_counts_only():
    moved = bar().moved(motion(4, (0.03, 0.02, 0.01)))
    aside = np.full((100, 3), 9.0)  # stands for a large thing that the truth lacks
    both = Surface(np.concatenate([moved.points, aside, aside + np.array([0, 3, 0])]))
    found = alignment.by_icp(both, bar(), keep=lambda points: points[:, 2] < 5)
    np.testing.assert_allclose(found.apply(moved.points), bar().points, atol=5e-3)
    everything = alignment.by_icp(both, bar())
    assert np.abs(everything.apply(moved.points) - bar().points).max() > 0.1


def test_icp_takes_a_cloud_without_normals_for_the_truth():
    truth = Surface(draw_points(bar(), Sampling(20_000)).points)
    moved = bar().moved(motion(4, (0.03, 0.02, 0.01)))
    found = alignment.by_icp(moved, truth)
    np.testing.assert_allclose(found.apply(moved.points), bar().points, atol=0.02)


def test_a_step_undoes_a_small_motion_and_leaves_what_planes_cannot_tell():
    rng = np.random.default_rng(0)
    points = rng.normal(size=(200, 3))
    normals = np.eye(3)[rng.integers(0, 3, 200)]
    shift = np.array([0.1, -0.2, 0.3])
    step = alignment.plane_step(points, np.tile(shift, (200, 1)), normals)
    np.testing.assert_allclose(step.apply(points), points + shift, atol=1e-9)
    grown = alignment.plane_step(points, 0.02 * points, normals, scaled=True)
    np.testing.assert_allclose(grown.apply(points), 1.02 * points, atol=1e-9)
    upward = np.tile([0.0, 0, 1], (200, 1))  # one plane says nothing of motion within it
    step = alignment.plane_step(points, np.tile([0.0, 0, 0.3], (200, 1)), upward)
    np.testing.assert_allclose(step.translation, [0, 0, 0.3], atol=1e-9)


def test_cameras_align_by_their_names():
    rng = np.random.default_rng(0)
    centers = {f"{i}": rng.normal(size=3) for i in range(6)}
    matrix = motion(30, (1, 2, 3), 2.5)
    true = {name: matrix[:3, :3] @ center + matrix[:3, 3] for name, center in centers.items() if name != "5"}
    found, paired = alignment.by_cameras(centers, {**true, "other": np.zeros(3)})
    np.testing.assert_allclose(found.matrix(), matrix, atol=1e-9)
    assert paired == 5
    with pytest.raises(ValueError, match="only 2 of 6"):
        alignment.by_cameras(centers, {"0": np.zeros(3), "1": np.ones(3)})


def test_a_moved_cloud_turns_its_normals_and_keeps_them_unit():
    cloud = Surface(np.zeros((1, 3)), None, np.array([[1.0, 0, 0]]))
    np.testing.assert_allclose(cloud.moved(motion(90, (1, 0, 0), 3)).normals, [[0, 1, 0]], atol=1e-12)
