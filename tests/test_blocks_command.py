"""`hineus blocks`, `hineus run --blocks` and what `hineus status` says of blocks."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from types import SimpleNamespace

import pytest
from small_town import town_workspace
from typer.testing import CliRunner, Result

from hineus_cli.app import build_app
from hineus_cli.options import block_count
from stages import block_by_block
from stages.errors import ConfigError, ReconstructionError


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    return town_workspace(tmp_path_factory.mktemp("town") / "whole")


@pytest.fixture
def whole(made, tmp_path, monkeypatch) -> Path:
    shutil.copytree(made, tmp_path / "whole")
    monkeypatch.chdir(tmp_path)
    return tmp_path / "whole"


def hineus(*arguments: str) -> Result:
    return CliRunner().invoke(build_app(), arguments)


def test_the_plan_is_shown_and_what_to_do_next(whole):
    result = hineus("blocks", "whole", "--count", "2")
    assert result.exit_code == 0, result.output
    assert "b01" in result.stdout
    assert "hineus run --workspace whole/blocks/b00" in result.stdout
    data = json.loads(hineus("blocks", "whole", "--count", "2", "--json").stdout)
    assert data["ok"] is True
    assert [block["neighbours"] for block in data["blocks"]] == [["b01"], ["b00"]]
    assert data["lattice"]["cell"] > 0


def test_status_has_a_line_for_each_block(whole):
    before = json.loads(hineus("status", "whole", "--json").stdout)
    assert "blocks" not in before
    hineus("blocks", "whole", "--count", "2")
    after = json.loads(hineus("status", "whole", "--json").stdout)
    assert [(block["name"], block["fresh"], block["waiting"]) for block in after["blocks"]] == [
        ("b00", 0, "ingest"),
        ("b01", 0, "ingest"),
    ]
    text = hineus("status", "whole").stdout
    assert "b01" in text
    assert f"0 of {len(after['stages'])}" in text


def test_a_failed_block_is_told_with_the_exit_code_of_its_kind(whole, monkeypatch):
    done = []

    def reconstruct(request, pipeline, listener):
        done.append(request.workspace.name)
        if request.workspace.name == "b00":
            raise ReconstructionError("It diverged.", "Try less.")
        workspace = SimpleNamespace(root=request.workspace.absolute())
        return SimpleNamespace(workspace=workspace, glb=None, report=None, as_dict=lambda: {"workspace": "whole"})

    monkeypatch.setattr(block_by_block, "reconstruct", reconstruct)
    result = hineus("run", "-w", "whole", "--blocks", "2")
    assert result.exit_code == ReconstructionError.exit_code
    assert done == ["whole", "b00", "b01", "b01"]
    assert "1 of 2 blocks failed (b00)" in result.stderr
    assert "It diverged." in result.stderr
    assert "Traceback" not in result.output


@pytest.mark.parametrize(("text", "count"), [("auto", None), ("1", 1), ("16", 16)])
def test_numbers_of_blocks(text, count):
    assert block_count(text) == count


@pytest.mark.parametrize("text", ["0", "-1", "many", "1.5", "123456", ""])
def test_what_is_no_number_of_blocks_is_refused(text):
    with pytest.raises(ConfigError, match="no number of blocks"):
        block_count(text)
