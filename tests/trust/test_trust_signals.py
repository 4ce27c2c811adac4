"""Signals in the middle of the commands that measure and draw: one sentence, and nothing half done is left."""

from __future__ import annotations

import importlib
import os
import shutil
import signal
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from tiny import Tiny
from trust_runs import Ended, run_hineus

from stages.engine.workspace import Workspace

pytestmark = pytest.mark.slow


def struck_in(module: str, name: str, number: signal.Signals) -> Callable[[], None]:
    """Lets the command be sent the signal when it calls a function of ours."""

    def strike(*given: object, **named: object) -> None:
        os.kill(os.getpid(), number)
        time.sleep(100)

    return lambda: setattr(importlib.import_module(module), name, strike)


def stopped(ended: Ended, number: signal.Signals) -> None:
    said = "Stopped." if number == signal.SIGINT else f"Stopped by {number.name}."
    assert ended.code == 128 + number, ended.output
    assert ended.output.count(f"Error: {said}") == 1
    assert "Traceback" not in ended.output


def test_relighting_leaves_the_last_picture(tiny: Tiny, tmp_path: Path):
    out = tmp_path / "here"
    out.mkdir()
    (out / "a.mp4").write_text("the last one")
    words = ["relight", str(tiny.workspace), "--out", "a.mp4", "--size", "32x32", "--frames", "40"]
    ended = run_hineus(words, out, 60, first=struck_in("stages.drawing.relighting", "relit", signal.SIGTERM))
    stopped(ended, signal.SIGTERM)
    assert [path.name for path in out.iterdir()] == ["a.mp4"]
    assert (out / "a.mp4").read_text() == "the last one"


def test_measuring_a_mesh(tiny: Tiny, tmp_path: Path):
    here = tmp_path / "here"
    here.mkdir()
    mesh = str(tiny.input("mesh.ply"))
    first = struck_in("stages.evaluation.surfaces", "_draw", signal.SIGINT)
    stopped(run_hineus(["evaluate", "mesh", mesh, mesh], here, 60, first=first), signal.SIGINT)
    assert list(here.iterdir()) == []


def test_a_benchmark_keeps_the_stages_that_were_done(tiny: Tiny, tmp_path: Path):
    scene = tmp_path / "here" / "set"
    scene.mkdir(parents=True)
    shutil.copytree(tiny.photos, scene / "images")
    shutil.copy(tiny.input("mesh.ply"), scene / "gt_mesh.ply")
    shutil.copy(tiny.input("transforms.json"), scene)
    words = ["bench", "known", "set", "--out", "out", "--until", "ingest", "--seeds", "2", "--preset", "tiny"]
    # The first seed cannot be scored, as there is no mesh; the second one starts from its poses.
    first = struck_in("shutil", "copytree", signal.SIGHUP)
    stopped(run_hineus(words, tmp_path / "here", 60, first=first), signal.SIGHUP)
    folder = tmp_path / "here" / "out" / "known" / "set"
    assert sorted(path.name for path in folder.iterdir()) == ["tiny-seed0", "tiny-seed0.json"]
    workspace = Workspace.open(folder / "tiny-seed0")
    assert workspace.published("ingest") is not None
    with workspace.lock():  # nobody holds it
        pass
