"""Gaussian splats before and after refining, beside field and textured mesh, on photos that all of them did without.

python -m benchmarks.splats WORKSPACE ...     these, each made with `--hold-out 8`; splats are made anew, twice
python -m benchmarks.splats --table-only      only rewrite the tables of docs/benchmarks/splats.md

Results go to benchmarks/results/splats/NAME.json, where NAME is the workspace's.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks.pages import NOT_MEASURED, markdown_table
from benchmarks.run_sets import GIB, machine, measure_folders
from benchmarks.run_sets import RESULTS as ALL_RESULTS
from configs.params import SplatsParams
from stages import artifacts

RESULTS = ALL_RESULTS / "splats"
# What it is called in the results, and the steps that it is refined by.
WAYS = {"least squares": 0, "refined": SplatsParams().steps}


def measure(workspace: Path) -> dict[str, Any]:
    """One workspace's scores on the object, and what each way of making splats takes."""
    from stages.evaluation.photos.held_out import evaluate_views

    scores: dict[str, Any] = {}
    costs = {}
    for way, steps in WAYS.items():
        options = ("--hold-out", "8", "--splats", "--set", f"splats.steps={steps}", "--force", "splats")
        command = [sys.executable, "-m", "hineus_cli", "run", "--workspace", str(workspace), *options]
        subprocess.run(command, check=True, stdout=sys.stderr)
        costs[way] = cost(workspace)
        found = evaluate_views(workspace)
        scores |= {what: found["mean"][what]["object"] for what in ("field", "mesh")}
        scores[way] = found["mean"]["splats"]["object"]
    photos = len(found["photos"])
    return {"name": workspace.resolve().name, "photos": photos, "scores": scores, "costs": costs, "machine": machine()}


def cost(workspace: Path) -> dict[str, Any]:
    """Of the splats that a workspace has: seconds and memory of their stage, and how large their files are."""
    made = artifacts.read_json(workspace / "splats" / "manifest.json")
    files = sorted((workspace / "export").glob("model.splats.*"))
    return {
        "gaussians": made["numbers"]["gaussians"],
        "cpu_s": made["cpu_s"],
        "wall_s": made["wall_s"],
        "gib": made["peak_rss"] / GIB,
        "bytes": {file.suffix[1:]: file.stat().st_size for file in files},
    }


def score_table(results: Sequence[dict[str, Any]]) -> str:
    """A row a workspace: PSNR and SSIM of each."""
    kinds = ("field", "mesh", *WAYS)
    rows = [
        [
            result["name"],
            str(result["photos"]),
            *(f"{result['scores'][kind]['psnr']:.2f} / {result['scores'][kind]['ssim']:.3f}" for kind in kinds),
        ]
        for result in results
    ]
    return markdown_table(["set", "photos", *kinds], rows)


def cost_table(results: Sequence[dict[str, Any]]) -> str:
    """A row a workspace and way."""
    rows = [
        [
            result["name"],
            way,
            f"{spent['gaussians']:,}",
            f"{spent['cpu_s']:.0f}",
            f"{spent['gib']:.2f}",
            *(f"{spent['bytes'].get(kind, 0) / 1e6:.1f}" for kind in ("ply", "glb", "spz")),
        ]
        for result in results
        for way, spent in result["costs"].items()
    ]
    return markdown_table(["set", "splats", "Gaussians", "CPU s", "GiB", "PLY, MB", "GLB, MB", "SPZ, MB"], rows)


def tables() -> dict[str, str]:
    """Both tables, from the result files."""
    results = [artifacts.read_json(path) for path in sorted(RESULTS.glob("*.json"))]
    made = {"splats-scores": score_table, "splats-costs": cost_table}
    return {name: table(results) if results else NOT_MEASURED for name, table in made.items()}


def main() -> int:
    return measure_folders(__doc__, "workspaces made with --hold-out", "drawing", RESULTS, measure, tables)


if __name__ == "__main__":
    sys.exit(main())
