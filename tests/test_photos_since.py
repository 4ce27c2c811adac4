"""Whether photos are those a workspace was made of: same, moved, changed or other."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from toy_pipeline import TOY

from configs.params import Config
from stages.engine import status
from stages.engine.fingerprint import SourceDigests
from stages.engine.photos_since import compare_photos
from stages.engine.runner import run_pipeline
from stages.engine.status import previous_to_continue
from stages.engine.workspace import Workspace
from stages.whereabouts import photos_since

BEFORE = {"1.jpg": "a", "2.jpg": "b", "3.jpg": "c", "4.jpg": "d"}


@pytest.mark.parametrize(
    ("now", "same_folder", "kind"),
    [
        (BEFORE, True, "same"),
        (BEFORE, False, "moved"),
        ({f"left/{path}": sha for path, sha in BEFORE.items()}, True, "moved"),
        ({**BEFORE, "5.jpg": "e"}, True, "changed"),
        ({**BEFORE, "5.jpg": "e"}, False, "changed"),
        ({**BEFORE, **{f"{i}.jpg": f"new {i}" for i in range(5, 99)}}, False, "changed"),
        ({"1.jpg": "a"}, False, "changed"),
        ({"1.jpg": "a", "x.jpg": "x", "y.jpg": "y"}, False, "other"),
        ({"1.jpg": "a", "x.jpg": "x", "y.jpg": "y"}, True, "changed"),
        ({path: "edited " + sha for path, sha in BEFORE.items()}, True, "changed"),  # exported again
        ({path: "edited " + sha for path, sha in BEFORE.items()}, False, "other"),  # 1.jpg of another camera
        ({"9.jpg": "x"}, True, "other"),
        ({}, False, "changed"),  # all gone: that is for ingest to tell
    ],
)
def test_kind(now: dict[str, str], same_folder: bool, kind: str) -> None:
    assert compare_photos(BEFORE, now, same_folder).kind == kind


def test_what_was_kept_added_and_removed() -> None:
    since = compare_photos(BEFORE, {"2.jpg": "b", "one.jpg": "a", "3.jpg": "c2", "5.jpg": "e"}, same_folder=True)
    assert since.kept == {"2.jpg": "2.jpg", "1.jpg": "one.jpg"}
    assert since.added == ("3.jpg", "5.jpg")
    assert since.removed == ("3.jpg", "4.jpg")


def test_copies_are_counted_once_each() -> None:
    assert compare_photos({"1": "a", "2": "a"}, {"3": "a", "2": "a"}, True).kept == {"2": "2", "1": "3"}
    assert compare_photos({"1": "a", "2": "a"}, {"2": "a"}, True).removed == ("1",)


def test_of_a_workspace(tmp_path: Path) -> None:
    for name in ("photos", "others"):
        (tmp_path / name).mkdir()
        for index in range(3):
            (tmp_path / name / f"{index}.jpg").write_text(f"{index} of {name}")
    workspace = Workspace.open(tmp_path / "ws", create=True)

    def since(name: str) -> str:
        folder = tmp_path / name
        return photos_since(workspace, folder, SourceDigests({"photos": folder}).files("photos") or {}).kind

    assert since("photos") == "new"
    run_pipeline(TOY, workspace, Config(), {"photos": tmp_path / "photos", "masks": None})
    assert since("photos") == "same"
    assert since("others") == "other"
    (tmp_path / "photos").rename(tmp_path / "elsewhere")
    assert since("elsewhere") == "moved"
    (workspace.stage_folder("ingest") / "manifest.json").write_text("{")
    assert since("others") == "new"


def test_outputs_are_read_back_of_stages_that_go_on_only(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "1.jpg").write_text("one")
    workspace = Workspace.open(tmp_path / "ws", create=True)
    run_pipeline(TOY, workspace, Config(), {"photos": tmp_path / "photos"})
    read: list[int | None] = []
    monkeypatch.setattr(status, "output_problem", lambda folder, manifest, most: read.append(most))
    assert not TOY[1].continues
    assert previous_to_continue(TOY[1], workspace, Config()) is None
    assert read == []
    goes_on = replace(TOY[1], continues=True)
    assert previous_to_continue(goes_on, workspace, Config()) is not None
    assert previous_to_continue(goes_on, workspace, Config(), hashes=False) is not None
    assert read == [None, status.CHEAP_BYTES]
