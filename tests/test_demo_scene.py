"""The demo's made-up object and its photographs."""

from __future__ import annotations

import json

import numpy as np
import pytest

from stages.evaluation.protocols.known_object import TRUTH_CAMERAS
from stages.scenes.demo_photos import FOCAL_35MM, make_demo_photos, photos_are_complete
from stages.scenes.figurine import figurine_distance, make_figurine
from stages.scenes.figurine_pictures import light_scene, render
from stages.scenes.noise import ValueNoise
from stages.scenes.room import CLOTH_SIDE
from stages.scenes.viewpoints import camera_ring

SIZE = (96, 72)
FOCAL = FOCAL_35MM / 36 * SIZE[0]


@pytest.fixture(scope="module")
def figurine():
    return make_figurine(cell=1 / 40)


@pytest.fixture(scope="module")
def scene(figurine):
    return light_scene(figurine, seed=0, light_samples=12, cloth_size=256)


def test_figurine_rests_on_the_ground_with_extent_one(figurine):
    low, high = figurine.vertices.min(0), figurine.vertices.max(0)
    assert low[2] == pytest.approx(0.0, abs=1e-12)
    assert (high - low).max() == pytest.approx(1.0)


def test_figurine_vertices_lie_on_the_implicit_surface(figurine):
    assert np.abs(figurine_distance(figurine.design)).max() < 2e-3


def test_figurine_is_closed_and_faces_outwards(figurine):
    trimesh = pytest.importorskip("trimesh")
    mesh = trimesh.Trimesh(figurine.vertices, figurine.faces, process=False)
    assert mesh.is_watertight
    assert mesh.volume > 0.02
    face_normals = np.einsum("ij,ij->i", mesh.face_normals, figurine.normals[figurine.faces[:, 0]])
    assert np.mean(face_normals > 0) > 0.99


def test_figurine_looks_different_from_left_and_right(figurine):
    """A mirror image would let a wrong handedness pass unseen."""
    distance = figurine_distance(figurine.design * [1, -1, 1])
    assert np.abs(distance).max() > 0.1


def test_value_noise_is_smooth_periodic_and_bounded():
    noise = ValueNoise(np.random.default_rng(0), size=8)
    points = np.random.default_rng(1).uniform(-3, 3, size=(500, 3))
    values = noise(points, 4.0)
    assert values.min() >= 0
    assert values.max() <= 1
    np.testing.assert_allclose(noise(points + 2.0, 4.0), values, atol=1e-4)  # 8 cells = 2 units
    assert np.abs(noise(points + 1e-4, 4.0) - values).max() < 5e-3


def test_cameras_look_at_the_figurine_from_above_the_ground():
    poses = camera_ring(24, np.random.default_rng(0))
    assert len(poses) == 24
    centers = -np.einsum("nji,nj->ni", poses[:, :3, :3], poses[:, :3, 3])
    assert centers[:, 2].min() > 0.5
    np.testing.assert_allclose(np.linalg.det(poses[:, :3, :3]), 1.0)
    in_cam = poses[:, :3, :3] @ [0, 0, 0.4] + poses[:, :3, 3]
    assert (in_cam[:, 2] > 1).all()
    assert np.abs(in_cam[:, :2] / in_cam[:, 2:]).max() < 0.1


def test_render_shows_the_blue_handle_where_the_camera_projects_it(figurine, scene):
    poses = camera_ring(8, np.random.default_rng(3))
    centers = -np.einsum("nji,nj->ni", poses[:, :3, :3], poses[:, :3, 3])
    pose = poses[centers[:, 1].argmax()]  # the handle is at +y, so this camera sees it
    picture = render(scene, pose, FOCAL, SIZE)
    assert picture.shape == (SIZE[1], SIZE[0], 3)
    assert np.isfinite(picture).all()
    handle = figurine.vertices[figurine.design[:, 1] > 0.38]
    in_cam = handle @ pose[:3, :3].T + pose[:3, 3]
    columns, rows = np.floor(FOCAL * in_cam[:, :2] / in_cam[:, 2:] + np.array(SIZE) / 2).astype(int).T
    red, _, blue = picture[rows, columns].mean(0)
    assert blue > 1.5 * red
    red, _, blue = picture.reshape(-1, 3).mean(0)
    assert blue < 1.2 * red


def test_ground_pixels_hold_the_cloth_at_the_projected_place(scene):
    """A pixel that looks at the cloth shows the cloth's texel where its ray meets z = 0."""
    pose = camera_ring(8, np.random.default_rng(3))[5]
    picture = render(scene, pose, FOCAL, SIZE)
    row, column = SIZE[1] - 3, 4  # a lower corner: cloth, not bird
    direction = pose[:3, :3].T @ [(column + 0.5 - SIZE[0] / 2) / FOCAL, (row + 0.5 - SIZE[1] / 2) / FOCAL, 1]
    center = -pose[:3, :3].T @ pose[:3, 3]
    x, y, _ = center - center[2] / direction[2] * direction
    size = scene.cloth.shape[0]
    texel = (np.array([y, x]) / CLOTH_SIDE + 0.5) * size
    i, j = texel.astype(int)
    around = scene.cloth[i - 2 : i + 3, j - 2 : j + 3].reshape(-1, 3)
    assert (picture[row, column] >= around.min(0) - 1e-3).all()
    assert (picture[row, column] <= around.max(0) + 1e-3).all()


@pytest.mark.slow
def test_photos_have_exif_and_the_truth_beside_them(tmp_path):
    image_module = pytest.importorskip("PIL.Image")
    make_demo_photos(tmp_path, num_photos=6, size=SIZE, seed=4)
    assert photos_are_complete(tmp_path, 6, SIZE, 4)
    assert not photos_are_complete(tmp_path, 6, SIZE, 5)
    assert not photos_are_complete(tmp_path, 7, SIZE, 4)
    photos = sorted((tmp_path / "photos").iterdir())
    assert [photo.name for photo in photos] == [f"{i:03d}.jpg" for i in range(6)]
    with image_module.open(photos[0]) as photo:
        assert photo.size == SIZE
        exif = photo.getexif()
        assert exif[0x0110] == "Demo camera"
        assert exif.get_ifd(0x8769)[0xA405] == FOCAL_35MM
        assert np.asarray(photo).std() > 20  # a picture, neither black nor blown out
    truth = json.loads((tmp_path / TRUTH_CAMERAS).read_text())
    assert truth["fl_x"] == pytest.approx(FOCAL)
    for frame in truth["frames"]:
        world_from_cam = np.array(frame["transform_matrix"]) @ np.diag([1.0, -1, -1, 1])
        np.testing.assert_allclose(world_from_cam @ np.array(frame["w2c_opencv"]), np.eye(4), atol=1e-12)
    photos[3].unlink()
    assert not photos_are_complete(tmp_path, 6, SIZE, 4)


def test_too_few_photos_are_refused(tmp_path):
    with pytest.raises(ValueError, match="at least 6 photos, got 3"):
        make_demo_photos(tmp_path, num_photos=3)
