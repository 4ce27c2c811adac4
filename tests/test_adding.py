"""Photos that come or go after poses were found: the others' poses stay, and what is published says so."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from printed_box import FOCAL, HEIGHT, WIDTH, render, texture
from rigs import look_at

from configs.params import SfmParams
from stages import artifacts
from stages.artifacts import ImageRecord, ImageSet, SkippedImage
from stages.engine.stage import StageContext
from stages.geometry.similarity import align_points
from stages.posing.adding import KnownPhotos, copy_features, known_model, put_back
from stages.posing.ladder import Step
from stages.posing.workbench import ADDED, RELAXED, Base
from stages.sfm import SFM, _is_relaxed, _same_cameras, _saw_left_out

CENTERS = [
    np.array([2.6 * np.cos(a), 2.6 * np.sin(a), 1.5 + 0.3 * (i % 2)])
    for i, a in enumerate(np.radians(np.arange(0, 120, 12)))
]


def photo(index: int) -> np.ndarray:
    """[H, W] uint8: one of ten around a box, or of something else."""
    if index < len(CENTERS):
        return render(look_at(CENTERS[index], np.array([0, 0, 0.35])), index)
    return cv2.resize(texture(90 + index), (WIDTH, HEIGHT)).astype(np.uint8)


def ingested(folder: Path, photos: dict[str, int], skipped: Sequence[SkippedImage] = ()) -> Path:
    """The folder that ingest would publish of photos by name."""
    records = []
    for name, index in sorted(photos.items()):
        path = artifacts.Pictures(folder).path(name)
        path.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(path), photo(index))
        records.append(ImageRecord(name, name, WIDTH, HEIGHT, FOCAL, "camera", 1.0, False, str(index)))
    artifacts.IMAGE_SET.save(folder, ImageSet(tuple(records), tuple(skipped)))
    return folder


def run(
    root: Path,
    photos: dict[str, int],
    previous: Path | None = None,
    skipped: Sequence[SkippedImage] = (),
    **params: Any,
) -> tuple[dict[str, Any], Path]:
    """Numbers and folder of the stage on these photos, after a `previous` run."""
    for folder in ("sfm", "scratch"):
        (root / folder).mkdir(parents=True)
    settings = SfmParams(**{"deterministic": True, **params})
    inputs = {"ingest": ingested(root / "ingest", photos, skipped)}
    context = StageContext(inputs, {}, root / "sfm", root / "scratch", settings, workers=2, previous=previous)
    return SFM.run(context), root / "sfm"


def named(*indices: int) -> dict[str, int]:
    return {f"{index:03d}.png": index for index in indices}


def poses(folder: Path) -> dict[str, np.ndarray]:
    """Photo -> its centre."""
    import pycolmap

    model = pycolmap.Reconstruction(str(artifacts.MODEL.load(folder)))
    return {model.images[i].name: model.images[i].projection_center() for i in model.reg_image_ids()}


def lineage(folder: Path) -> str:
    return artifacts.PHOTO_CONTENTS.load(folder).lineage


@pytest.fixture(scope="module")
def eight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Poses of photos 0 to 7, published."""
    numbers, folder = run(tmp_path_factory.mktemp("eight"), named(*range(8)))
    assert numbers["registered"] == 8
    assert "known" not in numbers
    return folder


@pytest.mark.slow
def test_new_photos_are_placed_beside_known_ones_that_stay(eight: Path, tmp_path: Path, monkeypatch) -> None:
    import pycolmap

    monkeypatch.setattr(pycolmap, "global_mapping", None)
    first = pycolmap.incremental_mapping

    def from_known(*arguments: Any, **options: Any) -> Any:
        assert options["input_path"], "poses are found anew"
        assert arguments[3].fix_existing_frames
        return first(*arguments, **options)

    monkeypatch.setattr(pycolmap, "incremental_mapping", from_known)
    # 0 has gone, 7 has another name, which changes the order of all, and two are new
    photos = {**named(*range(1, 7)), "a last one.png": 7, **named(8, 9)}
    numbers, folder = run(tmp_path, photos, eight)
    assert numbers["registered"] == 9
    assert (numbers["known"], numbers["new"], numbers["gone"]) == (7, 2, 1)
    assert numbers["kept"] == ADDED
    assert numbers["poses_stayed"] is True
    assert numbers["moved_percent"] < 0.1
    assert lineage(folder) == lineage(eight)
    before, now = poses(eight), poses(folder)
    moved = {name: np.linalg.norm(now[name] - before[name]) for name in named(*range(1, 7))}
    moved["7"] = np.linalg.norm(now["a last one.png"] - before["007.png"])
    assert max(moved.values()) < 0.01
    centers = np.array([CENTERS[index] for index in photos.values()])
    found = np.array([now[name] for name in photos])
    assert np.linalg.norm(align_points(found, centers).apply(found) - centers, axis=1).max() < 0.03
    assert artifacts.REGISTRATION.load(folder).mean_reprojection_error_px < 1.0

    # and once more from there, of what is published then
    numbers, third = run(tmp_path / "third", {**photos, "000.png": 0}, folder)
    assert (numbers["registered"], numbers["known"], numbers["new"]) == (10, 9, 1)
    assert lineage(third) == lineage(eight)


@pytest.mark.slow
def test_new_photos_are_matched_with_all_known_ones(eight: Path, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr("stages.posing.workbench.likely_pairs", lambda database, among: [])
    numbers, folder = run(tmp_path, named(*range(9)), eight)
    assert (numbers["registered"], numbers["kept"]) == (9, ADDED)
    assert artifacts.REGISTRATION.load(folder).matcher == "preemptive"


@pytest.mark.slow
def test_the_same_photos_keep_their_model_bit_for_bit_and_others_names_only(eight: Path, tmp_path: Path) -> None:
    def files(folder: Path) -> dict[str, bytes]:
        return {path.name: path.read_bytes() for path in artifacts.MODEL.load(folder).iterdir()}

    numbers, folder = run(tmp_path / "same", named(*range(8)), eight)
    assert (numbers["known"], numbers["new"], numbers["gone"]) == (8, 0, 0)
    assert files(folder) == files(eight)
    renamed = {f"b/{9 - index}.png": index for index in range(8)}
    numbers, folder = run(tmp_path / "renamed", renamed, eight)
    before, now = poses(eight), poses(folder)
    assert all(np.array_equal(now[name], before[f"{index:03d}.png"]) for name, index in renamed.items())
    assert artifacts.REGISTRATION.load(folder).lenses == artifacts.REGISTRATION.load(eight).lenses
    numbers, folder = run(tmp_path / "more", {**renamed, "c.png": 8}, folder)
    assert (numbers["registered"], numbers["known"], numbers["new"]) == (9, 8, 1)
    assert lineage(folder) == lineage(eight)


@pytest.mark.slow
def test_adding_twice_gives_the_same_model_bit_for_bit(eight: Path, tmp_path: Path) -> None:
    models = []
    for attempt in ("a", "b"):
        _, folder = run(tmp_path / attempt, named(*range(9)), eight)
        models.append({path.name: path.read_bytes() for path in artifacts.MODEL.load(folder).iterdir()})
    assert models[0] == models[1]


@pytest.mark.slow
def test_new_photos_that_do_not_connect_lead_to_poses_of_all_anew(eight: Path, tmp_path: Path, caplog) -> None:
    with caplog.at_level(logging.INFO):
        numbers, folder = run(tmp_path, named(*range(8), 11, 12, 13), eight, wanted=0.9)
    assert "beside the known photos 8 of 11 photos could be placed (10 wanted): poses are found anew" in caplog.text
    assert numbers["registered"] == 8
    assert numbers["attempts"] > 1
    reasons = {item.name: item.reason for item in artifacts.REGISTRATION.load(folder).unregistered}
    assert set(reasons) == {"011.png", "012.png", "013.png"}
    assert "matches no other photo" in reasons["011.png"]
    # of all, no more were placed: the known stay
    assert "poses of the known photos stay, since no more photos were placed" in caplog.text
    assert numbers["kept"] == ADDED
    assert lineage(folder) == lineage(eight)


@pytest.mark.slow
@pytest.mark.parametrize("why", ["few known", "left out on purpose", "nothing kept"])
def test_poses_are_found_anew_where_they_must(eight: Path, tmp_path: Path, caplog, why: str) -> None:
    photos, skipped, previous = named(*range(9)), [], eight
    if why == "few known":
        photos = named(5, 6, 7, 8, 9, 10)
    elif why == "left out on purpose":
        photos, skipped = named(*range(1, 8)), [SkippedImage("000.png", artifacts.LEFT_OUT, sha256="0")]
    else:
        previous = tmp_path / "without"
        previous.mkdir()
        for artifact in (artifacts.MODEL, artifacts.PHOTO_CONTENTS):
            for path in eight.rglob("*"):
                if path.is_file() and artifact.covers(path.relative_to(eight).as_posix()):
                    target = previous / path.relative_to(eight)
                    target.parent.mkdir(exist_ok=True)
                    target.write_bytes(path.read_bytes())
    with caplog.at_level(logging.INFO):
        numbers, folder = run(tmp_path / "now", photos, previous, skipped)
    assert "known" not in numbers
    assert numbers["kept"] != ADDED
    assert lineage(folder) != lineage(eight)
    expected = {"few known": "too few", "left out on purpose": "must not have been seen", "nothing kept": ""}
    assert expected[why] in caplog.text


@pytest.mark.slow
def test_known_poses_and_features_survive_a_change_of_ids(eight: Path, tmp_path: Path) -> None:
    """A database in which the photos have another order holds the same matches and takes the same model."""
    import pycolmap

    database = tmp_path / "plain.db"
    pycolmap.Database.open(database).close()
    names = {f"{9 - index}.png": f"{index:03d}.png" for index in range(8)}
    folder = ingested(tmp_path / "ingest", {name: int(then[:3]) for name, then in names.items()})
    pycolmap.import_images(database, artifacts.Pictures(folder).images, camera_mode=pycolmap.CameraMode.SINGLE)
    kept = next(artifacts.FEATURES.load(eight).iterdir())
    copy_features(kept, database, names)
    with pycolmap.Database.open(kept) as old, pycolmap.Database.open(database) as new:
        assert new.num_matched_image_pairs() == old.num_matched_image_pairs()
        assert new.num_inlier_matches() == old.num_inlier_matches()
        a, b = (old.read_image_with_name(name).image_id for name in ("000.png", "001.png"))
        c, d = (new.read_image_with_name(name).image_id for name in ("9.png", "8.png"))
        assert (a < b) != (c < d)
        assert np.array_equal(old.read_matches(a, b), new.read_matches(c, d))
        pairs = old.read_two_view_geometry(a, b).inlier_matches
        assert np.array_equal(pairs, new.read_two_view_geometry(c, d).inlier_matches)
        assert np.array_equal(old.read_keypoints(a), new.read_keypoints(c))
    earlier = pycolmap.Reconstruction(str(artifacts.MODEL.load(eight)))
    known = KnownPhotos(names, (), (), earlier, kept)
    model = known_model(known, database, 15)
    assert model.num_points3D() == earlier.num_points3D()
    model.update_point_3d_errors()
    assert model.compute_mean_reprojection_error() == pytest.approx(earlier.compute_mean_reprojection_error(), rel=1e-6)
    # moved as a whole it is put back; photos that moved against each other are told
    shift = pycolmap.Sim3d(2.0, pycolmap.Rotation3d(np.array([0, 0, 1.0, 0])), np.ones(3))
    model.transform(shift)
    assert put_back(known, model) == pytest.approx(0, abs=1e-9)
    assert model.compute_mean_reprojection_error() == pytest.approx(earlier.compute_mean_reprojection_error(), rel=1e-6)


def record(name: str, camera: str, focal: float | None = None) -> ImageRecord:
    return ImageRecord(name, name, WIDTH, HEIGHT, focal, camera, 1.0, False, name)


@pytest.mark.parametrize(
    ("cameras", "focal", "same"),
    [("aaaa", None, True), ("bbbb", None, True), ("aabb", None, False), ("aaaa", 300.0, False)],
)
def test_poses_stay_only_where_photos_share_cameras_as_before(cameras: str, focal: float | None, same: bool) -> None:
    files = {f"{i}": artifacts.PhotoFile(sha256=f"{i}", camera="a", focal_px=None) for i in range(4)}
    before = artifacts.PhotoContents(lineage="", contents={name: name for name in files}, files=files)
    records = [record(f"{i}.png", camera, focal) for i, camera in enumerate(cameras)]
    new = record("new.png", "another", 900.0)
    names = {f"{i}.png": f"{i}" for i in range(4)}
    assert _same_cameras(before, ImageSet((*records, new)), names) is same


def test_photos_once_seen_are_told_when_they_are_left_out() -> None:
    before = artifacts.PhotoContents(lineage="", contents={}, seen=("1", "2"))

    def left_out(sha256: str, reason: str = artifacts.LEFT_OUT) -> ImageSet:
        return ImageSet((), (SkippedImage("x.png", reason, sha256=sha256),))

    assert _saw_left_out(before, left_out("2"))
    assert not _saw_left_out(before, left_out("3"))
    assert not _saw_left_out(before, left_out("2", "no photo"))


@pytest.mark.parametrize(
    ("rung", "before", "relaxed"),
    [(RELAXED, False, True), (ADDED, True, True), (ADDED, False, False), ("x", True, False)],
)
def test_rough_poses_stay_rough_while_others_are_placed_beside_them(
    tmp_path: Path, rung: str, before: bool, relaxed: bool
) -> None:
    artifacts.REGISTRATION.save(tmp_path, artifacts.Registration(relaxed=before))
    context = StageContext({}, {}, tmp_path, tmp_path, SfmParams(), previous=tmp_path)
    assert _is_relaxed(context, Step(rung, 3, 9, 1.0, kept=True)) is relaxed


@pytest.mark.parametrize("base", [Base(), Base(affine=True), Base(masked=True, focal_priors=False), Base(corners=True)])
def test_a_database_s_name_says_what_it_was_made_on(base: Base) -> None:
    assert Base.of_file(base.file) == base
