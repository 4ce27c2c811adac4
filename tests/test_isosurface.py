"""Blocked marching cubes: closed forms, block independence, manifoldness on any field, work done."""

from __future__ import annotations

import numpy as np
import pytest

from stages.surface.isosurface import CORNERS, EDGES, cube_tables, extract_isosurface
from stages.surface.triangle_mesh import face_adjacency, face_normals, label_pieces, mesh_state


def sphere(points):
    return np.linalg.norm(points, axis=1) - 0.5


def torus(points):
    return np.hypot(np.hypot(points[:, 0], points[:, 1]) - 0.55, points[:, 2]) - 0.2


def plane_and_ball(points):
    ball = np.linalg.norm(points - np.array([0, 0, 0.1], np.float32), axis=1) - 0.35
    return np.minimum(ball, np.abs(points[:, 2] + 0.3) - 0.03)


def waves(points, amplitude=0.05):
    rng = np.random.default_rng(0)
    phase = points.astype(np.float64) @ (rng.normal(size=(3, 8)) * 25)
    return sphere(points) + amplitude * np.sin(phase).sum(1)


def white_noise(points):
    """A field that is different at every point: all 256 sign patterns come up, and no bound on the gradient holds."""
    scrambled = np.sin(points.astype(np.float64) @ np.array([12.9898, 78.233, 37.719]) * 1000) * 43758.5453
    return sphere(points) + 0.3 * (scrambled - np.floor(scrambled) - 0.5)


def area_and_volume(mesh):
    corners = mesh.vertices[mesh.faces].astype(np.float64)
    normals = face_normals(mesh.vertices, mesh.faces)
    return np.linalg.norm(normals, axis=1).sum() / 2, np.einsum("fi,fi->", corners.mean(1), normals) / 6


def euler(mesh):
    edges = np.unique(
        np.sort(np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]])), axis=0
    )
    return len(mesh.vertices) - len(edges) + len(mesh.faces)


def border_vertices(mesh):
    edges = np.sort(np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]]), axis=1)
    edges, counts = np.unique(edges, axis=0, return_counts=True)
    return mesh.vertices[np.unique(edges[counts == 1])]


def test_sphere_has_closed_form_area_and_volume():
    area, volume = area_and_volume(extract_isosurface(sphere, 64))
    assert area == pytest.approx(np.pi, rel=3e-3)
    assert volume == pytest.approx(np.pi / 6, rel=5e-3)  # positive: normals point to positive distances


def test_sphere_vertices_lie_on_the_sphere():
    mesh = extract_isosurface(sphere, 64)
    # Linear interpolation of a distance along an edge of length h errs by at most h^2 / (8 r).
    assert np.abs(sphere(mesh.vertices)).max() < (2 / 64) ** 2 / (8 * 0.5) * 1.5


@pytest.mark.parametrize(("field", "characteristic"), [(sphere, 2), (torus, 0)])
def test_topology(field, characteristic):
    mesh = extract_isosurface(field, 48, block=16)
    state = mesh_state(mesh.faces)
    assert state.watertight
    assert state.manifold
    assert euler(mesh) == characteristic


@pytest.mark.slow
@pytest.mark.parametrize("resolution", [80, 100])
def test_blocks_of_any_size_give_the_same_mesh(resolution):
    meshes = [extract_isosurface(plane_and_ball, resolution, block=b) for b in (24, 64, 256)]

    def canonical(mesh):
        order = np.lexsort(mesh.vertices.T)
        rank = np.empty(len(order), dtype=np.int64)
        rank[order] = np.arange(len(order))
        faces = rank[mesh.faces]
        faces = np.stack([np.roll(f, -int(f.argmin())) for f in faces])
        return mesh.vertices[order], faces[np.lexsort(faces.T)]

    vertices, faces = canonical(meshes[0])
    for other in meshes[1:]:
        other_vertices, other_faces = canonical(other)
        np.testing.assert_array_equal(other_vertices, vertices)
        np.testing.assert_array_equal(other_faces, faces)


@pytest.mark.parametrize("field", [waves, white_noise])
@pytest.mark.parametrize("block", [16, 64])
def test_noisy_fields_give_closed_manifolds(field, block):
    mesh = extract_isosurface(field, 72, block=block)
    state = mesh_state(mesh.faces)
    assert len(mesh.faces) > 10_000
    assert state.watertight
    assert state.manifold


def test_steep_field_is_followed_where_the_distances_mislead():
    """A thin ripple far steeper than the bound: skipping alone would leave cracks between blocks and cells."""

    def field(points):
        fade = np.exp(-((points[:, 1] / 0.2) ** 2) - (points[:, 0] / 0.6) ** 4 - (points[:, 2] / 0.6) ** 4)
        return sphere(points) + 0.5 * np.sin(40 * points[:, 0]) * fade

    mesh = extract_isosurface(field, 128, block=32, lipschitz=0.05)
    assert mesh_state(mesh.faces).watertight
    assert mesh_state(mesh.faces).manifold


def test_a_field_that_never_answers_twice_the_same_leaves_no_crack():
    """Networks on batches of another size differ in the last bits; blocks must still agree."""
    rng = np.random.default_rng(1)
    mesh = extract_isosurface(lambda p: sphere(p) + 1e-3 * rng.normal(size=len(p)), 128, block=16)
    assert mesh_state(mesh.faces).watertight
    assert mesh_state(mesh.faces).manifold


def test_exact_zeros_do_not_degenerate():
    mesh = extract_isosurface(lambda p: np.abs(p).max(1) - 0.5, 32)  # the box's faces lie on grid points
    assert np.linalg.norm(face_normals(mesh.vertices, mesh.faces), axis=1).min() > 0
    assert mesh_state(mesh.faces).watertight


def test_surface_that_leaves_the_ball_ends_in_an_open_border_near_it():
    mesh = extract_isosurface(lambda p: p[:, 2] - 0.013, 96, block=32)
    state = mesh_state(mesh.faces)
    assert state.manifold
    assert state.open_edges > 0
    radii = np.linalg.norm(border_vertices(mesh), axis=1)
    assert radii.min() > 1 - 2 * np.sqrt(3) * 2 / 96
    assert np.linalg.norm(mesh.vertices, axis=1).max() <= 1 + 1e-6
    assert face_normals(mesh.vertices, mesh.faces)[:, 2].min() > 0


def test_work_grows_with_the_surface_not_the_cube():
    coarse, fine = extract_isosurface(sphere, 128), extract_isosurface(sphere, 256)
    assert fine.evaluated < 0.05 * 257**3
    assert fine.evaluated < 4.5 * coarse.evaluated


def test_thin_sheet_is_found():
    mesh = extract_isosurface(lambda p: np.maximum(np.abs(p[:, 2] - 0.1) - 0.006, np.linalg.norm(p, axis=1) - 0.6), 256)
    assert len(np.unique(label_pieces(len(mesh.faces), face_adjacency(mesh.faces)))) == 1
    assert area_and_volume(mesh)[0] == pytest.approx(2 * np.pi * (0.36 - 0.01), rel=0.05)


def test_no_surface_gives_an_empty_mesh():
    mesh = extract_isosurface(lambda p: np.ones(len(p)), 32)
    assert mesh.vertices.shape == (0, 3)
    assert mesh.faces.shape == (0, 3)


def test_bad_answers_and_settings_are_refused():
    with pytest.raises(ValueError, match="finite"):
        extract_isosurface(lambda p: np.full(len(p), np.nan), 16)
    with pytest.raises(ValueError, match="shape"):
        extract_isosurface(lambda p: np.zeros((len(p), 1)), 16)
    with pytest.raises(ValueError, match="resolution >= 2"):
        extract_isosurface(sphere, 1)


def test_progress_ends_complete():
    calls = []
    extract_isosurface(sphere, 96, block=32, progress=lambda done, total: calls.append((done, total)))
    assert calls[-1][0] == calls[-1][1] == len(calls)


def test_tables_neighbours_agree_and_no_diagonal_lies_in_a_face():
    tables = cube_tables()
    midpoints = np.array([(CORNERS[a] + CORNERS[b]) / 2 for a, b in EDGES])
    on_face = {
        (axis, side): {e for e in range(12) if midpoints[e][axis] == side} for axis in range(3) for side in range(2)
    }
    seen: dict[tuple, set] = {}
    for pattern in range(256):
        triangles = tables.triangles[pattern, : tables.counts[pattern]]
        directed = [(int(t[i]), int(t[(i + 1) % 3])) for t in triangles for i in range(3)]
        assert len(directed) == len(set(directed))
        single = {(a, b) for a, b in directed if (b, a) not in directed}
        for (axis, side), edges in on_face.items():
            inner = {(a, b) for a, b in directed if a in edges and b in edges}
            assert inner <= single  # a segment on a cube face belongs to one triangle of this cube
            others = [a for a in range(3) if a != axis]
            corners = [c for c in range(8) if CORNERS[c][axis] == side]
            signs = tuple(pattern >> c & 1 for c in sorted(corners, key=lambda c: tuple(CORNERS[c][others])))
            drawn = {tuple(tuple(midpoints[e][others]) for e in (pair if side else pair[::-1])) for pair in inner}
            # The same signs on a face give the same segments from either side, run through in opposite directions.
            assert seen.setdefault((axis, signs), drawn) == drawn
        assert sum(len([p for p in single if p[0] in e and p[1] in e]) for e in on_face.values()) == len(single)
