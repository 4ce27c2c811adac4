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


def tileset_issues(files: list[Path]) -> list[str]:
    """What Cesium's 3d-tiles-validator finds in tilesets and all they name; skips where it is not there.

    TILES_VALIDATOR_DIR is where it was installed by npm, or its own folder where it was built.
    """
    folder = Path(os.environ.get("TILES_VALIDATOR_DIR", ROOT))
    places = [folder / "node_modules" / "3d-tiles-validator" / "build" / "main.js", folder / "build" / "main.js"]
    program = next((place for place in places if place.is_file()), None)
    if not shutil.which("node") or program is None:
        pytest.skip("needs node and `npm install 3d-tiles-validator`")
    issues = []
    for file in files:
        done = subprocess.run(
            ["node", str(program), "--tilesetFile", str(file)], capture_output=True, text=True, check=False, timeout=120
        )
        assert done.returncode == 0, done.stdout + done.stderr
        report = json.loads(done.stdout.partition("Validation result:")[2])
        assert report["numErrors"] + report["numWarnings"] + report["numInfos"] == len(report.get("issues", []))
        issues += [f"{issue['type']}: {issue['message']}" for issue in report.get("issues", [])]
    return issues
