"""Other programs' judges of our files: USD's own validators, and Khronos' of glTF."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


def usd_errors(path: Path) -> list[str]:
    """What all validators of usd-core, which `usdchecker` runs, find in a file; skips where it has none yet."""
    from pxr import Usd

    validation = pytest.importorskip("pxr.UsdValidation")
    validators = validation.ValidationRegistry().GetOrLoadAllValidators()
    assert {
        "usdUtilsValidators:UsdzPackageValidator",
        "usdShadeValidators:NormalMapTextureValidator",
        "usdPhysicsValidators:ColliderChecker",
    } <= {validator.GetMetadata().name for validator in validators}
    found = validation.ValidationContext(validators).Validate(Usd.Stage.Open(str(path)))
    return [error.GetErrorAsString() for error in found]


def gltf_reports(files: list[Path]) -> list[dict]:
    """The report on each GLB, none of which has an error, a warning or an info; skips where there is no validator."""
    folder = os.environ.get("GLTF_VALIDATOR_DIR", str(ROOT))
    if not shutil.which("node") or not (Path(folder) / "node_modules" / "gltf-validator").is_dir():
        pytest.skip("needs node and `npm install gltf-validator`")
    done = subprocess.run(
        ["node", str(ROOT / "benchmarks" / "validate_glb.mjs"), *map(str, files)],
        capture_output=True,
        text=True,
        check=False,
        timeout=60,
        env={**os.environ, "GLTF_VALIDATOR_DIR": folder},
    )
    assert done.returncode == 0, done.stdout + done.stderr
    reports = [json.loads(line) for line in done.stdout.splitlines()]
    for report in reports:
        assert (report["numErrors"], report["numWarnings"], report["numInfos"]) == (0, 0, 0), report["messages"]
    return reports
