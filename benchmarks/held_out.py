"""Photos that training and texture did without, against drawings of the trained field and of the final mesh.

python -m benchmarks.held_out WORKSPACE ...      these, each made with `--hold-out 8`
python -m benchmarks.held_out --table-only       only rewrite the table of docs/benchmarks/held-out.md

Results go to benchmarks/results/held_out/NAME.json, where NAME is the workspace's.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks.pages import NOT_MEASURED, markdown_table
from benchmarks.run_sets import RESULTS as ALL_RESULTS
from benchmarks.run_sets import machine, measure_folders
from stages import artifacts

RESULTS = ALL_RESULTS / "held_out"
# What is shown: drawing, region, number, its heading.
COLUMNS = tuple(
    (what, region, key, heading)
    for region in ("object", "whole")
    for what in ("field", "mesh")
    for key, heading in (("psnr", f"{what}, {region}: PSNR"), ("ssim", "SSIM"))
)


def measure(workspace: Path) -> dict[str, Any]:
    """One workspace's scores, without what belongs to this machine's folders."""
    from stages.evaluation.photos.held_out import evaluate_views

    found = evaluate_views(workspace)
    kept = {key: found[key] for key in ("photos", "mean", "done")}
    return {"name": workspace.resolve().name, **kept, "machine": machine()}


def load_results() -> list[dict[str, Any]]:
    """All results, by name."""
    return [artifacts.read_json(path) for path in sorted(RESULTS.glob("*.json"))]


def table(results: Sequence[dict[str, Any]]) -> str:
    """A row a workspace; a dash where a region cannot be scored."""
    rows = []
    for result in results:
        cells = []
        for what, region, key, _ in COLUMNS:
            scores = result["mean"][what][region]
            cells.append("-" if scores is None else f"{scores[key]:.2f}" if key == "psnr" else f"{scores[key]:.3f}")
        rows.append([result["name"], str(len(result["photos"])), *cells])
    return markdown_table(["set", "photos", *(heading for *_, heading in COLUMNS)], rows)


def tables() -> dict[str, str]:
    """The table, from the result files."""
    results = load_results()
    return {"held-out": table(results) if results else NOT_MEASURED}


def main() -> int:
    return measure_folders(__doc__, "workspaces made with --hold-out", "drawing", RESULTS, measure, tables)


if __name__ == "__main__":
    sys.exit(main())
