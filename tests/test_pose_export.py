"""Poses for other programs: what was written is read back and held against the pixels the points are seen at."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from dotted_capture import DOTS, MODELS, NUM_CAMERAS, dots_seen, undistort, write_capture
from toy_pipeline import TOY
from typer.testing import CliRunner

from hineus_cli.app import build_app
from stages import artifacts
from stages.engine.workspace import Workspace
from stages.posing.exporting import write_colmap, write_transforms
from stages.posing.known import KnownPoses
from stages.posing.reading import masks_beside, read_poses


def captured(tmp_path: Path, masks: bool = False) -> tuple[Path, Path]:
    """Folders of undistort and sfm: a distorted lens, reduced photos, a scene frame that is not the world."""
    inputs = write_capture(tmp_path, *MODELS[3], masks=masks)
    undistort(inputs, tmp_path, max_side=250)
    out = tmp_path / "exported"
    out.mkdir()
    return tmp_path / "undistort", inputs["sfm"]


def assert_dots_are_where_the_poses_say(poses: KnownPoses, images: Path) -> None:
    import pycolmap

    assert len(poses.cameras) == NUM_CAMERAS
    for camera in poses.cameras:
        lens = pycolmap.Camera(model=camera.model, width=camera.size[0], height=camera.size[1], params=camera.params)
        pixels = np.asarray(lens.img_from_cam(DOTS @ camera.cam_from_world[:, :3].T + camera.cam_from_world[:, 3]))
        photo = cv2.imread(str(images / camera.name.removeprefix("images/")), cv2.IMREAD_GRAYSCALE)
        assert photo.shape[::-1] == camera.size
        apart = np.linalg.norm(pixels[:, None] - pixels[None], axis=2) + 1e9 * np.eye(len(pixels))
        border = np.minimum(pixels, np.array(camera.size) - pixels).min(1)
        clear = (apart.min(1) > 14) & (border > 8)
        assert np.linalg.norm(dots_seen(photo, pixels[clear]) - pixels[clear], axis=1).max() < 0.1


def test_colmap_export_reads_back(tmp_path: Path):
    import pycolmap

    folder, sfm = captured(tmp_path, masks=True)
    out = tmp_path / "exported"
    numbers = write_colmap(folder, sfm, tmp_path / "place", out)
    assert numbers == {"images": NUM_CAMERAS, "points": len(DOTS), "observations": NUM_CAMERAS * len(DOTS)}
    assert len(list((out / "masks").iterdir())) == NUM_CAMERAS
    for suffix in (".bin", ".txt"):
        alone = tmp_path / suffix
        alone.mkdir()
        for file in (out / "sparse").glob(f"*{suffix}"):
            (alone / file.name).write_bytes(file.read_bytes())
        model = pycolmap.Reconstruction(str(alone))
        assert {camera.model_name for camera in model.cameras.values()} == {"PINHOLE"}
        assert model.num_cameras() == 1
        points = np.array([model.points3D[i].xyz for i in sorted(model.points3D)])
        np.testing.assert_allclose(points, DOTS, atol=1e-5)
        # the features went through lens and reduction as the photos did
        for image in model.images.values():
            for point in image.points2D:
                assert np.linalg.norm(image.project_point(model.points3D[point.point3D_id].xyz) - point.xy) < 1e-3
        assert all(point.color.min() > 100 for point in model.points3D.values())  # the dots are white
    assert_dots_are_where_the_poses_say(read_poses(out), out / "images")


def test_transforms_export_reads_back(tmp_path: Path):
    import trimesh

    folder, sfm = captured(tmp_path, masks=True)
    out = tmp_path / "exported"
    write_transforms(folder, sfm, tmp_path / "place", out)
    poses = read_poses(out)
    assert {camera.model for camera in poses.cameras} == {"PINHOLE"}
    assert_dots_are_where_the_poses_say(poses, out / "images")
    data = json.loads((out / "transforms.json").read_text())
    assert data["units"] == "arbitrary units"
    for frame in data["frames"]:
        assert (out / frame["file_path"]).is_file()
        assert (out / frame["mask_path"]).is_file()
    points = np.asarray(trimesh.load(out / data["ply_file_path"]).vertices)
    nearest = np.linalg.norm(points[:, None] - DOTS[None], axis=2)
    assert points.shape == DOTS.shape
    assert nearest.min(0).max() < 1e-5


@pytest.mark.parametrize(("kind", "exported"), [(artifacts.OUTLINES, NUM_CAMERAS), (artifacts.SILHOUETTES, 0)])
def test_masks_beside_whole_photos_are_exported_where_they_were_given(tmp_path: Path, kind, exported: int):
    folder, sfm = captured(tmp_path, masks=True)
    (folder / "masks").rename(kind.load(folder).masks)
    write_colmap(folder, sfm, tmp_path / "place", tmp_path / "exported")
    assert len(list(tmp_path.glob("exported/masks/*"))) == exported


def test_masks_of_some_photos_only_are_not_named_for_nerfstudio(tmp_path: Path, caplog: pytest.LogCaptureFixture):
    folder, sfm = captured(tmp_path, masks=True)
    next((folder / "masks").iterdir()).unlink()
    write_transforms(folder, sfm, tmp_path / "place", tmp_path / "exported")
    data = json.loads((tmp_path / "exported" / "transforms.json").read_text())
    assert not any("mask_path" in frame for frame in data["frames"])
    assert f"only {NUM_CAMERAS - 1} of {NUM_CAMERAS} photos have one" in caplog.text


def test_masks_of_an_export_are_read_back(tmp_path: Path):
    folder, sfm = captured(tmp_path, masks=True)
    out = tmp_path / "exported"
    write_transforms(folder, sfm, tmp_path / "place", out)
    masks = read_poses(out).masks
    assert masks == {f"images/{name.stem}": name for name in (out / "masks").iterdir()}
    assert masks_beside(out / "transforms.json") == out / "masks"


def test_both_exports_say_the_same_and_that_of_the_scene(tmp_path: Path):
    folder, sfm = captured(tmp_path)
    (tmp_path / "other").mkdir()
    write_colmap(folder, sfm, tmp_path / "place", tmp_path / "exported")
    write_transforms(folder, sfm, tmp_path / "place", tmp_path / "other")
    scene = artifacts.FIRST_SCENE.load(folder)
    world = scene.world_from_scene(artifacts.WORLD_PLACE.load(tmp_path / "place"))
    colmap, transforms = (read_poses(tmp_path / name) for name in ("exported", "other"))
    for i, (one, other) in enumerate(zip(colmap.cameras, transforms.cameras, strict=True)):
        np.testing.assert_allclose(one.cam_from_world, other.cam_from_world, atol=1e-9)
        np.testing.assert_allclose(one.params, other.params)
        at_center = one.cam_from_world[:, :3] @ world.apply(np.zeros(3)) + one.cam_from_world[:, 3]
        expected = scene.cameras.extrinsics[i, :, 3] * world.scale
        np.testing.assert_allclose(at_center, expected, atol=1e-9)


# ---------------------------------------------------------------- the commands
def test_a_workspace_without_undistorted_photos_and_a_folder_in_use(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "photos").mkdir()
    for index in range(3):
        (tmp_path / "photos" / f"{index}.jpg").write_text(f"{index}")
    monkeypatch.chdir(tmp_path)
    run = CliRunner().invoke
    app = build_app(TOY)
    assert run(app, ["run", "photos", "-w", "ws", "--until", "sfm"]).exit_code == 0
    early = run(app, ["export-colmap", "ws", "out"])
    assert early.exit_code == 5
    assert "has no undistorted photos" in early.stderr
    assert "hineus undistort --workspace" in early.stderr
    assert not (tmp_path / "out").exists()

    assert run(app, ["run", "photos", "-w", "ws"]).exit_code == 0
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "mine.txt").write_text("mine")
    for command in ("export-colmap", "export-transforms"):
        refused = run(app, [command, "ws", "out"])
        assert refused.exit_code == 3
        assert "out is there already" in refused.stderr
    assert Workspace.open(tmp_path / "ws").published("undistort") is not None
