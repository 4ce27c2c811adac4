"""Blocks run one by one: the steps as data, and a block that fails."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from stages import block_by_block
from stages.artifacts import SimilarityRecord
from stages.artifacts.blocks import Block, BlockPlan, Lattice
from stages.block_by_block import reconstruct_in_blocks, steps_of
from stages.errors import ConfigError, ReconstructionError
from stages.geometry.similarity import Similarity
from stages.request import Request


def plan_of(neighbours: dict[str, tuple[str, ...]]) -> BlockPlan:
    box = np.array([[0.0, 0, 0], [1, 1, 1]])
    return BlockPlan(
        made_from="",
        settings="",
        plan_from_poses=SimilarityRecord.model_validate(Similarity.identity()),
        lattice=Lattice(origin=np.zeros(3), cell=0.1),
        blocks=tuple(
            Block(name=name, core=box, region=box, photos=("a.jpg",), neighbours=others)
            for name, others in neighbours.items()
        ),
    )


PLAN = plan_of({"b00": ("b01",), "b01": ("b00", "b02"), "b02": ("b01",)})


def test_steps_are_data_in_an_order_in_which_they_can_be_done():
    steps = steps_of(PLAN)
    assert [step.name for step in steps[:3]] == ["train b00", "train b01", "train b02"]
    done: set[str] = set()
    for step in steps:
        assert {*step.needs, *step.after} <= done
        done.add(step.name)
    finish = steps[4]
    assert (finish.block, finish.needs, finish.after) == ("b01", ("train b01",), ("train b00", "train b02"))
    assert steps[0].command(Path("/w")) == ["hineus", "run", "--workspace", "/w/blocks/b00", "--until", "train"]
    assert finish.command(Path("/w")) == ["hineus", "run", "--workspace", "/w/blocks/b01"]


@pytest.fixture
def runs(monkeypatch, tmp_path):
    """What was run, as (folder's name, until); blocks in `runs.bad` fail in training, with that error."""
    seen = SimpleNamespace(asked=[], bad={})

    def reconstruct(request, pipeline, listener):
        folder = request.workspace or tmp_path
        seen.asked.append((folder.name, request.until))
        if folder.name in seen.bad and request.until == "train":
            raise seen.bad[folder.name]
        workspace = SimpleNamespace(root=folder)
        return SimpleNamespace(workspace=workspace, glb=folder / "asset.glb", report=None, as_dict=lambda: {})

    monkeypatch.setattr(block_by_block, "reconstruct", reconstruct)
    monkeypatch.setattr(block_by_block, "divide", lambda root, count: PLAN)
    return seen


def test_the_whole_gets_poses_and_then_each_block_is_run(runs, tmp_path):
    result = reconstruct_in_blocks(Request(workspace=tmp_path), 3, ())
    assert runs.asked[0] == (tmp_path.name, "place")
    assert runs.asked[1:4] == [("b00", "train"), ("b01", "train"), ("b02", "train")]
    assert runs.asked[4:] == [("b00", None), ("b01", None), ("b02", None)]
    assert result.failure() is None
    assert result.as_dict()["blocks"][2]["glb"] == str(tmp_path / "blocks" / "b02" / "asset.glb")


@pytest.mark.parametrize("error", [ReconstructionError("It diverged.", "Try less."), RuntimeError("it\ndiverged")])
def test_a_block_that_fails_is_named_and_the_rest_goes_on(runs, tmp_path, error):
    runs.bad = {"b01": error}
    result = reconstruct_in_blocks(Request(workspace=tmp_path), 3, ())
    assert ("b02", "train") in runs.asked
    assert ("b00", None) in runs.asked
    assert ("b01", None) not in runs.asked, "it was gone on with what it has not learned"
    assert [outcome.state for outcome in result.outcomes] == ["done", "failed", "done"]
    failure = result.failure()
    assert failure is not None
    assert "1 of 3 blocks failed (b01)" in failure.message
    assert "diverged" in failure.message
    assert f"hineus run --workspace {tmp_path / 'blocks' / 'b01'}" in failure.hint


def test_parts_of_the_pipeline_do_not_go_with_blocks(tmp_path):
    with pytest.raises(ConfigError, match="`--until`"):
        reconstruct_in_blocks(Request(workspace=tmp_path, until="train"), 2, ())
