"""The table of held-out photos."""

from __future__ import annotations

import json

import pytest

from benchmarks import held_out


def scores(psnr: float) -> dict[str, float | None]:
    return {"photos": 2, "psnr": psnr, "ssim": 0.9, "lpips": None}


def test_the_table_has_a_row_a_workspace_and_dashes_where_nothing_can_be_said(tmp_path, monkeypatch):
    monkeypatch.setattr(held_out, "RESULTS", tmp_path)
    mean = {"field": {"object": scores(30), "whole": scores(20)}, "mesh": {"object": scores(25.125), "whole": None}}
    result = {"name": "ball", "photos": [{}, {}], "mean": mean, "done": [], "machine": {}}
    (tmp_path / "ball.json").write_text(json.dumps(result))
    row = "| ball | 2 | 30.00 | 0.900 | 25.12 | 0.900 | 20.00 | 0.900 | - | - |"
    assert held_out.tables()["held-out"].splitlines()[2:] == [row]


def test_a_measurement_keeps_no_folder_of_the_machine(tmp_path, monkeypatch):
    from stages.evaluation.photos import held_out as against_photos

    found = {"workspace": str(tmp_path), "renders": None, "photos": [], "mean": {}, "done": ["photos: 1 of 2"]}
    monkeypatch.setattr(against_photos, "evaluate_views", lambda workspace: found)
    result = held_out.measure(tmp_path / "ball")
    assert result["name"] == "ball"
    assert str(tmp_path) not in json.dumps(result)
    with pytest.raises(KeyError):
        result["workspace"]
