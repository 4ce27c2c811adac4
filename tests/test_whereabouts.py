"""Where results lie by default, and what is done about photos that were moved, are gone, or are others."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path
from typing import Any

import pytest
from toy_pipeline import with_stage
from typer.testing import CliRunner, Result

from configs.load import load_config
from hineus_cli.app import build_app
from stages import reconstruct, whereabouts
from stages.artifacts import SkippedImage
from stages.capture.listing import list_captures
from stages.engine.fingerprint import SourceDigests
from stages.engine.runner import naming_command
from stages.engine.workspace import Workspace
from stages.posing.control_files import CONTROL

POSED = with_stage("sfm", sources=("poses",))  # a pipeline that reads poses, too


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current folder, with photos of two scenes in `a/images` and `b/images`, on a machine without a GPU."""
    for scene in "ab":
        make_photos(tmp_path / scene / "images", scene)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(reconstruct, "has_cuda", lambda: False)
    return tmp_path


def make_photos(folder: Path, scene: str, count: int = 4) -> None:
    folder.mkdir(parents=True)
    for index in range(count):
        (folder / f"{index}.jpg").write_text(f"II*\0{index} of {scene}")  # a TIFF, by its beginning


def hineus(*arguments: str) -> Result:
    return CliRunner().invoke(build_app(POSED), arguments)


def run(*arguments: str) -> dict[str, Any]:
    result = hineus("run", *arguments, "--json")
    assert result.exit_code == 0, result.output
    return {**json.loads(result.stdout), "said": result.stderr}


def folder_of(*arguments: str) -> Path:
    return Path(run(*arguments)["workspace"])


def actions(answer: dict[str, Any]) -> set[str]:
    return {stage["action"] for stage in answer["stages"]}


def refuse_to_write(monkeypatch: pytest.MonkeyPatch, *folders: Path) -> None:
    """As a read-only disk; the tests may be run by root, whom permissions do not hold."""
    allowed = os.access
    monkeypatch.setattr(whereabouts.os, "access", lambda path, mode: Path(path) not in folders and allowed(path, mode))


# ---------------------------------------------------------------- the default workspace
def test_two_folders_of_one_name_have_two_workspaces(folder: Path) -> None:
    assert folder_of("a/images") == folder / "a/images_hineus"
    assert folder_of("b/images") == folder / "b/images_hineus"
    assert actions(run("a/images")) == {"skipped"}


@pytest.mark.parametrize("named", [".", "../images", "./", "../images/", "../../a/./images"])
def test_however_the_folder_is_named(folder: Path, named: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder / "a/images")
    assert folder_of(named) == folder / "a/images_hineus"


def test_beside_a_link_unless_the_photos_have_one_already(folder: Path) -> None:
    (folder / "one").symlink_to("a/images")
    assert folder_of("one") == folder / "one_hineus"
    folder_of("a/images")
    (folder / "two").symlink_to("a/images")
    answer = run("two")
    assert answer["workspace"] == str(folder / "a/images_hineus")
    assert f"workspace: {folder}/a/images_hineus (these photos were reconstructed there before)" in answer["said"]


def test_a_link_s_parent_is_the_system_s(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (folder / "link").symlink_to("a/images")
    assert whereabouts.default_workspace(Path("link/..")).folder == Path(f"{folder}/a_hineus")


def test_beside_a_video(folder: Path) -> None:
    (folder / "clip.mp4").write_text("video")
    (folder / "night.mov").mkdir()
    assert whereabouts.default_workspace(Path("clip.mp4")).folder == folder / "clip_hineus"
    assert whereabouts.default_workspace(Path("night.mov")).folder == folder / "night.mov_hineus"


def test_here_with_a_telling_name_where_photos_cannot_be_written_beside(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    refuse_to_write(monkeypatch, folder / "a", folder / "b")
    answer = run("a/images")
    assert answer["workspace"] == str(folder / "a_images_hineus")
    assert f"({folder}/a cannot be written)" in answer["said"]
    assert folder_of("b/images") == folder / "b_images_hineus"
    assert actions(run("a/images")) == {"skipped"}


def test_the_old_default_is_found_and_said(folder: Path) -> None:
    run("a/images", "-w", "images_hineus")
    answer = run("a/images")
    assert answer["workspace"] == str(folder / "images_hineus")
    assert actions(answer) == {"skipped"}
    assert "these photos were reconstructed there before" in answer["said"]
    assert folder_of("b/images") == folder / "b/images_hineus"


def test_workspaces_beside_photos_are_no_photos_of_the_folder_above(folder: Path) -> None:
    run("a/images")
    (folder / "a/images_hineus/ingest/picture.jpg").write_text("not a photo")
    photos, _, skipped = list_captures(folder / "a")
    assert list(photos) == [f"images/{index}.jpg" for index in range(4)]
    assert skipped == [SkippedImage("images_hineus", "a workspace of hineus", expected=True)]
    assert list(SourceDigests({"photos": folder / "a"}).files("photos") or {}) == list(photos)


def test_the_photos_folder_is_no_workspace_but_has_one(folder: Path) -> None:
    run("a/images")
    result = hineus("status", "a/images")
    assert (result.exit_code, f"That of the photos in it is {folder}/a/images_hineus." in result.stderr) == (5, True)


# ---------------------------------------------------------------- other photos
def test_a_workspace_of_other_photos_is_refused_unless_told(folder: Path) -> None:
    run("a/images", "-w", "ws", "--masks", "a")
    model = folder / "ws/export/manifest.json"
    made = model.read_bytes()
    refused = hineus("run", "b/images", "-w", "ws")
    assert refused.exit_code == 5
    assert f"made of other photos: 0 of its 4 files, from {folder}/a/images, are among the 4 in" in refused.stderr
    assert f"`--workspace {folder}/b/images_hineus`" in refused.stderr
    assert model.read_bytes() == made
    assert Workspace.open(folder / "ws").record.sources["photos"] == f"{folder}/a/images"

    told = run("b/images", "-w", "ws", "--other-photos")
    assert "photo" in told["stages"][0]["reason"]
    assert f"the masks of the last run, {folder}/a, are not used" in told["said"]
    assert f"`--masks {folder}/a`" in told["said"]
    assert Workspace.open(folder / "ws").record.sources["masks"] is None
    assert actions(run("-w", "ws")) == {"skipped"}


def test_check_names_a_workspace_of_other_photos(folder: Path) -> None:
    run("a/images", "-w", "ws")
    result = hineus("check", "b/images", "-w", "ws")
    assert "made of other photos: 0 of its 4 files" in " ".join(result.stdout.split())
    assert "other photos" not in hineus("check", "a/images", "-w", "ws").stdout


def test_photos_that_took_the_place_of_others_are_refused(folder: Path) -> None:
    run("a/images")
    shutil.rmtree(folder / "a/images")
    make_photos(folder / "a/images", "another day", 9)
    for path in list((folder / "a/images").iterdir()):
        path.rename(path.with_name(f"new {path.name}"))
    assert hineus("run", "a/images").exit_code == 5


def test_photos_added_removed_and_edited_are_no_others(folder: Path) -> None:
    run("a/images")
    (folder / "a/images/9.jpg").write_text("9 more")
    (folder / "a/images/0.jpg").unlink()
    (folder / "a/images/1.jpg").write_text("1 edited")
    assert run("a/images")["stages"][0]["reason"] == "photo 1.jpg changed; photo 9.jpg added; photo 0.jpg removed"


def test_a_workspace_in_which_nothing_was_finished_is_free(folder: Path) -> None:
    run("a/images", "-w", "ws")
    shutil.rmtree(folder / "ws/ingest")
    run("b/images", "-w", "ws")


# ---------------------------------------------------------------- moved
@pytest.fixture
def masked(folder: Path) -> Path:
    """As `folder`, and a workspace `ws` made of a/images with masks and poses."""
    for name in ("masks", "poses"):
        (folder / "a" / name).mkdir()
    (folder / "a/masks/0.png").write_text("m")
    (folder / "a/poses/transforms.json").write_text("{}")
    run("a/images", "-w", "a/ws", "--masks", "a/masks", "--poses", "a/poses")
    return folder


def sources(workspace: Path) -> dict[str, str | None]:
    return dict(Workspace.open(workspace).record.sources)


def test_photos_moved_with_the_same_workspace_keep_masks_and_poses(masked: Path) -> None:
    """Case 21."""
    before = sources(masked / "a/ws")
    shutil.copytree(masked / "a/images", masked / "copy")
    answer = run("copy", "-w", "a/ws")
    assert actions(answer) == {"skipped"}
    assert f"photos: {masked}/copy (those of the last run were {masked}/a/images)" in answer["said"]
    assert sources(masked / "a/ws") == {**before, "photos": f"{masked}/copy"}


def test_photos_masks_and_poses_moved_together(masked: Path) -> None:
    (masked / "new").mkdir()
    for name in ("images", "masks", "poses"):
        (masked / "a" / name).rename(masked / "new" / name)
    answer = run("new/images", "-w", "a/ws")
    assert actions(answer) == {"skipped"}
    assert f"masks: {masked}/new/masks (those of the last run were {masked}/a/masks)" in answer["said"]
    assert sources(masked / "a/ws")["poses"] == f"{masked}/new/poses/transforms.json"


def test_everything_moved_together(masked: Path) -> None:
    (masked / "a").rename(masked / "elsewhere")
    answer = run("-w", "elsewhere/ws")
    assert {stage["action"] for stage in answer["stages"]} == {"skipped"}
    given = {name: path for name, path in sources(masked / "elsewhere/ws").items() if path}
    assert given == {
        "photos": f"{masked}/elsewhere/images",
        "masks": f"{masked}/elsewhere/masks",
        "poses": f"{masked}/elsewhere/poses/transforms.json",
    }
    assert "are no longer" not in answer["said"]
    (masked / "elsewhere").rename(masked / "again")
    assert actions(run("again/images", "-w", "again/ws")) == {"skipped"}
    assert sources(masked / "again/ws")["masks"] == f"{masked}/again/masks"


def test_the_workspace_moved_alone(masked: Path) -> None:
    (masked / "a/ws").rename(masked / "b/ws")
    before = sources(masked / "b/ws")
    assert actions(run("-w", "b/ws")) == {"skipped"}
    assert sources(masked / "b/ws") == before


def test_masks_that_stayed_behind_and_are_gone_are_told(masked: Path) -> None:
    shutil.rmtree(masked / "a/masks")
    answer = run("-w", "a/ws")
    assert actions(answer) == {"skipped"}
    assert f"The masks are no longer at {masked}/a/masks." in answer["said"]
    assert f"`hineus run --masks PATH --workspace {masked}/a/ws`" in answer["said"]
    refused = hineus("run", "-w", "a/ws", "--force", "ingest")
    assert refused.exit_code == 3
    assert "`hineus run --masks PATH --workspace" in refused.stderr


@pytest.mark.parametrize("emptied", [False, True], ids=["gone", "unmounted"])
def test_without_its_photos_a_workspace_still_runs(masked: Path, emptied: bool) -> None:
    shutil.rmtree(masked / "a/images")
    if emptied:
        (masked / "a/images").mkdir()
    for arguments in (["-w", "a/ws"], ["a/images", "-w", "a/ws"]):
        answer = run(*arguments, "--force", "undistort")
        assert [stage["action"] for stage in answer["stages"][:3]] == ["skipped", "skipped", "ran"]
        assert f"The photos are no longer at {masked}/a/images." in answer["said"]
    if not emptied:  # then it is for ingest to say that there are no photos
        assert hineus("run", "-w", "a/ws", "--force", "ingest").exit_code == 3
    assert actions(run("-w", "a/ws")) == {"skipped"}
    assert hineus("run", "a/nowhere", "-w", "a/ws").exit_code == 3


def test_records_of_older_versions_have_no_place(masked: Path) -> None:
    record = masked / "a/ws/workspace.json"
    data = json.loads(record.read_text())
    del data["root"]
    record.write_text(json.dumps(data))
    assert actions(run("-w", "a/ws")) == {"skipped"}
    assert json.loads(record.read_text())["root"] == f"{masked}/a/ws"


def test_the_option_of_every_source() -> None:
    root = Path("/my ws")
    assert naming_command("photos", root) == "hineus run PHOTOS --workspace '/my ws'"
    assert naming_command(CONTROL, root) == "hineus run --control PATH --workspace '/my ws'"
    assert naming_command("poses", root) == "hineus run --poses PATH --workspace '/my ws'"


def test_masks_that_follow_a_moved_workspace_later_are_found(masked: Path) -> None:
    """The workspace goes first and is run there, photos and masks come after it to the places beside it."""
    (masked / "later").mkdir()
    (masked / "a/ws").rename(masked / "later/ws")
    for name in ("images", "masks", "poses"):
        (masked / "a" / name).rename(masked / f"away-{name}")
    run("-w", "later/ws")
    for name in ("images", "masks", "poses"):
        (masked / f"away-{name}").rename(masked / "later" / name)
    assert actions(run("-w", "later/ws")) == {"skipped"}
    assert sources(masked / "later/ws")["masks"] == f"{masked}/later/masks"


def test_photos_moved_with_a_new_preset_keep_what_black_means(masked: Path) -> None:
    run("a/images", "-w", "a/ws", "--masks-black-keeps")
    shutil.copytree(masked / "a/images", masked / "copy")
    run("copy", "-w", "a/ws", "--preset", "tiny")
    assert load_config(None, masked / "a/ws/config.yaml").ingest.masks_keep == "black"


def test_nothing_of_other_photos_is_taken_over(masked: Path) -> None:
    shutil.rmtree(masked / "a/images")
    make_photos(masked / "a/images", "another scene", 5)
    for path in (masked / "a/images").iterdir():
        path.rename(path.with_stem(f"new_{path.stem}"))
    run("a/images", "-w", "a/ws", "--other-photos")
    assert sources(masked / "a/ws")["masks"] is None
