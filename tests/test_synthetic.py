"""The synthetic suite: its shapes, its camera's noise, its check of itself; with Mitsuba, a small render."""

from __future__ import annotations

import json

import numpy as np
import pytest

from benchmarks.synthetic import capture, city, drone_gps, objects, scenes, shapes
from benchmarks.synthetic.capture import Order, develop, make
from benchmarks.synthetic.check import check
from benchmarks.synthetic.model import Ground, Part, Scene, plain
from stages.capture.exif import NO_GPS, read_gps
from stages.evaluation.protocols.known_object import has_truth, load_known_object
from stages.geometry.earth import earth_centred, east_north_up
from stages.scenes import implicit
from stages.scenes.noise import ValueNoise
from stages.scenes.photo_files import photo_exif, write_truth
from stages.scenes.viewpoints import camera_ring

SIZE = (96, 72)


def _step(rng=None):
    """A part without symmetry: two boxes, one on the other."""
    low, high = city._box((-0.5, -0.3, 0), (0.5, 0.3, 0.3)), city._box((-0.4, -0.2, 0.3), (0.0, 0.1, 0.7))
    return [Part(*mesh, "matte", plain(0.6, 0.3, 0.2)) for mesh in (low, high)]


def _small_scene(rng, num_photos):
    ground = Ground(rng.random((16, 16, 3)), 3.0, -1e-4)
    return Scene(tuple(_step()), ground, scenes.sunny_sky(32), camera_ring(num_photos, rng))


# ---------------------------------------------------------------- shapes
def test_distances_of_simple_shapes():
    points = np.array([[2.0, 0, 0], [0, 0.1, 0], [0, 0, 3.0]])
    np.testing.assert_allclose(shapes.box(points, (0, 0, 0), (2, 2, 2)), [1.0, -0.9, 2.0])
    np.testing.assert_allclose(implicit.tube(points, [(0, 0, 0), (0, 0, 2)], (0.5, 0.5)), [1.5, -0.4, 0.5])
    np.testing.assert_allclose(shapes.cylinder(points, (0, 0, 0), 2, 1.0, 4.0), [1.0, -0.9, 1.0])
    hollow = shapes.without(shapes.box(points, (0, 0, 0), (2, 2, 2)), shapes.box(points, (0, 0, 0), (1, 1, 1)))
    assert list(hollow > 0) == [True, True, True]


def test_a_turned_profile_is_as_far_as_its_curve():
    angle = np.linspace(-np.pi / 2, np.pi / 2, 20)
    sphere = shapes.profile(np.stack([np.cos(angle), np.sin(angle)], 1))
    points = np.random.default_rng(0).uniform(-0.8, 0.8, (200, 3))
    np.testing.assert_allclose(sphere(points), np.abs(np.linalg.norm(points, axis=1) - 1), atol=5e-3)


def test_meshes_face_outwards_and_have_the_shapes_normals():
    vertices, faces, normals = shapes.mesh_of(
        lambda points: np.linalg.norm(points, axis=1) - 0.4, (-0.5, -0.5, -0.5), (0.5, 0.5, 0.5), 0.05
    )
    np.testing.assert_allclose(np.linalg.norm(vertices, axis=1), 0.4, atol=2e-3)
    np.testing.assert_allclose(normals, vertices / 0.4, atol=1e-2)
    corners = vertices[faces]
    outward = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert np.einsum("ij,ij->i", outward, corners.mean(1)).min() > -1e-12  # 0: a face without area


@pytest.mark.parametrize("make_parts", [objects.bicycle, city.city_block], ids=["bicycle", "city"])
def test_built_parts_face_outwards(make_parts):
    """Of a closed part the signed volume is positive; the city's pavement is no closed part."""
    for part in make_parts(np.random.default_rng(0)):
        if np.ptp(part.vertices[:, 2]) > 0:
            corners = part.vertices[part.faces] - part.vertices.mean(0)
            assert np.einsum("ij,ij->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) > 0


def test_the_same_seed_builds_the_same_city_and_another_seed_another():
    first, again, other = (city.city_block(np.random.default_rng(seed)) for seed in (3, 3, 4))
    assert all(np.array_equal(a.vertices, b.vertices) for a, b in zip(first, again, strict=True))
    assert not all(np.array_equal(a.vertices, b.vertices) for a, b in zip(first, other, strict=False))


def test_objects_are_made_one_large_and_keep_their_paint():
    striped = Part(np.eye(3) * 4 + 7, np.array([[0, 1, 2]]), "matte", lambda points, normals: points, grain=0.2)
    (moved,) = scenes.normalised([striped])
    assert np.ptp(moved.vertices, axis=0).max() == pytest.approx(1.0)
    assert moved.vertices[:, 2].min() == pytest.approx(0.0)
    np.testing.assert_allclose(moved.paint(moved.vertices, moved.vertices), striped.vertices)
    assert moved.grain == pytest.approx(0.05)


def test_a_flight_looks_down_and_to_all_four_sides():
    poses = scenes.flight(40, np.random.default_rng(0))
    assert poses.shape == (40, 4, 4)
    np.testing.assert_allclose(np.linalg.det(poses[:, :3, :3]), 1.0)
    forward = poses[:, 2, :3]
    down = forward[:, 2] < -0.99
    assert down.sum() == 16
    sides = np.round(np.degrees(np.arctan2(forward[~down, 1], forward[~down, 0])) / 90) % 4
    assert [int((sides == k).sum()) for k in range(4)] == [6, 6, 6, 6]


def test_paints_stay_albedos():
    rng = np.random.default_rng(0)
    points, normals = rng.uniform(-0.5, 0.5, (500, 3)), np.tile([1.0, 0, 0], (500, 1))
    for paint in (city._facade(rng, ValueNoise(rng)), city._streets(ValueNoise(rng)), objects.mosaic(rng, points)):
        colors = paint(points, normals)
        assert colors.shape == (500, 3)
        assert colors.min() > 0
        assert colors.max() < 1


# ---------------------------------------------------------------- camera
def test_noise_grows_with_the_light_and_ends_where_the_sensor_is_full():
    rng = np.random.default_rng(0)
    for light in (0.02, 0.6):
        values = develop(np.full((200, 200, 3), light), rng).astype(float)
        slope = 1.055 / 2.4 * light ** (1 / 2.4 - 1) * 255  # of the tone curve
        sigma = slope * np.hypot(capture.READ_NOISE, capture.SHOT_NOISE * light**0.5)
        assert values.std() == pytest.approx(np.hypot(sigma, 12**-0.5), rel=0.05)  # and what rounding adds
    assert (develop(np.full((4, 4, 3), 5.0), rng) >= 253).all()


def test_another_order_starts_anew_and_the_same_goes_on(tmp_path):
    order = Order("plain", 6, SIZE, 4, 0)
    capture._begin(order.as_dict(), tmp_path)
    photo = tmp_path / "images" / "000.jpg"
    photo.write_bytes(b"x")
    capture._begin(order.as_dict(), tmp_path)
    assert photo.exists()
    capture._begin(Order("plain", 6, SIZE, 5, 0).as_dict(), tmp_path)
    assert not photo.exists()


# ---------------------------------------------------------------- GPS
@pytest.mark.parametrize(
    "position", [(47.37, 8.54, 589.123), (-33.9999999, -18.5, -2.5), (0.25, 179.99999, 0.0)], ids=str
)
def test_exif_says_where_the_camera_was_to_millimetres(tmp_path, position):
    from PIL import Image

    for i, place in enumerate((position, None)):
        picture = Image.new("RGB", SIZE)
        picture.save(tmp_path / f"{i}.jpg", exif=photo_exif(picture, i, "Drone", 40, place))
    with Image.open(tmp_path / "0.jpg") as photo, Image.open(tmp_path / "1.jpg") as other:
        read, none = read_gps(photo.getexif()), read_gps(other.getexif())
    assert none == NO_GPS
    off = earth_centred(np.array([read.position])) - earth_centred(np.array([position]))
    assert np.linalg.norm(off) < 0.004


def test_a_drones_gps_is_off_by_metres_and_lies_east_north_up_of_the_origin():
    poses = scenes.flight(400, np.random.default_rng(0), 2)
    told = drone_gps.drone_positions(poses, city.METRES, np.random.default_rng(1))
    off = east_north_up(told, drone_gps.ORIGIN) - 200 * np.linalg.inv(poses)[:, :3, 3]
    np.testing.assert_allclose(off.mean(0), 0.0, atol=0.8)
    np.testing.assert_allclose(off.std(0), [2, 2, 4], rtol=0.15)


def test_towns_have_gps_and_blocks_of_two_hundred_metres():
    poses = scenes.flight(4, np.random.default_rng(0))
    scene = Scene(tuple(_step()), None, scenes.sunny_sky(32), poses)
    assert all(recipe.metres == city.METRES for recipe in scenes.TOWNS.values())
    first, again, other = (capture._positions(scene, scenes.TOWNS["town4"], seed) for seed in (0, 0, 1))
    assert len(first) == 4
    assert first == again
    assert first != other
    assert capture._positions(scene, scenes.RECIPES["city"], 0) == [None] * 4


# ---------------------------------------------------------------- the check
def _write_cast_masks(folder, shift=0.0):
    """A folder as the suite leaves it, masks cast from cameras that are `shift` pixels off."""
    import cv2
    import open3d as o3d
    import trimesh

    from stages.surface.triangle_mesh import raycaster

    order = Order("plain", 6, SIZE, 4, 0)
    scene = _small_scene(np.random.default_rng(1), 6)
    (folder / "masks").mkdir(parents=True)
    trimesh.Trimesh(*scene.surface(), process=False).export(folder / "gt_mesh.ply")
    names = [f"images/{i:03d}.jpg" for i in range(6)]
    write_truth(folder, names, scene.cam_from_world, SIZE, order.focal, order.as_dict())
    K = np.array([[order.focal, 0, SIZE[0] / 2 + shift], [0, order.focal, SIZE[1] / 2], [0, 0, 1]])
    caster = raycaster(*scene.surface())
    for i, pose in enumerate(scene.cam_from_world):
        rays = o3d.t.geometry.RaycastingScene.create_rays_pinhole(o3d.core.Tensor(K), o3d.core.Tensor(pose), *SIZE)
        mask = np.isfinite(caster.cast_rays(rays)["t_hit"].numpy())
        cv2.imwrite(str(folder / "masks" / f"{i:03d}.png"), mask.astype(np.uint8) * 255)


def test_masks_of_the_stated_cameras_agree_and_half_a_pixel_is_found(tmp_path):
    _write_cast_masks(tmp_path / "good")
    _write_cast_masks(tmp_path / "off", shift=0.5)
    assert check(tmp_path / "good").is_exact
    off = check(tmp_path / "off")
    assert not off.is_exact
    assert off.shift == pytest.approx(0.5, abs=0.15)


# ---------------------------------------------------------------- with Mitsuba
def test_rendered_photos_fit_their_cameras_and_are_not_made_twice(tmp_path, monkeypatch):
    pytest.importorskip("mitsuba")
    from PIL import ExifTags, Image

    from benchmarks.synthetic.mitsuba_camera import EVERYWHERE

    monkeypatch.setitem(scenes.RECIPES, "step", scenes.Recipe("a step", _small_scene))
    order = Order("step", 3, SIZE, 4, 0)
    assert make(order, tmp_path, EVERYWHERE)
    assert has_truth(tmp_path)
    assert check(tmp_path).is_exact
    known = load_known_object(tmp_path)
    assert known.surface.extent == pytest.approx(1.0)
    assert [name.removeprefix("images/") for name in sorted(known.cameras.names)] == ["000.jpg", "001.jpg", "002.jpg"]

    photos = [tmp_path / "images" / f"{i:03d}.jpg" for i in range(3)]
    with Image.open(photos[0]) as photo:
        assert photo.size == SIZE
        assert photo.getexif().get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.FocalLengthIn35mmFilm] == 40
    assert not make(order, tmp_path, EVERYWHERE)  # nothing to do

    before = [(photo.read_bytes(), photo.stat().st_mtime_ns) for photo in photos]
    photos[1].unlink()
    assert make(order, tmp_path, EVERYWHERE)
    assert photos[1].read_bytes() == before[1][0]  # deterministic
    assert photos[2].stat().st_mtime_ns == before[2][1]  # kept

    exposures = [frame["exposure"] for frame in json.loads((tmp_path / "transforms.json").read_text())["frames"]]
    assert 0.005 < np.std(exposures) / np.mean(exposures) < 0.2
