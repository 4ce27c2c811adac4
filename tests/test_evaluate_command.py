"""`hineus evaluate`: tiny stand-ins of the published layouts, what is said, and what is refused."""

from __future__ import annotations

import json
import pickle
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh
from scipy.io import savemat
from typer.testing import CliRunner

from hineus_cli.app import app
from stages.drawing.rendering import look_at
from stages.errors import HineusError, InputError
from stages.evaluation import reading
from stages.evaluation.protocols.dtu import read_dtu
from stages.evaluation.protocols.glossy import drawn_depth, read_glossy
from stages.evaluation.protocols.tanks import read_tanks
from stages.geometry.cameras import PinholeCameras


def hineus(*words: object) -> tuple[int, str]:
    """Exit code and stdout."""
    done = CliRunner().invoke(app, ["evaluate", *map(str, words)], catch_exceptions=True)
    return done.exit_code, done.stdout


def numbers(*words: object) -> dict:
    code, out = hineus(*words, "--json")
    found = json.loads(out.strip().splitlines()[-1])
    assert (code, found["ok"]) == (0, True), found
    return found


def write_mesh(path: Path, mesh: trimesh.Trimesh) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    mesh.export(path)
    return path


def ball(radius: float = 1.0) -> trimesh.Trimesh:
    return trimesh.creation.icosphere(4, radius)


def cameras_around(count: int = 6, size: int = 64, distance: float = 4.0) -> PinholeCameras:
    angles = 2 * np.pi * np.arange(count) / count
    eyes = [distance * np.array([np.cos(a), np.sin(a), 0.3 * (-1) ** i]) for i, a in enumerate(angles)]
    found = [look_at(eye, np.zeros(3), np.array([0.0, 0, 1]), size, size, 40) for eye in eyes]
    return PinholeCameras(
        tuple(f"{i + 1:06}.png" for i in range(count)),
        *(np.concatenate([getattr(one, name) for one in found]) for name in ("sizes", "intrinsics", "extrinsics")),
    )


def write_transforms(path: Path, cameras: PinholeCameras, matrix: np.ndarray | None = None) -> Path:
    """transforms.json of cameras, their world moved by a similarity."""
    matrix = np.eye(4) if matrix is None else matrix
    turn = matrix[:3, :3] / np.cbrt(np.linalg.det(matrix[:3, :3]))
    frames = []
    for i, name in enumerate(cameras.names):
        pose = np.eye(4)
        pose[:3, :3] = turn @ cameras.extrinsics[i, :, :3].T @ np.diag([1, -1, -1])
        pose[:3, 3] = matrix[:3, :3] @ cameras.centers[i] + matrix[:3, 3]
        frames.append({"file_path": name, "transform_matrix": pose.tolist()})
    K, (width, height) = cameras.intrinsics[0], cameras.sizes[0].tolist()
    data = {"w": width, "h": height, "fl_x": K[0, 0], "fl_y": K[1, 1], "cx": K[0, 2], "cy": K[1, 2], "frames": frames}
    path.write_text(json.dumps(data))
    return path


MOTION = trimesh.transformations.rotation_matrix(0.7, (1, 2, 3))
MOTION[:3, :3] *= 2.5
MOTION[:3, 3] = 3, -1, 2


# ---------------------------------------------------------------- mesh
def test_a_mesh_against_a_mesh_and_all_that_was_done(tmp_path):
    ours, true = write_mesh(tmp_path / "a.stl", ball(1.01)), write_mesh(tmp_path / "b.ply", ball())
    found = numbers("mesh", ours, true, "--samples", 5000, "--seed", 7, "--thresholds", "0.005,1%")
    assert found["chamfer"] == pytest.approx(0.01, rel=0.02)
    assert [score["threshold"] for score in found["f_scores"]] == pytest.approx([0.02, 0.005])
    assert [score["f_score"] for score in found["f_scores"]] == pytest.approx([100, 0])
    said = "\n".join(found["done"])
    assert "alignment: none" in said
    assert said.count("5000 points, uniform by area, seed 7") == 2
    code, out = hineus("mesh", ours, true, "--samples", 5000, "--icp", "similarity")
    assert code == 0
    assert "similarity point-to-plane ICP" in out
    assert "consistency 1.0000" in out or "consistency 0.99" in out
    assert numbers("mesh", ours, true, "--samples", 5000, "--icp", "similarity")["chamfer"] < 1e-3
    whole = ball(1.01)
    upper = whole.triangles_center[:, 2] > 0
    halved = write_mesh(tmp_path / "half.ply", trimesh.Trimesh(whole.vertices, whole.faces[upper]))
    boxed = numbers("mesh", halved, true, "--samples", 5000, "--box", "-2,-2,0.1,2,2,2")
    assert boxed["completeness"]["mean"] == pytest.approx(0.01, rel=0.1)
    assert "the box -2 -2 0.1 to 2 2 2" in "\n".join(boxed["done"])


def test_a_mesh_in_another_frame_is_aligned_by_cameras_or_a_matrix(tmp_path):
    true = write_mesh(tmp_path / "true.ply", ball())
    moved = ball(1.01).apply_transform(MOTION)
    ours = write_mesh(tmp_path / "ours.ply", moved)
    cameras = write_transforms(tmp_path / "ours.json", cameras_around(), MOTION)
    true_cameras = write_transforms(tmp_path / "true.json", cameras_around())
    found = numbers("mesh", ours, true, "--cameras", cameras, "--true-cameras", true_cameras, "--samples", 5000)
    assert found["chamfer"] == pytest.approx(0.01, rel=0.02)
    np.testing.assert_allclose(np.array(found["matrix"]) @ MOTION, np.eye(4), atol=1e-6)
    assert "by 6 camera centres" in found["done"][0]
    np.savetxt(tmp_path / "matrix.txt", np.linalg.inv(MOTION))
    found = numbers("mesh", ours, true, "--matrix", tmp_path / "matrix.txt", "--samples", 5000)
    assert found["chamfer"] == pytest.approx(0.01, rel=0.02)


def test_only_what_cameras_see_and_masks_show_counts(tmp_path):
    true = write_mesh(tmp_path / "true.ply", ball())
    with_core = write_mesh(tmp_path / "ours.ply", trimesh.util.concatenate([ball(), ball(0.5)]))
    cameras = cameras_around()
    poses = write_transforms(tmp_path / "true.json", cameras)
    arguments = ("mesh", with_core, true, "--spacing", 0.05, "--true-cameras", poses)
    assert numbers(*arguments)["accuracy"]["max"] == pytest.approx(0.5, abs=0.01)
    found = numbers(*arguments, "--visible")
    assert found["accuracy"]["max"] < 1e-3
    assert "only what one of 6 cameras" in "\n".join(found["done"])
    masks = tmp_path / "masks"
    masks.mkdir()
    for name in cameras.names:
        mask = np.zeros((64, 64), np.uint8)
        mask[:32] = 255  # the upper half, however the cameras look at it
        cv2.imwrite(str(masks / name), mask)
    upper = numbers(*arguments, "--visible", "--masks", masks)
    assert upper["completeness"]["points"] < 0.7 * found["completeness"]["points"]
    code, _ = hineus("mesh", with_core, true, "--masks", masks)
    assert code == InputError.exit_code


def test_a_workspace_is_judged_in_the_frame_of_its_poses(tmp_path):
    from sphere_scene import RADIUS, ring_of_cameras, sphere_scene

    from stages import artifacts
    from stages.engine.fingerprint import Identity
    from stages.engine.manifest import Manifest
    from stages.engine.workspace import Workspace
    from stages.geometry.place import Place
    from stages.geometry.similarity import Similarity

    cameras = ring_of_cameras()
    scene = sphere_scene(cameras)
    workspace = Workspace.open(tmp_path / "run", create=True)
    with workspace.lock():
        workspace.remember({}, None, {})
        out, _ = workspace.begin("undistort", "")
        artifacts.FIRST_SCENE.save(out, scene)
        workspace.publish("undistort", Manifest(Identity("undistort", 1, {}), {}))
        out, _ = workspace.begin("place", "")
        artifacts.WORLD_PLACE.save(out, Place(Similarity.identity()))
        workspace.publish("place", Manifest(Identity("place", 1, {}), {}))
    mesh = ball(RADIUS)
    mesh.vertices = scene.poses_from_scene.apply(mesh.vertices)
    write_mesh(artifacts.asset_path(workspace.root / "export", "ply"), mesh)
    true = write_mesh(tmp_path / "true.ply", ball(RADIUS))
    poses = write_transforms(tmp_path / "true.json", cameras)
    found = numbers("mesh", workspace.root, true, "--true-cameras", poses, "--samples", 5000)
    assert found["chamfer"] < 1e-3
    known = reading.workspace_cameras(workspace.root)
    np.testing.assert_allclose(
        np.stack(list(known.centers.values())), scene.poses_from_scene.apply(cameras.centers), atol=1e-9
    )
    pixels, _ = known.pinhole.project(2, scene.poses_from_scene.apply(scene.points.astype(float)))
    np.testing.assert_allclose(pixels, cameras.project(2, scene.points.astype(float))[0], atol=1e-6)


@pytest.mark.parametrize(
    ("words", "kind", "message"),
    [
        (["--thresholds", "0.1,none"], "ConfigError", "'none' is no length"),
        (["--box", "1,2,3"], "ConfigError", "six numbers are needed"),
        (["--box", "0,0,0,1,1,-1"], "ConfigError", "lowest corner first"),
        (["--icp", "affine"], "ConfigError", "no ICP 'affine'"),
        (["--visible"], "InputError", "where the photos were taken from"),
        (["--box", "5,5,5,6,6,6"], "InputError", "all were cut away"),
    ],
)
def test_what_cannot_be_done_is_explained(tmp_path, words, kind, message):
    mesh = write_mesh(tmp_path / "a.ply", ball())
    code, out = _in_main("mesh", mesh, mesh, *words)
    assert code == {"ConfigError": 2, "InputError": 3}[kind]
    assert message in out["error"]["message"]
    assert out["error"]["hint"]


def _in_main(*words: object) -> tuple[int, dict]:
    done = CliRunner().invoke(app, ["evaluate", *map(str, words), "--json"])
    return done.exit_code, json.loads(done.stdout.strip().splitlines()[-1])


def test_files_that_are_nothing_are_named(tmp_path):
    bad = tmp_path / "bad.txt"
    bad.write_text("1 2 3")
    skew = tmp_path / "skew.txt"
    np.savetxt(skew, np.diag([1.0, 2, 1, 1]))
    for call, message in (
        (lambda: reading.read_surface(tmp_path / "absent.ply"), "no file"),
        (lambda: reading.read_matrix(bad), "4 x 4"),
        (lambda: reading.read_matrix(skew), "no similarity"),
        (lambda: read_dtu(tmp_path, 24), "lacks 3 of 3 files of scan 24"),
        (lambda: read_glossy(tmp_path, None), "-camera.pkl"),
        (lambda: read_tanks(tmp_path), "lacks"),
        (lambda: list(reading.read_masks(tmp_path / "masks", cameras_around())), "no folder"),
        (lambda: list(reading.read_masks(tmp_path, cameras_around())), "None of the 6 photos"),
    ):
        with pytest.raises(HineusError, match=message) as caught:
            call()
        assert caught.value.hint


def test_clouds_come_with_their_normals(tmp_path):
    points = ball().vertices
    plain = tmp_path / "plain.ply"
    trimesh.PointCloud(points).export(plain)
    assert reading.read_surface(plain).faces is None
    assert reading.read_surface(plain).normals is None
    turned = tmp_path / "turned.ply"
    rows = "\n".join(" ".join(f"{value:.9f}" for value in (*point, *(3 * point))) for point in points)
    names = "".join(f"property float {name}\n" for name in ("x", "y", "z", "nx", "ny", "nz"))
    turned.write_text(f"ply\nformat ascii 1.0\nelement vertex {len(points)}\n{names}end_header\n{rows}\n")
    found = reading.read_surface(turned)
    np.testing.assert_allclose(found.normals, points, atol=1e-6)
    (tmp_path / "empty.xyz").write_text("")
    with pytest.raises(InputError, match="it holds no points"):
        reading.read_surface(tmp_path / "empty.xyz")


# ---------------------------------------------------------------- the protocols
def test_dtu_from_its_published_layout(tmp_path):
    data = tmp_path / "eval"
    (data / "ObsMask").mkdir(parents=True)
    (data / "Points" / "stl").mkdir(parents=True)
    observed = np.ones((25, 25, 25), np.uint8)
    savemat(data / "ObsMask" / "ObsMask7_10.mat", {"ObsMask": observed, "BB": [[-6.0] * 3, [6.0] * 3], "Res": 0.5})
    savemat(data / "ObsMask" / "Plane7.mat", {"P": np.array([[0.0], [0], [1], [100]])})
    trimesh.PointCloud(trimesh.creation.icosphere(6, 5.0).vertices).export(data / "Points" / "stl" / "stl007_total.ply")
    ours = write_mesh(tmp_path / "ours.ply", trimesh.creation.icosphere(5, 5.05))
    found = numbers("dtu", ours, "--data", data, "--scan", 7)
    assert found["accuracy"] == pytest.approx(0.05, abs=0.03)  # the scan's points are 0.07 apart
    assert found["overall"] == pytest.approx(0.5 * (found["accuracy"] + found["completeness"]))
    assert found["unit"] == "mm"
    code, out = hineus("dtu", ours, "--data", data, "--scan", 7)
    assert code == 0
    assert "overall" in out
    far = write_mesh(tmp_path / "far.ply", trimesh.creation.icosphere(5, 5.05).apply_translation((900, 0, 0)))
    code, refused = _in_main("dtu", far, "--data", data, "--scan", 7)
    assert code == InputError.exit_code
    assert "--poses cameras_sphere.npz" in refused["error"]["hint"]
    savemat(data / "ObsMask" / "Plane7.mat", {"Q": 1})
    code, refused = _in_main("dtu", ours, "--data", data, "--scan", 7)
    assert "holds no matrix P" in refused["error"]["message"]


def test_glossy_from_its_published_layout(tmp_path):
    data = tmp_path / "bell"
    data.mkdir()
    cameras, mesh = cameras_around(distance=3.0), ball(0.7)
    for i in range(len(cameras)):
        depth = drawn_depth(cameras, i, np.asarray(mesh.vertices), np.asarray(mesh.faces))
        stored = np.where(np.isfinite(depth), depth / 15 * 65535, 65535).round().astype(np.uint16)
        cv2.imwrite(str(data / f"{i}-depth.png"), stored)
        cv2.imwrite(str(data / f"{i}.png"), np.zeros((64, 64, 3), np.uint8))
        (data / f"{i}-camera.pkl").write_bytes(pickle.dumps([cameras.extrinsics[i], cameras.intrinsics[i]]))
    ours = write_mesh(tmp_path / "ours.ply", ball(0.7))
    found = numbers("glossy", ours, "--data", data)
    assert found["chamfer"] < 2e-4  # depth is stored in steps of 0.0002
    assert "all 6 views" in "\n".join(found["done"])
    larger = write_mesh(tmp_path / "larger.ply", ball(0.73))
    split = tmp_path / "split.pkl"
    split.write_bytes(pickle.dumps([["0", "2", "3"], ["1", "4", "5"]]))
    found = numbers("glossy", larger, "--data", data, "--split", split)
    assert found["views"] == 3
    assert found["accuracy"] == pytest.approx(0.03, rel=0.25)
    split.write_bytes(pickle.dumps([["0", "77"], []]))
    code, refused = _in_main("glossy", larger, "--data", data, "--split", split)
    assert code == InputError.exit_code
    assert "1 of 2 views" in refused["error"]["message"]


def test_tanks_from_its_published_layout(tmp_path):
    data = tmp_path / "Block"
    data.mkdir()
    block = trimesh.creation.box((1.0, 0.8, 0.6))
    points, _ = trimesh.sample.sample_surface(block, 40_000, seed=0)
    trimesh.PointCloud(points).export(data / "Block.ply")
    polygon = [[-2, -2, 0], [2, -2, 0], [2, 2, 0], [-2, 2, 0]]
    crop = {"orthogonal_axis": "Z", "axis_min": -1, "axis_max": 1, "bounding_polygon": polygon}
    (data / "Block.json").write_text(json.dumps(crop))
    cameras = cameras_around()
    reference = trimesh.transformations.rotation_matrix(1.0, (0, 1, 1))  # the log's frame is another one
    blocks = []
    for i, center in enumerate(cameras.centers):
        pose = np.eye(4)
        pose[:3, 3] = (np.linalg.inv(reference) @ [*center, 1])[:3]
        blocks.append(f"{i} {i} 0\n" + "\n".join(" ".join(map(str, row)) for row in pose))
    (data / "Block_COLMAP_SfM.log").write_text("\n".join(blocks) + "\n")
    np.savetxt(data / "Block_trans.txt", reference)
    ours = write_mesh(tmp_path / "ours.ply", block.copy().apply_transform(MOTION))
    poses = write_transforms(tmp_path / "ours.json", cameras, MOTION)
    code, refused = _in_main("tanks", ours, "--data", data)
    assert code == InputError.exit_code
    assert "its tau is not known" in refused["error"]["message"]
    found = numbers("tanks", ours, "--data", data, "--tau", 0.02, "--cameras", poses)
    assert found["f_score"] > 99
    assert "by 6 camera centres" in "\n".join(found["done"])
    np.testing.assert_allclose(np.array(found["matrix"]) @ MOTION, np.eye(4), atol=0.02)
    np.savetxt(tmp_path / "matrix.txt", np.linalg.inv(MOTION))
    arguments = ("tanks", ours, "--data", data, "--tau", 0.02, "--matrix", tmp_path / "matrix.txt", "--no-refine")
    found = numbers(*arguments)
    assert found["f_score"] > 99
    np.testing.assert_allclose(np.array(found["matrix"]) @ MOTION, np.eye(4), atol=1e-9)
    (data / "Block.json").write_text("{}")
    code, refused = _in_main(*arguments)
    assert "has no 'orthogonal_axis'" in refused["error"]["message"]


@pytest.mark.parametrize(
    "option",
    ["--spacing=nan", "--spacing=0", "--box=nan,0,0,1,1,1", "--box=nan%", "--box=1,2%", "--box=1e9", "--thresholds=inf",
     "--thresholds=nan", "--samples=1000000000000", "--grow=1000000000", "--spacing=1e-9"],
)  # fmt: skip
def test_options_that_cannot_be(tmp_path: Path, option: str):
    mesh = write_mesh(tmp_path / "a.ply", ball())
    code, out = hineus("mesh", mesh, mesh, option)
    assert code in (2, 3), out


def test_a_crop_volume_and_a_trajectory_that_cannot_be(tmp_path: Path):
    data = tmp_path / "Block"
    trimesh.PointCloud(ball().vertices).export(write_mesh(data / "Block.ply", ball()))
    for text in (
        "[" * 100_000,
        "[]",
        '{"orthogonal_axis": 1}',
        "NaN",
        '{"orthogonal_axis": "Z", "bounding_polygon": 1}',
    ):
        (data / "Block.json").write_text(text)
        with pytest.raises(InputError, match=r"The crop volume .* cannot be read"):
            read_tanks(data)
    polygon = [[-2, -2, 0], [2, -2, 0], [2, 2, 0]]
    crop = {"orthogonal_axis": "Z", "axis_min": -1, "axis_max": 1, "bounding_polygon": polygon}
    (data / "Block.json").write_text(json.dumps(crop))
    np.savetxt(data / "Block_trans.txt", np.eye(4))
    for text in ("nan " * 19, "1 " * 18, "x " * 19):
        (data / "Block_COLMAP_SfM.log").write_text(text)
        with pytest.raises(InputError, match=r"The trajectory .* cannot be read"):
            read_tanks(data)


def test_observed_cells_that_are_too_many(tmp_path: Path):
    """A header of 2^60 cells; scipy would take memory for them."""
    from stages.evaluation.protocols import dtu

    file = tmp_path / "ObsMask1_10.mat"
    savemat(file, {"ObsMask": np.zeros((2, 3, 4), np.uint8)})
    whole = file.read_bytes()
    shape = np.array([2, 3, 4], np.int32).tobytes()
    assert shape in whole
    file.write_bytes(whole.replace(shape, np.array([1 << 20] * 3, np.int32).tobytes()))
    with pytest.raises(InputError, match=r"1152921504606846976 cells"):
        dtu._matrix(file, "ObsMask")
