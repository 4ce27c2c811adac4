"""The sfm stage with known poses: the poses stay, points are found, and what does not fit is said."""

from __future__ import annotations

import json
import logging
from pathlib import Path

import cv2
import numpy as np
import pytest
from printed_box import FOCAL, HEIGHT, WIDTH, ingested, render
from rigs import look_at

from configs.params import SfmParams
from stages import artifacts
from stages.artifacts import ImageSet, SkippedImage
from stages.engine.stage import StageContext
from stages.errors import InputError
from stages.posing.known import KnownCamera
from stages.posing.triangulation import fitted_camera
from stages.sfm import SFM

ANGLES = np.radians(np.arange(0, 96, 16))
CENTERS = [np.array([2.6 * np.cos(a), 2.6 * np.sin(a), 1.5 + 0.3 * (i % 2)]) for i, a in enumerate(ANGLES)]
POSES = [look_at(center, np.array([0, 0, 0.35])) for center in CENTERS]


def write_poses(folder: Path, names: list[str], focal: float = FOCAL, size: tuple[int, int] = (WIDTH, HEIGHT)) -> Path:
    frames = []
    for name, pose in zip(names, POSES, strict=True):
        matrix = np.linalg.inv(np.vstack([pose, [0, 0, 0, 1]])) @ np.diag([1.0, -1.0, -1.0, 1.0])
        frames.append({"file_path": name, "transform_matrix": matrix.tolist()})
    file = folder / "transforms.json"
    file.write_text(json.dumps({"fl_x": focal, "w": size[0], "h": size[1], "frames": frames}))
    return file


def run_sfm(
    ingest: Path, poses: Path, root: Path, previous: Path | None = None, **params: object
) -> tuple[dict[str, object], Path]:
    out, scratch = root / "sfm", root / "scratch"
    out.mkdir()
    scratch.mkdir()
    settings = SfmParams(**params)  # type: ignore[arg-type]
    sources = {"poses": poses}
    context = StageContext({"ingest": ingest}, sources, out, scratch, settings, workers=2, previous=previous)
    return SFM.run(context), out


@pytest.mark.slow
@pytest.mark.parametrize("preemptive_max", [150, 2])
def test_poses_stay_and_points_are_found(tmp_path: Path, preemptive_max: int):
    import pycolmap

    ingest = ingested(tmp_path / "ingest", [render(pose, i) for i, pose in enumerate(POSES)])
    poses = write_poses(tmp_path, [f"images/{i:03d}" for i in range(len(POSES))])
    numbers, out = run_sfm(ingest, poses, tmp_path, preemptive_max=preemptive_max)
    assert numbers["registered"] == len(POSES)
    assert numbers["matcher"] == ("preemptive" if preemptive_max > len(POSES) else "spatial")
    assert numbers["poses_from"] == "transforms.json"
    assert numbers["mean_reprojection_error_px"] < 0.5
    model = pycolmap.Reconstruction(str(artifacts.MODEL.load(out)))
    for image in model.images.values():
        np.testing.assert_allclose(image.cam_from_world().matrix(), POSES[int(image.name[:3])], atol=1e-9)
    points = np.array([point.xyz for point in model.points3D.values()])
    assert len(points) > 300
    # of the printed floor and box: nothing below the floor, nothing above the box
    assert np.mean((points[:, 2] > -0.02) & (points[:, 2] < 0.92)) > 0.98
    assert artifacts.REGISTRATION.load(out).registered == tuple(sorted(f"{i:03d}.png" for i in range(len(POSES))))
    assert artifacts.GIVEN_POSES.load(out) == artifacts.GivenPoses(origin="transforms.json")


def test_plain_photos_are_a_warning_and_no_error(tmp_path: Path, caplog: pytest.LogCaptureFixture):
    import pycolmap

    photos = [np.full((HEIGHT, WIDTH), 100 + 10 * i, np.uint8) for i in range(len(POSES))]
    poses = write_poses(tmp_path, [f"{i:03d}.png" for i in range(len(POSES))])
    with caplog.at_level(logging.WARNING):
        numbers, out = run_sfm(ingested(tmp_path / "ingest", photos), poses, tmp_path)
    assert (numbers["registered"], numbers["points"]) == (len(POSES), 0)
    assert "only 0 points could be triangulated" in caplog.text
    assert pycolmap.Reconstruction(str(artifacts.MODEL.load(out))).num_reg_images() == len(POSES)


def test_given_poses_are_of_one_lineage_while_photos_that_stay_keep_theirs(tmp_path: Path, monkeypatch):
    photos = [np.full((HEIGHT, WIDTH), 100 + 10 * i, np.uint8) for i in range(len(POSES))]
    names = [f"{i:03d}.png" for i in range(len(POSES))]

    def lineage(
        name: str, count: int, previous: Path | None = None, left_out: int | None = None, focal: float = FOCAL
    ) -> tuple[str, Path]:
        (tmp_path / name).mkdir()
        ingest = ingested(tmp_path / name / "ingest", photos[:count])
        if left_out is not None:
            records = artifacts.IMAGE_SET.load(ingest).images
            gone = SkippedImage(names[left_out], artifacts.LEFT_OUT, sha256=str(left_out))
            rest = tuple(record for record in records if record.name != names[left_out])
            artifacts.IMAGE_SET.save(ingest, ImageSet(rest, (gone,)))
        _, out = run_sfm(ingest, write_poses(tmp_path / name, names, focal), tmp_path / name, previous)
        return artifacts.PHOTO_CONTENTS.load(out).lineage, out

    first, folder = lineage("five", 5)
    assert lineage("four", 4, folder)[0] == first
    _, six = lineage("six", 6, folder)
    assert artifacts.PHOTO_CONTENTS.load(six).lineage == first
    assert lineage("other lens", 6, folder, focal=1.1 * FOCAL)[0] != first
    # photos that no stage may see: one that was seen, in the last run or before, and one that never was
    assert lineage("left out", 6, six, left_out=5)[0] != first
    _, removed = lineage("removed", 5, six)
    assert artifacts.PHOTO_CONTENTS.load(removed).lineage == first
    forgotten, without = lineage("left out later", 6, removed, left_out=5)
    assert forgotten != first
    assert lineage("once more", 6, without, left_out=5)[0] == forgotten
    assert lineage("never seen", 6, folder, left_out=5)[0] == first
    assert lineage("alone", 6)[0] != first
    monkeypatch.setattr("test_triangulation.POSES", [POSES[0] + [[0, 0, 0, 0.01]], *POSES[1:]])
    assert lineage("moved", 6, folder)[0] != first


def test_a_reduced_photo_gets_a_reduced_camera():
    params = (FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2, -0.1, 0.0, 0.0, 0.0)
    known = KnownCamera("a.png", (WIDTH, HEIGHT), "OPENCV", params, POSES[0])
    camera = fitted_camera(known, "a.jpg", (WIDTH // 2, HEIGHT // 2))
    assert (camera.width, camera.height) == (WIDTH // 2, HEIGHT // 2)
    np.testing.assert_allclose(camera.params, [FOCAL / 2, FOCAL / 2, WIDTH / 4, HEIGHT / 4, -0.1, 0, 0, 0])


def test_a_turned_photo_is_refused(tmp_path: Path):
    ingest = ingested(tmp_path / "ingest", [cv2.rotate(render(pose, 0), cv2.ROTATE_90_CLOCKWISE) for pose in POSES])
    poses = write_poses(tmp_path, [f"{i:03d}.png" for i in range(len(POSES))])
    with pytest.raises(InputError, match=r"000.png is 240 x 320 pixels upright, but its pose is for 320 x 240"):
        run_sfm(ingest, poses, tmp_path)
