"""Who may import whom, and what `hineus --help` may import."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
HEAVY = ("torch", "open3d", "pycolmap", "cv2", "trimesh", "pymeshlab", "numba", "xatlas", "scipy", "PIL", "jinja2")


def test_import_contracts_hold():
    pytest.importorskip("importlinter")
    done = subprocess.run(
        [sys.executable, "-c", "from importlinter.cli import lint_imports_command; lint_imports_command()"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert " 0 broken" in done.stdout


def test_the_command_line_loads_nothing_heavy():
    script = f"import hineus_cli.app, sys; print([name for name in {HEAVY!r} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_the_command_line_has_no_science_and_catches_errors_in_one_place():
    for path in sorted((ROOT / "hineus_cli").rglob("*.py")):
        source = path.read_text(encoding="utf-8")
        imported = re.search(r"^\s*(import|from) (numpy|scipy|torch|cv2)\b", source, flags=re.M)
        assert not imported, f"{path}: computing belongs to stages/"
        assert path.name == "app.py" or "except HineusError" not in source, path


def test_no_drawer_modules():
    """A module is named after what it does."""
    names = {path.stem for folder in ("hineus_cli", "stages", "configs") for path in (ROOT / folder).rglob("*.py")}
    assert not names & {"utils", "common", "helpers", "misc"}
