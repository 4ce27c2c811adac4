"""The demo command's wiring: photos once, the same run as `hineus run`, a score. The stages are stand-ins."""

from __future__ import annotations

import json
from types import SimpleNamespace

import pytest

from configs.load import load_config
from stages import artifacts
from stages.errors import InputError
from stages.pipeline import PIPELINE
from stages.reconstruct import Reconstruction
from stages.scenes import demo

SCORE = {
    "accuracy": 1.0,
    "completeness": 2.0,
    "mean": 1.5,
    "accuracy_median": 1.0,
    "completeness_median": 1.0,
    "f_half_percent": 50.0,
    "f_one_percent": 60.0,
}


@pytest.fixture
def stand_ins(monkeypatch):
    """Requests handed to the pipeline; the export holds a PLY unless `made.ply` is turned off."""
    made = SimpleNamespace(requests=[], ply=True)

    def reconstruct(request, pipeline, listener):
        made.requests.append(request)
        export = request.workspace / "export"
        export.mkdir(parents=True, exist_ok=True)
        if made.ply:
            artifacts.asset_path(export, "ply").write_text("ply")
        workspace = SimpleNamespace(root=request.workspace, stage_folder=lambda name: request.workspace / name)
        return Reconstruction(workspace, load_config(request.preset), request.preset, "cpu", 2, ())

    monkeypatch.setattr(demo, "reconstruct", reconstruct)
    monkeypatch.setattr(demo, "score_mesh", lambda mesh, model, truth: dict(SCORE))
    monkeypatch.setattr(demo, "NUM_PHOTOS", 6)
    monkeypatch.setattr(demo, "PHOTO_SIZE", (32, 24))
    monkeypatch.setattr(demo, "make_demo_photos", lambda folder, *recipe: made.requests.append("photos"))
    return made


def test_demo_runs_on_its_own_photos_and_keeps_the_score(tmp_path, stand_ins):
    made = demo.run_demo(tmp_path, preset="demo", device="cpu", workers=2, pipeline=PIPELINE)
    result = made.as_dict()
    photos, request = stand_ins.requests
    assert photos == "photos"
    assert request.photos == tmp_path / "photos"
    assert request.workspace == tmp_path / "workspace"
    assert request.preset == "demo"
    assert (request.device, request.workers) == ("cpu", 2)
    assert result["mean_distance_percent"] == 1.5
    assert json.loads((tmp_path / "score.json").read_text()) == SCORE
    json.dumps(result)


def test_demo_takes_another_preset(tmp_path, stand_ins):
    assert demo.run_demo(tmp_path, preset="tiny", device="cpu", workers=None, pipeline=PIPELINE).result.preset == "tiny"


def test_demo_without_a_ply_says_what_to_do(tmp_path, stand_ins):
    stand_ins.ply = False
    with pytest.raises(InputError, match="writes no PLY"):
        demo.run_demo(tmp_path, preset="demo", device="cpu", workers=None, pipeline=PIPELINE)


def test_complete_photos_are_not_made_again(tmp_path, stand_ins, monkeypatch):
    monkeypatch.setattr(demo, "photos_are_complete", lambda *recipe: True)
    demo.make_photos(tmp_path)
    assert stand_ins.requests == []


def test_a_folder_that_cannot_be_written_is_told(tmp_path, stand_ins, monkeypatch):
    def refuse(folder, *recipe):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(demo, "make_demo_photos", refuse)
    with pytest.raises(InputError, match="Permission denied"):
        demo.make_photos(tmp_path)


def test_the_demo_preset_writes_what_the_score_needs():
    assert "ply" in load_config("demo").export.formats
