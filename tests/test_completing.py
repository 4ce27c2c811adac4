"""The Tab key: asked as the shells ask."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).parents[1]


def offered(shell: str, typed: str) -> str:
    asked = {
        "_HINEUS_COMPLETE": f"complete_{shell}",
        "COMP_WORDS": typed,
        "COMP_CWORD": str(len(typed.split()) - 1),
        "_TYPER_COMPLETE_ARGS": typed,
        "_TYPER_COMPLETE_FISH_ACTION": "get-args",
    }
    command = [sys.executable, "-m", "hineus_cli"]
    ended = subprocess.run(
        command, cwd=REPOSITORY, env={**os.environ, **asked}, capture_output=True, text=True, check=False
    )
    assert ended.stderr == ""
    return ended.stdout


@pytest.mark.parametrize(
    ("shell", "typed", "wanted", "unwanted"),
    [
        ("bash", "hineus ru", "run", "report"),
        ("zsh", "hineus run --wat", "--watertight", "--workspace"),
        ("fish", "hineus run --preset t", "tiny", "cpu"),
        ("fish", "hineus train --set sfm.match", "sfm.matcher=", "sfm.mapper="),
        ("zsh", "hineus run --set sfm.matcher=e", "sfm.matcher=exhaustive", "sequential"),
        ("fish", "hineus run --from a", "atlas", "bake"),
        ("bash", "hineus run --device cu", "cuda", "auto"),
    ],
)
def test_the_tab_key_offers_what_fits(shell: str, typed: str, wanted: str, unwanted: str) -> None:
    answer = offered(shell, typed)
    assert wanted in answer
    assert unwanted not in answer
