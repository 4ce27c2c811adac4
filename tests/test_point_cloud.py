"""Dense points: fused of depth maps, moved, chosen, what they cover, and how training is held to them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from stereo_scene import RADIUS, camera, cameras, draw, ring

from stages.geometry.plane import Plane
from stages.geometry.point_cloud import PointCloud
from stages.geometry.similarity import Similarity
from stages.neural.sightings import Sightings
from stages.stereo.depths import views_of
from stages.stereo.fusion import _cells, fused
from stages.surface.covering import covered_share


def cloud_of(points: np.ndarray, lists: list[list[int]], trust: np.ndarray | float = 1.0) -> PointCloud:
    normals = points / np.linalg.norm(points, axis=1, keepdims=True)
    starts = np.cumsum([0] + [len(each) for each in lists])
    photos = np.array([k for each in lists for k in each], np.int32)
    colors = np.full((len(points), 3), 9, np.uint8)
    return PointCloud(points, normals, colors, np.broadcast_to(trust, len(points)), starts, photos)


def ball_cloud(cams, count: int = 6000) -> PointCloud:
    points = np.random.default_rng(0).normal(size=(count, 3))
    points *= RADIUS / np.linalg.norm(points, axis=1, keepdims=True)
    facing = points @ cams.centers.T > RADIUS**2
    kept = facing.any(1)
    return cloud_of(points[kept], [np.flatnonzero(row)[:3].tolist() for row in facing[kept]])


def all_around():
    rng = np.random.default_rng(0)
    centers = rng.normal(size=(30, 3))
    centers *= 2.5 / np.linalg.norm(centers, axis=1, keepdims=True)
    return cameras([camera(center) for center in centers], [(160, 120)] * 30, [190.0] * 30)


# ---------------------------------------------------------------- fusion
def test_depths_of_one_place_become_one_point_seen_by_their_photos():
    cams = ring(1)
    view = views_of(cams, 1000)[0]
    true = draw(cams).depths[0].astype(np.float32)
    trusts = [np.float32(t) * (true > 0) for t in (0.9, 0.3, 0.6)]
    colors = [np.full((*true.shape, 3), c, np.uint8) for c in (100, 200, 0)]
    cloud = fused([view] * 3, [true] * 3, trusts, iter(colors))
    np.testing.assert_array_equal(np.diff(cloud.starts), 3)
    np.testing.assert_array_equal(cloud.photos, np.tile([0, 1, 2], len(cloud)))
    np.testing.assert_allclose(cloud.trust, 0.6, atol=1e-6)
    np.testing.assert_array_equal(cloud.colors, round((0.9 * 100 + 0.3 * 200) / 1.8))
    ball = np.abs(np.linalg.norm(cloud.points, axis=1) - RADIUS) < 0.016
    floor = np.abs(cloud.points[:, 2] + 0.5) < 0.016  # a cell, in which both may lie where they touch
    assert (ball | floor).all()
    assert (np.abs(np.linalg.norm(cloud.points[~floor], axis=1) - RADIUS) < 1e-4).mean() > 0.8
    inner = np.abs(np.linalg.norm(cloud.normals, axis=1) - 1) < 1e-5
    assert inner.mean() > 0.95
    assert (cloud.normals[floor & ~ball & inner][:, 2] > 0.99).mean() > 0.95
    # about a point a pixel: a cell is a pixel wide to the nearest power of two
    assert 0.3 < len(cloud) / true.size < 1


def test_a_close_up_keeps_its_detail():
    near, far = ring(1, focal=760.0), ring(1)
    views = [views_of(near, 1000)[0], views_of(far, 1000)[0]]
    depths = [draw(cams).depths[0].astype(np.float32) for cams in (near, far)]
    trusts = [(depth > 0).astype(np.float32) for depth in depths]
    colors = [np.zeros((120, 160, 3), np.uint8)] * 2
    both = fused(views, depths, trusts, colors)
    alone = [fused(views[k : k + 1], depths[k : k + 1], trusts[:1], colors[:1]) for k in range(2)]
    assert len(both) == len(alone[0]) + len(alone[1])  # two octaves apart, no cell is shared
    by_photo = np.bincount(both.photos)
    np.testing.assert_array_equal(by_photo, [len(each) for each in alone])


def test_no_two_cells_have_one_number():
    axis = np.arange(-20, 20) + 0.5
    points = np.stack(np.meshgrid(axis, axis, axis), -1).reshape(-1, 3)
    keys = [_cells(points * size, np.full(len(points), size)) for size in (0.5, 1.0, 2.0)]
    assert len(np.unique(keys)) == 3 * len(points)
    np.testing.assert_array_equal(_cells(points + 0.4, np.full(len(points), 1.0)), keys[1])


def test_no_trust_gives_no_points():
    view = views_of(ring(1), 1000)[0]
    depth = np.ones((120, 160), np.float32)
    cloud = fused([view], [depth], [np.zeros_like(depth)], [np.zeros((120, 160, 3), np.uint8)])
    assert len(cloud) == 0
    assert cloud.starts.tolist() == [0]


# ---------------------------------------------------------------- the record
def test_points_moved_and_chosen():
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    target = Similarity(2.0, turn, np.array([1.0, 2, 3]))
    cloud = cloud_of(np.eye(3), [[0], [1, 2], [0, 1, 4]], np.array([0.1, 0.2, 0.3]))
    moved = cloud.moved(target)
    np.testing.assert_allclose(moved.points, target.apply(np.eye(3)))
    np.testing.assert_allclose(moved.normals, np.eye(3) @ turn.T)
    np.testing.assert_allclose(moved.moved(target.inverse()).points, cloud.points, atol=1e-6)
    chosen = moved.chosen(np.array([True, False, True]))
    assert chosen.starts.tolist() == [0, 1, 4]
    assert chosen.photos.tolist() == [0, 0, 1, 4]
    np.testing.assert_allclose(chosen.trust, [0.1, 0.3])
    assert len(cloud.chosen(np.zeros(3, bool))) == 0
    assert len(PointCloud.empty().moved(target)) == 0


# ---------------------------------------------------------------- what points cover
def ball_mesh() -> tuple[np.ndarray, np.ndarray]:
    ball = trimesh.creation.icosphere(4, RADIUS)
    return np.asarray(ball.vertices), np.asarray(ball.faces)


def test_share_of_a_ball_that_points_cover():
    cams, (vertices, faces) = all_around(), ball_mesh()
    whole = ball_cloud(cams, 30_000)

    def share(cloud: PointCloud, ground: Plane | None = None) -> float:
        return covered_share(vertices, faces, cams, ground, cloud)

    assert share(whole) == 1
    assert share(whole.chosen(whole.points[:, 2] > 0)) == pytest.approx(0.5, abs=0.08)
    assert share(whole.chosen(whole.points[:, 2] > RADIUS / 2)) == pytest.approx(0.25, abs=0.08)
    doubtful = replace(whole, trust=np.full(len(whole), 0.2))
    for nothing in (
        PointCloud.empty(),
        doubtful,
        whole.chosen(np.arange(len(whole)) % 300 == 0),
    ):  # none, thinly spread
        assert share(nothing) < 0.01
    ground = Plane(np.array([0.0, 0, 1]), 0.0, 0.01, 1.0)
    assert share(whole.chosen(whole.points[:, 2] > 0), ground) == 1  # what lies under the ground is not asked for


def test_nothing_is_covered_where_there_is_no_surface():
    cams = all_around()
    nothing = (np.zeros((0, 3)), np.zeros((0, 3), int))
    assert covered_share(*nothing, cams, None, ball_cloud(cams)) == 0


# ---------------------------------------------------------------- training
def test_sightings_of_a_cloud():
    points = np.array([[0.5, 0, 0], [0, 0.3, 0], [0, 0, 2.0], [0, 0, 0.7]])
    cloud = cloud_of(points, [[0, 1], [1, 2], [0, 2], [2, 0, 1, 0]], np.array([0.5, 0.0, 1.0, 0.2]))
    centers = np.array([[3.0, 0, 0], [0, 3, 0], [0, 0, 3]])
    found = Sightings.from_cloud(cloud, centers, "cpu")
    assert found.points.tolist() == pytest.approx(np.array([[0.5, 0, 0], [0, 0, 0.7]]))  # no trust; outside the sphere
    assert found.weights.tolist() == pytest.approx([0.5, 0.2])
    assert found.lines.tolist() == [[0, 0], [1, 0], [2, 1], [0, 1], [1, 1], [0, 1]]
    held_out = Sightings.from_cloud(cloud, centers, "cpu", np.array([True, False, True]))
    assert held_out.lines.tolist() == [[0, 0], [2, 1], [0, 1], [0, 1]]
    drawn = found.draw(3, 0.01, torch.Generator().manual_seed(0))
    at, behind, before, free = drawn.places.view(4, 3, 3)
    for k in range(3):
        origin = centers[np.argmin(np.linalg.norm(np.cross(centers - at[k].numpy(), behind[k] - at[k]), axis=1))]
        sight = (at[k].numpy() - origin) / np.linalg.norm(at[k].numpy() - origin)
        np.testing.assert_allclose(behind[k] - at[k], 0.01 * sight, atol=1e-6)
        np.testing.assert_allclose(before[k] - at[k], -0.01 * sight, atol=1e-6)
        assert (at[k] - free[k]).numpy() @ sight >= 0.01 - 1e-6
        assert np.linalg.norm(free[k]) <= 1 + 1e-5
    nothing = Sightings.from_cloud(PointCloud.empty(), centers, "cpu")
    assert len(nothing.draw(5, 0.01, torch.Generator()).weights) == 0
