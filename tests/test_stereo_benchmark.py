"""The benchmark of dense points: depth maps as places, their score against a known surface, its table."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from sphere_scene import RADIUS, ring_of_cameras, sphere_scene

from benchmarks import stereo
from stages import artifacts
from stages.evaluation.protocols.known_object import KnownObject, seen_surface


def ball_depths(cameras, index: int) -> np.ndarray:
    """Depth [H, W] of the ball along the optical axis, 0 beside it."""
    width, height = cameras.sizes[index]
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    origins, directions = cameras.rays(index, np.stack([x.ravel(), y.ravel()], 1))
    middle = -(origins * directions).sum(1)
    half_squared = RADIUS**2 - ((origins + middle[:, None] * directions) ** 2).sum(1)
    along = middle - np.sqrt(np.maximum(half_squared, 0))
    depth = along * (directions @ cameras.extrinsics[index, 2, :3])
    return np.where(half_squared > 0, depth, 0).reshape(height, width).astype(np.float32)


def test_depth_maps_become_places_in_the_frame_of_the_poses(tmp_path):
    cameras = ring_of_cameras()
    scene = sphere_scene(cameras)
    maps = artifacts.DepthMaps(tmp_path)
    for index in (0, 3):
        depth = ball_depths(cameras, index)
        maps.save(cameras.names[index], depth * np.float32(scene.poses_from_scene.scale), np.where(depth > 0, 0.4, 0))
    points, trust = stereo.every_depth(scene, maps)
    known = sum(int((ball_depths(cameras, index)[:: stereo.STRIDE, :: stereo.STRIDE] > 0).sum()) for index in (0, 3))
    assert len(points) == known > 20
    in_scene = scene.poses_from_scene.inverse().apply(points)
    np.testing.assert_allclose(np.linalg.norm(in_scene, axis=1), RADIUS, atol=1e-4)
    np.testing.assert_allclose(trust, 0.4, atol=1 / 255)
    assert len(stereo.every_depth(scene, artifacts.DepthMaps(tmp_path / "none"))[0]) == 0


def test_points_are_scored_both_ways_and_by_trust():
    mesh = trimesh.creation.icosphere(5, 0.5)
    known = KnownObject(np.asarray(mesh.vertices), np.asarray(mesh.faces), ring_of_cameras())
    seen = seen_surface(known)
    directions = np.random.default_rng(0).normal(size=(100_000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    off = np.arange(100_000) % 4 == 0  # a quarter lies 4 % of the extent outside, and is trusted a third as much
    row = stereo.score_points("some", (0.5 + 0.04 * off)[:, None] * directions, np.where(off, 0.3, 0.9), known, seen)
    assert (row.points, row.within) == (100_000, 75)
    assert row.trust == pytest.approx(0.75)
    assert row.mean == pytest.approx(1.0, abs=0.05)
    assert row.weighed == pytest.approx(4 * 0.3 / 3, abs=0.05)
    assert row.median < 0.1
    assert row.covered > 95
    front = directions[directions[:, 0] > 0]
    half = stereo.score_points("half", 0.5 * front, np.ones(len(front)), known, seen)
    assert half.completeness > 5
    assert half.covered < 60
    assert stereo.score_points("none", np.zeros((0, 3)), np.zeros(0), known, seen).points == 0


def test_the_table_has_a_row_a_choice_and_files_come_back(tmp_path, monkeypatch):
    monkeypatch.setattr(stereo, "ROWS", tmp_path)
    every = stereo.Row("every depth", 1234, 0.5, 2.0, 1.0, 1.5, 60.0, 0.5, 90.0)
    result = stereo.Result("ball", "x", {}, 8, 12, 20.4, 1 << 29, (every, replace(every, name="cloud", points=900)))
    stereo.save_result(result)
    assert stereo.load_results() == [result]
    lines = stereo.tables()["stereo"].splitlines()
    assert lines[2] == "| ball | every depth | 1k | 0.50 | 2.00 | 1.00 | 1.50 | 60 | 0.50 | 90 | 20 |"
    assert lines[3].startswith("|  | cloud | 1k |")
    assert lines[3].endswith("|  |")
