"""Both unwrappings: no texel claimed twice, padding kept, nothing flipped or lost; and which one is used when."""

from __future__ import annotations

import subprocess

import numpy as np
import pytest

from configs.params import AtlasParams
from stages import artifacts
from stages.atlas import ATLAS
from stages.engine.stage import StageContext
from stages.errors import ReconstructionError
from stages.surface.decimation import decimate
from stages.surface.isosurface import extract_isosurface
from stages.texture import charts, xatlas_worker

TEXTURE, PADDING = 512, 4


def bumpy(points):
    rng = np.random.default_rng(0)
    phase = points.astype(np.float64) @ (rng.normal(size=(3, 8)) * 25)
    ball = np.linalg.norm(points, axis=1) - 0.4 + 0.02 * np.sin(phase).sum(1) / 3
    return np.minimum(ball, np.abs(points[:, 2] + 0.3) - 0.05)


@pytest.fixture(scope="module")
def mesh():
    surface = extract_isosurface(bumpy, 96)
    return decimate(surface.vertices, surface.faces, 8000)


def winding_ramp(turns=3, steps=48):
    """A helicoid: every turn lies above the last, all of it facing up."""
    angle = np.linspace(0, 2 * np.pi * turns, steps * turns + 1)
    rims = [np.stack([r * np.cos(angle), r * np.sin(angle), 0.05 * angle], axis=1) for r in (0.3, 0.6)]
    count = len(angle)
    first = np.arange(count - 1)
    lower = np.stack([first, first + count, first + count + 1], axis=1)
    upper = np.stack([first, first + count + 1, first + 1], axis=1)
    return np.concatenate(rims).astype(np.float32), np.concatenate([lower, upper]).astype(np.int32)


def cross(a, b):
    return a[0] * b[1] - a[1] * b[0]


def claims(layout, size, scale=3):
    """How many faces strictly contain each sample [size * scale, size * scale], and the chart there or -1.

    The slow, obvious way: each triangle against each sample in its box.
    """
    count = np.zeros((size * scale,) * 2, dtype=np.int64)
    owner = np.full(count.shape, -1)
    for face, triangle in enumerate(layout.texels[layout.faces] * scale):
        low = np.maximum(np.floor(triangle.min(0)).astype(int), 0)
        high = np.minimum(np.ceil(triangle.max(0)).astype(int), size * scale)
        if cross(triangle[1] - triangle[0], triangle[2] - triangle[0]) < 0:
            triangle = triangle[::-1]
        x, y = np.meshgrid(np.arange(low[0], high[0]) + 0.5, np.arange(low[1], high[1]) + 0.5)
        inside = np.ones(x.shape, dtype=bool)
        for i in range(3):
            (ax, ay), (bx, by) = triangle[i], triangle[(i + 1) % 3]
            # Strict by a thousandth of a sample: a shared edge belongs to neither.
            inside &= (bx - ax) * (y - ay) - (by - ay) * (x - ax) > 1e-3 * np.hypot(bx - ax, by - ay)
        box = (slice(low[1], high[1]), slice(low[0], high[0]))
        count[box] += inside
        owner[box][inside] = layout.charts[face]
    return count, owner


def areas(layout):
    return flat_areas(layout.texels[layout.faces])


def flat_areas(corners):
    edges = corners[:, 1:] - corners[:, :1]
    return (edges[:, 0, 0] * edges[:, 1, 1] - edges[:, 0, 1] * edges[:, 1, 0]) / 2


@pytest.fixture(scope="module", params=["xatlas", "projected"])
def layout(request, mesh):
    if request.param == "xatlas":
        return charts.unwrap_xatlas(*mesh, TEXTURE, PADDING, time_limit=120)
    return charts.unwrap_projected(*mesh, TEXTURE, PADDING)


def test_every_face_is_there_once_and_in_place(layout, mesh):
    vertices, faces = mesh
    np.testing.assert_array_equal(layout.source[layout.faces], faces)
    assert layout.texels.min() >= 0
    assert layout.texels.max() <= TEXTURE
    assert np.unique(layout.faces).size == len(layout.source)
    assert len(layout.source) < 2 * len(vertices)


def test_no_texel_is_claimed_twice(layout):
    count, _ = claims(layout, TEXTURE)
    assert count.max() == 1
    assert (count == 1).mean() > 0.3


@pytest.mark.slow
def test_charts_keep_their_distance(layout):
    from scipy.ndimage import distance_transform_edt

    scale = 3
    _, owner = claims(layout, TEXTURE, scale)
    _, nearest = distance_transform_edt(owner < 0, return_indices=True)
    label = owner[tuple(nearest)]
    distance = distance_transform_edt(owner < 0)
    # Where the regions nearest to two charts meet, both are at least half the padding away.
    meet = (label[:, 1:] != label[:, :-1])[:-1] | (label[1:] != label[:-1])[:, :-1]
    assert meet.any()
    assert distance[:-1, :-1][meet].min() >= (PADDING / 2 - 1) * scale


def test_detail_is_spread_evenly(layout, mesh):
    vertices, faces = mesh
    a, b, c = (vertices[faces[:, i]].astype(np.float64) for i in range(3))
    in_space = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
    density = np.abs(areas(layout)) / in_space
    typical = np.median(density)
    assert np.mean(density < 0.2 * typical) < 0.01


def test_projected_charts_are_not_mirrored(mesh):
    assert areas(charts.unwrap_projected(*mesh, TEXTURE, PADDING)).min() > 0


def test_winding_ramp_is_cut_where_it_overlaps_itself():
    vertices, faces = winding_ramp()
    layout = charts.unwrap_projected(vertices, faces, TEXTURE, PADDING)
    assert claims(layout, TEXTURE)[0].max() == 1
    assert 3 <= layout.charts.max() + 1 <= 8


def test_overlaps_are_found_and_touching_is_none():
    square = np.array([[[0, 0], [1, 0], [1, 1]], [[0, 0], [1, 1], [0, 1]]], dtype=float)
    assert len(charts.overlapping_pairs(square)) == 0
    fold = np.array([[0, 0], [1, 0], [0.5, 0.9]], dtype=float)
    assert charts.overlapping_pairs(np.concatenate([square, fold[None]])).tolist() == [[0, 2], [1, 2]]
    inside = 0.01 * fold + [0.7, 0.2]
    assert charts.overlapping_pairs(np.concatenate([square, inside[None]])).tolist() == [[0, 2]]
    groups = np.array([0, 0, 1])
    assert len(charts.overlapping_pairs(np.concatenate([square, fold[None]]), groups)) == 0


def test_overlaps_agree_with_a_search_of_all_pairs():
    rng = np.random.default_rng(3)
    triangles = rng.uniform(0, 1, (60, 1, 2)) + rng.normal(0, 0.08, (60, 3, 2))

    def contains(triangle, points):
        a, b, c = triangle
        sign = [(q[0] - p[0]) * (points[:, 1] - p[1]) - (q[1] - p[1]) * (points[:, 0] - p[0])
                for p, q in ((a, b), (b, c), (c, a))]  # fmt: skip
        return (np.array(sign) > 0).all(0) | (np.array(sign) < 0).all(0)

    grid = np.stack(np.meshgrid(np.linspace(-0.5, 1.5, 400), np.linspace(-0.5, 1.5, 400)), axis=2).reshape(-1, 2)
    cover = np.array([contains(t, grid) for t in triangles])
    shared = cover.astype(np.int64) @ cover.T.astype(np.int64)
    found = {tuple(pair) for pair in charts.overlapping_pairs(triangles).tolist()}
    certain = {(i, j) for i in range(60) for j in range(i + 1, 60) if shared[i, j] > 0}
    assert certain <= found
    # Overlaps too thin for the samples: there are some, but a search that answers "always" would not pass.
    assert len(found - certain) < 0.3 * len(found)


def test_folded_faces_are_moved_to_free_texels():
    square = np.array([[10, 10], [60, 10], [60, 60], [10, 60], [30, 20], [40, 20], [35, 30]], dtype=float)
    faces = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6]], dtype=np.int32)
    layout = charts.UvLayout(np.arange(7), faces, square, np.array([0, 0, 1]))
    moved = charts._move_overlaps(layout, charts.overlapping_pairs(square[faces]), 128, PADDING)
    count, _ = claims(moved, 128)
    assert count.max() == 1
    np.testing.assert_array_equal(moved.source[moved.faces], faces)
    np.testing.assert_allclose(np.abs(areas(moved)), np.abs(areas(layout)))
    with pytest.raises(charts.XatlasError, match="no room"):
        charts._move_overlaps(layout, charts.overlapping_pairs(square[faces]), 62, PADDING)


def test_normals_do_not_show_the_seams(layout, mesh):
    normals = charts.smooth_normals(*mesh, layout.source)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-5)
    order = np.argsort(layout.source, kind="stable")
    same = layout.source[order][1:] == layout.source[order][:-1]
    np.testing.assert_array_equal(normals[order][1:][same], normals[order][:-1][same])


def test_charts_fill_the_texture_at_one_scale(mesh):
    cut = xatlas_worker._charts(*mesh, max_chart_area=0.1, resolution=2048)
    texels = xatlas_worker._fitted(cut, TEXTURE, PADDING)
    assert 0.95 * TEXTURE < texels.max() <= TEXTURE
    before, after = (np.abs(flat_areas(flat[cut.faces])) for flat in (cut.texels, texels))
    ratio = after[before > 1] / before[before > 1]
    assert np.quantile(ratio, 0.95) < 1.15 * np.quantile(ratio, 0.05)  # but for sides stretched to whole texels


def test_a_vertex_of_faces_without_area_lies_with_its_neighbours():
    square = np.array([[0, 0], [400, 0], [400, 400], [0, 400], [200, 0], [900, 900]], dtype=float)
    faces = np.array([[0, 2, 3], [0, 1, 2], [0, 4, 1], [5, 5, 5]])
    texels, side = xatlas_worker._packed(xatlas_worker._Charts(np.arange(6), faces, square, 1), 0.1, PADDING)
    assert texels[:4].max() > 35
    assert texels.min() >= 0
    assert texels.max() <= side
    assert (texels[4] == texels[0]).all() or (texels[4] == texels[1]).all()


def test_time_limit_stops_xatlas(mesh):
    with pytest.raises(charts.XatlasError, match=r"more than 0\.01 s"):
        charts.unwrap_xatlas(*mesh, TEXTURE, PADDING, time_limit=0.01)


def test_a_crash_of_xatlas_is_told(mesh, monkeypatch):
    crash = subprocess.CompletedProcess([], -11, "", "some\nSegmentation fault\n")
    monkeypatch.setattr(subprocess, "run", lambda *a, **k: crash)
    with pytest.raises(charts.XatlasError, match="code -11: Segmentation fault"):
        charts.unwrap_xatlas(*mesh, TEXTURE, PADDING, time_limit=10)


def test_too_many_charts_for_the_texture():
    rng = np.random.default_rng(0)
    corners = rng.uniform(-1, 1, (400, 1, 3)) + rng.normal(0, 0.01, (400, 3, 3))
    with pytest.raises(ValueError, match="room for 400 charts"):
        charts.unwrap_projected(corners.reshape(-1, 3), np.arange(1200).reshape(-1, 3), 64, PADDING)


def run_stage(tmp_path, mesh, **params):
    cleanup, out = tmp_path / "cleanup", tmp_path / "out"
    cleanup.mkdir()
    out.mkdir()
    artifacts.CLEAN_MESH.save(cleanup, mesh)
    context = StageContext({"cleanup": cleanup}, {}, out, tmp_path, AtlasParams(**params))
    return ATLAS.run(context), artifacts.ATLAS_MESH.load(out)


def test_stage_uses_xatlas(tmp_path, mesh):
    numbers, saved = run_stage(tmp_path, mesh, texture_size=TEXTURE)
    assert saved.texture_size == TEXTURE
    assert numbers["method"] == "xatlas"
    assert numbers["texture_used"] > 0.4
    np.testing.assert_allclose(saved.vertices[saved.faces], mesh[0][mesh[1]])
    assert saved.uvs.dtype == saved.normals.dtype == np.float32
    assert saved.uvs.min() >= 0
    assert saved.uvs.max() <= 1


def test_stage_falls_back_when_the_time_is_up(tmp_path, mesh):
    numbers, saved = run_stage(tmp_path, mesh, texture_size=TEXTURE, time_limit=0.01)
    assert numbers["method"] == "projected"
    assert "0.01 s" in numbers["fallback_reason"]
    assert len(saved.faces) == len(mesh[1])


def test_stage_says_when_no_texture_is_large_enough(tmp_path):
    rng = np.random.default_rng(0)
    corners = rng.uniform(-1, 1, (400, 1, 3)) + rng.normal(0, 0.01, (400, 3, 3))
    soup = corners.reshape(-1, 3).astype(np.float32), np.arange(1200).reshape(-1, 3)
    with pytest.raises(ReconstructionError) as caught:
        run_stage(tmp_path, soup, texture_size=64, time_limit=0.01)
    assert "--set atlas.texture_size=128" in caught.value.hint
