"""What `hineus check` foresees is what ingest does: the same photos and masks of the same sources."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from test_masks import COUNT, SIZE, check, ingest, said, scene, white, write_set, write_transforms
from typer.testing import CliRunner

from hineus_cli.app import app
from stages.errors import ConfigError, InputError
from stages.posing.reading import masks_beside


def looked_at(*arguments: str | Path) -> dict[str, object]:
    found: dict[str, object] = json.loads(check(*arguments, "--json").stdout)
    return found


def test_names_left_out_are_no_photos_in_either(tmp_path: Path):
    photos = write_set(tmp_path, "")
    seen = looked_at(photos, "--set", 'ingest.leave_out=["00*"]')
    assert (seen["photos"], seen["verdict"]) == (0, "no-go")
    with pytest.raises(InputError, match="Found 0 usable photos"):
        ingest(photos, leave_out=("00*",))


def test_poses_of_other_photos_are_refused_by_both(tmp_path: Path):
    photos = write_set(tmp_path, "")
    file = write_transforms(tmp_path, lambda i: None)
    file.write_text(file.read_text().replace("photos/", "photos/other"))
    result = check(photos, "--poses", file)
    assert result.exit_code == InputError.exit_code
    assert "None of the 6 photos has a pose" in said(result)


def test_photos_without_a_pose_and_copies_need_no_mask(tmp_path: Path):
    photos = write_set(tmp_path)
    file = write_transforms(tmp_path, lambda i: None)
    Image.fromarray(scene(9)[0]).save(photos / "unposed.jpg")
    seen = looked_at(photos, "--poses", file, "--masks", tmp_path / "masks")
    assert (seen["photos"], seen["refusals"]) == (COUNT, [])
    assert len(ingest(photos, tmp_path / "masks", file).images) == COUNT
    (photos / "unposed.jpg").unlink()
    shutil.copy(photos / "000.jpg", photos / "x copy.jpg")
    seen = looked_at(photos, "--masks", tmp_path / "masks")
    assert (seen["photos"], seen["refusals"]) == (COUNT, [])


@pytest.mark.parametrize("masks", ["masks/{stem}.png", "photos/{stem}_mask.png"])
def test_of_equal_files_the_one_with_a_mask_stays(tmp_path: Path, masks: str):
    photos = write_set(tmp_path, masks)
    shutil.copy(photos / "000.jpg", photos / "000 copy.jpg")  # sorted first
    folder = tmp_path / "masks" if masks.startswith("masks") else None
    image_set = ingest(photos, folder)
    assert all(record.has_mask for record in image_set.images)
    assert {item.source: item.reason for item in image_set.skipped}["000 copy.jpg"] == "same file as 000.jpg"


def panorama(folder: Path, alpha: bool) -> Path:
    """Five 360-degree pictures."""
    photos = folder / "photos"
    photos.mkdir()
    for i in range(5):
        pixels = np.tile(np.random.default_rng(i).integers(0, 255, (128, 4, 3)), (1, 64, 1)).astype(np.uint8)
        cut = np.where(np.arange(256) < 100, 255, 0)[None].repeat(128, 0)[..., None].astype(np.uint8)
        Image.fromarray(np.dstack([pixels, cut]) if alpha else pixels).save(photos / f"P_{i}.png")
    return photos


@pytest.mark.parametrize("kind", ["folder", "beside", "alpha"])
def test_masks_of_360_degree_pictures_are_refused_by_both(tmp_path: Path, kind: str):
    photos = panorama(tmp_path, kind == "alpha")
    folder = {"folder": tmp_path / "masks", "beside": photos}.get(kind)
    for i in range(5) if folder else ():
        folder.mkdir(exist_ok=True)
        white(scene(i)[1]).resize((256, 128)).save(folder / f"P_{i}_mask.png")
    given = ["--masks", folder] if kind == "folder" else []
    split = "ingest.panoramas=split"
    result = check(photos, *given, "--set", split)
    assert result.exit_code == InputError.exit_code
    assert "P_0.png is a 360-degree picture: masks of those cannot be used" in said(result)
    with pytest.raises(InputError, match="is a 360-degree picture: masks of those cannot be used"):
        ingest(photos, folder if given else None, panoramas="split")
    assert "masks of those" not in said(check(photos, "--set", split, "--no-masks"))
    assert len(ingest(photos, panoramas="split", own_masks=False).images) > 5


def test_masks_of_several_cameras_leave_their_photos(tmp_path: Path):
    """The folder that all masks have in common holds the photos."""
    root = tmp_path / "root"
    frames = []
    for i in range(COUNT):
        camera = root / "scene" / f"cam{i % 2}"
        for kind in ("img", "fg"):
            (camera / kind).mkdir(parents=True, exist_ok=True)
        Image.fromarray(scene(i)[0]).save(camera / "img" / f"{i}.jpg")
        white(scene(i)[1]).save(camera / "fg" / f"{i}.png")
        pose = np.eye(4)
        pose[0, 3] = i
        frames.append(
            {
                "file_path": f"scene/cam{i % 2}/img/{i}.jpg",
                "mask_path": f"scene/cam{i % 2}/fg/{i}.png",
                "transform_matrix": pose.tolist(),
            }
        )
    file = root / "transforms.json"
    file.write_text(json.dumps({"fl_x": 150, "w": SIZE[0], "h": SIZE[1], "frames": frames}))
    assert masks_beside(file) == root / "scene"
    image_set = ingest(root, masks_beside(file), file)
    assert [record.has_mask for record in image_set.images] == [True] * COUNT
    assert not [item for item in image_set.skipped if "fg" in item.source]
    seen = looked_at(root, "--poses", file)
    assert (seen["photos"], seen["masks"], seen["refusals"]) == (COUNT, COUNT, [])


def test_check_remembers_what_the_workspace_does(tmp_path: Path):
    photos = write_set(tmp_path, draw=lambda i: white(~scene(i)[1]))
    ran = CliRunner().invoke(
        app, ["ingest", str(photos), "--masks", str(tmp_path / "masks"), "--masks-black-keeps", "--preset", "tiny"]
    )
    assert ran.exit_code == 0, ran.stderr
    result = check(photos)
    assert result.exit_code == 0
    assert "6 are used" in said(result)
    assert "inverted" not in said(result)


def test_masks_and_none_contradict(tmp_path: Path):
    photos = write_set(tmp_path)
    for command in ("check", "ingest"):
        result = CliRunner().invoke(app, [command, str(photos), "--masks", str(tmp_path / "masks"), "--no-masks"])
        assert result.exit_code == ConfigError.exit_code
        assert "Both `--masks` and `--no-masks` are given" in said(result)


def test_masks_that_are_there_or_made_are_not_missed(tmp_path: Path):
    photos = write_set(tmp_path, "photos/{stem}_mask.png")
    assert "there are none" not in said(check(photos, "--set", "sfm.masks=always"))
    (photos / "001_mask.png").unlink()
    assert "training goes without masks" not in said(check(photos, "--set", "ingest.auto_mask=plain"))


def test_an_alpha_channel_keeps_what_is_opaque(tmp_path: Path):
    photos = tmp_path / "photos"
    photos.mkdir()
    for i in range(3):
        pixels, mask = scene(i)
        Image.fromarray(np.dstack([pixels, mask.astype(np.uint8) * 255])).save(photos / f"{i}.png")
    result = check(photos, "--masks-black-keeps")
    assert result.exit_code == 0
    assert "inverted" not in said(result)
    assert len(ingest(photos, masks_keep="black").images) == 3
    kept = np.asarray(Image.open(tmp_path / "out" / "masks" / "0.png.png")) > 127
    assert (kept == scene(0)[1]).all()


def test_the_other_colour_is_the_one_that_was_not_given(tmp_path: Path):
    photos = write_set(tmp_path)
    told = said(check(photos, "--masks", tmp_path / "masks", "--masks-black-keeps"))
    assert "Try the other colour: `--masks-white-keeps`." in told
