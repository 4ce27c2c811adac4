"""The benchmark runner's tables and set discovery, on made-up results."""

from __future__ import annotations

import pytest

from benchmarks import run_sets
from benchmarks.run_sets import (
    Result,
    StageCost,
    find_sets,
    load_results,
    result_path,
    save_result,
    updated_page,
    with_tables,
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


SCORE = {"mean": 0.655, "accuracy": 0.5, "completeness": 0.81, "f_one_percent": 84.0}


def test_summary_adds_up_the_stages():
    assert _result().wall_s == 256
    assert _result().peak_rss == 3 << 30
    table = run_sets.summary_table([_result(score=SCORE)])
    row = [cell.strip() for cell in table.splitlines()[2].strip("|").split("|")]
    assert row == ["banana", "1", "15 of 16", "4.3", "7.7", "3.00", "99000", "5.2",
                   "0.66", "0.50", "0.81", "84.00", "0 / 1"]  # fmt: skip


def test_seeds_share_a_row_with_their_spread_and_the_other_tables_have_the_first(tmp_path):
    from dataclasses import replace

    worse = {**SCORE, "mean": 0.765, "accuracy": 0.7}
    runs = [_result(score=SCORE), replace(_result(score=worse), seed=1)]
    row = [cell.strip() for cell in run_sets.summary_table(runs).splitlines()[2].strip("|").split("|")]
    assert (row[1], row[8], row[9]) == ("2", "0.71 (0.66 to 0.77)", "0.60")
    page = "".join(f"<!-- table {name} -->\n<!-- end {name} -->\n" for name in run_sets.TABLES)
    assert "| stage | banana |\n" in with_tables(page, runs)
    paths = [run_sets.result_path("banana", tmp_path, seed).name for seed in (0, 1)]
    assert paths == ["banana.json", "banana-seed1.json"]


def test_sets_without_truth_or_validator_get_a_dash():
    result = _result()
    assert run_sets.summary_table([result]).splitlines()[2].count(" - ") == 4


def test_stage_table_has_a_column_for_each_set():
    table = run_sets.stage_table([_result("a"), _result("b")]).splitlines()
    assert table[0] == "| stage | a | b |"
    assert "| train | 180.0 / 350.0 | 180.0 / 350.0 |" in table
    assert table[-1] == "| all | 256 / 464 | 256 / 464 |"


def test_texture_table_has_the_numbers_only():
    table = run_sets.texture_table([_result()])
    assert "| seen | 0.91 |" in table
    assert "note" not in table


def test_tables_are_replaced_between_their_markers_and_nothing_else():
    page = "top\n" + "".join(f"<!-- table {n} -->\nold\n<!-- end {n} -->\n" for n in run_sets.TABLES) + "bottom\n"
    once = with_tables(page, [_result()])
    assert once.startswith("top\n")
    assert once.endswith("bottom\n")
    assert "old" not in once
    assert with_tables(once, [_result()]) == once
    assert "Not measured yet." in with_tables(page, [])
    with pytest.raises(ValueError, match="expected once each"):
        with_tables("no markers", [])


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
    names = [*run_sets.TABLES, run_sets.SYNTHETIC]
    page = updated_page("".join(f"<!-- table {n} -->\nold\n<!-- end {n} -->\n" for n in names))
    others, ours = page.split("<!-- table synthetic -->")
    assert "| thin |" in ours
    assert "banana" not in ours
    assert "thin" not in others


def test_sets_are_folders_with_photos(tmp_path):
    for name in ("a/images", "b/image", "c/other"):
        (tmp_path / name).mkdir(parents=True)
    assert find_sets(tmp_path, []) == ["a", "b"]
    assert find_sets(tmp_path, ["b"]) == ["b"]
    with pytest.raises(SystemExit, match="no photos for c"):
        find_sets(tmp_path, ["c"])
