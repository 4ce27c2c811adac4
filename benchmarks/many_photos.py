"""Poses of many photos: which pairs are matched, what is found, and what it costs, from 50 to 1000 photos.

python -m benchmarks.many_photos                    all sizes with all mappers
python -m benchmarks.many_photos --photos 100 200   of these sizes
python -m benchmarks.many_photos --mappers global   with this mapper
python -m benchmarks.many_photos --table-only       only rewrite the tables of docs/benchmarks/many-photos.md

Photos are of a made-up city (`benchmarks.made_up_survey`), features are made up, and all else is the pipeline's own:
which pairs are matched, COLMAP's matches and their verification, and mapping. One thread. Each step is a process of its
own, whose peak of memory is nothing else's.

One result a row goes to benchmarks/results/many_photos/; rows that are there are not measured again without --again.
"""

from __future__ import annotations

import argparse
import json
import pickle
import resource
import shutil
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from benchmarks.pages import NOT_MEASURED, markdown_table, write_tables
from benchmarks.run_sets import GIB, OUT, RESULTS, ROOT

SIZES = (50, 100, 200, 400, 1000)
MAPPERS = ("global", "incremental", "hierarchical")
FEATURES = 2000
# Pairs of photos that both have so many features of the same points ought to be matched; a match of the whole graph
# hangs on the strong ones.
TRUE, STRONG = 100, 200
ROWS = RESULTS / "many_photos"
FOLDER = OUT / "many_photos"
PAIRS = "pairs"  # the step that comes before all mappers
PAIRS_WITHOUT_GPS = "pairs-without-gps"  # chosen only


# ---------------------------------------------------------------- steps, each in a process of its own
def measure(step: str, photos: int) -> dict[str, Any]:
    """The numbers of one step, and what it cost."""
    began = time.process_time()
    folder = FOLDER / str(photos)
    numbers = (
        make(folder, photos) if step == "survey"
        else match(folder, photos, gps=step == PAIRS) if step in (PAIRS, PAIRS_WITHOUT_GPS)
        else solve(folder, step)
    )  # fmt: skip
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    return {"cpu_seconds": round(time.process_time() - began, 1), "peak_rss": peak, **numbers}


def make(folder: Path, photos: int) -> dict[str, Any]:
    """Write the survey's database and truth."""
    from benchmarks.made_up_survey import write_survey

    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    survey = write_survey(folder / "unmatched.db", photos, FEATURES)
    (folder / "survey.pickle").write_bytes(pickle.dumps(survey))
    return {}


def match(folder: Path, photos: int, gps: bool) -> dict[str, Any]:
    """Choose pairs; with GPS, match and verify them, too."""
    import numpy as np
    import pycolmap

    from benchmarks.made_up_survey import overlaps
    from configs.params import SfmParams
    from stages.geometry.earth import east_north_up, middle_position
    from stages.posing.candidates import candidate_pairs
    from stages.posing.pairs import likely_pairs, match_pairs
    from stages.posing.settings import match_options

    pycolmap.logging.minloglevel = 2
    survey = pickle.loads((folder / "survey.pickle").read_bytes())
    database = folder / ("plain.db" if gps else "choosing.db")
    shutil.copyfile(folder / "unmatched.db", database)
    with pycolmap.Database.open(database) as opened:
        priors = np.array([prior.position.ravel() for prior in opened.read_all_pose_priors()])
    metres = east_north_up(priors, middle_position(priors))
    positions = dict(zip(survey.names, metres, strict=True)) if gps else {}
    began = time.process_time()
    candidates = candidate_pairs(database, positions)
    chosen = likely_pairs(database, candidates)
    choosing = time.process_time() - began
    common = overlaps(survey)
    numbers: dict[str, Any] = {
        "candidates": len(candidates), "pairs": len(chosen), "choosing_seconds": round(choosing, 1),
        **{f"{name}_found": round(found(common >= least, chosen), 4)
           for name, least in (("true", TRUE), ("strong", STRONG))},
        "candidates_found": round(found(common >= TRUE, candidates), 4),
        "true_share": round(float(np.mean([common[i - 1, j - 1] >= TRUE for i, j in chosen])), 4),
        "most_partners": int(np.bincount(np.array(chosen).ravel()).max()),
    }  # fmt: skip
    if gps:
        began = time.process_time()
        match_pairs(database, chosen, match_options(SfmParams(), 1, False))
        numbers["matching_seconds"] = round(time.process_time() - began, 1)
    else:
        database.unlink()
    return numbers


def found(true: Any, pairs: Sequence[tuple[int, int]]) -> float:
    """Part of the true pairs [n, n] that are among those chosen (image ids, from 1)."""
    import numpy as np

    taken = np.zeros_like(true)
    first, second = np.array(pairs).T - 1
    taken[first, second] = taken[second, first] = True
    return float(taken[true].mean())


def solve(folder: Path, mapper: str) -> dict[str, Any]:
    """Map what was matched, and compare with the true poses."""
    import tempfile

    import numpy as np
    import pycolmap

    from configs.params import SfmParams
    from stages.artifacts import ImageSet
    from stages.artifacts.ingest import ImageRecord
    from stages.geometry.similarity import align_points
    from stages.posing.workbench import Base, Workbench

    pycolmap.logging.minloglevel = 2
    survey = pickle.loads((folder / "survey.pickle").read_bytes())

    class Matched(Workbench):
        """A workbench whose photos have features and matches already."""

        def _import(self, base: Base) -> None:
            shutil.copyfile(folder / "plain.db", self.database(base))

    records = tuple(ImageRecord(name, name, 1600, 1200, 1.0, "c", 1.0, False, "") for name in survey.names)
    with tempfile.TemporaryDirectory(dir=folder) as work:
        began = time.process_time()
        bench = Matched(
            Path(work), folder, folder, ImageSet(records), SfmParams(), 1, 1, False, lambda done, total, note: None
        )
        solution = bench._solve(Base(), mapper)
        seconds = time.process_time() - began
    if solution is None:
        return {"mapping_seconds": round(seconds, 1), "registered": 0}
    model, places = solution.model, {name: i for i, name in enumerate(survey.names)}
    images = [model.images[i] for i in model.reg_image_ids()]
    rows = [places[image.name] for image in images]
    true_from_found = align_points(np.array([image.projection_center() for image in images]), survey.centers[rows])
    centers = true_from_found.apply(np.array([image.projection_center() for image in images]))
    turns = []
    for image, row in zip(images, rows, strict=True):
        world_from_cam = true_from_found.rotation @ image.cam_from_world().rotation.matrix().T
        cosine = (np.trace(world_from_cam.T @ survey.world_from_cam[row]) - 1) / 2
        turns.append(np.degrees(np.arccos(np.clip(cosine, -1, 1))))
    errors = np.linalg.norm(centers - survey.centers[rows], axis=1)
    return {
        "mapping_seconds": round(seconds, 1), "registered": len(images), "points": solution.points,
        "error_px": round(solution.error_px, 3),
        "median_error_m": round(float(np.median(errors)), 4), "most_error_m": round(float(errors.max()), 3),
        "median_error_deg": round(float(np.median(turns)), 4),
    }  # fmt: skip


# ---------------------------------------------------------------- rows
def row_path(step: str, photos: int) -> Path:
    return ROWS / f"{photos}-{step}.json"


def load(step: str, photos: int) -> dict[str, Any] | None:
    path = row_path(step, photos)
    return json.loads(path.read_text(encoding="utf-8")) if path.exists() else None


def run_step(step: str, photos: int) -> dict[str, Any]:
    """One step in a process of its own.

    Raises:
        RuntimeError: it failed.
    """
    command = [sys.executable, "-m", "benchmarks.many_photos", "--step", step, "--photos", str(photos)]
    done = subprocess.run(command, cwd=ROOT, stdout=subprocess.PIPE, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"{step} of {photos} photos failed")
    answer: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return answer


def measure_all(sizes: Sequence[int], mappers: Sequence[str], again: bool) -> None:
    """Measure what has no result yet."""
    ROWS.mkdir(parents=True, exist_ok=True)
    for photos in sizes:
        steps = [step for step in (PAIRS, PAIRS_WITHOUT_GPS, *mappers) if again or load(step, photos) is None]
        if steps and not (FOLDER / str(photos) / "survey.pickle").exists():
            run_step("survey", photos)
        if steps and PAIRS not in steps and not (FOLDER / str(photos) / "plain.db").exists():
            steps.insert(0, PAIRS)
        for step in steps:
            try:
                numbers = run_step(step, photos)
            except RuntimeError as error:
                print(error, file=sys.stderr, flush=True)
                continue
            row_path(step, photos).write_text(json.dumps(numbers, indent=1) + "\n", encoding="utf-8")
            print(f"{photos} photos, {step}: {numbers}", file=sys.stderr, flush=True)


# ---------------------------------------------------------------- tables
def pairs_row(photos: int, gps: bool, row: Mapping[str, Any]) -> list[str]:
    shares = ("true_share", "candidates_found", "true_found", "strong_found")
    return [
        str(photos),
        "yes" if gps else "no",
        f"{2 * row['candidates'] / photos:.0f}",
        f"{2 * row['pairs'] / photos:.1f}",
        *(f"{100 * row[share]:.0f}" for share in shares),
        f"{row['choosing_seconds']:.0f}",
        f"{row['matching_seconds']:.0f}" if gps else "-",
        f"{row['peak_rss'] / GIB:.2f}",
    ]


def mapping_row(photos: int, mapper: str, row: Mapping[str, Any]) -> list[str]:
    poses = ["-", "-", "-"]
    if row["registered"]:
        poses = [
            f"{100 * row['median_error_m']:.1f}", f"{row['median_error_deg']:.3f}", f"{row['error_px']:.2f}",
        ]  # fmt: skip
    cost = [f"{row['mapping_seconds']:.0f}", f"{row['peak_rss'] / GIB:.2f}"]
    return [str(photos), mapper, str(row["registered"]), *poses, *cost]


def tables() -> dict[str, str]:
    """Pairs and poses, from the result files."""
    pairs = [
        pairs_row(photos, step == PAIRS, row)
        for photos in SIZES
        for step in (PAIRS, PAIRS_WITHOUT_GPS)
        if (row := load(step, photos)) is not None
    ]
    poses = [
        mapping_row(photos, mapper, row)
        for photos in SIZES
        for mapper in MAPPERS
        if (row := load(mapper, photos)) is not None
    ]
    about_pairs = [
        "photos", "GPS", "compared a photo", "matched a photo", "true, %", "true among compared, %",
        "true matched, %", "strong matched, %", "choosing, CPU s", "matching, CPU s", "peak GiB",
    ]  # fmt: skip
    about_poses = [
        "photos", "mapper", "registered", "place, cm", "turn, degrees", "error, px", "mapping, CPU s", "peak GiB",
    ]  # fmt: skip
    return {
        "many-photos-pairs": markdown_table(about_pairs, pairs) if pairs else NOT_MEASURED,
        "many-photos-poses": markdown_table(about_poses, poses) if poses else NOT_MEASURED,
    }


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--photos", nargs="+", type=int, default=list(SIZES), help="sizes; default all")
    parser.add_argument("--mappers", nargs="+", choices=MAPPERS, default=list(MAPPERS), help="default all")
    parser.add_argument("--again", action="store_true", help="measure rows that have a result, too")
    parser.add_argument("--table-only", action="store_true", help="only rewrite the tables")
    parser.add_argument("--step", help=argparse.SUPPRESS)
    arguments = parser.parse_args(argv)
    if arguments.step:
        print(json.dumps(measure(arguments.step, arguments.photos[0])))
        return 0
    if not arguments.table_only:
        measure_all(arguments.photos, arguments.mappers, arguments.again)
    write_tables(tables())
    return 0


if __name__ == "__main__":
    sys.exit(main())
