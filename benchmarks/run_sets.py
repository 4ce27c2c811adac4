"""Run `hineus run` with default settings on sets of photos, and keep what it cost and what came out.

python -m benchmarks.run_sets DATA                  every set in DATA that has no result yet
python -m benchmarks.run_sets DATA banana viking    these
python -m benchmarks.run_sets DATA --seeds 2        each with seeds 0 and 1, poses made anew, too
python -m benchmarks.run_sets --demo                `hineus demo`
python -m benchmarks.run_sets --table-only          only rewrite the tables of the docs

A set is a folder with `images/` (or `image/`) and, where the truth is known, `gt_mesh.ply` and `transforms.json`.
Results go to benchmarks/results/SET.json (SET-seed1.json and so on), those of the scenes that `benchmarks.synthetic`
made to results/synthetic/, which has a table of its own; workspaces and contact sheets to benchmarks/out/. A set that
was cut off goes on where it stopped; seconds are those of the stages, as the workspace recorded them when each ran.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from statistics import fmean
from typing import Any

from benchmarks.pages import NOT_MEASURED, markdown_table, write_tables
from benchmarks.synthetic import MADE_WITH
from stages import artifacts
from stages.evaluation.machine import machine
from stages.posing import neus

ROOT = Path(__file__).parent.parent
RESULTS = ROOT / "benchmarks" / "results"
OUT = ROOT / "benchmarks" / "out"
VALIDATOR = ROOT / "benchmarks" / "validate_glb.mjs"
DEMO = "demo"
SYNTHETIC = "synthetic"  # folder of results, and table
GIB = 1 << 30


@dataclass(frozen=True)
class StageCost:
    """What one stage took, and the plain numbers it returned."""

    name: str
    wall_s: float
    cpu_s: float
    peak_rss: int
    numbers: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Result:
    """One set.

    Attributes:
        name: of the set.
        command: that made it, with DATA for the folder of sets.
        machine: CPU, cores, versions.
        stages: in order.
        score: distances in percent of the extent, or None without truth; see `protocols.known_object`.
        validator: counts of the glTF validator's messages, or None where it is not installed.
        glb_bytes: size of the textured model.
        seed: of the training.
    """

    name: str
    command: str
    machine: dict[str, str]
    stages: tuple[StageCost, ...]
    score: dict[str, float] | None
    validator: dict[str, int] | None
    glb_bytes: int
    seed: int = 0

    @property
    def wall_s(self) -> float:
        return sum(stage.wall_s for stage in self.stages)

    @property
    def cpu_s(self) -> float:
        return sum(stage.cpu_s for stage in self.stages)

    @property
    def peak_rss(self) -> int:
        return max(stage.peak_rss for stage in self.stages)

    def number(self, stage: str, name: str) -> Any:
        """A number that a stage returned, or None."""
        return next((each.numbers.get(name) for each in self.stages if each.name == stage), None)


# ---------------------------------------------------------------- running
def photos_of(folder: Path) -> Path:
    """The folder of photos of a set; where there is none, it is no set."""
    other = folder / neus.IMAGES
    return other if other.is_dir() and not (folder / "images").is_dir() else folder / "images"


def known_cameras(folder: Path) -> Path | None:
    """The file of a set's cameras in the layout of NeuS, where it comes with them."""
    path = folder / neus.FILES[0]
    return path if path.is_file() else None


def find_sets(data: Path, names: Sequence[str]) -> list[str]:
    """The sets to run: those named, else all in `data`.

    Raises:
        SystemExit: a named one has no photos, or there are none at all.
    """
    found = sorted(folder.name for folder in data.iterdir() if photos_of(folder).is_dir()) if data.is_dir() else []
    unknown = [name for name in names if name not in found]
    if unknown or not found:
        sys.exit(
            f"no photos for {', '.join(unknown) or 'any set'} in {data}; the sets there: {', '.join(found) or '-'}"
        )
    return list(names) or found


def run_set(name: str, data: Path | None, seed: int = 0) -> Result:
    """Run one set (or the demo, without `data`) in a process of its own, and measure its result.

    Raises:
        RuntimeError: `hineus` failed; its message is included.
    """
    OUT.mkdir(parents=True, exist_ok=True)
    workspace = OUT / _seeded(name, seed)
    if data is None:
        arguments, shown = ["demo", "--workspace", str(workspace)], "hineus demo"
        truth = workspace
    else:
        photos = photos_of(data / name)
        arguments = ["run", str(photos), "--workspace", str(workspace)]
        shown = f"hineus run DATA/{name}/{photos.name}"
        truth = data / name
        if seed:
            arguments += ["--set", f"train.seed={seed}"]
            shown += f" --set train.seed={seed}"
    answer = run_hineus([*arguments, "--json"])
    stages = tuple(
        StageCost(
            stage["name"],
            round(stage["wall_s"], 2),
            round(stage["cpu_s"], 2),
            int(stage["peak_rss"]),
            {key: value for key, value in stage["numbers"].items() if isinstance(value, (bool, int, float, str))},
        )
        for stage in answer["stages"]
    )
    folder = Path(answer["workspace"])
    glb = Path(answer["glb"])
    contact_sheet(folder, OUT / f"{workspace.name}.png")
    score = _score(folder, truth)
    return Result(name, shown, machine(), stages, score, validate(glb), glb.stat().st_size, seed)


def run_hineus(arguments: Sequence[str], answers: Sequence[int] = (0,)) -> dict[str, Any]:
    """What `hineus` says to arguments with `--json`, run in a process of its own.

    Args:
        answers: exit codes with which it is an answer.

    Raises:
        RuntimeError: it failed or gave no answer; its message is included.
    """
    command = [sys.executable, "-m", "hineus_cli", *arguments]
    done = subprocess.run(command, cwd=ROOT, stdout=subprocess.PIPE, text=True, check=False)
    try:
        answer = json.loads(done.stdout)
    except ValueError:
        answer = None
    if answer is None or done.returncode not in answers:
        raise RuntimeError(f"{' '.join(arguments)} ended with {done.returncode}: {done.stdout[-2000:]}")
    return answer


def _score(workspace: Path, truth: Path) -> dict[str, float] | None:
    from stages.evaluation.protocols.known_object import has_truth, score_mesh

    if not has_truth(truth):
        return None
    return score_mesh(artifacts.asset_path(workspace / "export", "ply"), artifacts.MODEL.load(workspace / "sfm"), truth)


def validate(glb: Path) -> dict[str, int] | None:
    """Errors, warnings, infos, hints that the glTF validator finds; None without Node.js or the package."""
    if shutil.which("node") is None:
        return None
    done = subprocess.run(
        ["node", str(VALIDATOR), str(glb)], cwd=VALIDATOR.parent, capture_output=True, text=True, check=False
    )
    try:
        report = json.loads(done.stdout)
    except ValueError:
        print(f"the glTF validator did not run: {done.stderr.strip()[-300:]}", file=sys.stderr)
        return None
    issues = report.get("issues", report)
    return {name: int(issues[key]) for name, key in VALIDATOR_COUNTS.items() if key in issues}


VALIDATOR_COUNTS = {"errors": "numErrors", "warnings": "numWarnings", "infos": "numInfos", "hints": "numHints"}


def contact_sheet(workspace: Path, path: Path) -> None:
    """Four sides of the textured mesh, and under them the bare geometry."""
    import numpy as np
    from PIL import Image

    from stages.drawing.rendering import render_textured, turntable
    from stages.reporting.pictures import read_rgb

    atlas = artifacts.ATLAS_MESH.load(workspace / "atlas")
    scene = artifacts.SCENE.load(workspace / "train")
    texture = read_rgb(artifacts.BASE_COLOR.load(workspace / "bake"))
    grey = np.full((1, 1, 3), 200, np.uint8)
    rows = []
    for colors, shaded in ((texture, False), (grey, True)):
        views = turntable(atlas.vertices, scene.up)
        rows.append(np.hstack([render_textured(atlas, colors, view, shaded) for view in views]))
    Image.fromarray(np.vstack(rows)).save(path)


# ---------------------------------------------------------------- result files
def result_path(name: str, data: Path | None, seed: int = 0) -> Path:
    """Where the result of a set belongs; `data`: its folder of sets, None for the demo."""
    ours = data is not None and (data / name / MADE_WITH).is_file()
    return (RESULTS / SYNTHETIC if ours else RESULTS) / f"{_seeded(name, seed)}.json"


def _seeded(name: str, seed: int) -> str:
    return f"{name}-seed{seed}" if seed else name


def save_result(result: Result, path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    artifacts.write_json(path, asdict(result))


def load_results(folder: Path) -> list[Result]:
    """All results there are, the demo first, then by name and seed."""
    results = []
    for path in sorted(folder.glob("*.json")):
        data = artifacts.read_json(path)
        data["stages"] = tuple(StageCost(**stage) for stage in data["stages"])
        results.append(Result(**data))
    return sorted(results, key=lambda result: (result.name != DEMO, result.name, result.seed))


# ---------------------------------------------------------------- tables
def summary_table(results: Sequence[Result]) -> str:
    """One row a set: what was registered and what it cost with the first seed, and the mean distances of all seeds."""
    header = [
        "set", "seeds", "photos registered", "wall min", "CPU min", "peak GiB", "faces", "GLB MB",
        "distance %", "accuracy %", "completeness %", "F at 1 %", "normals °", "glTF errors / warnings",
    ]  # fmt: skip
    by_name: dict[str, list[Result]] = {}
    for result in results:
        by_name.setdefault(result.name, []).append(result)
    return markdown_table(header, [_summary_row(seeds) for seeds in by_name.values()])


def _summary_row(seeds: Sequence[Result]) -> list[str]:
    first = seeds[0]
    validator = next((result.validator for result in seeds if result.validator), None)
    return [
        first.name,
        str(len(seeds)),
        f"{_text(first.number('sfm', 'registered'))} of {_text(first.number('sfm', 'images'))}",
        f"{first.wall_s / 60:.1f}",
        f"{first.cpu_s / 60:.1f}",
        f"{first.peak_rss / GIB:.2f}",
        _text(first.number("cleanup", "faces")),
        f"{first.glb_bytes / 1e6:.1f}",
        *(_score_cell(seeds, name) for name in ("mean", "accuracy", "completeness", "f_one_percent", "normals_deg")),
        f"{validator['errors']} / {validator['warnings']}" if validator else "-",
    ]


def stage_table(results: Sequence[Result]) -> str:
    """Wall and CPU seconds of each stage, one column a set."""
    rows = _stage_rows(results, lambda stage: f"{stage.wall_s:.1f} / {stage.cpu_s:.1f}")
    rows.append(["all", *(f"{result.wall_s:.0f} / {result.cpu_s:.0f}" for result in results)])
    return markdown_table(["stage", *(result.name for result in results)], rows)


def memory_table(results: Sequence[Result]) -> str:
    """Peak memory of each stage in GiB, one column a set."""
    rows = _stage_rows(results, lambda stage: f"{stage.peak_rss / GIB:.2f}")
    return markdown_table(["stage", *(result.name for result in results)], rows)


def _stage_rows(results: Sequence[Result], cell: Callable[[StageCost], str]) -> list[list[str]]:
    """One row a stage, one column a set."""
    names = dict.fromkeys(stage.name for result in results for stage in result.stages)
    costs = [{stage.name: stage for stage in result.stages} for result in results]
    return [[name, *(cell(cost[name]) if name in cost else "-" for cost in costs)] for name in names]


def texture_table(results: Sequence[Result]) -> str:
    """What the bake stage says of its texture."""
    names = list(
        dict.fromkeys(
            name
            for result in results
            for stage in result.stages
            if stage.name == "bake"
            for name, value in stage.numbers.items()
            if isinstance(value, (int, float)) and not isinstance(value, bool)
        )
    )
    rows = [[name.replace("_", " "), *(_text(result.number("bake", name)) for result in results)] for name in names]
    return markdown_table(["texture", *(result.name for result in results)], rows)


TABLES = {"summary": summary_table, "stages": stage_table, "memory": memory_table, "texture": texture_table}


def tables_of(results: Sequence[Result]) -> dict[str, str]:
    """The tables of sets; all but the summary show the first seed alone."""
    first = [result for result in results if result.seed == 0]
    shown = {name: results if table is summary_table else first for name, table in TABLES.items()}
    return {name: table(shown[name]) if shown[name] else NOT_MEASURED for name, table in TABLES.items()}


def tables() -> dict[str, str]:
    """All tables, from the result files."""
    ours = load_results(RESULTS / SYNTHETIC)
    return tables_of(load_results(RESULTS)) | {SYNTHETIC: summary_table(ours) if ours else NOT_MEASURED}


def _score_cell(seeds: Sequence[Result], name: str) -> str:
    """The mean over the seeds, and of several seeds' distances the least and the largest."""
    values = [result.score[name] for result in seeds if result.score and name in result.score]
    if not values:
        return "-"
    several = name == "mean" and len(values) > 1
    return f"{fmean(values):.2f}" + (f" ({min(values):.2f} to {max(values):.2f})" if several else "")


def _text(value: Any) -> str:
    if value is None:
        return "-"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def measure_folders(
    doc: str | None,
    folders: str,
    doing: str,
    results: Path,
    measure: Callable[[Path], dict[str, Any]],
    tables: Callable[[], dict[str, str]],
) -> int:
    """The command of a benchmark that measures folders one by one; returns its exit code.

    Args:
        doc: the module's, for --help. folders: what they are. doing: what is done with one, for stderr.
        results: where `measure`'s result of a folder goes, by its "name".
        tables: made from all results, and written.
    """
    parser = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", type=Path, nargs="*", help=folders)
    parser.add_argument("--table-only", action="store_true", help="measure nothing")
    arguments = parser.parse_args()
    if not arguments.folders and not arguments.table_only:
        parser.error(f"name {folders}, or --table-only")
    results.mkdir(parents=True, exist_ok=True)
    for folder in arguments.folders:
        print(f"{folder}: {doing}", file=sys.stderr, flush=True)
        result = measure(folder)
        artifacts.write_json(results / f"{result['name']}.json", result)
    write_tables(tables())
    return 0


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, nargs="?", help="folder of sets")
    parser.add_argument("sets", nargs="*", help="names of sets; default: all")
    parser.add_argument("--demo", action="store_true", help="run the demo, too")
    parser.add_argument("--seeds", type=int, default=1, help="how many seeds, from 0")
    parser.add_argument("--again", action="store_true", help="also sets that have a result")
    parser.add_argument("--table-only", action="store_true", help="run nothing")
    arguments = parser.parse_args()
    jobs: list[tuple[str, Path | None]] = [(DEMO, None)] if arguments.demo else []
    if arguments.data is not None and not arguments.table_only:
        jobs += [(name, arguments.data.resolve()) for name in find_sets(arguments.data, arguments.sets)]
    if not jobs and not arguments.table_only:
        parser.error("name a folder of sets, or --demo, or --table-only")
    failed = []
    # the demo has one seed
    runs = [
        (name, data, seed) for seed in range(arguments.seeds) for name, data in jobs if data is not None or not seed
    ]
    for name, data, seed in [] if arguments.table_only else runs:
        path = result_path(name, data, seed)
        if path.exists() and not arguments.again:
            print(f"{path.stem}: has a result (--again measures it anew)", file=sys.stderr)
            continue
        print(f"{path.stem}: running", file=sys.stderr)
        try:
            save_result(run_set(name, data, seed), path)
        except RuntimeError as error:
            print(f"{path.stem}: {error}", file=sys.stderr)
            failed.append(path.stem)
    write_tables(tables())
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
