"""The benchmarks' pages and tables, the runner's set discovery: on made-up results, and the pages as they are."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from benchmarks import pages, run_sets, what_to_expect
from benchmarks.pages import NOT_MEASURED, all_tables, read_pages, with_tables, write_tables
from benchmarks.run_sets import (
    Result,
    StageCost,
    find_sets,
    load_results,
    result_path,
    save_result,
    tables_of,
)


def _result(name="banana", score=None):
    stages = (
        StageCost("sfm", 60.0, 90.0, 1 << 30, {"registered": 15, "images": 16}),
        StageCost("train", 180.0, 350.0, 3 << 30, {}),
        StageCost("cleanup", 6.0, 6.0, 1 << 30, {"faces": 99_000}),
        StageCost("bake", 10.0, 18.0, 1 << 30, {"seen": 0.91, "note": "text"}),
    )
    validator = {"errors": 0, "warnings": 1, "infos": 2, "hints": 0}
    return Result(name, f"hineus run DATA/{name}/images", {"cpu": "x"}, stages, score, validator, 5_250_000)


SCORE = {"mean": 0.655, "accuracy": 0.5, "completeness": 0.81, "f_one_percent": 84.0, "normals_deg": 12.34}


def test_summary_adds_up_the_stages():
    assert _result().wall_s == 256
    assert _result().peak_rss == 3 << 30
    table = run_sets.summary_table([_result(score=SCORE)])
    row = [cell.strip() for cell in table.splitlines()[2].strip("|").split("|")]
    assert row == ["banana", "1", "15 of 16", "4.3", "7.7", "3.00", "99000", "5.2",
                   "0.66", "0.50", "0.81", "84.00", "12.34", "0 / 1"]  # fmt: skip


def test_seeds_share_a_row_with_their_spread_and_the_other_tables_have_the_first(tmp_path):
    from dataclasses import replace

    worse = {**SCORE, "mean": 0.765, "accuracy": 0.7}
    runs = [_result(score=SCORE), replace(_result(score=worse), seed=1)]
    row = [cell.strip() for cell in run_sets.summary_table(runs).splitlines()[2].strip("|").split("|")]
    assert (row[1], row[8], row[9]) == ("2", "0.71 (0.66 to 0.77)", "0.60")
    assert "| stage | banana |\n" in tables_of(runs)["stages"]
    paths = [run_sets.result_path("banana", tmp_path, seed).name for seed in (0, 1)]
    assert paths == ["banana.json", "banana-seed1.json"]


def test_sets_without_truth_or_validator_get_a_dash():
    result = _result()
    assert run_sets.summary_table([result]).splitlines()[2].count(" - ") == 5


def test_stage_table_has_a_column_for_each_set():
    table = run_sets.stage_table([_result("a"), _result("b")]).splitlines()
    assert table[0] == "| stage | a | b |"
    assert "| train | 180.0 / 350.0 | 180.0 / 350.0 |" in table
    assert table[-1] == "| all | 256 / 464 | 256 / 464 |"


def test_without_results_the_tables_say_so():
    assert set(tables_of([]).values()) == {NOT_MEASURED}


def test_texture_table_has_the_numbers_only():
    table = run_sets.texture_table([_result()])
    assert "| seen | 0.91 |" in table
    assert "note" not in table


# ---------------------------------------------------------------- pages
def test_tables_are_replaced_between_their_markers_and_nothing_else(tmp_path, monkeypatch):
    monkeypatch.setattr(pages, "DOCS", tmp_path)
    first, second = tmp_path / "first.md", tmp_path / "deep" / "second.md"
    second.parent.mkdir()
    first.write_text("top\n<!-- table a -->\nold\n<!-- end a -->\nbottom\n<!-- table c -->\nkept\n<!-- end c -->\n")
    second.write_text("<!-- table b -->\n<!-- end b -->\n")
    made = {"a": "| one |", "b": "| two |"}
    write_tables(made)
    once = read_pages()
    expected = "top\n<!-- table a -->\n| one |\n<!-- end a -->\nbottom\n<!-- table c -->\nkept\n<!-- end c -->\n"
    assert once[first] == expected
    assert once[second] == "<!-- table b -->\n| two |\n<!-- end b -->\n"
    assert with_tables(once, made) == once


@pytest.mark.parametrize("text", ["no markers", "<!-- table a -->\n<!-- end a -->\n" * 2, "<!-- table a -->"])
def test_a_table_has_one_place(text):
    with pytest.raises(ValueError, match="expected once each"):
        with_tables({Path("page.md"): text}, {"a": "| one |"})


def test_the_tables_on_the_pages_are_those_of_the_result_files():
    """And every table that a page has markers for is written by some benchmark."""
    written, made = read_pages(), all_tables()
    assert written == with_tables(written, made), "run `make docs`"
    marked = {name for page in written.values() for name in re.findall(r"<!-- table (.+?) -->", page)}
    assert marked - {"rooms", "wheels"} == set(made)


def test_tables_are_the_same_in_whatever_order_a_folder_lists_its_files(monkeypatch):
    listed = Path.glob
    made = all_tables()
    monkeypatch.setattr(Path, "glob", lambda folder, pattern: reversed(list(listed(folder, pattern))))
    assert all_tables() == made


def test_what_to_expect_says_the_same_as_the_pages_behind_it():
    """A row of each of its tables, worked out from the other pages' cells."""

    def cells(table, first):
        lines = [line.strip("| ").split(" | ") for line in all_tables()[table].splitlines()]
        return next(dict(zip(lines[0], line, strict=True)) for line in lines if line[0] == first)

    helmet = what_to_expect.SCENES["synth_helmet"]
    summary = cells("summary", "synth_helmet")
    assert cells("expect quality", helmet)["mean distance, %"] == summary["distance %"]
    held_out = cells("held-out", "synth_helmet")["mesh, object: PSNR"]
    assert cells("expect quality", helmet)["new photos, PSNR dB"] == f"{float(held_out):.0f}"
    assert cells("expect cost", helmet)["all, min"] == summary["wall min"]
    assert (
        cells("expect hard", "as they are")["mean distance, %"] == cells("poses", "synth_helmet")["mesh distance %"][:4]
    )


# ---------------------------------------------------------------- sets
def test_results_survive_their_files_and_the_demo_comes_first(tmp_path):
    for result in (_result("banana", SCORE), _result("demo")):
        save_result(result, tmp_path / f"{result.name}.json")
    assert load_results(tmp_path) == [_result("demo"), _result("banana", SCORE)]


def test_results_of_our_own_scenes_lie_apart_and_have_their_own_table(tmp_path, monkeypatch):
    (tmp_path / "data" / "thin").mkdir(parents=True)
    (tmp_path / "data" / "thin" / "made_with.json").write_text("{}")
    monkeypatch.setattr(run_sets, "RESULTS", tmp_path / "results")
    for name in ("thin", "banana"):
        save_result(_result(name), result_path(name, tmp_path / "data"))
    made = run_sets.tables()
    ours = made.pop(run_sets.SYNTHETIC)
    assert "| thin |" in ours
    assert "banana" not in ours
    assert "banana" in made["summary"]
    assert not any("thin" in table for table in made.values())


def test_sets_are_folders_with_photos(tmp_path):
    for name in ("a/images", "b/image", "c/other"):
        (tmp_path / name).mkdir(parents=True)
    assert find_sets(tmp_path, []) == ["a", "b"]
    assert find_sets(tmp_path, ["b"]) == ["b"]
    with pytest.raises(SystemExit, match="no photos for c"):
        find_sets(tmp_path, ["c"])
