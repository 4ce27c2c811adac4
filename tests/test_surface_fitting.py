"""Meshes moved to dense points, and rid of noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from stages.geometry.point_cloud import PointCloud
from stages.surface import fitting
from stages.surface.denoising import denoised
from stages.surface.fitting import fit_to_points
from stages.surface.isosurface import extract_isosurface
from stages.surface.moving import directions_of, rings_of, within_gaps, without_folds
from stages.surface.triangle_mesh import face_normals

RESOLUTION = 40
CELL = 2 / RESOLUTION
RADIUS = 0.6


@pytest.fixture(scope="module")
def sphere():
    surface = extract_isosurface(lambda p: np.linalg.norm(p, axis=1).astype(np.float32) - RADIUS, RESOLUTION)
    return surface.vertices, surface.faces


def cloud_of(points, normals, photos=12, trust=1.0):
    """A cloud whose points are each seen by so many photos."""
    count = len(points)
    return PointCloud(
        points.astype(np.float32),
        normals.astype(np.float32),
        np.zeros((count, 3), np.uint8),
        np.full(count, trust, np.float32),
        np.arange(count + 1) * photos,
        np.tile(np.arange(photos, dtype=np.int32), count),
    )


def round_cloud(radius, noise=0.0, count=20_000, **kwargs):
    """Points about a sphere."""
    rng = np.random.default_rng(0)
    normals = rng.normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return cloud_of(normals * (radius + noise * rng.normal(size=(count, 1))), normals, **kwargs)


def radii(vertices):
    return np.linalg.norm(vertices, axis=1)


def folds(vertices, moved, faces):
    """Faces that turned over."""
    return np.einsum("fc,fc->f", face_normals(vertices, faces), face_normals(moved, faces)) <= 0


@pytest.mark.parametrize("off", [-1.5, 0.4, 2.0])
def test_the_mesh_goes_to_the_mean_of_noisy_points(sphere, off):
    fit = fit_to_points(*sphere, round_cloud(RADIUS + off * CELL, noise=0.15 * CELL), CELL)
    away = radii(fit.vertices) - (RADIUS + off * CELL)
    assert np.abs(away).mean() < 0.06 * CELL
    assert fit.vertices.dtype == np.float32
    assert fit.used > 15_000


def test_points_that_disagree_with_their_surroundings_have_no_say(sphere):
    good = round_cloud(RADIUS + 0.5 * CELL, noise=0.1 * CELL)
    wild = np.arange(len(good)) % 6 == 0
    points = np.where(wild[:, None], good.points + 4 * CELL * good.normals, good.points)
    fit = fit_to_points(*sphere, replace(good, points=points.astype(np.float32)), CELL)
    assert np.abs(radii(fit.vertices) - RADIUS - 0.5 * CELL).mean() < 0.12 * CELL


@pytest.mark.parametrize(
    "cloud",
    [
        PointCloud.empty(),
        round_cloud(RADIUS + CELL, trust=0.0),
        round_cloud(RADIUS + 9 * CELL),
        replace(round_cloud(RADIUS + CELL), normals=-round_cloud(RADIUS + CELL).normals),
    ],
    ids=["empty", "distrusted", "far", "turned away"],
)
def test_what_is_no_evidence_moves_nothing(sphere, cloud):
    fit = fit_to_points(*sphere, cloud, CELL)
    np.testing.assert_array_equal(fit.vertices, sphere[0])
    assert fit.used == fit.folds == 0


def test_only_points_about_the_mesh_are_looked_up(sphere, monkeypatch):
    near, far = round_cloud(RADIUS + CELL, count=3000), round_cloud(3.0, count=3000)
    both = cloud_of(np.concatenate([near.points, far.points]), np.concatenate([near.normals, far.normals]))
    looked_up, beside = [], fitting._beside
    monkeypatch.setattr(fitting, "_beside", lambda *given: looked_up.append(len(given[3])) or beside(*given))
    fits = [fit_to_points(*sphere, cloud, CELL) for cloud in (near, both)]
    assert looked_up == [3000, 3000]
    np.testing.assert_array_equal(fits[0].vertices, fits[1].vertices)


def test_few_points_and_points_of_one_photo_move_little(sphere):
    few = fit_to_points(*sphere, round_cloud(RADIUS + CELL, count=30), CELL)
    one = fit_to_points(*sphere, round_cloud(RADIUS + CELL, noise=0.15 * CELL, photos=1), CELL)
    many = fit_to_points(*sphere, round_cloud(RADIUS + CELL, noise=0.15 * CELL), CELL)
    moved = [np.abs(radii(fit.vertices) - RADIUS).mean() / CELL for fit in (few, one, many)]
    assert moved[0] < 0.25
    assert moved[1] < 0.25
    assert moved[2] > 0.9


def test_where_points_end_the_move_fades(sphere):
    vertices, faces = sphere
    cloud = round_cloud(RADIUS + CELL)
    fit = fit_to_points(vertices, faces, cloud.chosen(cloud.points[:, 2] > 0), CELL)
    moved = (radii(fit.vertices) - RADIUS) / CELL
    assert moved[vertices[:, 2] > 2 * CELL].min() > 0.8
    assert np.abs(moved[vertices[:, 2] < -9 * CELL]).max() < 0.02
    edges = np.stack([moved[faces], moved[np.roll(faces, 1, axis=1)]])
    assert np.abs(edges[0] - edges[1]).max() < 0.35


def test_the_sides_of_a_wall_never_meet():
    half = np.array([0.5, 0.5, 0.06])
    box = extract_isosurface(lambda p: (np.abs(p) - half).max(1).astype(np.float32), RESOLUTION)
    vertices, faces = box.vertices, box.faces
    rng = np.random.default_rng(1)
    side = np.where(np.arange(30_000) % 2, 1.0, -1.0)
    points = np.stack([*rng.uniform(-0.45, 0.45, (2, 30_000)), 0.004 * side], axis=1)
    normals = np.stack([0 * side, 0 * side, side], axis=1)
    fit = fit_to_points(vertices, faces, cloud_of(points, normals), CELL)
    flat = np.abs(vertices[:, :2]).max(1) < 0.4
    top, bottom = (fit.vertices[flat & (sign * vertices[:, 2] > 0), 2] for sign in (1, -1))
    assert top.min() > bottom.max()
    assert np.abs(top).mean() < 0.02  # held at 0.4 of the way, 0.012
    assert not folds(vertices, fit.vertices, faces).any()


def test_the_sides_of_a_thin_wall_are_not_smoothed_into_each_other():
    box = extract_isosurface(lambda p: (np.abs(p) - np.array([0.5, 0.5, 0.06])).max(1).astype(np.float32), RESOLUTION)
    # A corrugated sheet, less than a fifth of a cell thick: its top alone would go straight through its bottom.
    sheet = box.vertices * np.array([1, 1, 0.08 * CELL / 0.06])
    sheet[:, 2] += 0.3 * CELL * np.sin(2 * np.pi / (5 * CELL) * sheet[:, 0])
    top = (np.abs(box.vertices[:, :2]).max(1) < 0.4) & (box.vertices[:, 2] > 0)
    up = (denoised(sheet, box.faces, 5) - sheet)[top, 2]
    assert up.max() > 0.12 * CELL  # away from the bottom nothing holds it
    assert up.min() > -0.41 * 0.16 * CELL


def test_what_meets_its_own_side_first_still_finds_the_other():
    """A ray that grazes a face of its own side goes on beyond it."""
    steps = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], dtype=float)
    vertices = np.concatenate([steps + np.array([0, 0, height]) for height in (0.0, 0.4, 1.0)])
    faces = np.array([[0, 1, 2], [3, 4, 5], [6, 8, 7]])
    directions = np.repeat([[0.0, 0, 1], [0, 0, 1], [0, 0, -1]], 3, axis=0)
    moves = np.zeros_like(vertices)
    vertices[0, :2], moves[0] = 0.1, [0, 0, 3]
    moved = within_gaps(vertices, faces, directions, moves, 0.5)
    np.testing.assert_allclose(moved[0], [0, 0, 0.4], atol=1e-5)
    assert not moved[1:].any()


def test_displacements_are_the_minimum_that_is_written_down(sphere):
    vertices, faces = sphere
    rings = rings_of(faces, len(vertices))
    rng = np.random.default_rng(2)
    pull, moves = rng.uniform(0, 2, len(vertices)), np.zeros(len(vertices))
    aim = pull * rng.normal(size=len(vertices))
    fitting._relax(moves, pull, aim, rings.starts, rings.others, 0.3, 0.01, 400)
    matrix = np.diag(pull + 0.01)
    for v in range(len(vertices)):
        for other in rings.others[rings.starts[v] : rings.starts[v + 1]]:
            matrix[v, v] += 0.3
            matrix[v, other] -= 0.3
    np.testing.assert_allclose(moves, np.linalg.solve(matrix, aim), atol=1e-6)


@pytest.mark.parametrize("size", [0.3, 1.0, 3.0])
def test_no_face_folds_however_vertices_are_moved(sphere, size):
    vertices, faces = sphere
    rings = rings_of(faces, len(vertices))
    directions = directions_of(vertices, faces, rings)
    wild = vertices + size * CELL * np.random.default_rng(3).normal(size=vertices.shape)
    assert folds(vertices, wild, faces).any()
    moved, would = without_folds(vertices, faces, directions, wild, rings)
    assert would > 0
    towards = directions[faces].sum(1)
    assert (np.einsum("fc,fc->f", face_normals(moved, faces), towards) > 0).all()


def test_what_does_not_fold_is_not_held_back(sphere):
    vertices, faces = sphere
    rings = rings_of(faces, len(vertices))
    moved, would = without_folds(vertices, faces, directions_of(vertices, faces, rings), 1.02 * vertices, rings)
    np.testing.assert_array_equal(moved, 1.02 * vertices)
    assert would == 0


def test_ring_means_by_an_obvious_loop(sphere):
    vertices, faces = sphere
    rings = rings_of(faces, len(vertices))
    means = rings.mean(vertices)
    for v in (0, 17, len(vertices) - 1):
        around = {v, *faces[(faces == v).any(1)].ravel().tolist()}
        np.testing.assert_allclose(means[v], vertices[sorted(around)].mean(0), rtol=1e-6)
    rows = np.array([17, 3])
    np.testing.assert_array_equal(rings.mean_at(rows, vertices), means[rows])


def test_a_noisy_box_comes_out_flat_with_its_edges():
    box = extract_isosurface(lambda p: (np.abs(p) - 0.5).max(1).astype(np.float32), RESOLUTION)
    rng = np.random.default_rng(4)
    noisy = (box.vertices + 0.08 * CELL * rng.normal(size=box.vertices.shape)).astype(np.float32)
    smooth = denoised(noisy, box.faces, 5)

    places = np.sort(np.abs(box.vertices), axis=1)
    middles, beside_edges = places[:, 1] < 0.4, places[:, 1] > 0.5 - 1.01 * CELL

    def off(vertices, rows):
        """How far vertices are from the box's surface."""
        beyond = np.abs(vertices[rows]) - 0.5
        outside, inside = np.linalg.norm(np.maximum(beyond, 0), axis=1), np.minimum(beyond.max(1), 0)
        return np.abs(outside + inside).mean()

    assert off(smooth, middles) < 0.6 * off(noisy, middles)
    assert off(smooth, beside_edges) < 0.7 * off(noisy, beside_edges)
    # A filter that rounds the edges off makes them worse.
    rounded = rings_of(box.faces, len(noisy)).mean(noisy)
    assert off(rounded, beside_edges) > 2 * off(noisy, beside_edges)
    # The noise-free mesh, as sharp as its cells let it be, hardly moves.
    still = denoised(box.vertices, box.faces, 5)
    assert np.linalg.norm(still - box.vertices, axis=1).max() < 0.25 * CELL


def test_a_round_thing_stays_as_large(sphere):
    vertices, faces = sphere
    assert np.abs(radii(denoised(vertices, faces, 5)) - RADIUS).max() < 0.06 * CELL


def test_no_rounds_change_nothing_and_bad_values_are_refused(sphere):
    np.testing.assert_array_equal(denoised(*sphere, 0), sphere[0])
    with pytest.raises(ValueError, match="rounds >= 0, got -1"):
        denoised(*sphere, -1)
    with pytest.raises(ValueError, match="positive cell, got 0"):
        fit_to_points(*sphere, PointCloud.empty(), 0)
