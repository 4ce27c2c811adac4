"""Gaussians on a mesh, and colours of points by least squares, on closed forms."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree

from stages.artifacts import AtlasMesh
from stages.gaussians.colours import degree_for, fit_each, shared
from stages.gaussians.placing import count_for, free_gaussians, place, turns_to
from stages.gaussians.refining import ACROSS, ALONG, Anchors
from stages.geometry.cameras import PinholeCameras
from stages.geometry.vectors import unit
from stages.shading.observations import Observations

C0, C1 = 0.28209479177387814, 0.4886025119029199


def ball() -> AtlasMesh:
    made = trimesh.creation.icosphere(4)
    points = made.vertices.astype(np.float32)
    return AtlasMesh(points, points.copy(), (0.5 + 0.45 * points[:, :2]).astype(np.float32), made.faces, 64)


def grey(side: int = 64) -> np.ndarray:
    return np.full((side, side, 3), 128, np.uint8)


def test_places_are_on_the_surface_and_evenly_apart() -> None:
    gaussians, normals = place(ball(), grey(), 2000)
    assert abs(len(gaussians) - 2000) < 100
    assert np.abs(np.linalg.norm(gaussians.centers, axis=1) - 1).max() < 0.01
    assert ((gaussians.centers * normals).sum(1) > 0.99).all()
    tree = cKDTree(gaussians.centers)
    nearest = tree.query(gaussians.centers, k=2)[0][:, 1]
    even = np.sqrt(4 * np.pi / len(gaussians))
    assert nearest.min() > 0.7 * even  # a random sample has some a hundredth of that apart
    holes = tree.query(unit(np.random.default_rng(0).normal(0, 1, (5000, 3))))[0]
    assert holes.max() < 1.2 * even


def test_detail_draws_gaussians() -> None:
    texture = grey()
    texture[:, 32:] = np.random.default_rng(0).integers(0, 255, (64, 32, 3))  # u > 1/2, where x > 0
    gaussians, _ = place(ball(), texture, 2000)
    right = gaussians.centers[:, 0] > 0
    assert 3 < right.sum() / (~right).sum() < 5
    widths = np.exp(gaussians.log_scales[:, 0])
    assert np.median(widths[~right]) == pytest.approx(2 * np.median(widths[right]), rel=0.1)


def test_both_sides_of_a_thin_sheet_have_their_own() -> None:
    corners = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], np.float32)
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    sheet = AtlasMesh(
        np.concatenate([corners, corners - [0, 0, 1e-3]]).astype(np.float32),
        np.repeat([[0, 0, 1], [0, 0, -1]], 4, axis=0).astype(np.float32),
        np.concatenate([corners[:, :2]] * 2) * 0.5,
        np.concatenate([faces, faces[:, ::-1] + 4]),
        64,
    )
    _, normals = place(sheet, grey(), 1000)
    assert abs((normals[:, 2] > 0).mean() - 0.5) < 0.05


def test_turns_bring_the_z_axis_to_the_normals() -> None:
    normals = np.concatenate([unit(np.random.default_rng(0).normal(0, 1, (20, 3))), [[0, 0, 1], [0, 0, -1]]])
    w, x, y, z = turns_to(normals).T
    third = np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], 1)
    np.testing.assert_allclose(third, normals, atol=1e-6)


def test_as_many_as_a_photo_has_pixels_of_the_surface() -> None:
    K = np.array([[300.0, 0, 200], [0, 300, 200], [0, 0, 1]])
    pose = np.concatenate([np.eye(3), [[0], [0], [4]]], 1)
    camera = PinholeCameras(("a",), np.array([[400, 400]]), K[None], pose[None])
    # A pixel is 4 / 300 wide at the centre of the ball of area 4 pi.
    assert count_for(ball(), camera) == pytest.approx(4 * np.pi * (300 / 4) ** 2, rel=0.05)


# ---------------------------------------------------------------- colours
def some_seen(photos: int = 30, points: int = 40) -> tuple[Observations, np.ndarray]:
    """Points whose colour is linear in the direction, and its harmonics of degree 1 [S, 4, 3]."""
    rng = np.random.default_rng(0)
    towards = unit(rng.normal(0, 1, (points, photos, 3)))
    truth = rng.normal(0, 0.1, (points, 4, 3))
    away = -towards
    basis = np.stack([np.full(away.shape[:2], C0), -C1 * away[..., 1], C1 * away[..., 2], -C1 * away[..., 0]], -1)
    colors = 0.5 + basis @ truth
    ids = np.tile(np.arange(photos), (points, 1))
    ones = np.ones((points, photos), np.float32)
    return Observations(colors.astype(np.float32), ones, towards.astype(np.float32), ids), truth


@pytest.mark.slow
def test_least_squares_finds_the_harmonics_and_outliers_change_little() -> None:
    seen, truth = some_seen()
    found = fit_each(seen, np.ones((30, 3)), truth.astype(np.float32))
    np.testing.assert_allclose(found, truth, atol=1e-4)
    assert np.abs(fit_each(seen, np.ones((30, 3)), np.zeros_like(found)) - truth).max() < 0.1
    wrong = seen.colors.copy()
    wrong[:, 5] = 1.0
    disturbed = fit_each(
        Observations(wrong, seen.weights, seen.towards, seen.photos), np.ones((30, 3)), truth.astype(np.float32)
    )
    assert np.abs(disturbed - truth).mean() < 0.01


@pytest.mark.slow
def test_what_no_photo_sees_keeps_the_prior_and_exposures_are_taken_out() -> None:
    seen, truth = some_seen()
    prior = np.random.default_rng(1).normal(0, 1, truth.shape).astype(np.float32)
    unseen = Observations(seen.colors, 0 * seen.weights, seen.towards, seen.photos)
    np.testing.assert_allclose(fit_each(unseen, np.ones((30, 3)), prior), prior, atol=1e-5)
    gains = np.linspace(0.7, 1.4, 30)[:, None].repeat(3, 1)
    dim = Observations((seen.colors / gains[seen.photos]).astype(np.float32), seen.weights, seen.towards, seen.photos)
    np.testing.assert_allclose(fit_each(dim, gains, truth.astype(np.float32)), truth, atol=1e-4)


def test_neighbours_share_on_their_own_side_alone() -> None:
    rng = np.random.default_rng(0)
    places = rng.random((2000, 3)).astype(np.float32) * [1, 1, 0]
    normals = np.repeat([[0.0, 0, 1], [0, 0, -1]], 1000, axis=0)
    harmonics = np.repeat([1.0, 5.0], 1000)[:, None, None] * np.ones((1, 4, 3), np.float32)
    some = slice(None, None, 4)
    told = shared(harmonics[some].astype(np.float32), places[some], normals[some], places, normals)
    np.testing.assert_allclose(told, harmonics, atol=1e-5)


def test_free_ones_stand_where_points_lie_off_the_surface() -> None:
    rng = np.random.default_rng(0)
    surface = np.stack(np.meshgrid(np.linspace(0, 1, 40), np.linspace(0, 1, 40), [0.0]), -1).reshape(-1, 3)
    thin = np.stack([np.full(300, 0.5), np.full(300, 0.5), np.linspace(0.2, 1, 300)], 1)
    points = np.concatenate([surface + np.array([0.004, 0.004, 0.01]), thin, [[9.0, 9, 9]]])
    colors = np.tile(np.uint8([255, 0, 128]), (len(points), 1))
    free = free_gaussians(points, colors, surface, 1000, 2)
    assert len(free) == 301
    assert not free.anchored.any()
    assert (free.centers[:, 2] > 0.19).all()
    np.testing.assert_allclose(0.5 + C0 * free.harmonics[:, 0], colors[:301] / 255, atol=1e-6)
    np.testing.assert_allclose(np.exp(free.log_scales[150]), 0.8 / 299 * 4 / 3, rtol=1e-3)
    assert np.exp(free.log_scales).max() < 5 * 0.8 / 299 * 4 / 3  # the lone one is no fog
    assert len(free_gaussians(points, colors, surface, 100, 2)) == 100
    assert len(free_gaussians(surface + rng.normal(0, 1e-3, surface.shape), colors[:1600], surface, 100, 0)) == 0


def test_more_photos_more_degrees() -> None:
    assert [degree_for(count) for count in (1, 5, 6, 12, 24, 500)] == [0, 0, 1, 2, 3, 3]


def test_anchors_hold() -> None:
    rng = np.random.default_rng(0)
    points, normals = rng.normal(0, 1, (50, 3)), unit(rng.normal(0, 1, (50, 3)))
    centers = (points + rng.normal(0, 0.1, (50, 3))).astype(np.float32)
    centers[0] = points[0]
    before = centers.copy()
    Anchors(points, normals, 2.0).hold(centers, np.arange(40))
    off = centers[:40] - points[:40]
    height = (off * normals[:40]).sum(1)
    assert np.abs(height).max() < 2 * ALONG * 1.001
    assert np.linalg.norm(off - height[:, None] * normals[:40], axis=1).max() < 2 * ACROSS * 1.001
    np.testing.assert_array_equal(centers[[0, *range(40, 50)]], before[[0, *range(40, 50)]])
