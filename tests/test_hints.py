"""The hints of errors are commands that work: the settings, stages and presets they name exist."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

from configs.load import describe_settings, load_config, preset_names
from stages.pipeline import PIPELINE

ROOT = Path(__file__).parent.parent
SOURCES = sorted(path for folder in ("stages", "hineus_cli", "configs") for path in (ROOT / folder).rglob("*.py"))


def _texts(path: Path):
    """Every string of a source file but docstrings; what an f-string fills in stands as {}."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    inside = {id(part) for node in ast.walk(tree) if isinstance(node, ast.JoinedStr) for part in ast.walk(node)}
    bare = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    for node in ast.walk(tree):
        if isinstance(node, ast.JoinedStr):
            parts = [part.value if isinstance(part, ast.Constant) else "{}" for part in node.values]
            yield "".join(str(part) for part in parts)
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and not {id(node)} & (inside | bare):
            yield node.value


def _named(pattern: str):
    found = [(path, match) for path in SOURCES for text in _texts(path) for match in re.findall(pattern, text)]
    return [pytest.param(match, id=f"{path.relative_to(ROOT)}-{match}") for path, match in dict.fromkeys(found)]


SETTINGS = _named(r"--set ([a-z_]+\.\w+=[^`\s,;]+)")
STAGES = _named(r"--(?:force|from|until) ([a-z]\w*)\b(?! name)")
PRESETS = _named(r"--preset ([a-z]\w*)`")


def test_there_are_hints_to_check():
    assert len(SETTINGS) > 10
    assert len(STAGES) > 1
    assert len(PRESETS) > 1


@pytest.mark.parametrize("setting", SETTINGS)
def test_a_setting_that_is_named_exists_and_takes_the_value(setting):
    key, value = setting.rstrip(".").split("=")
    if "{}" in value:
        assert key in {known.key for known in describe_settings()}
    else:
        load_config(sets=[f"{key}={value}"])


@pytest.mark.parametrize("stage", STAGES)
def test_a_stage_that_is_named_exists(stage):
    assert stage in {known.name for known in PIPELINE}


@pytest.mark.parametrize("preset", PRESETS)
def test_a_preset_that_is_named_exists(preset):
    assert preset in preset_names()
