"""The hard variants: what is done to the photos, truth and error, result files and the table, without running any."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import ExifTags, Image

from benchmarks import hard_variants as hard
from benchmarks.hard_variants import BASES, VARIANTS, Row, all_rows, load_photos, load_rows, make_photos, pose_table

STEP = {"rung": "exhaustive matching", "registered": 15, "points": 9, "error_px": 0.5, "kept": True, "note": ""}


def _row(name="synth_helmet", **changes) -> Row:
    return Row(**{"name": name, "command": "c", "machine": {"cpu": "x"}, "code": "c", "photos": 47, "registered": 47,
                  "center_error": {"median": 0.131, "max": 0.85}, "attempts": (STEP,), "cpu_s": 31.4,
                  "failure": None, **changes})  # fmt: skip


@pytest.fixture
def data(tmp_path, monkeypatch):
    """A set of seven photos with masks, and result files of its own."""
    monkeypatch.setattr(hard, "FOLDERS", tmp_path / "out")
    monkeypatch.setattr(hard, "ROWS", tmp_path / "rows")
    for name in ("images", "masks"):
        (tmp_path / "synth_helmet" / name).mkdir(parents=True)
    noise = np.random.default_rng(0)
    for i in range(7):
        pixels = noise.integers(0, 256, (48, 64, 3), dtype=np.uint8)
        mask = np.zeros((48, 64), np.uint8)
        mask[10:30, 20:40] = 255
        Image.fromarray(pixels).save(tmp_path / "synth_helmet" / "images" / f"{i:03d}.jpg", quality=97)
        Image.fromarray(mask).save(tmp_path / "synth_helmet" / "masks" / f"{i:03d}.png")
    return tmp_path


@pytest.mark.parametrize("variant", [name for name in VARIANTS if name != "video"])
def test_every_variant_changes_photos_and_keeps_their_names(variant, data):
    original = load_photos(data / "synth_helmet")
    folder = make_photos(f"synth_helmet-{variant}", data)
    made = sorted(folder.iterdir())
    kept = original[::3] if variant == "every_third" else original
    assert [path.stem for path in made] == [Path(photo.name).stem for photo in kept]
    for i, (path, photo) in enumerate(zip(made, kept, strict=True)):
        with Image.open(path) as image:
            pixels = np.asarray(image.convert("RGB"))
            focal = image.getexif().get_ifd(ExifTags.IFD.Exif).get(ExifTags.Base.FocalLengthIn35mmFilm)
        assert focal == (96 if variant == "wrong_focal" else None)
        if variant == "rotated":
            assert pixels.shape[:2] == ((64, 48) if i % 2 else (48, 64))
        if variant == "two_cameras":
            assert pixels.shape[:2] == ((43, 58) if i % 2 else (48, 64))
        if variant == "off_centre":
            assert (pixels == photo.pixels[5:, 10:]).all()
        if variant in ("black_background", "plain_ground"):
            mask = photo.mask
            assert (pixels[mask] == photo.pixels[mask]).all()
            assert abs(pixels[~mask].mean() - (0 if variant == "black_background" else hard.GREY)) < 1
    assert make_photos(f"synth_helmet-{variant}", data) == folder  # made once


def test_the_wide_lens_is_one_that_needs_two_radial_terms():
    where = hard.distorted_positions(640, 480) + 0.5
    center, focal = np.array([320, 240]), hard.WIDE_FOCAL * 640
    assert np.abs(where[[0, -1], [0, -1]] - [[0.5, 0.5], [639.5, 479.5]]).max() < 0.6
    assert where.min() > 0
    assert (where.max((0, 1)) < [640, 480]).all()
    pixels = np.stack(np.meshgrid(np.arange(640) + 0.5, np.arange(480) + 0.5), -1)
    out, true = (np.linalg.norm(each - center, axis=-1) for each in (pixels, where))
    far = out > 30
    shrunk, squares = (out / true)[far], (true[far] / focal) ** 2
    one, two = (np.vander(squares, terms + 1, increasing=True) for terms in (1, 2))
    rest = [shrunk - each @ np.linalg.lstsq(each, shrunk, rcond=None)[0] for each in (one, two)]
    assert np.abs(rest[1] * out[far]).max() < 0.02  # pixels
    assert np.abs(rest[0] * out[far]).max() > 1.0


def test_a_row_tells_what_the_workspace_says(data, monkeypatch):
    from stages import artifacts

    def answer(arguments, answers):
        folder = hard.FOLDERS / "synth_helmet-no_exif" / "workspace" / "sfm"
        folder.mkdir(parents=True)
        artifacts.REGISTRATION.save(folder, artifacts.Registration(registered=("000.png",), ladder=(STEP,)))
        return {"ok": True, "stages": [{"name": "sfm", "cpu_s": 3.21}]}

    monkeypatch.setattr(hard, "run_hineus", answer)
    monkeypatch.setattr(hard, "center_error", lambda *_: None)
    row = hard.run_row("synth_helmet-no_exif", data, mesh=False, preset="cpu")
    assert (row.photos, row.registered, row.attempts, row.cpu_s) == (7, 1, (STEP,), 3.2)


def test_a_third_of_the_photos_is_blurred(data):
    folder = make_photos("synth_helmet-blurred", data)
    changed = 0
    for photo in load_photos(data / "synth_helmet"):
        with Image.open(folder / f"{Path(photo.name).stem}.png") as image:
            changed += not np.array_equal(np.asarray(image), photo.pixels)
    assert changed == 2


def test_the_video_shows_every_photo_for_a_while(data):
    import cv2

    (clip,) = make_photos("synth_helmet-video", data).iterdir()
    reader = cv2.VideoCapture(str(clip))
    assert reader.get(cv2.CAP_PROP_FRAME_COUNT) == 7 * hard.VIDEO_HOLD


def test_a_variant_that_needs_masks_says_so(data):
    for mask in (data / "synth_helmet" / "masks").iterdir():
        mask.unlink()
    with pytest.raises(ValueError, match=r"000\.jpg has no mask"):
        make_photos("synth_helmet-plain_ground", data)


def test_rows_are_the_sets_and_the_variants_of_those_that_have_any():
    rows = all_rows(["banana", "synth_plaster"])
    assert rows == ["banana", "synth_plaster", *(f"synth_plaster-{name}" for name in BASES["synth_plaster"])]


def test_center_error_is_in_percent_of_the_extent_whatever_the_frame(data, monkeypatch):
    true = np.random.default_rng(1).normal(0, 2, (7, 3))
    monkeypatch.setattr(hard, "true_centers", lambda folder: (list(true), 4.0))
    turn = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]])
    found = {f"{i:03d}.png": 3 * turn @ center + 5 for i, center in enumerate(true)}
    monkeypatch.setattr(hard, "_found_centers", lambda model: found)
    error = hard.center_error(data, data, "synth_helmet-no_exif")
    assert error == {"median": 0.0, "max": 0.0}
    found["003.png"] = found["003.png"] + [0.3, 0, 0]  # a tenth of the truth's unit
    error = hard.center_error(data, data, "synth_helmet-no_exif")
    assert 1.5 < error["max"] < 2.5
    assert error["median"] < 0.6


def test_every_photo_of_a_variant_is_found_again_among_those_of_its_set(data):
    source = data / "synth_helmet" / "images"
    assert hard.known_stem(source, "rotated")("005.png") == "005"
    of_frame = hard.known_stem(source, "video")
    frames = ["capture.mp4/000000.jpg", "capture.mp4/000009.jpg", "capture.mp4/000010.jpg", "000069.jpg"]
    assert [of_frame(name) for name in frames] == ["000", "000", "001", "006"]


def test_results_survive_their_files_and_failures_stand_under_the_table(data):
    failed = _row("synth_helmet-blurred", registered=0, center_error=None, attempts=(), cpu_s=None,
                  failure={"message": "None of the 47 photos could be registered.", "hint": "Add photos."})  # fmt: skip
    for row in (failed, _row("synth_helmet-no_exif"), _row("viking", center_error=None)):
        hard.save_row(row)
    assert json.loads((data / "rows" / "viking.json").read_text())["code"] == "c"
    rows = load_rows()
    assert [row.name for row in rows] == ["viking", "synth_helmet-no_exif", "synth_helmet-blurred"]
    table = pose_table(rows).splitlines()
    hard.save_row(_row("viking", score={"mean": 0.5}, mesh_preset="cpu", mesh_settings=("train.steps=9",)))
    (again,) = (row for row in load_rows() if row.name == "viking")
    assert again.mesh_settings == ("train.steps=9",)
    assert "| 0.50 (cpu train.steps=9) |" in pose_table([again])
    assert table[2] == "| viking | 47 of 47 | - | - | **exhaustive matching 15** | 31 | - |"
    assert table[3] == "| synth helmet: no exif | 47 of 47 | 0.13 | 0.85 | **exhaustive matching 15** | 31 | - |"
    assert table[4] == "| synth helmet: blurred | 0 of 47 | - | - | - | - | - |"
    assert table[-1] == "- synth_helmet-blurred: None of the 47 photos could be registered. Add photos."
