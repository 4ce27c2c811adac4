"""Distances between meshes that are known in closed form."""

from __future__ import annotations

import json

import numpy as np
import pytest

from stages.errors import InputError
from stages.evaluation.protocols.known_object import KnownObject, score_surface, seen_surface
from stages.evaluation.surfaces import sample_faces
from stages.geometry.cameras import PinholeCameras
from stages.geometry.normalisation import into_frame
from stages.geometry.similarity import Similarity, align_points

trimesh = pytest.importorskip("trimesh")


def _look_at_origin(center):
    forward = -np.asarray(center, float) / np.linalg.norm(center)
    right = np.cross(forward, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    pose[:3, 3] = -pose[:3, :3] @ center
    return pose


def _known_sphere(centers):
    """A sphere of diameter 1 around the origin."""
    sphere = trimesh.creation.icosphere(subdivisions=5, radius=0.5)
    cameras = PinholeCameras(
        names=tuple(f"photos/{i:03d}.jpg" for i in range(len(centers))),
        sizes=np.array([(120, 90)] * len(centers)),
        intrinsics=np.array([[[120.0, 0, 60], [0, 120, 45], [0, 0, 1]]] * len(centers)),
        extrinsics=np.stack([_look_at_origin(center)[:3] for center in centers]),
    )
    return KnownObject(np.asarray(sphere.vertices), np.asarray(sphere.faces), cameras)


SHRUNK = Similarity(0.1, np.eye(3), np.zeros(3))
AROUND = [(2 * np.cos(a), 2 * np.sin(a), z) for a in np.arange(6) for z in (-0.8, 0.9)]


@pytest.fixture(scope="module")
def known():
    return _known_sphere(AROUND)


def test_the_true_surface_scores_the_sampling_distance(known):
    score = score_surface(known.vertices, known.faces, known, samples=60_000)
    assert score.accuracy < 0.02
    assert score.completeness < 0.4  # half the spacing of 60 000 samples on an area of pi
    assert score.f_one_percent > 99


def test_a_swollen_sphere_is_off_by_the_swelling(known):
    score = score_surface(1.04 * known.vertices, known.faces, known, samples=60_000)
    assert score.accuracy == pytest.approx(2.0, abs=0.05)  # 0.04 * radius 0.5
    assert score.completeness == pytest.approx(2.0, abs=0.1)
    assert score.mean == pytest.approx((score.accuracy + score.completeness) / 2, abs=1e-9)
    assert score.f_one_percent == 0


def test_the_score_is_relative_to_the_extent(known):
    large = KnownObject(10 * known.vertices, known.faces, into_frame(known.cameras, SHRUNK))
    score = score_surface(10.4 * known.vertices, known.faces, large, samples=60_000)
    assert score.accuracy == pytest.approx(2.0, abs=0.05)


def test_normals_are_those_of_the_nearest_place_whichever_way_they_point(known):
    """A sphere of 80 faces: by a slow search for the nearest face. A fine one has none, turned inside out or not."""
    coarse = trimesh.creation.icosphere(subdivisions=1, radius=0.5)
    score = score_surface(np.asarray(coarse.vertices), np.asarray(coarse.faces), known, samples=100_000)
    seen = np.random.default_rng(0).permutation(seen_surface(known))[:2000]
    faces = trimesh.proximity.closest_point_naive(coarse, seen)[2]
    cosines = np.abs((coarse.face_normals[faces] * seen).sum(1)) / np.linalg.norm(seen, axis=1)
    expected = np.degrees(np.arccos(cosines)).mean()
    assert expected > 5
    assert score.normals_deg == pytest.approx(expected, abs=0.3)
    for turned in (known.faces, known.faces[:, ::-1]):
        assert score_surface(known.vertices, turned, known, samples=100_000).normals_deg < 1


def test_what_no_camera_sees_need_not_be_there():
    """One camera sees less than half of the sphere: the other half may be missing."""
    known = _known_sphere([(2.0, 0, 0)])
    seen = seen_surface(known)
    assert seen[:, 0].min() > 0.1
    front = known.vertices[known.faces].mean(1)[:, 0] > 0
    half = score_surface(known.vertices, known.faces[front], known, samples=60_000)
    assert half.completeness < 0.3
    missing = score_surface(known.vertices, known.faces[~front], known, samples=60_000)
    assert missing.completeness > 5


def test_a_table_under_the_object_is_not_judged(known):
    table = trimesh.creation.box((6, 6, 0.02))
    vertices = np.concatenate([known.vertices, table.vertices - [0, 0, 0.51]])
    faces = np.concatenate([known.faces, table.faces + len(known.vertices)])
    score = score_surface(vertices, faces, known, samples=60_000)
    assert score.accuracy < 0.02
    assert score.completeness < 0.4


def test_a_mesh_elsewhere_is_refused(known):
    with pytest.raises(ValueError, match="same frame"):
        score_surface(known.vertices + 5, known.faces, known, samples=1000)


def test_samples_are_uniform_by_area():
    """Two triangles, areas 1 : 3."""
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [5, 0, 0], [8, 0, 0], [5, 1, 0.0]])
    points = sample_faces(vertices, np.array([[0, 1, 2], [3, 4, 5]]), 40_000)[0]
    assert np.mean(points[:, 0] > 3) == pytest.approx(0.75, abs=0.01)
    small = points[points[:, 0] < 3]
    np.testing.assert_allclose(small.mean(0), [1 / 3, 1 / 3, 0], atol=0.01)
    assert (small[:, :2].sum(1) <= 1).all()


def test_a_mesh_without_area_is_refused():
    with pytest.raises(ValueError, match="got 1 faces with none"):
        sample_faces(np.zeros((3, 3)), np.array([[0, 1, 2]]), 10)


def test_align_points_finds_a_known_similarity():
    rng = np.random.default_rng(0)
    rotation, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    rotation *= np.sign(np.linalg.det(rotation))
    expected = Similarity(2.7, rotation, np.array([1.0, -4, 0.3]))
    source = rng.normal(size=(12, 3))
    found = align_points(source, expected.apply(source))
    assert found.scale == pytest.approx(expected.scale)
    np.testing.assert_allclose(found.rotation, expected.rotation, atol=1e-10)
    np.testing.assert_allclose(found.translation, expected.translation, atol=1e-10)


def test_align_points_never_mirrors():
    source = np.random.default_rng(1).normal(size=(20, 3))
    assert np.linalg.det(align_points(source, source * [1, 1, -1]).rotation) == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("source", "message"),
    [(np.zeros((2, 3)), "at least 3 pairs"), (np.arange(12.0)[:, None] * [1, 2, 3], "one line")],
)
def test_align_points_refuses_what_does_not_fix_a_frame(source, message):
    with pytest.raises(ValueError, match=message):
        align_points(source, source)


@pytest.mark.slow
def test_score_mesh_reads_files_and_undoes_the_models_frame(tmp_path, known):
    """The mesh lies in the frame of a COLMAP model that is scaled, turned and moved."""
    pycolmap = pytest.importorskip("pycolmap")
    from stages.evaluation.protocols.known_object import score_mesh

    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    model_from_world = Similarity(3.0, turn, np.array([1.0, 2, 3]))
    trimesh.Trimesh(known.vertices, known.faces, process=False).export(tmp_path / "gt_mesh.ply")
    moved = model_from_world.apply(1.04 * known.vertices)
    trimesh.Trimesh(moved, known.faces, process=False).export(tmp_path / "model.ply")
    poses = np.concatenate([known.cameras.extrinsics, [[[0, 0, 0, 1.0]]] * len(known.cameras)], 1)
    opengl = np.diag([1.0, -1, -1, 1])
    frames = [
        {"file_path": name, "transform_matrix": (np.linalg.inv(pose) @ opengl).tolist()}
        for name, pose in zip(known.cameras.names, poses, strict=True)
    ]
    K = known.cameras.intrinsics[0]
    truth = {"w": 120, "h": 90, "fl_x": K[0, 0], "fl_y": K[1, 1], "cx": 60, "cy": 45, "frames": frames}
    (tmp_path / "transforms.json").write_text(json.dumps(truth))

    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera.create_from_model_name(1, "PINHOLE", 120.0, 120, 90)
    model.add_camera_with_trivial_rig(camera)
    for i, pose in enumerate(poses):
        center = model_from_world.apply(-pose[:3, :3].T @ pose[:3, 3])
        rotation = pose[:3, :3] @ turn.T
        image = pycolmap.Image(name=f"{i:03d}.jpg", camera_id=1, image_id=i + 1)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), -rotation @ center))
    (tmp_path / "model").mkdir()
    model.write(str(tmp_path / "model"))

    score = score_mesh(tmp_path / "model.ply", tmp_path / "model", tmp_path)
    assert score["accuracy"] == pytest.approx(2.0, abs=0.05)
    with pytest.raises(InputError, match="holds no known object"):
        score_mesh(tmp_path / "model.ply", tmp_path / "model", tmp_path / "model")
