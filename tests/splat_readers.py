"""Other programs that read Gaussian splats: PlayCanvas' splat-transform."""

from __future__ import annotations

import csv
import os
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).parents[1]
PACKAGE = Path("node_modules") / "@playcanvas" / "splat-transform"


def splat_transform(*arguments: str | Path) -> str:
    """What it says, `--quiet`, of a job that succeeds; skips where it is not there."""
    folder = Path(os.environ.get("SPLAT_TRANSFORM_DIR", ROOT))
    if not shutil.which("node") or not (folder / PACKAGE).is_dir():
        pytest.skip("needs node and `npm install @playcanvas/splat-transform`")
    done = subprocess.run(
        ["node", str(folder / PACKAGE / "bin" / "cli.mjs"), "--quiet", "--overwrite", *map(str, arguments)],
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout + done.stderr


def read_splats(file: Path, scratch: Path) -> dict[str, np.ndarray]:
    """The columns of a .ply or .spz file by their names in a PLY, read without a word."""
    table = scratch / f"{file.name}.csv"
    assert splat_transform(file, table) == ""
    with table.open(newline="") as stream:
        rows = list(csv.reader(stream))
    return dict(zip(rows[0], np.array(rows[1:], np.float64).T, strict=True))
