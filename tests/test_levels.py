"""Levels of detail: fewer faces, the same shape, the same place in the texture, normals of the full mesh."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from stages.artifacts import AtlasMesh
from stages.surface.levels_of_detail import levels_of_detail


def globe(rows: int = 48) -> AtlasMesh:
    """A unit ball as two charts, cut along the circle x = 0: each half is laid flat by (y, z)."""
    from stages.surface.solids import cut_at_plane, cut_to_ball, extract_solid

    parts = []
    surface = extract_solid(lambda p: np.linalg.norm(p, axis=1) - 0.5, rows)
    whole = cut_to_ball(surface.vertices, surface.faces, 0.9)
    for side in (1.0, -1.0):
        vertices, faces = cut_at_plane(*whole, np.array([side, 0.0, 0.0]), 0.0)
        lid = (np.abs(vertices[faces][:, :, 0]) < 1e-6).all(1)
        used, index = np.unique(faces[~lid], return_inverse=True)
        flat = vertices[used, 1:] * 0.45 + 0.25
        parts.append((vertices[used], index.reshape(-1, 3), flat + np.array([0.5 * (side < 0), 0])))
    (va, fa, ua), (vb, fb, ub) = parts
    vertices = np.concatenate([va, vb])
    normals = vertices / np.linalg.norm(vertices, axis=1, keepdims=True)
    return AtlasMesh(
        vertices.astype(np.float32),
        normals.astype(np.float32),
        np.concatenate([ua, ub]).astype(np.float32),
        np.concatenate([fa, fb + len(va)]).astype(np.int32),
        64,
    )


@pytest.fixture(scope="module")
def levels() -> tuple[AtlasMesh, list[AtlasMesh]]:
    atlas = globe()
    return atlas, list(levels_of_detail(atlas, 3))


def test_each_level_has_half_the_faces_of_the_one_before(levels):
    atlas, light = levels
    counts = [len(mesh.faces) for mesh in (atlas, *light)]
    for before, after in pairwise(counts):
        assert 0.45 * before < after <= before / 2


def test_levels_keep_shape_and_closedness(levels):
    import trimesh

    for mesh in levels[1]:
        assert np.abs(np.linalg.norm(mesh.vertices, axis=1) - 0.5).max() < 0.02
        joined = trimesh.Trimesh(mesh.vertices, mesh.faces)
        joined.merge_vertices(merge_tex=True, merge_norm=True)
        assert joined.is_watertight
        assert joined.volume == pytest.approx(np.pi / 6, rel=0.03)


def test_levels_keep_the_place_in_the_texture(levels):
    """Every point reads where the full mesh reads, on its own side of the seam."""
    for mesh in levels[1]:
        middle, flat = mesh.vertices[mesh.faces].mean(1), mesh.uvs[mesh.faces].mean(1)
        left = flat[:, 0] < 0.5
        assert (mesh.uvs[mesh.faces][:, :, 0] < 0.5).all(1).sum() == left.sum()  # no face has corners in both charts
        assert middle[left, 0].min() > -0.02
        assert middle[~left, 0].max() < 0.02
        expected = middle[:, 1:] * 0.45 + 0.25 + np.stack([0.5 * ~left, 0 * left], axis=1)
        assert np.abs(flat - expected).max() < 0.01


def test_levels_have_the_full_mesh_normals(levels):
    for mesh in levels[1]:
        outward = mesh.vertices / np.linalg.norm(mesh.vertices, axis=1, keepdims=True)
        np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=1), 1, atol=1e-4)
        assert (mesh.normals * outward).sum(1).min() > 0.995


def test_no_levels_are_none():
    assert list(levels_of_detail(globe(16), 0)) == []
