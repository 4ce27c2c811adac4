"""Materials and lights that are known, and how near a run comes to them.

python -m benchmarks.materials make OUT             photos, masks, cameras, truth and lights of all six objects
python -m benchmarks.materials run OUT              `hineus run --relightable` on each, then its score
python -m benchmarks.materials run OUT --steps 500  the same with shorter training
python -m benchmarks.materials score OUT RUNS       RUNS/NAME: a workspace, or a folder with model.glb and light.exr
python -m benchmarks.materials judge OUT            what the scores say of the truth itself
python -m benchmarks.materials tables               only rewrite the tables of docs/benchmarks/materials.md

All but the last need Mitsuba 3: `pip install -e '.[bench]'`. Runs go to OUT/runs/NAME, contact sheets to
OUT/sheets/NAME.png, results to benchmarks/results/materials/.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from benchmarks.materials import tables
from benchmarks.materials.glb_model import read_finished
from benchmarks.materials.making import make_object, write_true_object
from benchmarks.materials.measuring import measure
from benchmarks.materials.scenes import SUBJECTS
from benchmarks.materials.sheet import write_sheet
from benchmarks.pages import write_tables
from benchmarks.run_sets import run_hineus
from benchmarks.synthetic.mitsuba_camera import FAST, choose_variant
from stages import artifacts
from stages.engine.manifest import load_manifest
from stages.errors import HineusError

RUNS, SHEETS, TRUE = "runs", "sheets", "true"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("command", choices=("make", "run", "score", "judge", "tables"))
    parser.add_argument("out", type=Path, nargs="?", help="a folder for each object is, or gets, in it")
    parser.add_argument("runs", type=Path, nargs="?", help="what is scored; default: OUT/runs")
    parser.add_argument("--objects", default=",".join(SUBJECTS), help="names, with commas between; default: all")
    parser.add_argument("--steps", type=int, help="of training, for `run`; default: as many as `hineus run` takes")
    parser.add_argument("--threads", type=int, help="of Mitsuba; default: all cores")
    asked = parser.parse_args()
    names = asked.objects.split(",")
    unknown = [name for name in names if name not in SUBJECTS]
    if unknown:
        parser.error(f"no object is called {', '.join(unknown)}; there are {', '.join(SUBJECTS)}")
    if asked.command != "tables":
        if asked.out is None:
            parser.error("name a folder")
        try:
            _measure(asked, names)
        except HineusError as error:
            _say(f"{error.message}\n{error.hint}")
            return error.exit_code
    if asked.command != "make":
        write_tables(tables.tables())
    return 0


def _measure(asked: argparse.Namespace, names: Sequence[str]) -> None:
    variant, reason = choose_variant()
    _say(f"Mitsuba's variant: {variant}, {reason}")
    if asked.threads is not None and variant == FAST:
        import drjit

        drjit.set_thread_count(asked.threads)
    for name in names:
        started, used = time.monotonic(), time.process_time()
        truth = asked.out / name
        if asked.command == "make":
            make_object(name, truth, variant)
        elif asked.command == "judge":
            folder = asked.out / TRUE / name
            write_true_object(name, folder)
            score_object(name, asked.out, folder, tables.JUDGED, variant)
        else:
            runs = asked.runs or asked.out / RUNS
            if asked.command == "run":
                run_object(truth, runs / name, asked.steps)
            score_object(name, asked.out, runs / name, tables.RESULTS, variant)
        _say(f"{name}: {time.monotonic() - started:.0f} s, {time.process_time() - used:.0f} CPU s")


def run_object(truth: Path, workspace: Path, steps: int | None) -> None:
    """`hineus run --relightable` with known poses and masks."""
    shorter = [] if steps is None else ["--set", f"train.steps={steps}"]
    run_hineus(
        ["run", str(truth / "images"), "--workspace", str(workspace), "--poses", str(truth / "transforms.json"),
         "--masks", str(truth / "masks"), "--relightable", "--json", *shorter]
    )  # fmt: skip


def score_object(name: str, out: Path, folder: Path, results: Path, variant: str) -> None:
    """Score a workspace or a folder of files, and draw its contact sheet."""
    manifest = load_manifest(folder / "materials")
    finished = read_finished(folder)
    measured = measure(name, out / name, finished, variant)
    if manifest is not None and finished.has_materials:
        measured.result["cost"] = {"wall_s": manifest.wall_s, "cpu_s": manifest.cpu_s, "peak_rss": manifest.peak_rss}
    results.mkdir(parents=True, exist_ok=True)
    artifacts.write_json(results / f"{name}.json", measured.result)
    sheets = out / SHEETS / (TRUE if results == tables.JUDGED else "")
    write_sheet(measured.rows, measured.result["unseen"], sheets / f"{name}.png")
    for label, scores in measured.result["scores"].items():
        _say(f"{name}, {label}: " + ", ".join(f"{key} {value:.3f}" for key, value in scores.items()))


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


if __name__ == "__main__":
    sys.exit(main())
