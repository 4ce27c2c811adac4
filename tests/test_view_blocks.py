"""`hineus view` of a whole in blocks: one page of all blocks, and the pages of each."""

from __future__ import annotations

import json
import logging
import urllib.error
from pathlib import Path

import numpy as np
import pytest
from test_view import PIPELINE, get, train_a_little, write_report

from hineus_cli.viewing import Watched, serving, watch
from stages import artifacts
from stages.artifacts.blocks import Block, BlockPlan, Lattice, block_folder, write_plan
from stages.artifacts.place import SimilarityRecord
from stages.engine.run_log import failure_told, log_to_file
from stages.engine.workspace import LOCK, Workspace
from stages.errors import ReconstructionError
from stages.geometry.similarity import Similarity
from stages.reporting.ground_plan import ground_plan

NAMES = ("b00", "b01", "b02")


def opened(folder: Path) -> Workspace:
    workspace = Workspace.open(folder, create=True)
    with workspace.lock():
        workspace.remember({"photos": None}, "cpu", {})
    return workspace


def cut(whole: Workspace) -> None:
    cores, margin = [np.array([[i, 0.0, 0], [i + 1.0, 2, 1]]) for i in range(3)], np.array([[-0.1], [0.1]])
    blocks = [
        Block(name=name, core=core, region=core + margin, photos=("a.jpg", "b.jpg"), neighbours=())
        for name, core in zip(NAMES, cores, strict=True)
    ]
    similarity = SimilarityRecord.model_validate(Similarity.identity())
    lattice = Lattice(origin=np.zeros(3), cell=0.5)
    write_plan(
        whole.root,
        BlockPlan(made_from="", settings="", plan_from_poses=similarity, lattice=lattice, blocks=tuple(blocks)),
    )


@pytest.fixture
def whole(tmp_path: Path) -> Workspace:
    """Cut into three blocks: the first has its report, the second is not made, the third failed."""
    workspace = opened(tmp_path / "ws")
    cut(workspace)
    done = opened(block_folder(workspace.root, "b00"))
    for stage in PIPELINE:
        done.stage_folder(stage.name).mkdir()
    write_report(done)
    fail(opened(block_folder(workspace.root, "b02")))
    return workspace


def fail(block: Workspace) -> None:
    with pytest.raises(ReconstructionError), log_to_file(block.log_path):
        raise ReconstructionError("Only <7> photos agree.", "Take more.")


def states(url: str) -> dict[str, dict]:
    return {block["name"]: block for block in json.loads(get(f"{url}state.json"))["blocks"]}


def test_all_blocks_are_on_one_page_and_each_has_its_own(whole):
    with serving(watch(whole.root, PIPELINE)) as url:
        assert "Reconstruction in blocks" in get(url)
        told = states(url)
        assert {name: block["state"] for name, block in told.items()} == {
            "b00": "done", "b01": "waiting", "b02": "failed"
        }  # fmt: skip
        assert told["b02"]["error"] == "Only <7> photos agree."
        assert told["b00"]["photos"] == 2
        assert get(f"{url}blocks/b00/") == "<p>the report</p>"
        assert "under way" in get(f"{url}blocks/b00/live")
        assert "under way" in get(f"{url}blocks/b02/")
        assert json.loads(get(f"{url}blocks/b00/state.json"))["workspace"].endswith("b00")
        for path in ("blocks/b01/", "blocks/b09/", "blocks/b00", "blocks/", "blocks/../state.json", "report", "b00/"):
            with pytest.raises(urllib.error.HTTPError, match="404"):
                get(url + path)


@pytest.mark.slow
def test_a_block_at_work_in_another_process_is_told_by_its_files(whole):
    block = opened(block_folder(whole.root, "b01"))
    with serving(watch(whole.root, PIPELINE)) as url, block.lock():
        train_a_little(block)
        with artifacts.METRICS.load(block.scratch_folder("train")).open("a") as file:
            file.write('\n{"step": 30, "progress": 0.25}\n{"step": 40, "pro')
        found = states(url)["b01"]
        assert (found["state"], found["stage"], found["progress"]) == ("running", "train", 0.25)
        assert [stage["state"] for stage in found["stages"]] == ["waiting", "waiting", "running"]
        assert get(f"{url}blocks/b01/preview/0000100.png") == "a picture"
    assert Watched(whole, PIPELINE).workspace.in_use() is False


def test_a_block_at_work_on_another_machine_is_running_there(whole):
    block = opened(block_folder(whole.root, "b01"))
    (block.root / LOCK).write_text(json.dumps({"pid": 5, "host": "node7", "since": "now"}))
    block.begin("sfm", "print")
    with serving(watch(whole.root, PIPELINE)) as url:
        found = states(url)["b01"]
    assert (found["state"], found["host"], found["stage"]) == ("running", "node7", "sfm")
    assert [stage["state"] for stage in found["stages"]] == ["waiting", "running", "waiting"]


def test_the_page_of_a_run_becomes_that_of_blocks_once_it_is_cut(tmp_path):
    workspace = opened(tmp_path / "ws")
    with workspace.lock(), serving(watch(workspace.root, PIPELINE)) as url:
        assert "blocks" not in json.loads(get(f"{url}state.json"))
        cut(workspace)
        assert [block["state"] for block in states(url).values()] == ["waiting"] * 3
        assert "Reconstruction in blocks" in get(f"{url}live")


def test_a_block_that_is_no_workspace_is_told_of(whole):
    (block_folder(whole.root, "b01")).mkdir()
    (block_folder(whole.root, "b01") / "diary.txt").write_text("dear diary")
    with serving(watch(whole.root, PIPELINE)) as url:
        found = states(url)
    assert found["b01"]["state"] == "failed"
    assert "no workspace" in found["b01"]["error"]
    assert found["b00"]["state"] == "done"


def test_what_ended_the_last_run_is_told_until_the_next_one_begins(tmp_path):
    log = tmp_path / "hineus.log"
    assert failure_told(log) is None
    with pytest.raises(MemoryError), log_to_file(log):
        raise MemoryError
    assert failure_told(log) == "MemoryError"
    with pytest.raises(ValueError, match="two"), log_to_file(log):
        raise ValueError("two\n2026-01-01 lines: of it")
    assert failure_told(log) == "two"
    with log_to_file(log):
        logging.getLogger("stages").warning("begun again")
    assert failure_told(log) is None


def test_the_plan_has_north_up_and_a_link_for_each_block():
    cores = {"b<0": np.array([[0, 0], [1, 1]]), "b1": np.array([[0, 1], [1, 3.0]])}
    drawn = ground_plan(cores, {"b<0": "done", "b1": "running"})
    assert 'href="blocks/b&lt;0/"' in drawn
    first, second = drawn.split("<rect")[1:]
    assert 'class="done"' in first
    assert 'class="running"' in second
    top = [float(part.split(' y="')[1].split('"')[0]) for part in (first, second)]
    tall = [float(part.split('height="')[1].split('"')[0]) for part in (first, second)]
    assert top[1] < top[0]
    assert tall[1] == pytest.approx(2 * tall[0], abs=0.1)
