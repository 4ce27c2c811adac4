"""Measures per vertex on a ball seen by a ring of cameras, against slow loops and closed forms."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import trimesh
from sphere_scene import RADIUS, render, ring_of_cameras

from stages.artifacts import AtlasMesh
from stages.drawing.rasterizing import Texels, rasterize_atlas
from stages.texture.baking import Provenance
from stages.texture.photo_views import prepare_view
from stages.texture.vertex_quality import (
    VertexWitness,
    color_precision,
    invented_share,
    mean_disagreement,
    texel_density,
)


def ball() -> AtlasMesh:
    mesh = trimesh.creation.icosphere(4, RADIUS)
    normals = mesh.vertices / RADIUS
    uvs = (normals[:, :2] + 1) / 2  # seen from above: both halves on one disc
    return AtlasMesh(
        *(np.asarray(a, np.float32) for a in (mesh.vertices, normals, uvs)), mesh.faces.astype(np.int32), 64
    )


def square(size: int = 32) -> AtlasMesh:
    """A square of side 2 on a quarter of its texture."""
    corners = np.array([[0, 0, 0], [2, 0, 0], [2, 2, 0], [0, 2, 0]], np.float32)
    normals = np.tile(np.array([0, 0, 1], np.float32), (4, 1))
    return AtlasMesh(corners, normals, corners[:, :2] / 4, np.array([[0, 1, 2], [0, 2, 3]], np.int32), size)


def measure_quality(atlas, cameras, photos, provenance, gains):
    witness = VertexWitness(atlas, len(photos))
    for i, photo in enumerate(photos):
        witness.look(i, prepare_view(cameras, i, photo, None, atlas.vertices, atlas.faces), gains[i])
    return witness.quality(texels_of(atlas), provenance)


def texels_of(atlas: AtlasMesh) -> Texels:
    return rasterize_atlas(atlas.uvs, atlas.faces, atlas.texture_size)


@pytest.fixture(scope="module")
def measured():
    cameras, atlas = ring_of_cameras(8, 96, 80), ball()
    provenance = np.full((64, 64), Provenance.PHOTO, np.uint8)
    photos = [render(cameras, i)[0] for i in range(8)]
    even = measure_quality(atlas, cameras, photos, provenance, np.ones((8, 3)))
    return cameras, atlas, photos, even


def test_photos_see_the_side_they_face(measured):
    cameras, atlas, _, quality = measured
    away = cameras.centers[:, None] - atlas.vertices
    cos = (away * atlas.normals).sum(2) / np.linalg.norm(away, axis=2)
    surely, maybe = (cos > 0.6).sum(0), (cos > 0.1).sum(0)
    assert (quality.seen_by >= surely).all()
    assert (quality.seen_by <= maybe).all()
    seen = quality.seen_by > 0
    np.testing.assert_allclose(quality.facing[surely > 0], cos.max(0)[surely > 0], atol=1e-5)
    assert (quality.facing[~seen] == 0).all()
    assert (quality.photo_density[~seen] == 0).all()
    # the focal length is 60 and the nearest surface 2.5 - 0.45 away
    assert quality.photo_density.max() < 60 / (2.5 - RADIUS)
    assert quality.photo_density.max() > 0.8 * 60 / (2.5 - RADIUS)


def test_photos_that_show_one_ball_agree_and_a_strange_one_is_noticed(measured):
    cameras, atlas, photos, quality = measured
    strange = [*photos[:3], 255 - photos[3], *photos[4:]]
    provenance = np.full((64, 64), Provenance.PHOTO, np.uint8)
    worse = measure_quality(atlas, cameras, strange, provenance, np.ones((8, 3)))
    before_it = atlas.normals @ cameras.centers[3] / np.linalg.norm(cameras.centers[3]) > 0.8
    assert np.median(worse.ambiguity[before_it]) > 3 * np.median(quality.ambiguity[before_it])


def test_gains_take_a_brighter_photo_back(measured):
    cameras, atlas, photos, quality = measured
    gains = np.ones((8, 3))
    gains[2] = 2
    darker = [*photos[:2], photos[2] // 2, *photos[3:]]
    provenance = np.full((64, 64), Provenance.PHOTO, np.uint8)
    again = measure_quality(atlas, cameras, darker, provenance, gains)
    np.testing.assert_allclose(again.ambiguity, quality.ambiguity, atol=0.03)


def test_photos_count_as_they_are_and_not_as_smoothed_for_the_texture(measured):
    cameras, atlas, photos, quality = measured
    witness = VertexWitness(atlas, len(photos))
    for i, photo in enumerate(photos):
        view = prepare_view(cameras, i, photo, None, atlas.vertices, atlas.faces, texel_side=0.2)
        assert (view.photo != view.original).any()
        witness.look(i, view, np.ones(3))
    again = witness.quality(texels_of(atlas), np.full((64, 64), Provenance.PHOTO, np.uint8))
    np.testing.assert_array_equal(again.ambiguity, quality.ambiguity)


def test_disagreement_is_that_of_a_slow_loop():
    random = np.random.default_rng(1)
    colors = random.integers(0, 256, (5, 20, 3), dtype=np.uint8)
    seen = random.random((5, 20)) > 0.4
    precision = np.linalg.inv(np.cov(random.normal(0, 50, (3, 40))))
    expected = np.zeros(20)
    for v in range(20):
        lambdas = []
        ids = np.flatnonzero(seen[:, v])
        for i in ids:
            differences = [colors[i, v].astype(float) - colors[j, v] for j in ids if j != i]
            lambdas += [np.mean([np.sqrt(d @ precision @ d) for d in differences])] if differences else []
        expected[v] = np.mean(lambdas) if lambdas else 0
    np.testing.assert_allclose(mean_disagreement(colors, seen, precision), expected, rtol=1e-4, atol=1e-6)


def test_precision_is_the_inverse_covariance_with_a_floor():
    colors = np.random.default_rng(0).normal(100, [30, 20, 10], (500, 3))
    rows = np.concatenate([np.ones((500, 1)), colors], 1)
    expected = np.linalg.inv(np.cov(colors.T, bias=True) + np.eye(3))
    np.testing.assert_allclose(color_precision(rows.T @ rows), expected, rtol=1e-6)
    assert np.isfinite(color_precision(np.zeros((4, 4)))).all()


def test_texels_per_unit_and_the_share_that_no_photo_saw():
    np.testing.assert_allclose(texel_density(square(32)), 8)  # 16 texels on a side of 2
    provenance = np.full((32, 32), Provenance.PHOTO, np.uint8)
    assert (invented_share(square(), texels_of(square()), provenance) == 0).all()
    provenance[:] = Provenance.FIELD
    assert (invented_share(square(), texels_of(square()), provenance) == 1).all()
    texels = {(x, y) for x, y in itertools.product(range(16), range(16)) if y > x}  # of the face that has corner 3
    for x, y in texels:
        provenance[31 - y, x] = Provenance.PHOTO
    share = invented_share(square(), texels_of(square()), provenance)
    assert share[1] > 0.99
    assert share[3] == 0
    assert share[0] == pytest.approx(0.5, abs=0.06)
