"""All unwrappings: no texel claimed twice, padding kept, nothing flipped or lost; and which one is used when."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import trimesh

from configs.params import AtlasParams
from stages import artifacts
from stages.atlas import ATLAS
from stages.engine.stage import StageContext
from stages.errors import ReconstructionError
from stages.surface.decimation import decimate
from stages.surface.isosurface import extract_isosurface
from stages.surface.triangle_mesh import cut_into_manifold, mesh_state
from stages.texture import charts, footprint, random_device, xatlas_worker
from stages.texture.chart_quality import chart_quality, seam_length, signed_areas, stretch

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


def flat_areas(corners):
    edges = corners[:, 1:] - corners[:, :1]
    return (edges[:, 0, 0] * edges[:, 1, 1] - edges[:, 0, 1] * edges[:, 1, 0]) / 2


@pytest.fixture(scope="module")
def small():
    """UVAtlas takes long for good charts of meshes below 25,000 faces."""
    surface = extract_isosurface(bumpy, 48)
    return decimate(surface.vertices, surface.faces, 1500)


@pytest.fixture(scope="module")
def by_uvatlas(small):
    return charts.unwrap_uvatlas(*small, TEXTURE, PADDING, time_limit=120)


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


def least_distance(layout, size, scale=3):
    """Texels between the charts that are nearest to each other, a sample's width too many at most."""
    from scipy.ndimage import distance_transform_edt

    _, owner = claims(layout, size, scale)
    least = np.inf
    for chart in np.unique(layout.charts):
        others = (owner >= 0) & (owner != chart)
        least = min(least, distance_transform_edt(owner != chart)[others].min(initial=np.inf))
    return least / scale


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
    density = np.abs(signed_areas(layout)) / in_space
    typical = np.median(density)
    assert np.mean(density < 0.2 * typical) < 0.01


def test_projected_charts_are_not_mirrored(mesh):
    assert signed_areas(charts.unwrap_projected(*mesh, TEXTURE, PADDING)).min() > 0


# ---------------------------------------------------------------- UVAtlas
@pytest.mark.slow
def test_uvatlas_makes_few_charts_of_one_scale_none_mirrored(by_uvatlas, small):
    vertices, faces = small
    np.testing.assert_array_equal(by_uvatlas.source[by_uvatlas.faces], faces)
    assert np.unique(by_uvatlas.faces).size == len(by_uvatlas.source)
    assert signed_areas(by_uvatlas).min() > 0
    quality = chart_quality(vertices, faces, by_uvatlas, TEXTURE)
    assert quality.charts < 12
    assert 0.35 < quality.fill < 1
    assert 1 < quality.stretch < 1.2


@pytest.mark.slow
@pytest.mark.parametrize("padding", [2, 8])
def test_uvatlas_keeps_the_padding_between_charts_and_half_of_it_at_the_border(small, padding):
    layout = charts.unwrap_uvatlas(*small, TEXTURE, padding, time_limit=120)
    count, _ = claims(layout, TEXTURE)
    assert count.max() == 1
    assert least_distance(layout, TEXTURE) > padding
    assert layout.texels.min() >= padding / 2
    assert layout.texels.max() <= TEXTURE - padding / 2


@pytest.mark.slow
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="std::random_device is held still on Linux only")
def test_uvatlas_gives_the_same_bytes_twice(by_uvatlas, small):
    again = charts.unwrap_uvatlas(*small, TEXTURE, PADDING, time_limit=120)
    assert again.texels.tobytes() == by_uvatlas.texels.tobytes()
    assert again.faces.tobytes() == by_uvatlas.faces.tobytes()


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="nothing is done elsewhere")
def test_a_processor_whose_code_is_not_known_is_left_alone(monkeypatch):
    monkeypatch.setattr(random_device.platform, "machine", lambda: "riscv64")
    assert not random_device.answer_always_one()


def ball():
    sphere = trimesh.creation.icosphere(2)
    return np.asarray(sphere.vertices, np.float32), np.asarray(sphere.faces, np.int32)


def unsound():
    """Name, mesh: what UVAtlas refuses or dies of, and what has several pieces or faces without area."""
    vertices, faces = ball()
    flat = vertices.copy()
    flat[faces[7, 1]] = (flat[faces[7, 0]] + flat[faces[7, 2]]) / 2
    turned = faces.copy()
    turned[3] = turned[3, ::-1]
    fin = np.array([[0, 0, 0], [0, 0, 1], [1, 0, 0], [-1, 1, 0], [-1, -1, 0]], np.float32)
    bow = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0]], np.float32)
    return {
        "three faces at an edge": (fin, np.array([[0, 1, 2], [0, 1, 3], [0, 1, 4]])),
        "two fans at a vertex": (bow, np.array([[0, 1, 2], [0, 3, 4]])),
        "faces twice": (vertices, np.concatenate([faces, faces[:5]])),
        "faces back to back": (vertices, np.concatenate([faces, faces[:5, ::-1]])),
        "two faces and nothing else": (np.eye(3, dtype=np.float32), np.array([[0, 1, 2], [0, 2, 1]])),
        "a face turned around": (vertices, turned),
        "a vertex twice in a face": (vertices, np.concatenate([faces, [[0, 0, 1], [2, 2, 2]]])),
        "a face without area": (flat, faces),
        "two pieces": (np.concatenate([vertices, vertices + 3]), np.concatenate([faces, faces + len(vertices)])),
        "a vertex of nothing but a point": (
            np.concatenate([vertices, vertices[:1]]),
            np.concatenate([faces, [[162] * 3]]),
        ),
    }


@pytest.mark.parametrize("name", unsound())
def test_faces_are_cut_apart_where_they_are_no_manifold(name):
    _, faces = unsound()[name]
    faces = faces[(faces != np.roll(faces, 1, axis=1)).all(1)]
    source, cut = cut_into_manifold(faces)
    assert mesh_state(cut).manifold
    np.testing.assert_array_equal(source[cut], faces)
    assert np.unique(cut).size == len(source)


def test_a_sound_mesh_is_not_cut():
    _, faces = ball()
    source, cut = cut_into_manifold(faces)
    assert len(source) == faces.max() + 1
    assert mesh_state(cut).watertight


@pytest.mark.slow
@pytest.mark.parametrize("name", unsound())
def test_uvatlas_takes_meshes_that_are_not_sound(name):
    vertices, faces = unsound()[name]
    layout = charts.unwrap_uvatlas(vertices, faces, 128, 2, time_limit=60)
    np.testing.assert_array_equal(layout.source[layout.faces], faces)
    assert layout.texels.min() >= 0
    assert layout.texels.max() <= 128
    assert claims(layout, 128)[0].max() == 1


def test_a_face_without_texels_lies_in_a_point_of_its_neighbour():
    faces = np.array([[0, 1, 2], [1, 1, 3], [4, 4, 4]])
    corners = np.full((3, 3, 2), np.nan)
    corners[0] = [[1, 1], [5, 1], [1, 5]]
    source, new_faces, texels = charts._joined(faces, corners)
    np.testing.assert_array_equal(source[new_faces], faces)
    np.testing.assert_array_equal(texels[new_faces[0]], corners[0])
    assert (texels[new_faces[1]] == [5, 1]).all()
    assert (texels[new_faces[2]] == 0).all()


# ---------------------------------------------------------------- how good charts are
def unfolded_cube(scale=(10.0, 10.0)):
    """A cube of side 2 whose six sides lie apart, each 10 x 10 texels."""
    cube = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=np.float64)
    sides = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
    faces = np.concatenate([sides[:, [0, 1, 2]], sides[:, [0, 2, 3]]])
    square = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * scale
    texels = np.concatenate([square + np.array([20 * k, 0]) for k in range(6)])
    first = np.arange(6)[:, None] * 4
    new_faces = np.concatenate([first + np.array(corners) for corners in ([0, 1, 2], [0, 2, 3])])
    return cube, faces, charts.UvLayout(sides.ravel(), new_faces, texels, np.tile(np.arange(6), 2))


def test_seams_of_a_cube_are_its_edges_and_squares_do_not_stretch():
    quality = chart_quality(*unfolded_cube(), 128)
    assert quality.charts == 6
    assert quality.fill == pytest.approx(600 / 128**2)
    assert quality.seam_length == pytest.approx(12 * 2 / np.sqrt(6 * 4))
    assert quality.stretch == pytest.approx(1)


def test_a_texture_twice_as_wide_as_high_stretches():
    # singular values 2 and 1 at the same area: (2 + 1/2) / 2
    assert stretch(*unfolded_cube((20.0, 10.0))) == pytest.approx(np.sqrt(1.25))


def test_a_chart_of_less_detail_stretches_the_whole():
    cube, faces, layout = unfolded_cube()
    texels = layout.texels.copy()
    texels[:4] /= 2
    # a side at half the scale: mean of (4 + 5) / 6 over the surface, at (5 + 1/4) / 6 of the area
    smaller = charts.UvLayout(layout.source, layout.faces, texels, layout.charts)
    assert stretch(cube, faces, smaller) == pytest.approx(np.sqrt(9 / 6 * 5.25 / 6))


def test_mirrored_faces_are_counted():
    cube, faces, layout = unfolded_cube((-10.0, 10.0))
    assert chart_quality(cube, faces, layout, 128).mirrored == 1
    assert chart_quality(*unfolded_cube(), 128).mirrored == 0


def test_an_edge_inside_a_chart_and_the_border_are_no_seams():
    square = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], dtype=np.float64)
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    assert seam_length(square, faces, charts.UvLayout(np.arange(4), faces, square[:, :2], np.zeros(2))) == 0


# ---------------------------------------------------------------- overlaps
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
    np.testing.assert_allclose(np.abs(signed_areas(moved)), np.abs(signed_areas(layout)))
    with pytest.raises(charts.ChartsError, match="no room"):
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


UNWRAP = [charts.unwrap_uvatlas, charts.unwrap_xatlas]


@pytest.mark.parametrize("unwrap", UNWRAP)
def test_time_limit_stops_it(mesh, unwrap):
    with pytest.raises(charts.ChartsError, match=r"more than 0\.01 s"):
        unwrap(*mesh, TEXTURE, PADDING, time_limit=0.01)


@pytest.mark.parametrize("unwrap", UNWRAP)
def test_a_crash_is_told(mesh, monkeypatch, unwrap):
    crash = subprocess.CompletedProcess([], -11, "", "some\nSegmentation fault\n")
    monkeypatch.setattr(subprocess, "run", lambda *a, **k: crash)
    with pytest.raises(charts.ChartsError, match="code -11: Segmentation fault"):
        unwrap(*mesh, TEXTURE, PADDING, time_limit=10)


@pytest.mark.parametrize("texels", [np.full((1, 3, 2), np.nan), np.zeros((2, 3, 2)), np.full((1, 3, 2), 200.0)])
def test_faces_that_uvatlas_lost_or_put_outside_are_told(monkeypatch, texels):
    monkeypatch.setattr(charts, "_in_child", lambda *a, **k: {"texels": texels})
    with pytest.raises(charts.ChartsError):
        charts.unwrap_uvatlas(np.eye(3), np.array([[0, 1, 2]]), 128, PADDING, 10)


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


@pytest.mark.slow
@pytest.mark.parametrize("method", ["uvatlas", "xatlas"])
def test_stage_makes_charts_as_it_is_told(tmp_path, small, method):
    numbers, saved = run_stage(tmp_path, small, texture_size=TEXTURE, method=method)
    assert saved.texture_size == TEXTURE
    assert numbers["method"] == method
    assert numbers["fallback_reason"] == ""
    assert numbers["texture_used"] > 0.3
    assert numbers["stretch"] > 1
    assert numbers["seam_length"] > 0
    np.testing.assert_allclose(saved.vertices[saved.faces], small[0][small[1]])
    assert saved.uvs.dtype == saved.normals.dtype == np.float32
    assert saved.uvs.min() >= 0
    assert saved.uvs.max() <= 1


def test_the_default_is_uvatlas():
    assert AtlasParams().method == next(iter(charts.WAYS)) == "uvatlas"


def test_xatlas_takes_over_where_uvatlas_fails(tmp_path, mesh, monkeypatch):
    def fail(*arguments):
        raise charts.ChartsError("UVAtlas ended with code -11: no message")

    monkeypatch.setitem(charts.WAYS, "uvatlas", replace(charts.WAYS["uvatlas"], unwrap=fail))
    numbers, saved = run_stage(tmp_path, mesh, texture_size=TEXTURE)
    assert numbers["method"] == "xatlas"
    assert numbers["fallback_reason"] == "UVAtlas ended with code -11: no message"
    assert len(saved.faces) == len(mesh[1])


def test_stage_falls_back_to_projection_when_the_time_is_up(tmp_path, mesh):
    numbers, saved = run_stage(tmp_path, mesh, texture_size=TEXTURE, time_limit=0.01)
    assert numbers["method"] == "projected"
    assert numbers["fallback_reason"].count("0.01 s") == 2
    assert len(saved.faces) == len(mesh[1])


def test_each_way_has_the_texture_that_its_charts_need(tmp_path, mesh, monkeypatch):
    """Charts that fill less of it get a larger one, so that the detail stays."""
    sizes = {}

    def refuse(name):
        def unwrap(vertices, faces, size, *rest):
            sizes[name] = size
            raise charts.ChartsError(name)

        return unwrap

    for name, way in charts.WAYS.items():
        monkeypatch.setitem(charts.WAYS, name, replace(way, unwrap=refuse(name)))
    monkeypatch.setattr(footprint, "pixels_per_area", lambda *a: (None, None))
    monkeypatch.setattr(footprint, "texels_needed", lambda *a: 0.65 * 2048**2)
    with monkeypatch.context() as patch:
        patch.setattr(StageContext, "read", lambda self, what: mesh if what is artifacts.CLEAN_MESH else None)
        run_stage(tmp_path, mesh)
    assert sizes == {"uvatlas": 2048, "xatlas": 4096}


def test_stage_says_when_no_texture_is_large_enough(tmp_path):
    rng = np.random.default_rng(0)
    corners = rng.uniform(-1, 1, (400, 1, 3)) + rng.normal(0, 0.01, (400, 3, 3))
    soup = corners.reshape(-1, 3).astype(np.float32), np.arange(1200).reshape(-1, 3)
    with pytest.raises(ReconstructionError) as caught:
        run_stage(tmp_path, soup, texture_size=64, time_limit=0.01)
    assert "--set atlas.texture_size=128" in caught.value.hint
