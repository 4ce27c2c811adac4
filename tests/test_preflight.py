"""The look before a run: what it notices of the photos, what it says of the machine, with which exit code."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from PIL import Image, ImageFile, ImageFilter
from typer.testing import CliRunner, Result

from configs.load import load_config
from configs.params import IngestParams
from hineus_cli.app import app
from stages import preflight as module
from stages import reconstruct
from stages.capture.colour import ADOBE_RGB, matrix_profile
from stages.capture.inspection import Inspection, Video, inspect
from stages.capture.photo_reading import read_head
from stages.capture.selection import Sources
from stages.errors import InputError
from stages.files.light_files import write_hdr
from stages.preflight import GIB, estimate, preflight

SIZE = (320, 240)


def picture(seed: int, light: float = 1.0) -> Image.Image:
    """Texture of all scales, different for each seed."""
    generator = np.random.default_rng(seed)
    pixels = np.zeros((SIZE[1], SIZE[0], 3))
    for cells in (4, 16, 64):
        noise = generator.normal(0, 40, (cells * 3 // 4, cells, 3))
        pixels += cv2.resize(noise, SIZE, interpolation=cv2.INTER_CUBIC)
    return Image.fromarray(((pixels + 128) * light).clip(0, 255).astype(np.uint8))


@pytest.fixture
def photos(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """24 good photos, on a machine without a GPU and with room."""
    folder = tmp_path / "photos"
    folder.mkdir()
    for i in range(24):
        picture(i).save(folder / f"{i:02d}.jpg")
    monkeypatch.setattr(reconstruct, "has_cuda", lambda: False)
    room(monkeypatch, memory_gib=64, disk_gb=500)
    return folder


def room(monkeypatch: pytest.MonkeyPatch, memory_gib: float, disk_gb: float) -> None:
    monkeypatch.setattr(module, "available_memory", lambda: memory_gib * GIB)
    monkeypatch.setattr(module.shutil, "disk_usage", lambda path: SimpleNamespace(free=disk_gb * 1e9))


def check(*arguments: str) -> Result:
    return CliRunner().invoke(app, ["check", *arguments])


def look(folder: Path) -> Inspection:
    return inspect(
        Sources(folder, None, lambda path, file: file.read_bytes().hex()), IngestParams(), workers=2, decode=True
    )


# ---------------------------------------------------------------- what is noticed
def test_good_photos_are_a_go(photos: Path):
    result = check(str(photos))
    assert result.exit_code == 0
    assert "24 x 320 x 240" in result.stdout
    assert result.stdout.split()[-1] == "go"


def test_blurred_photos_are_named(photos: Path):
    picture(30).filter(ImageFilter.GaussianBlur(2)).save(photos / "shaken.jpg")
    assert look(photos).oddities.blurred == ("shaken.jpg",)


def test_dark_and_light_photos_are_named(photos: Path):
    picture(30, light=0.3).save(photos / "x_dark.jpg")
    picture(31, light=1.1).save(photos / "y_usual.jpg")
    assert look(photos).oddities.badly_exposed == ("x_dark.jpg",)


def test_the_same_picture_twice_is_named_with_its_twin(photos: Path):
    picture(3).save(photos / "again.jpg", quality=60)
    assert look(photos).oddities.alike == (("03.jpg", "again.jpg"),)


def test_exif_and_size_are_those_of_the_upright_photo(photos: Path):
    exif = Image.Exif()
    exif[0x0112], exif[0x0110] = 6, "Phone"
    exif.get_ifd(0x8769)[0xA405] = 28
    large = picture(40).resize((2400, 1800))  # large enough to be decoded smaller
    large.save(photos / "z.jpg", exif=exif)
    seen = read_head(photos / "z.jpg", "z.jpg", 3200)
    assert (seen.width, seen.height) == (1800, 2400)
    assert seen.camera == "Phone | 28 mm equivalent | 1800 x 2400"
    assert seen.has_focal
    assert not read_head(photos / "00.jpg", "00.jpg", 3200).has_focal


def test_damaged_files_are_told_with_the_reason_and_other_files_are_no_warning(photos: Path, capfd):
    (photos / "bad.jpg").write_text("not a picture")
    (photos / "empty.png").touch()
    (photos / "torn.mp4").write_bytes(b"0" * 100)
    (photos / "notes.txt").write_text("hello")
    result = check(str(photos), "--json")
    data = json.loads(result.stdout)
    assert data["verdict"] == "go with warnings"
    assert {item["source"] for item in data["left_out"]} == {"bad.jpg", "empty.png", "torn.mp4", "notes.txt"}
    assert len(data["warnings"]) == 3
    assert data["warnings"][0].startswith("Left out bad.jpg: no image")
    assert data["warnings"][1] == "Left out empty.png: no image, whatever its name says (empty)."
    assert data["warnings"][2].startswith("Left out torn.mp4: cannot be read as a video")
    assert "VIDEOIO" not in capfd.readouterr().err


def test_a_mostly_plain_background_is_named_with_what_masks_it(photos: Path):
    for i in range(14):
        cloth = Image.new("RGB", SIZE, (12, 12, 14))
        cloth.paste(picture(i).resize((120, 120)), (100, 60))
        cloth.save(photos / f"{i:02d}.jpg")
    assert look(photos).plain_share == pytest.approx(14 / 24)
    said = " ".join(check(str(photos)).output.split())
    assert "plain in 58% of the photos: `--set ingest.auto_mask=salient`" in said


def test_a_plain_background_is_noticed(tmp_path: Path):
    for i in range(3):
        cloth = Image.new("RGB", SIZE, (12, 12, 14))
        cloth.paste(picture(i).resize((120, 120)), (100, 60))
        cloth.save(tmp_path / f"{i}.png")
    assert look(tmp_path).plain


def test_what_is_done_to_files_is_said_beforehand(photos: Path):
    wide = matrix_profile("Adobe RGB", ADOBE_RGB, lambda values: values**2.2)
    picture(50).save(photos / "wide.jpg", icc_profile=wide)
    picture(51).save(photos / "broken.jpg", icc_profile=b"nothing")
    picture(52).resize((4000, 3000)).save(photos / "large.jpg")
    picture(53).save(photos / "IMG_1.THM", format="JPEG")
    said = dict(module.facts(preflight({"photos": photos}, photos.parent, load_config("cpu"), "cpu", 2, decode=False)))
    assert said["reduced"] == "1 of 27 to 3200 pixels, by `ingest.max_side`"
    assert said["colours"] == "Adobe RGB (1 photos), converted to sRGB"
    assert said["set aside"] == "IMG_1.THM: the preview of a video"
    data = json.loads(check(str(photos), "--json").stdout)
    assert (data["photos"], data["reduced"], data["colour_profiles"]) == (27, 1, {"Adobe RGB": 1})
    assert "broken.jpg: its colour profile is broken: taken for sRGB." in data["warnings"]
    assert not any("THM" in warning for warning in data["warnings"])


# ---------------------------------------------------------------- verdicts
def test_too_few_photos_are_a_no_go(photos: Path):
    for file in sorted(photos.iterdir())[2:]:
        file.unlink()
    result = check(str(photos))
    assert result.exit_code == 3
    assert "2 usable photos, 3 are needed." in result.stdout


def test_few_photos_are_a_warning(photos: Path):
    for file in sorted(photos.iterdir())[8:]:
        file.unlink()
    result = check(str(photos), "--json")
    assert result.exit_code == 0
    assert json.loads(result.stdout)["verdict"] == "go with warnings"


@pytest.mark.parametrize(("memory", "disk", "word"), [(0.5, 500, "memory"), (64, 0.1, "disk")])
def test_lack_of_room_is_a_no_go(photos: Path, monkeypatch, memory: float, disk: float, word: str):
    room(monkeypatch, memory, disk)
    result = check(str(photos), "--json")
    assert result.exit_code == 6
    data = json.loads(result.stdout)
    assert data["ok"] is False
    assert data["verdict"] == "no-go"
    assert word in data["shortages"][0]


def test_missing_folder(photos: Path):
    result = check(str(photos / "nowhere"))
    assert result.exit_code == 3
    assert "There is no photos folder" in result.stderr


# ---------------------------------------------------------------- what it needs
def test_needs_grow_with_photos_as_measured():
    def of(count: int, side: int, workers: int = 2, **sets: object):
        seen = Inspection((), (Video("clip.mp4", count, side, side),), (), 0)
        config = load_config("cpu", sets=[f"{key}={value}" for key, value in sets.items()])
        return estimate(seen, config, "cpu", workers)

    small = of(47, 554)  # 47 photos of 0.31 megapixels: docs/benchmarks had 1.45 to 1.62 GiB, without stereo 4 minutes
    without = of(47, 554, **{"densify.method": "off"})
    assert without.minutes == pytest.approx(4.0, abs=0.4)
    assert small.minutes == pytest.approx(2.8, abs=0.3)
    assert of(47, 554, **{"densify.neighbors": 8}).minutes > small.minutes
    assert of(47, 554, **{"materials.enabled": True}).minutes == pytest.approx(small.minutes + 0.85, abs=0.2)
    splats = {"splats.enabled": True, "splats.steps": 100}  # 95 CPU seconds, of which two cores share four fifths
    assert of(47, 554, **splats).minutes == pytest.approx(small.minutes + 0.95, abs=0.2)
    assert small.disk_gb > without.disk_gb
    # one core takes 1.5 to 1.8 times as long, and no number of cores does it in no time
    assert 1.5 < of(47, 554, workers=1).minutes / small.minutes < 1.8
    assert 1.0 < of(47, 554, workers=64).minutes < of(47, 554, workers=8).minutes < small.minutes
    assert small.memory_gib == pytest.approx(1.55, abs=0.1)
    # past undistort.max_side a photo takes no more memory; 200 photos of 1600 x 1600 are 1.43 GiB
    plain = {"densify.method": "off"}
    most = of(200, 4000, **plain).memory_gib
    assert most == pytest.approx(of(200, 1600, **plain).memory_gib) == pytest.approx(1.1 + 1.43, abs=0.01)
    # past densify.side stereo takes no more: 200 megapixels and their maps
    for side in (1200, 4000):
        assert of(200, side).memory_gib == pytest.approx(0.5 + 200 * 0.021, abs=0.01)
    assert of(47, 1600, workers=16).memory_gib > of(47, 1600).memory_gib  # each thread looks for features
    # pairs to match grow with the photos, and with their square only where all are asked for
    fixed = {"train.minutes": 1, "densify.method": "off"}
    (six, twelve), (all_six, all_twelve) = (
        [
            of(count, 300, **fixed, **{"sfm.matcher": matcher}).minutes - of(1, 300, **fixed).minutes
            for count in (60, 120)
        ]
        for matcher in ("auto", "exhaustive")
    )
    assert twelve == pytest.approx(2 * six, rel=0.05)
    assert all_twelve - twelve > 3 * (all_six - six) > 0
    assert of(8, 300, **fixed).minutes == of(8, 300, **fixed, **{"sfm.matcher": "exhaustive"}).minutes
    assert of(47, 554, **{"train.minutes": 20}).minutes == pytest.approx(21.0, abs=0.5)


def test_poses_alone_need_nothing_of_learning(photos: Path):
    sizes = tuple((1600, 1200) for _ in range(400))
    seen = Inspection((), (Video("clip.mp4", 400, 1600, 1200),), (), 0)
    config = load_config("cpu")
    poses, all_of_it = (estimate(seen, config, "cpu", 1, only_poses=only) for only in (True, False))
    assert poses.memory_gib == pytest.approx(0.25 + 0.25 * 1.92, abs=0.01)  # one photo at a time
    assert all_of_it.memory_gib > module.photos_held(sizes, config, all_of_it.memory_gib) / 400 * 3 > 0
    assert poses.minutes < all_of_it.minutes
    assert poses.disk_gb < all_of_it.disk_gb


def test_more_photos_than_a_process_holds_are_sent_to_blocks(photos: Path, monkeypatch: pytest.MonkeyPatch):
    for base in ("MEMORY_BASE_GIB", "TRAIN_BASE_GIB", "SFM_BASE_GIB"):
        monkeypatch.setattr(module, base, 0.001)  # so that these small photos matter
    sets = ("--set", "densify.method=off", "--set", "sfm.max_image_size=100")
    many = 24 * 3 * 320 * 240 / GIB

    def said(gib: float) -> str:
        room(monkeypatch, memory_gib=gib, disk_gb=500)
        return " ".join(check(str(photos), *sets).output.split())

    assert "`--blocks auto` makes them in parts" in said(many)
    assert "It may take" in said(0.3 * many)
    assert "--blocks" not in said(0.3 * many)  # no block would have photos enough
    assert "no-go" not in said(2 * many)


def test_nothing_is_said_of_the_time_on_a_gpu(photos: Path):
    done = preflight({"photos": photos}, photos.parent, load_config("gpu"), "cuda", 2, decode=False)
    assert done.needs.minutes is None
    assert "not measured" in dict(module.facts(done))["needs"]


def test_a_run_begins_with_it_in_short(photos: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(photos.parent)
    picture(30).filter(ImageFilter.GaussianBlur(2)).save(photos / "shaken.jpg")
    result = CliRunner().invoke(app, ["run", "photos", "--until", "ingest"])
    assert result.exit_code == 0
    lines = result.stderr.splitlines()
    assert "25 photos, 1 camera; about" in lines[0]
    assert any("Far less sharp than the others: shaken.jpg" in line for line in lines)
    again = CliRunner().invoke(app, ["run", "photos", "--until", "ingest"])
    assert "25 photos, 1 camera" not in again.stderr
    shutil.rmtree(photos.parent / "photos_hineus")


def test_a_run_decodes_each_photo_once(photos: Path, monkeypatch: pytest.MonkeyPatch):
    picture(30).save(photos / "z.png")
    monkeypatch.chdir(photos.parent)
    decoded: list[str] = []
    load = ImageFile.ImageFile.load

    def counted(image: ImageFile.ImageFile):
        if image.tile:  # what is still to be decoded
            decoded.append(Path(image.filename).name)
        return load(image)

    monkeypatch.setattr(ImageFile.ImageFile, "load", counted)
    assert CliRunner().invoke(app, ["run", "photos", "--until", "ingest"]).exit_code == 0
    assert sorted(decoded) == sorted(file.name for file in photos.iterdir())


# ---------------------------------------------------------------- GPS and control points
def located(folder: Path, positions: dict[int, tuple[float, float, float | None]]) -> None:
    """These photos carry a GPS position; `positions`: number of the photo -> latitude, longitude, altitude."""
    for i, (latitude, longitude, altitude) in positions.items():
        exif = Image.Exif()
        exif[0x0110] = "Drone"
        tags = exif.get_ifd(0x8825)
        tags[1], tags[2] = "S" if latitude < 0 else "N", (abs(latitude), 0.0, 0.0)
        tags[3], tags[4] = "W" if longitude < 0 else "E", (abs(longitude), 0.0, 0.0)
        if altitude is not None:
            tags[5], tags[6] = b"\0", altitude
        picture(i).save(folder / f"{i:02d}.jpg", exif=exif)


def warned(folder: Path, *more: str) -> str:
    return " ".join(json.loads(check(str(folder), "--json", *more).stdout)["warnings"])


def test_good_positions_are_counted(photos: Path):
    # across the 180th meridian
    located(photos, {i: (-17 + i / 1e5, (180 - i / 1e5) * (-1) ** i, 5.0) for i in range(24)})
    result = check(str(photos))
    assert "a position in 24 of 24 photos" in result.stdout
    assert result.stdout.split()[-1] == "go"


def test_positions_that_cannot_be_are_named(photos: Path):
    good = {i: (47.0, 8 + i / 1e5, 400.0) for i in range(24)}
    located(photos, good | {3: (47.0, 8.0, None), 5: (0.0, 0.0, 0.0), 7: (47.0, 200.0, 1.0), 9: (56.0, 8.0, 400.0)})
    text = warned(photos)
    assert "GPS is not used of 03.jpg: it has no altitude." in text
    assert "GPS is not used of 05.jpg: it says 0, 0, as cameras do without a fix." in text
    assert "GPS is not used of 07.jpg: its latitude or longitude is beyond 90 or 180 degrees." in text
    assert "GPS puts 09.jpg 1,000 km from the other photos" in text
    assert warned(photos, "--set", "place.gps=false") == ""


def test_altitudes_of_0_among_others_are_named(photos: Path):
    located(photos, {i: (47 + i / 1e5, 8.0, 0.0 if i in (3, 8) else 400.0) for i in range(24)})
    assert "GPS has 03.jpg, 08.jpg at an altitude of 0, the other photos at about 400 m" in warned(photos)


def test_photos_of_one_position_tell_no_scale(photos: Path):
    located(photos, {i: (47.0, 8.0, 400.0) for i in range(24)})
    assert "All 24 photos carry the same GPS position" in warned(photos)


def gcp(folder: Path, rows: list[str], head: str = "name,x,y,z,photo,px,py") -> str:
    file = folder.parent / "gcp.csv"
    file.write_text("\n".join([head, *rows]))
    return str(file)


@pytest.mark.parametrize(
    ("points", "verdict", "text"),
    [
        ("ABC", "go", ""),
        ("AB", "go with warnings", "2 of 2 control points are marked in two photos or more: they tell the scale"),
        ("A", "no-go", "1 of 1 control points are marked in two photos or more, 2 are needed for the scale"),
    ],
)
def test_control_points_are_counted(photos: Path, points: str, verdict: str, text: str):
    rows = [f"{name},{ord(name)},{ord(name) ** 2},3,{photo}.jpg,10,20" for name in points for photo in ("00", "05")]
    data = json.loads(check(str(photos), "--json", "--control", gcp(photos, rows)).stdout)
    assert data["verdict"] == verdict
    assert text in " ".join(data["warnings"] + data["refusals"])


@pytest.mark.parametrize(
    ("row", "text"),
    [
        ("A,1,2,3,IMG_1.jpg,10,20", "photos are called e.g. 00.jpg"),
        ("A,1,2,3,00.jpg,400,20", "A is marked at 400 20 in 00.jpg, which has 320 x 240 pixels"),
        ("A;1,5;2;3;00.jpg;10;20", "1,5 has a decimal comma"),
    ],
)
def test_control_points_that_cannot_be_used_are_refused_before_a_run(photos: Path, tmp_path: Path, row: str, text: str):
    file = gcp(photos, [row], "name;x;y;z;photo;px;py" if ";" in row else "name,x,y,z,photo,px,py")
    for command in (["check"], ["run", "--workspace", str(tmp_path / "ws")]):
        result = CliRunner().invoke(app, [*command, str(photos), "--control", file, "--preset", "tiny"])
        assert result.exit_code == InputError.exit_code
        assert text in " ".join(result.output.split())


@pytest.mark.parametrize(("rows", "columns", "value", "text"), [(4, 4, 1, "twice as wide"), (4, 8, 0, "is black")])
def test_a_light_that_cannot_be_used_is_refused_before_a_run(
    photos: Path, tmp_path: Path, rows: int, columns: int, value: float, text: str
):
    write_hdr(tmp_path / "studio.hdr", np.full((rows, columns, 3), value))
    for command in (["check"], ["run", "--workspace", str(tmp_path / "ws")]):
        light = str(tmp_path / "studio.hdr")
        result = CliRunner().invoke(app, [*command, str(photos), "--light", light, "--preset", "tiny"])
        assert result.exit_code == InputError.exit_code
        assert text in " ".join(result.output.split())


def test_balls_that_cannot_be_used_are_refused_before_a_run(photos: Path, tmp_path: Path):
    for command in (["check"], ["run", "--workspace", str(tmp_path / "ws")]):
        result = CliRunner().invoke(
            app, [*command, str(photos), "--ball", "chrome:00.jpg:300,20,50", "--preset", "tiny"]
        )
        assert result.exit_code == InputError.exit_code
        said = " ".join(result.output.split())
        assert "50 pixels around 300 20, reaches out of 00.jpg, which has 320 x 240 pixels" in said
    good = json.loads(check(str(photos), "--json", "--ball", "chrome:00.jpg:160,120,50").stdout)
    assert good["verdict"] == "go"


def test_a_list_of_control_points_among_the_photos_is_noticed(photos: Path):
    (photos / "gcp_list.txt").write_text("EPSG:32632\n")
    assert f"which are used with `--control {photos / 'gcp_list.txt'}`" in warned(photos)
