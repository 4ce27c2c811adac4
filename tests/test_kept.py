"""Photos that come or go in a workspace: what a run says it keeps, and that it does."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from printed_box import render
from rigs import look_at

from stages.pipeline import PIPELINE
from stages.reconstruct import Reconstruction, check_photos, reconstruct
from stages.request import Request

COARSE = (
    "train.steps=40", "sfm.deterministic=true", "sfm.wanted=0.9", "train.sampling.rays=64", "train.field.log2_rows=10",
    "train.field.finest=64", "train.field.levels=4", "undistort.max_side=160", "train.steps_if_covered=1",
)  # fmt: skip


def write_photo(folder: Path, index: int, name: str | None = None) -> None:
    angle = np.radians(12 * index)
    center = np.array([2.6 * np.cos(angle), 2.6 * np.sin(angle), 1.5 + 0.3 * (index % 2)])
    folder.mkdir(exist_ok=True)
    cv2.imwrite(str(folder / (name or f"{index}.png")), render(look_at(center, np.array([0, 0, 0.35])), index))


def numbers(result: Reconstruction) -> dict[str, Any]:
    """Of the stages that ran."""
    return {outcome.name: outcome.numbers for outcome in result.outcomes if outcome.action == "ran"}


@pytest.mark.slow
def test_photos_that_came_and_went_are_told_and_the_rest_is_kept(tmp_path: Path, caplog: pytest.LogCaptureFixture):
    photos, workspace = tmp_path / "photos", tmp_path / "workspace"
    for index in range(8):
        write_photo(photos, index)
    request = Request(photos, workspace, preset="tiny", sets=COARSE, until="train", device="cpu")

    def run(**options: Any) -> dict[str, Any]:
        caplog.clear()
        with caplog.at_level(logging.INFO):
            return numbers(reconstruct(Request(photos, workspace, until="train", device="cpu", **options), PIPELINE))

    assert "kept_of_budget" not in numbers(reconstruct(request, PIPELINE))["train"]
    assert check_photos(request).kept == ""

    write_photo(photos, 8)
    (photos / "0.png").unlink()
    (photos / "1.png").rename(photos / "one.png")
    (photos / "notes.txt").write_text("none of these")
    (photos / "copy.png").write_bytes((photos / "2.png").read_bytes())
    said = "7 photos known, 1 new, 1 gone: the poses of 7 stay, training goes on from what it has learned"
    # of eight photos two are a quarter
    assert check_photos(request).kept == said
    other = Request(photos, workspace, preset="tiny", sets=(*COARSE, "train.steps=41"), device="cpu")
    assert check_photos(other).kept == said.replace("goes on from what it has learned", "starts anew")
    # a run that was stopped when it had taken the photos in says what it keeps, too
    reconstruct(Request(photos, workspace, until="ingest", device="cpu"), PIPELINE)
    assert check_photos(request).kept == said
    made = run()
    assert said in caplog.text
    assert made["sfm"]["poses_stayed"]
    assert (made["sfm"]["known"], made["sfm"]["new"], made["sfm"]["gone"]) == (7, 1, 1)
    assert made["undistort"]["region_kept"] in (True, False)
    assert "densify" in made
    assert made["train"]["kept_of_budget"] in (0.7, 0.2)
    assert made["train"]["steps_in_all"] == 40 + round(40 * (1 - made["train"]["kept_of_budget"]))
    assert made["train"]["photos"] == 8
    assert run() == {}
    assert "known" not in caplog.text

    # what the folder holds beside photos trains nothing
    (photos / "more notes.txt").write_text("none of these either")
    assert "train" not in run()

    # asked for, all is found anew, and nothing goes on from there
    made = run(force=("sfm",))
    assert "known" not in made["sfm"]
    assert "kept_of_budget" not in made["train"]

    write_photo(photos, 9)
    caplog.clear()
    made = run(from_stage="sfm")
    assert "8 photos known, 1 new, 0 gone: poses are found anew from all" in caplog.text
    assert "known" not in made["sfm"]

    for index in range(9):
        (photos / f"{index}.png").unlink(missing_ok=True)
    for index in range(12, 16):
        write_photo(photos, index)
    said = "3 photos known, 4 new, 6 gone: poses are found anew from all, since 3 of them have one"
    assert check_photos(request).kept == said


def test_photos_are_told_by_content_and_masks_are_none(tmp_path: Path):
    photos, workspace = tmp_path / "photos", tmp_path / "workspace"
    for index in range(4):
        write_photo(photos, index)
    (photos / "3.png").rename(photos / "3.photo")
    request = Request(photos, workspace, preset="tiny", until="ingest", device="cpu")
    reconstruct(request, PIPELINE)
    write_photo(photos, 4)
    (photos / "4.png").rename(photos / "4.photo")
    cv2.imwrite(str(photos / "0_mask.png"), np.eye(64, dtype=np.uint8) * 255)
    said = "4 photos known, 1 new, 0 gone: poses are found anew from all"
    assert check_photos(request).kept == said
    (photos / "0.png").unlink()
    (photos / "3.photo").unlink()
    (photos / "0_mask.png").unlink()
    assert "2 photos known, 1 new, 2 gone" in check_photos(request).kept
