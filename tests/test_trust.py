"""The share of `make trust` that every run of the tests has."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest


@pytest.mark.slow
def test_what_is_promised_holds(tmp_path: Path):
    """In a process of its own: a fork of one whose libraries have started threads does not work."""
    command = [
        sys.executable,
        "-m",
        "pytest",
        "--tb=short",
        "-p",
        "no:cacheprovider",
        f"--basetemp={tmp_path / 'trust'}",
    ]
    place = Path(__file__).with_name("trust")
    done = subprocess.run([*command, str(place)], capture_output=True, text=True, errors="replace", check=False)
    print(done.stdout[-20_000:], done.stderr[-2_000:])
    assert done.returncode == 0
