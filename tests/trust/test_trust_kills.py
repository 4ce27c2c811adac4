"""A run that is killed loses no stage, and ends as if it had not been: the same bytes."""

from __future__ import annotations

import json
import random
import shutil
from pathlib import Path

import pytest
from moments import Moment, choose_moments, die_at, listen
from tiny import STAGES, Tiny, files_of
from trust_runs import Ended

pytestmark = pytest.mark.slow

WHOLE, SHARE = 8, 1  # kills in each stage
POSED = STAGES[: STAGES.index("train")]  # are there when a run of the share begins, which is killed in the later ones
IN_SHARE = ("ingest", "place", "undistort", "atlas")  # one at a time: quick ones, and one with a child
BREAKS = 8  # of one run from its start to its end


@pytest.mark.parametrize("stage", STAGES)
def test_a_stage_that_is_killed_ends_as_the_unbroken_one(stage: str, tiny: Tiny, whole: bool, tmp_path: Path):
    if stage not in IN_SHARE and not whole:
        pytest.skip("of `make trust`")
    before = STAGES[: STAGES.index(stage)]
    unbroken = files_of(tiny.workspace / stage)

    def start(name: str) -> Path:
        return tiny.begun(tmp_path / name, before)

    calls, seconds = _calls(tiny, start("heard"), stage, tmp_path / "calls")
    count = WHOLE if whole else SHARE
    for i, moment in enumerate(choose_moments(calls, seconds, count, random.Random(stage))):
        workspace = start(f"{i}")
        _kill(tiny, workspace, stage, moment)
        ended = tiny.run(workspace, "--until", stage, "--json")
        where = f"{stage}, killed {moment} ({calls[moment.call] if moment.call is not None else 'by the clock'})"
        assert not ended.fault(), f"{where}: {ended.output}"
        assert _ran(ended) <= {stage}, f"{where}: stages were lost"
        found = files_of(workspace / stage)
        assert found.keys() == unbroken.keys(), where
        assert [name for name in found if found[name] != unbroken[name]] == [], where
        left = list((workspace / ".work").rglob("*")) if (workspace / ".work").exists() else []
        assert not [path for path in left if "old" in path.parts or "out" in path.parts or path.suffix == ".tmp"], where
        shutil.rmtree(workspace)


def test_a_run_that_is_killed_again_and_again_ends_as_the_unbroken_one(tiny: Tiny, whole: bool, tmp_path: Path):
    workspace, chance, finished = tmp_path / "w", random.Random(0), set()
    if not whole:
        tiny.begun(workspace, POSED)
    for _ in range(BREAKS):
        _kill(tiny, workspace, STAGES[-1], Moment(None, 0.3 + 3 * chance.random()))
        published = {name for name in STAGES if (workspace / name / "manifest.json").exists()}
        assert finished <= published
        finished = published
    ended = tiny.run(workspace, "--json")
    assert not ended.fault(), ended.output
    assert _ran(ended).isdisjoint(finished)
    for name in STAGES:
        assert files_of(workspace / name) == files_of(tiny.workspace / name), name


def _calls(tiny: Tiny, workspace: Path, stage: str, notes: Path) -> tuple[list[str], float]:
    """What a run of the stage does to the workspace, and how long it takes."""

    def first() -> None:
        _checkpoint_often()
        listen(workspace, lambda call: notes.open("a").write(f"{call}\n") and None)

    ended = tiny.run(workspace, "--until", stage, first=first)
    assert ended.code == 0, ended.output
    return notes.read_text().splitlines(), ended.seconds


def _kill(tiny: Tiny, workspace: Path, stage: str, moment: Moment) -> None:
    def first() -> None:
        _checkpoint_often()
        die_at(moment, workspace)

    tiny.run(workspace, "--until", stage, first=first)


def _checkpoint_often() -> None:
    import stages.train

    stages.train.CHECKPOINT_EVERY = 0.2


def _ran(ended: Ended) -> set[str]:
    start = ended.output.index('{"ok"')
    outcomes = json.loads(ended.output[start:].splitlines()[0])["stages"]
    return {outcome["name"] for outcome in outcomes if outcome["action"] == "ran"}
