"""Files of the engine that runs the steps of blocks: they lie beside the plan.

<whole>/blocks/Snakefile                    the rules
<whole>/blocks/steps.json                   what they are about: needs, command, cores and memory of each step
<whole>/blocks/steps/<kind>/<block>.done    a step that is done; its name is relative to <whole>/blocks
<whole>/blocks/steps/<kind>/<block>.log     what it said
<whole>/blocks/steps/engine.log             what the engine said
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from stages.artifacts.blocks import plan_path
from stages.artifacts.own_files import read_own, write_own

MARKERS = "steps/{kind}/{block}"


def engine_folder(whole: Path) -> Path:
    """In which the engine works."""
    return plan_path(whole).parent


def marker_name(kind: str, block: str) -> str:
    return f"{MARKERS.format(kind=kind, block=block)}.done"


def log_name(kind: str, block: str) -> str:
    return f"{MARKERS.format(kind=kind, block=block)}.log"


def engine_log_path(folder: Path) -> Path:
    return folder / "steps" / "engine.log"


def read_log(path: Path) -> str:
    """Empty where there is none."""
    return read_own(path).decode(errors="replace") if path.exists() else ""


def write_rules(folder: Path, rules: str) -> None:
    write_own(folder / "Snakefile", rules)


def write_steps(folder: Path, steps: Mapping[str, Mapping[str, Any]]) -> None:
    """
    Args:
        steps: by kind and block: a dict with `needs` (names of markers), `command`, `threads`, `mem_mb` (of each
            attempt) and `gpu` (how many).
    """
    write_own(folder / "steps.json", json.dumps({"steps": steps}, indent=1) + "\n")


def mark(folder: Path, done: Sequence[str], undone: Sequence[str]) -> None:
    """Let these markers, and none of the others, be there; those that are done in their order of time."""
    for name in (*undone, *done):
        (folder / name).unlink(missing_ok=True)
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
    for name in done:
        write_own(folder / name, "")
