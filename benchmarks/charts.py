"""Charts by UVAtlas and by xatlas on the meshes of finished runs: number, fill, seams, stretch, cost.

python -m benchmarks.charts WORKSPACE ...     done up to `cleanup`; texture sizes as the stage `atlas` chooses them
python -m benchmarks.charts --table-only      only rewrite the table of docs/benchmarks/charts.md

Results go to benchmarks/results/charts/NAME.json, where NAME is the workspace's.
"""

from __future__ import annotations

import multiprocessing
import resource
import sys
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from benchmarks.pages import NOT_MEASURED, markdown_table
from benchmarks.run_sets import GIB, machine, measure_folders
from benchmarks.run_sets import RESULTS as ALL_RESULTS
from configs.params import AtlasParams
from stages import artifacts

RESULTS = ALL_RESULTS / "charts"
TIME_LIMIT = 600.0


def measure(workspace: Path) -> dict[str, Any]:
    """One workspace: each way in a process of its own, so that its cost is its own."""
    from stages.texture.charts import WAYS

    ways = {}
    for name in WAYS:
        with multiprocessing.get_context("spawn").Pool(1) as pool:
            ways[name] = pool.apply(measure_way, (workspace, name))
    return {"name": workspace.resolve().name, "ways": ways, "machine": machine()}


def measure_way(workspace: Path, name: str) -> dict[str, Any]:
    """Numbers of one way, or why it failed."""
    from stages.texture import charts
    from stages.texture.chart_quality import chart_quality
    from stages.texture.footprint import pixels_per_area, texels_needed, texture_size_for

    vertices, faces = artifacts.CLEAN_MESH.load(workspace / "cleanup")
    texels = texels_needed(*pixels_per_area(vertices, faces, artifacts.CAMERAS.load(workspace / "train")))
    size = texture_size_for(texels, charts.WAYS[name].fill)
    before = _cpu_seconds()
    try:
        layout = charts.WAYS[name].unwrap(vertices, faces, size, AtlasParams().padding, TIME_LIMIT)
    except charts.ChartsError as error:
        return {"failed": str(error)}
    seconds = _cpu_seconds() - before
    quality = chart_quality(vertices, faces, layout, size)
    return {
        "faces": len(faces),
        "size": size,
        "texels_a_pixel": (quality.fill * size**2 / max(texels, 1.0)) ** 0.5,
        **asdict(quality),
        "vertices": len(layout.source) / len(vertices),
        "cpu_s": seconds,
        "child_gib": resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss * 1024 / GIB,
    }


def _cpu_seconds() -> float:
    """Of this process and those that it ran and that have ended."""
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(each.ru_utime + each.ru_stime for each in used)


def chart_table(results: Sequence[dict[str, Any]]) -> str:
    """A row a workspace and way."""
    rows = []
    for result in results:
        for name, way in result["ways"].items():
            if "failed" in way:
                rows.append([result["name"], name, "failed", *["-"] * 9])
                continue
            rows.append([
                result["name"], name, f"{way['charts']}", f"{100 * way['fill']:.0f} %", f"{way['seam_length']:.1f}",
                f"{way['stretch']:.3f}", f"{100 * way['mirrored']:.0f} %", f"{way['vertices']:.2f}",
                f"{way['size']}", f"{way['texels_a_pixel']:.2f}", f"{way['cpu_s']:.1f}", f"{way['child_gib']:.2f}",
            ])  # fmt: skip
    header = ["mesh", "by", "charts", "fill", "seams", "L2 stretch", "mirrored", "vertices", "texture"]
    return markdown_table([*header, "texels a pixel", "CPU s", "GiB"], rows)


def load_results() -> list[dict[str, Any]]:
    """All results, by name."""
    return [artifacts.read_json(path) for path in sorted(RESULTS.glob("*.json"))]


def tables() -> dict[str, str]:
    """The table, from the result files."""
    results = load_results()
    return {"charts": chart_table(results) if results else NOT_MEASURED}


def main() -> int:
    return measure_folders(__doc__, "finished workspaces", "charts", RESULTS, measure, tables)


if __name__ == "__main__":
    sys.exit(main())
