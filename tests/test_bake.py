"""Baking on a small synthetic capture: a textured box with an occluder, photographed analytically."""

from __future__ import annotations

import os
import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from stages import blocks
from stages.artifacts import AtlasMesh
from stages.drawing.rasterizing import (
    NO_FACE,
    corner_weights,
    depth_map,
    projected,
    rasterize,
    rasterize_atlas,
)
from stages.drawing.rendering import look_at, render_textured, turntable
from stages.geometry.cameras import PinholeCameras
from stages.texture import baking
from stages.texture.baking import Baked, Provenance, bake_texture
from stages.texture.filling import face_neighbors, harmonic_offsets
from stages.texture.gains import solve_gains
from stages.texture.padding import pad_charts
from stages.texture.photo_views import low_pass, prepare_view, surface_links
from stages.texture.prepared_views import PreparedViews

WORKERS = min(2, os.cpu_count() or 1)
SIZE = 192
UNSEEN_COLOR = (0.2, 0.5, 0.8)


def quad(center, right, up, half, cells, cell_uv, atlas_cells):
    """A flat square of 2 cells² faces, facing right x up; its chart is one cell of a square atlas."""
    s = np.linspace(-1, 1, cells + 1)
    x, y = np.meshgrid(s, s)
    x, y = x.ravel(), y.ravel()
    vertices = np.asarray(center) + half * (x[:, None] * np.asarray(right) + y[:, None] * np.asarray(up))
    margin = 0.06
    local = np.stack([x, y], 1) * (0.5 - margin) + 0.5
    uvs = (local + np.asarray(cell_uv)) / atlas_cells
    normals = np.broadcast_to(np.cross(right, up), vertices.shape)
    i = np.arange(cells)[:, None] * (cells + 1) + np.arange(cells)[None]
    i = i.ravel()
    faces = np.concatenate([np.stack([i, i + 1, i + cells + 2], 1), np.stack([i, i + cells + 2, i + cells + 1], 1)])
    return vertices, normals, uvs, faces


def join(parts) -> AtlasMesh:
    vertices, normals, uvs, faces, start = [], [], [], [], 0
    for v, n, u, f in parts:
        vertices.append(v)
        normals.append(n)
        uvs.append(u)
        faces.append(f + start)
        start += len(v)
    return AtlasMesh(
        np.concatenate(vertices).astype(np.float32),
        np.concatenate(normals).astype(np.float32),
        np.concatenate(uvs).astype(np.float32),
        np.concatenate(faces).astype(np.int32),
        SIZE,
    )


X, Y, Z = np.eye(3)
BOX_SIDES = [(X, Y, Z), (-X, Z, Y), (Y, Z, X), (-Y, X, Z), (Z, X, Y), (-Z, Y, X)]  # (outward, right, up)


def box(half=0.5, cells=8) -> AtlasMesh:
    parts = []
    for k, (outward, right, up) in enumerate(BOX_SIDES):
        assert np.allclose(np.cross(right, up), outward)
        parts.append(quad(half * outward, right, up, half, cells, (k % 3, k // 3), 3))
    return join(parts)


def true_color(points: np.ndarray) -> np.ndarray:
    """Smooth, position-dependent colours with some detail, 0..255."""
    x, y, z = points.T
    return np.stack(
        [
            128 + 70 * np.sin(5 * x + 2 * y) + 12 * np.sin(30 * (y + z)),
            128 + 70 * np.sin(4 * y - 3 * z) + 12 * np.sin(30 * (x + z)),
            128 + 70 * np.sin(5 * z + 3 * x) + 12 * np.sin(30 * (x + y)),
        ],
        1,
    )


def photograph(mesh: AtlasMesh, camera: PinholeCameras, index: int, paint=true_color) -> np.ndarray:
    """The photo of a mesh painted by a function of position, on a magenta background."""
    width, height = camera.sizes[index]
    face_map, _ = depth_map(camera, index, mesh.vertices, mesh.faces)
    xy, inverse_depth = projected(camera, index, mesh.vertices)
    hit = np.flatnonzero(face_map.ravel() != NO_FACE)
    centers = np.stack([hit % width, hit // width], 1) + 0.5
    weights = corner_weights(xy, inverse_depth, mesh.faces, face_map.ravel()[hit], centers)
    points = np.einsum("pc,pcd->pd", weights, mesh.vertices[mesh.faces[face_map.ravel()[hit]]])
    photo = np.empty((height * width, 3))
    photo[:] = (255, 0, 255)
    photo[hit] = paint(points)
    return np.clip(photo + 0.5, 0, 255).astype(np.uint8).reshape(height, width, 3)


def ring(count=8, elevations=(0.5,), distance=2.6, side=160) -> PinholeCameras:
    views = []
    for elevation in elevations:
        for angle in np.linspace(0.2, 2 * np.pi + 0.2, count, endpoint=False):
            eye = distance * np.array(
                [np.cos(elevation) * np.cos(angle), np.cos(elevation) * np.sin(angle), np.sin(elevation)]
            )
            views.append(look_at(eye, np.zeros(3), Z, side, side, fov_deg=38))
    return PinholeCameras(
        tuple(f"{i}.png" for i in range(len(views))),
        np.concatenate([v.sizes for v in views]),
        np.concatenate([v.intrinsics for v in views]),
        np.concatenate([v.extrinsics for v in views]),
    )


def first(cameras: PinholeCameras) -> PinholeCameras:
    return PinholeCameras(cameras.names[:1], cameras.sizes[:1], cameras.intrinsics[:1], cameras.extrinsics[:1])


def constant_field(points, normals, view_dirs):
    assert np.allclose(np.linalg.norm(view_dirs, axis=1), 1, atol=1e-4)
    return np.broadcast_to(np.array(UNSEEN_COLOR), points.shape)


def bake(mesh, cameras, photos, masks=None, field=constant_field, **options) -> Baked:
    return bake_texture(
        mesh,
        rasterize_atlas(mesh.uvs, mesh.faces, SIZE),
        cameras,
        lambda i: (photos[i], None if masks is None else masks[i]),
        field,
        workers=WORKERS,
        **options,
    )


def texel_truth(mesh: AtlasMesh, paint=true_color) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    texels = rasterize_atlas(mesh.uvs, mesh.faces, SIZE)
    points = np.einsum("pc,pcd->pd", texels.corner, mesh.vertices[mesh.faces[texels.face_ids]])
    return texels.index, points, paint(points)


@pytest.fixture(scope="module")
def capture():
    mesh, cameras = box(), ring(8, (0.5, -0.1))
    return mesh, cameras, [photograph(mesh, cameras, i) for i in range(len(cameras))]


@pytest.fixture(scope="module")
def baked(capture):
    return bake(*capture)


# ---------------------------------------------------------------- rasterising
def test_rasterize_agrees_with_a_slow_loop():
    rng = np.random.default_rng(3)
    xy, inverse_depth = rng.uniform(-4, 20, (30, 2)), rng.uniform(0.2, 1, 30)
    faces = rng.permutation(30).reshape(10, 3)
    face_map, w_map = rasterize(xy, inverse_depth, faces, 16, 12)
    for y in range(12):
        for x in range(16):
            best, best_w = NO_FACE, 0.0
            for f, corners in enumerate(faces):
                matrix = np.vstack([xy[corners].T, np.ones(3)])
                weights = np.linalg.solve(matrix, [x + 0.5, y + 0.5, 1])
                if (weights >= 0).all() and weights @ inverse_depth[corners] > best_w:
                    best, best_w = f, weights @ inverse_depth[corners]
            assert face_map[y, x] == best
            assert w_map[y, x] == pytest.approx(best_w, rel=1e-5)


def test_faces_behind_the_camera_are_not_drawn():
    camera = look_at(np.array([0.0, 0, 0]), np.array([0.0, 1, 0]), Z, 8, 8)
    behind = np.array([[-5.0, -2, -5], [5, -2, -5], [0, -2, 5]])
    face_map, _ = depth_map(camera, 0, behind, np.array([[0, 1, 2]]))
    assert (face_map == NO_FACE).all()


def test_atlas_texels_lie_on_their_faces_whichever_way_the_chart_is_turned():
    mesh = box(cells=3)
    mirrored = replace(mesh, uvs=np.stack([1 - mesh.uvs[:, 0], mesh.uvs[:, 1]], 1))
    for atlas in (mesh, mirrored):
        texels = rasterize_atlas(atlas.uvs, atlas.faces, 64)
        uv = np.einsum("pc,pcd->pd", texels.corner, atlas.uvs[atlas.faces[texels.face_ids]])
        np.testing.assert_allclose(uv[:, 0], (texels.index % 64 + 0.5) / 64, atol=1e-5)
        np.testing.assert_allclose(uv[:, 1], 1 - (texels.index // 64 + 0.5) / 64, atol=1e-5)
    assert len(texels) == pytest.approx(64**2 * 6 / 9 * 0.88**2, rel=0.05)


# ---------------------------------------------------------------- bands
def test_links_hold_on_a_slanted_plane_and_break_at_a_step():
    focal, x = 100.0, np.arange(32) + 0.5
    plane = np.tile(1 / 2.0 + 0.01 * x, (8, 1)).astype(np.float32)  # 1 / depth is linear on a plane
    left, up = surface_links(plane, focal)
    assert left[:, 1:].all()
    assert up[1:].all()
    stepped = plane.copy()
    stepped[:, 16:] *= 1.5
    left, up = surface_links(stepped, focal)
    assert not left[:, 16].any()
    assert left[:, 1:16].all()
    assert left[:, 17:].all()
    assert up[1:].all()


def test_low_pass_keeps_the_mean_and_stops_at_edges():
    rng = np.random.default_rng(0)
    photo = np.full((40, 80, 3), 60, np.uint8)
    photo[:, 40:] = 200
    photo[:, :40] += rng.integers(0, 20, (40, 40, 3)).astype(np.uint8)
    left, up = np.ones((40, 80), bool), np.ones((40, 80), bool)
    left[:, 40] = False
    low = low_pass(photo, left, up, 8.0)
    assert (low[:, 40:] == 200).all()
    assert abs(low[:, :40].mean() - photo[:, :40].mean()) < 1
    assert low[:, :40].std() < 0.3 * photo[:, :40].std()


# ---------------------------------------------------------------- whole bake
def test_a_photo_is_cut_to_what_shows_the_mesh(capture):
    atlas, cameras, photos = capture
    for i, photo in enumerate(photos):
        view = prepare_view(cameras, i, photo, None, atlas.vertices, atlas.faces)
        _, inverse_depth = depth_map(cameras, i, atlas.vertices, atlas.faces)
        assert view.photo.size < photo.size
        assert np.count_nonzero(view.inverse_depth) == np.count_nonzero(inverse_depth)
        xy, _ = cameras.project(i, atlas.vertices.astype(np.float64))
        cut = np.concatenate([atlas.vertices, np.ones((len(atlas.vertices), 1))], 1) @ view.matrix.T
        shift = xy - cut[:, :2] / cut[:, 2:]
        left, top = np.round(shift[0]).astype(int)
        np.testing.assert_allclose(shift, np.broadcast_to((left, top), shift.shape), atol=1e-6)
        height, width = view.photo.shape[:2]
        np.testing.assert_array_equal(view.original, photo[top : top + height, left : left + width])


def test_a_cut_keeps_nothing_of_the_rest_of_the_photo_in_memory(capture):
    atlas, cameras, photos = capture
    beyond = atlas.vertices.astype(np.float64) @ cameras.extrinsics[0, :, :3].T
    beyond *= 5, 1, 1  # over both sides of the photo, not over its upper and lower border
    beyond = (beyond @ cameras.extrinsics[0, :, :3]).astype(np.float32)
    view = prepare_view(cameras, 0, photos[0], None, beyond, atlas.faces)
    assert view.photo.shape[1] == photos[0].shape[1]
    assert view.photo.shape[0] < photos[0].shape[0]
    assert not np.shares_memory(view.photo, photos[0])


def test_the_first_photos_are_kept_whichever_are_ready_first(monkeypatch):
    first_two = threading.Event()

    def prepare_view(cameras, index, *_):
        if index == 0:
            assert first_two.wait(10)
        if index == 2:
            first_two.set()
        return SimpleNamespace(nbytes=60 if index == 1 else 50, index=index)

    monkeypatch.setattr("stages.texture.prepared_views.prepare_view", prepare_view)
    monkeypatch.setattr("stages.texture.prepared_views.KEPT_BYTES", 100)
    flat = SimpleNamespace(vertices=np.zeros((3, 3)), faces=np.array([[0, 1, 2]]))
    views = PreparedViews(flat, 1, range(4), lambda index: (None, None))
    with ThreadPoolExecutor(3) as pool:
        for _ in range(2):
            assert [view.index for view in views.in_order(pool, 3)] == [0, 1, 2, 3]
            assert sorted(views.kept) == [0, 2]
            assert views.room == 0


def test_a_photo_that_shows_nothing_of_the_mesh_is_no_error(capture):
    atlas, cameras, photos = capture
    behind = atlas.vertices + 10 * (cameras.centers[0] - atlas.vertices.mean(0)).astype(np.float32)
    view = prepare_view(cameras, 0, photos[0], None, behind, atlas.faces)
    assert not view.confidence.any()


def test_colours_are_recovered_and_numbers_add_up(capture, baked):
    mesh, _, _ = capture
    texels, points, truth = texel_truth(mesh)
    provenance = baked.provenance.ravel()[texels]
    seen = provenance == Provenance.PHOTO
    error = np.abs(baked.base_color.reshape(-1, 3)[texels].astype(float) - truth)[seen]
    assert np.median(error) < 2
    assert np.percentile(error, 95) < 8
    bottom = points[:, 2] < -0.499
    assert not seen[bottom].any()
    assert seen[~bottom].mean() > 0.97
    assert baked.numbers["texels"] == len(texels)
    assert baked.numbers["seen_share"] == pytest.approx(seen.mean(), abs=1e-3)
    assert baked.numbers["filled_share"] == pytest.approx(1 - seen.mean(), abs=1e-3)
    assert np.abs(baked.gains - 1).max() < 0.02


def test_the_high_band_brings_detail(capture, baked):
    mesh, _, _ = capture
    texels, _, truth = texel_truth(mesh)
    seen = baked.provenance.ravel()[texels] == Provenance.PHOTO
    soft = bake(*capture, detail=False).base_color.reshape(-1, 3)[texels]
    sharp = baked.base_color.reshape(-1, 3)[texels]
    error = [np.sqrt(((image.astype(float) - truth)[seen] ** 2).mean()) for image in (soft, sharp)]
    assert error[1] < 0.6 * error[0]


def test_texels_no_photo_saw_come_from_the_field_shifted_to_meet_the_photos(capture):
    mesh, cameras, photos = capture
    texels, points, truth = texel_truth(mesh)

    def darker(points, normals, view_dirs):  # the field is right but 30 levels too dark
        np.testing.assert_allclose(view_dirs, -normals)
        return (true_color(points.astype(float)) - 30) / 255

    result = bake(mesh, cameras, photos, field=darker)
    filled = result.provenance.ravel()[texels] == Provenance.FIELD
    bottom = points[:, 2] < -0.499
    assert filled[bottom].all()
    error = np.abs(result.base_color.reshape(-1, 3)[texels].astype(float) - truth)[filled]
    assert np.median(error) < 6


def test_the_background_never_bleeds_in(capture, baked):
    """Photos show the box on magenta; no texel of it may turn magenta, at silhouettes neither."""
    mesh, _, _ = capture
    texels, _, truth = texel_truth(mesh)
    seen = baked.provenance.ravel()[texels] == Provenance.PHOTO
    off = baked.base_color.reshape(-1, 3)[texels].astype(float) - truth
    pinker = (off[:, 0] > 25) & (off[:, 2] > 25) & (off[:, 1] < -25) & seen
    assert pinker.sum() == 0


def test_padding_repeats_the_nearest_chart_colour(baked):
    provenance = baked.provenance
    assert set(np.unique(provenance)) <= {int(p) for p in Provenance}
    ys, xs = np.nonzero(provenance == Provenance.PADDING)
    inside = np.argwhere((provenance == Provenance.PHOTO) | (provenance == Provenance.FIELD))
    rng = np.random.default_rng(0)
    for k in rng.choice(len(ys), 50, replace=False):
        distance = ((inside - [ys[k], xs[k]]) ** 2).sum(1)
        nearest = inside[distance <= distance.min() * 1.2 + 1]
        colors = baked.base_color[nearest[:, 0], nearest[:, 1]].astype(int)
        assert (np.abs(colors - baked.base_color[ys[k], xs[k]].astype(int)).max(1) == 0).any()


def test_an_occluder_leaves_no_trace_behind_it():
    """A red plate floats before one side: cameras that see red there must not paint it on the side."""
    wall = quad((0, 0, 0), Y, Z, 0.8, 12, (0, 0), 2)  # looks along +x
    plate_front = quad((0.5, 0, 0), Y, Z, 0.15, 4, (1, 0), 2)
    plate_back = quad((0.49, 0, 0), Z, Y, 0.15, 4, (0, 1), 2)
    mesh = join([wall, plate_front, plate_back])

    def paint(points):
        return np.where(points[:, :1] > 0.3, [230.0, 20, 20], [60.0, 120, 180])

    eyes = [(2.5, y, z) for y in (-1.2, -0.4, 0.4, 1.2) for z in (-0.6, 0.6)]
    views = [look_at(np.array(e), np.zeros(3), Z, 160, 160, 40) for e in eyes]
    cameras = PinholeCameras(
        tuple(map(str, range(len(views)))),
        *(np.concatenate([getattr(v, key) for v in views]) for key in ("sizes", "intrinsics", "extrinsics")),
    )
    photos = [photograph(mesh, cameras, i, paint) for i in range(len(cameras))]
    result = bake(mesh, cameras, photos)
    texels, points, truth = texel_truth(mesh, paint)
    seen = result.provenance.ravel()[texels] == Provenance.PHOTO
    error = np.abs(result.base_color.reshape(-1, 3)[texels].astype(float) - truth).max(1)
    on_wall = points[:, 0] < 0.3
    assert error[on_wall & seen].max() < 12
    behind_plate = on_wall & (np.abs(points[:, 1]) < 0.1) & (np.abs(points[:, 2]) < 0.1)
    assert seen[behind_plate].mean() > 0.9  # some camera looks past the plate
    assert error[(points[:, 0] > 0.495) & seen].max() < 12


def test_gains_are_found_and_undone(capture):
    mesh, cameras, photos = capture
    rng = np.random.default_rng(5)
    gains = np.exp(rng.uniform(-0.25, 0.25, (len(cameras), 3)))
    gains /= np.exp(np.log(gains).mean(0))
    darkened = [np.clip(p * g + 0.5, 0, 255).astype(np.uint8) for p, g in zip(photos, 1 / gains, strict=True)]
    result = bake(mesh, cameras, darkened)
    np.testing.assert_allclose(result.gains, gains, rtol=0.03)
    texels, _, truth = texel_truth(mesh)
    seen = result.provenance.ravel()[texels] == Provenance.PHOTO
    error = np.abs(result.base_color.reshape(-1, 3)[texels].astype(float) - truth)[seen]
    assert np.median(error) < 3
    plain = bake(mesh, cameras, darkened, gain=False)
    worse = np.abs(plain.base_color.reshape(-1, 3)[texels].astype(float) - truth)[seen]
    assert np.median(worse) > 2 * np.median(error)
    assert (plain.gains == 1).all()


def test_a_highlight_in_one_photo_is_rejected(capture):
    mesh, cameras, photos = capture

    def shiny(points):
        spot = np.exp(-((np.linalg.norm(points - [0.1, 0, 0.5], axis=1) / 0.15) ** 2))
        return true_color(points) + 200 * spot[:, None]

    altered = list(photos)
    altered[1] = photograph(mesh, cameras, 1, shiny)
    assert np.abs(altered[1].astype(int) - photos[1]).max() > 80
    result = bake(mesh, cameras, altered)
    texels, points, truth = texel_truth(mesh)
    near = np.linalg.norm(points - [0.1, 0, 0.5], axis=1) < 0.15
    error = np.abs(result.base_color.reshape(-1, 3)[texels].astype(float) - truth).max(1)[near]
    assert np.percentile(error, 95) < 15


def test_a_car_that_drives_by_is_not_painted_onto_the_road():
    """It drives along below the photographer: the photos from straight above, whose weights are greatest, have it."""
    road = join([quad((0, 0, 0), X, Y, 1.0, 12, (0, 0), 1)])

    def paint(points):
        grey = 120 + 30 * np.sin(6 * points[:, 0] + 2 * points[:, 1])
        return np.where(points[:, 2:] > 0.01, [220.0, 30, 20], grey[:, None] * [1.0, 1.0, 0.95])

    eyes = [(x, y, 2.6) for x in (-0.8, 0.0, 0.8) for y in (-0.9, -0.3, 0.3, 0.9)]
    views = [look_at(np.array(eye), np.zeros(3), Y, 200, 200, 50) for eye in eyes]
    cameras = PinholeCameras(
        tuple(map(str, range(len(views)))),
        *(np.concatenate([getattr(view, key) for view in views]) for key in ("sizes", "intrinsics", "extrinsics")),
    )
    photos, covered = [], []
    texels, points, truth = texel_truth(road, paint)
    for index in range(len(cameras)):
        middle = np.array([-0.9 + 1.8 * index / (len(cameras) - 1), 0.2, 0.12])
        car = [
            quad(middle + 0.12 * outward * [2, 1, 1], right * [2, 1, 1], up * [2, 1, 1], 0.12, 2, (0, 0), 1)
            for outward, right, up in BOX_SIDES
        ]
        photos.append(photograph(join([*car, quad((0, 0, 0), X, Y, 1.0, 12, (0, 0), 1)]), cameras, index, paint))
        u, v = cameras.project(index, points)[0].astype(int).T
        reddish = photos[-1].astype(int)
        covered.append((reddish[v, u, 0] - reddish[v, u, 1]) > 100)
    often = np.mean(covered, axis=0)
    assert (often > 0).mean() > 0.15  # the car passes over much of the road
    assert often.max() > 0.3  # and hides parts of it from a third of the photos
    result = bake(road, cameras, photos)
    seen = result.provenance.ravel()[texels] == Provenance.PHOTO
    error = np.abs(result.base_color.reshape(-1, 3)[texels].astype(float) - truth).max(1)
    print(
        often.max(),
        [
            (round(float(q), 2), int((often[seen] > q).sum()), float(np.percentile(error[seen][often[seen] > q], 95)))
            for q in (0, 0.1, 0.2, 0.3, 0.4)
            if (often[seen] > q).any()
        ],
        error[seen & (often == 0)].max(),
        error[seen].max(),
    )
    assert error[seen & (often > 0)].max() < 12


def test_pixels_outside_the_mask_are_not_used(capture):
    mesh, cameras, photos = capture
    masks = [np.zeros(p.shape[:2], bool) for p in photos]
    masks[0][:] = True
    result = bake(mesh, cameras, photos, masks)
    alone = bake(mesh, PinholeCameras(*(getattr(cameras, k)[:1] for k in cameras.__dataclass_fields__)), photos[:1])
    assert (result.provenance == alone.provenance).all()
    assert 0.05 < result.numbers["seen_share"] < 0.6
    assert result.numbers["mean_views"] == 1


def test_what_a_wall_beyond_the_mesh_hides_takes_nothing_from_that_photo():
    """A wall 0.6 high at x = 1.2 hides the ground from x = 0.6 on from a camera at x = 3 and z = 2.4."""
    ground = join([quad((0, 0, 0), X, Y, 1.0, 8, (0, 0), 1)])
    wall = quad((1.2, 0, 0.3), Y, Z, 1.0, 2, (0, 0), 1)
    wall = (wall[0] * [1, 3, 0.3] + [0, 0, 0.21]).astype(np.float32), wall[3].astype(np.int32)
    cameras = look_at(np.array([3.0, 0, 2.4]), np.zeros(3), Z, 160, 160, 50)

    def paint(points):
        return np.where(points[:, :1] > 1.1, (250.0, 0, 0), true_color(points))

    together = replace(
        ground,
        vertices=np.concatenate([ground.vertices, wall[0]]),
        faces=np.concatenate([ground.faces, wall[1] + len(ground.vertices)]),
    )
    photo = photograph(together, cameras, 0, paint)
    texels, points, truth = texel_truth(ground)
    hidden, clear = points[:, 0] > 0.62, np.abs(points).max(1) < 0.55
    for others, taken in ((None, True), (wall, False)):
        found = bake(ground, cameras, [photo], others=others)
        seen = found.provenance.ravel()[texels] == Provenance.PHOTO
        error = np.abs(found.base_color.reshape(-1, 3)[texels].astype(float) - truth).max(1)
        assert seen[clear].all()
        assert np.percentile(error[clear], 95) < 12
        assert seen[hidden].any() == taken
        assert found.base_color.shape == (SIZE, SIZE, 3)


def test_photos_of_the_wrong_size_are_refused(capture):
    mesh, cameras, photos = capture
    with pytest.raises(ValueError, match=r"expected shape \(160, 160, 3\), got \(80, 160, 3\)"):
        bake(mesh, cameras, [p[:80] for p in photos])


def test_charts_without_texels_are_refused(capture):
    mesh, cameras, photos = capture
    with pytest.raises(ValueError, match="covering texels"):
        bake(replace(mesh, uvs=np.zeros_like(mesh.uvs)), cameras, photos)


def test_a_texture_done_in_parts_is_the_same(capture, baked, monkeypatch):
    monkeypatch.setattr("stages.texture.baking.BAND_BYTES", 16 * 25 * 3000)
    monkeypatch.setattr("stages.texture.prepared_views.KEPT_BYTES", 0)  # and photos are made ready anew for each
    monkeypatch.setattr("stages.texture.baking._CHUNK", 1000)
    again = bake(*capture)
    assert (again.base_color == baked.base_color).all()
    assert again.numbers == baked.numbers


def test_where_memory_runs_out_fewer_texels_are_done_at_once(capture, baked, monkeypatch):
    blend, sizes, visited = baking._blend, [], []

    def scarce(pool, points, normals, gains, sharpness, prepared, *rest):
        sizes.append(len(points))
        if len(points) > 3000:
            next(prepared)
            raise MemoryError
        return blend(pool, points, normals, gains, sharpness, prepared, *rest)

    monkeypatch.setattr(blocks, "_enough", {})
    monkeypatch.setattr(baking, "_blend", scarce)
    again = bake(*capture, visit=lambda index, view, gains: visited.append(index))
    assert max(sizes) > 3000
    assert (again.base_color == baked.base_color).all()
    assert again.numbers == baked.numbers
    assert visited == list(range(len(capture[1])))


def test_a_blurred_photo_counts_less(capture):
    import cv2

    mesh, cameras, _ = capture

    def rough(points):
        return true_color(points) + 25 * np.sign(np.sin(60 * points[:, :1]) * np.sin(60 * points[:, 1:2] + 1))

    sharp = [photograph(mesh, cameras, i, rough) for i in range(len(cameras))]
    blurred = [cv2.GaussianBlur(p, (0, 0), 3) if i % 2 else p for i, p in enumerate(sharp)]
    assert bake(mesh, cameras, sharp).numbers["blurred_photos"] == 0
    assert bake(mesh, cameras, blurred[:-1] + sharp[-1:]).numbers["blurred_photos"] == 7


def test_photos_finer_than_the_texels_do_not_alias():
    """A checkerboard of pixels, too fine for the texture, becomes its mean."""
    mesh = join([quad((0, 0, 0), X, Z, 0.5, 4, (0, 0), 1)])
    camera = look_at(np.array([0.0, -2.0, 0]), np.zeros(3), Z, 400, 400, 30)
    board = np.where(np.indices((400, 400)).sum(0)[..., None] % 2, 200, 60).astype(np.uint8).repeat(3, 2)
    fine = rasterize_atlas(mesh.uvs, mesh.faces, 48)
    coarse = bake_texture(mesh, fine, camera, lambda i: (board, None), constant_field)
    seen = coarse.provenance == Provenance.PHOTO
    assert seen.sum() > 1000
    assert np.abs(coarse.base_color[seen].astype(int) - 130).mean() < 12


# ---------------------------------------------------------------- parts
def test_gains_of_photos_that_share_nothing_are_one():
    colors = np.full((6, 2, 3), 100.0)
    weights = np.zeros((6, 2))
    weights[:3, 0], weights[3:, 1] = 1, 1
    np.testing.assert_array_equal(solve_gains(colors, weights), 1)


def test_gains_ignore_a_minority_of_highlights():
    rng = np.random.default_rng(1)
    true_gain = np.array([1.2, 1.0, 1 / 1.2])
    colors = rng.uniform(40, 180, (400, 1, 3)) / true_gain[None, :, None]
    colors[:80, 0] = 240
    gains = solve_gains(colors, np.ones((400, 3)))
    np.testing.assert_allclose(gains, np.tile(true_gain[:, None], 3), rtol=0.02)


def test_sheen_is_not_taken_for_gain():
    """Photo 1 brightens half of its points, by up to 40 %: sheen. Photo 2 brightens all by 20 %: exposure."""
    rng = np.random.default_rng(2)
    colors = np.repeat(rng.uniform(40, 150, (500, 1, 1)), 6, axis=1).repeat(3, axis=2)
    colors[:, 1] *= 1 + 0.8 * np.maximum(rng.random((500, 1)) - 0.5, 0)
    colors[:, 2] *= 1.2
    gains = solve_gains(colors, np.ones((500, 6)))
    np.testing.assert_allclose(gains[2] / gains[0], 1 / 1.2, rtol=0.03)
    np.testing.assert_allclose(gains[1] / gains[0], 1, atol=0.03)


def test_neighbours_reach_across_uv_seams():
    mesh = box(cells=1)  # 12 faces, every edge shared by two of them
    pairs = face_neighbors(mesh.vertices, mesh.faces)
    assert len(pairs) == 18


def test_offsets_between_two_known_faces_are_their_blend():
    chain = np.stack([np.arange(6), np.arange(1, 7)], 1)
    known = np.array([True, False, False, False, False, False, True])
    offsets = np.zeros((7, 3))
    offsets[6] = 12
    spread = harmonic_offsets(known, offsets, chain)
    np.testing.assert_allclose(spread[:, 0], np.linspace(0, 12, 7), atol=0.4)


def test_padding_fills_everything_and_leaves_charts_alone():
    image = np.zeros((32, 32, 3), np.uint8)
    known = np.zeros((32, 32), bool)
    known[4:8, 4:8] = True
    image[known] = (10, 200, 90)
    filled, padded = pad_charts(image, known, reach=3)
    assert (filled == (10, 200, 90)).all()
    assert padded.sum() > 0
    assert not (padded & known).any()
    assert not padded[20:, 20:].any()


def test_the_smooth_fill_lies_between_the_charts_colours():
    image = np.zeros((64, 64, 3), np.uint8)
    known = np.zeros((64, 64), bool)
    known[:, :6] = known[:, 58:] = True
    image[:, :6], image[:, 58:] = 40, 200
    filled, _ = pad_charts(image, known, reach=2)
    assert (filled[known] == image[known]).all()
    assert 60 < filled[32, 32, 0] < 180
    assert filled[32, 12, 0] < filled[32, 50, 0]


# ---------------------------------------------------------------- renderer
def test_renderer_shows_the_texture(capture, baked):
    mesh, cameras, photos = capture
    one = PinholeCameras(*(getattr(cameras, k)[:1] for k in cameras.__dataclass_fields__))
    picture = render_textured(mesh, baked.base_color, one, background=(255, 0, 255))
    assert np.median(np.abs(picture.astype(int) - photos[0])) <= 2


def test_turntable_sees_all_of_the_mesh():
    mesh = box()
    for camera in turntable(mesh.vertices, Z, 4, 64, 48):
        xy, depth = camera.project(0, mesh.vertices.astype(float))
        assert (depth > 0).all()
        assert (xy >= 0).all()
        assert (xy[:, 0] <= 64).all()
        assert (xy[:, 1] <= 48).all()
