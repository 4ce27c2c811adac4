"""Levels of detail: fewer faces, the same shape, the same place in the texture, normals of the full mesh."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from globe import globe

from stages.artifacts import AtlasMesh
from stages.surface.levels_of_detail import levels_of_detail


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
