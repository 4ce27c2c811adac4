"""Measure dense stereo alone: how far its points lie from a known surface, how much of that they cover.

python -m benchmarks.stereo DATA                       every set in DATA with a known surface
python -m benchmarks.stereo DATA synth_helmet --again  this one, also if it has a result
python -m benchmarks.stereo DATA --workspaces DIR      of runs that are there: DIR/SET, done up to `densify`
python -m benchmarks.stereo --table-only               only rewrite the table

Only points on the object count, as `protocols.known_object` has it. The first row of a set is every depth that several
pairs of photos agree on, as the depth maps have it; the others are of the fused cloud, by the least trust. Results go
to benchmarks/results/stereo/SET.json, workspaces to benchmarks/out/stereo/.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.pages import NOT_MEASURED, markdown_table, write_tables
from benchmarks.run_sets import OUT, RESULTS, find_sets, machine, photos_of, run_hineus
from stages import artifacts
from stages.engine.manifest import load_manifest
from stages.errors import HineusError
from stages.evaluation.protocols.known_object import (
    KnownObject,
    has_truth,
    load_known_object,
    seen_surface,
    truth_from_model,
)
from stages.evaluation.surfaces import OneWay, Surface, Target
from stages.geometry.cameras import PosedScene

ROWS, FOLDER = RESULTS / "stereo", OUT / "stereo"
EVERY = "every depth"
THRESHOLDS = (0.0, 0.5, 0.9)  # least trust
STRIDE = 3  # of the depth maps, every so many rows and columns
NEAR = 0.01  # of the extent


@dataclass(frozen=True)
class Row:
    """Some of a set's points. Distances are in percent of the object's extent, shares in percent.

    Attributes:
        points: on the object; trust: their mean.
        mean, median: distances to the known surface; weighed: their mean by trust, which is how training has them.
        within: share of the points that lie within 1 % of it.
        completeness: mean distance from the seen surface to the nearest point; covered: share of it within 1 %.
    """

    name: str
    points: int
    trust: float
    mean: float
    weighed: float
    median: float
    within: float
    completeness: float
    covered: float


@dataclass(frozen=True)
class Result:
    """One set."""

    name: str
    command: str
    machine: dict[str, str]
    photos: int
    pairs: int
    cpu_s: float
    peak_rss: int
    rows: tuple[Row, ...]


def make_workspace(name: str, data: Path) -> Path:
    """The set's workspace, done up to `densify`.

    Raises:
        RuntimeError: `hineus` failed.
    """
    workspace = FOLDER / name
    run_hineus(["run", str(photos_of(data / name)), "--workspace", str(workspace), "--until", "densify", "--json"])
    return workspace


def measure(name: str, workspace: Path, truth: Path) -> Result:
    """The points of a finished `densify` against the known surface.

    Raises:
        HineusError: the cameras cannot be aligned, or a file is missing.
    """
    known = load_known_object(truth)
    scene, cloud = (
        artifacts.FIRST_SCENE.load(workspace / "undistort"),
        artifacts.POINT_CLOUD.load(workspace / "densify"),
    )
    to_truth = truth_from_model(known, artifacts.MODEL.load(workspace / "sfm"), truth)
    seen = seen_surface(known)

    def row(name: str, points: np.ndarray, trust: np.ndarray) -> Row:
        at = to_truth.apply(points)
        judged = known.counts(at)
        return score_points(name, at[judged], trust[judged], known, seen)

    rows = [row(EVERY, *every_depth(scene, artifacts.DEPTH_MAPS.load(workspace / "densify")))]
    for least in THRESHOLDS:
        chosen = cloud.trust >= least
        rows.append(row(f"trust from {least:g} on" if least else "cloud", cloud.points[chosen], cloud.trust[chosen]))
    done = load_manifest(workspace / "densify")
    command = f"python -m benchmarks.stereo DATA {name}"
    pairs = int(done.numbers["pairs"])
    return Result(name, command, machine(), len(scene.cameras), pairs, done.cpu_s, done.peak_rss, tuple(rows))


def every_depth(scene: PosedScene, maps: artifacts.DepthMaps) -> tuple[np.ndarray, np.ndarray]:
    """Places [N, 3] in the frame of the poses and trust [N] of every third row's and column's known depths."""
    from stages.stereo.depths import views_of
    from stages.stereo.trust import places

    points, trusts = [np.zeros((0, 3))], [np.zeros(0)]
    for k, name in enumerate(scene.cameras.names):
        if (loaded := maps.load(name)) is None:
            continue
        depth, trust = loaded
        view = views_of(scene.cameras.select([k]), max(depth.shape))[0]
        v, u = (STRIDE * each for each in np.nonzero(depth[::STRIDE, ::STRIDE] > 0))
        points.append(scene.poses_from_scene.apply(places(view, depth / scene.poses_from_scene.scale, v, u)))
        trusts.append(trust[v, u])
    return np.concatenate(points), np.concatenate(trusts)


def score_points(name: str, points: np.ndarray, trust: np.ndarray, known: KnownObject, seen: np.ndarray) -> Row:
    """Of points [P, 3] on the object and their trust [P], all in the truth's frame."""
    if not len(points):
        return Row(name, 0, *[float("nan")] * 7)
    scale = 100 / known.surface.extent
    distances = scale * Target(known.surface).nearest(points).distances
    to_points = scale * Target(Surface(points)).nearest(seen).distances
    accuracy = OneWay.of(distances)
    return Row(
        name, len(points), float(trust.mean()), accuracy.mean, float(np.average(distances, weights=trust)),
        accuracy.median, 100 * float((distances < 100 * NEAR).mean()), float(to_points.mean()),
        100 * float((to_points < 100 * NEAR).mean()),
    )  # fmt: skip


# ---------------------------------------------------------------- files and table
def save_result(result: Result) -> None:
    ROWS.mkdir(parents=True, exist_ok=True)
    rounded = json.loads(json.dumps(asdict(result)), parse_float=lambda text: round(float(text), 3))
    (ROWS / f"{result.name}.json").write_text(json.dumps(rounded, indent=1) + "\n", encoding="utf-8")


def load_results() -> list[Result]:
    """All there are, by name."""
    return [_result(json.loads(path.read_text(encoding="utf-8"))) for path in sorted(ROWS.glob("*.json"))]


def _result(data: dict[str, Any]) -> Result:
    return Result(**{**data, "rows": tuple(Row(**row) for row in data["rows"])})


def stereo_table(results: Sequence[Result]) -> str:
    """A row for each choice of points of each set."""
    header = [
        "set", "points", "on the object", "mean trust", "mean error, %", "weighed by trust", "median", "within 1 %",
        "completeness, %", "covered within 1 %", "CPU s",
    ]  # fmt: skip
    rows = [
        [
            result.name if first else "",
            row.name,
            f"{row.points / 1000:.0f}k",
            f"{row.trust:.2f}",
            f"{row.mean:.2f}",
            f"{row.weighed:.2f}",
            f"{row.median:.2f}",
            f"{row.within:.0f}",
            f"{row.completeness:.2f}",
            f"{row.covered:.0f}",
            f"{result.cpu_s:.0f}" if first else "",
        ]
        for result in results
        for first, row in zip((True, *[False] * len(result.rows)), result.rows, strict=False)
    ]
    return markdown_table(header, rows)


def tables() -> dict[str, str]:
    """The table, from the result files."""
    results = load_results()
    return {"stereo": stereo_table(results) if results else NOT_MEASURED}


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, nargs="?", help="folder of sets")
    parser.add_argument("sets", nargs="*", help="names of sets; default: all with a known surface")
    parser.add_argument("--workspaces", type=Path, help="runs that are there, by the names of sets")
    parser.add_argument("--again", action="store_true", help="also sets that have a result")
    parser.add_argument("--table-only", action="store_true", help="measure nothing")
    arguments = parser.parse_args(argv)
    failed = []
    if not arguments.table_only:
        if arguments.data is None:
            parser.error("name a folder of sets, or --table-only")
        data = arguments.data.resolve()
        for name in [name for name in find_sets(data, arguments.sets) if has_truth(data / name)]:
            if (ROWS / f"{name}.json").exists() and not arguments.again:
                continue
            try:
                made = arguments.workspaces
                save_result(measure(name, made / name if made else make_workspace(name, data), data / name))
            except (RuntimeError, HineusError) as error:
                print(f"{name}: {error}", file=sys.stderr)
                failed.append(name)
    write_tables(tables())
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
