"""What the last adjustment does to poses whose truth is known: the same models without it and with it.

python -m benchmarks.last_adjustment DATA                           every row that has no result yet
python -m benchmarks.last_adjustment DATA synth_helmet-off_centre   these
python -m benchmarks.last_adjustment DATA ROW --models FOLDER       from the model in FOLDER/ROW/sfm/model
python -m benchmarks.last_adjustment --table-only                   only rewrite the table of docs/benchmarks

Rows are those of `benchmarks.hard_variants` whose cameras are known, and sets with surveyed cameras: `images/` beside
`gt_dense_cameras/PHOTO.camera`, as in https://github.com/openMVG/SfM_quality_evaluation. Without `--models` the poses
are found first, `--deterministic`, in benchmarks/out/last_adjustment/ROW/. Results go to
benchmarks/results/last_adjustment/ROW.json.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.hard_variants import (
    VARIANTS,
    all_rows,
    center_distances,
    code_hash,
    make_photos,
    true_centers,
    true_centers_of_row,
)
from benchmarks.pages import NOT_MEASURED, markdown_table, write_tables
from benchmarks.run_sets import OUT, RESULTS, find_sets, machine, photos_of, run_hineus
from configs.params import SfmParams
from stages import artifacts
from stages.posing.adjustment import FREEDOMS, adjust_last

ROWS = RESULTS / "last_adjustment"
FOLDERS = OUT / "last_adjustment"
SURVEYED, CAMERA = "gt_dense_cameras", ".camera"


@dataclass(frozen=True)
class Row:
    """One set or variant.

    Attributes:
        name: SET or SET-VARIANT. machine: CPU, cores, versions. code: hash of the sources that find poses.
        unit: of the errors: mm, or % of the object's extent.
        photos: how many have a pose.
        error: median and largest distance of camera centres to the truth without and with the last adjustment.
        expected: median of what the covariance says it is, with it; None where it cannot be told.
        freed: what was, of any camera.
        gain_percent: of the mean error of held-out observations of the camera with most photos, by each
            freedom that was tried, kept or not.
        cpu_s: CPU seconds it took.
    """

    name: str
    machine: dict[str, str]
    code: str
    unit: str
    photos: int
    error: dict[str, tuple[float, float]]
    expected: float | None
    freed: tuple[str, ...]
    gain_percent: dict[str, float]
    cpu_s: float


# ---------------------------------------------------------------- truth
def surveyed_centers(folder: Path) -> dict[str, np.ndarray]:
    """Name of a photo -> its camera's centre [3] in metres, from files of K, distortion, world_from_cam and centre."""
    numbers = {
        path.name.removesuffix(CAMERA): np.array(path.read_text(encoding="utf-8").split(), float)
        for path in sorted((folder / SURVEYED).glob(f"*{CAMERA}"))
    }
    return {name: values[21:24] for name, values in numbers.items()}


def has_known_centers(row: str, data: Path) -> bool:
    return bool(surveyed_centers(data / row)) or true_centers(data / row.partition("-")[0]) is not None


def known_centers(row: str, data: Path, names: Sequence[str]) -> tuple[dict[str, np.ndarray], float, str]:
    """Centres of these photos of a row, how many of their unit the errors' unit is, and that unit's name.

    Raises:
        ValueError: the cameras are not known.
    """
    if surveyed := surveyed_centers(data / row):
        return surveyed, 1e-3, "mm"
    if (truth := true_centers_of_row(row, data, names)) is None:
        raise ValueError(f"the cameras of {row} are not known")
    centers, extent = truth
    return dict(zip(names, centers, strict=True)), extent / 100, "%"


# ---------------------------------------------------------------- one row
def run_row(row: str, data: Path, models: Path | None) -> Row:
    """Adjust one model.

    Raises:
        RuntimeError: its poses could not be found.
        ValueError: its cameras are not known.
    """
    import pycolmap

    if models is None:
        models = FOLDERS
        photos = photos_of(data / row) if (data / row).is_dir() else make_photos(row, data)
        given = ["--set", "sfm.refine_lens=off", "--deterministic", "--until", "sfm", "--json"]
        run_hineus(["run", str(photos), "--workspace", str(models / row), *given])
    model = pycolmap.Reconstruction(str(artifacts.MODEL.load(models / row / "sfm")))
    before = _centers(model)
    truth, unit, unit_name = known_centers(row, data, list(before))
    started = time.process_time()
    last = adjust_last(model, SfmParams(), threads=1)
    seconds = time.process_time() - started
    after = _centers(last.model)
    lens = max(last.lenses, key=lambda lens: lens.photos)
    scale = _scale(after, truth)
    return Row(
        name=row,
        machine=machine(),
        code=code_hash(),
        unit=unit_name,
        photos=len(after),
        error={"without": _error(before, truth, unit), "with": _error(after, truth, unit)},
        expected=round(last.pose_error.center * scale / unit, 4) if last.pose_error else None,
        freed=tuple(sorted({freedom for each in last.lenses for freedom in each.freed})),
        gain_percent={
            trial.freedom: round(100 * (1 - trial.held_out_px[1] / trial.held_out_px[0]), 2) for trial in lens.trials
        },
        cpu_s=round(seconds, 1),
    )


def _centers(model: Any) -> dict[str, np.ndarray]:
    return {model.images[i].name: np.array(model.images[i].projection_center()) for i in model.reg_image_ids()}


def _paired(found: dict[str, np.ndarray], truth: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Centres [N, 3] found and true of the photos that have both."""
    names = sorted(found.keys() & truth.keys())
    return np.array([found[name] for name in names]), np.array([truth[name] for name in names])


def _scale(found: dict[str, np.ndarray], truth: dict[str, np.ndarray]) -> float:
    from stages.geometry.similarity import align_points

    return align_points(*_paired(found, truth)).scale


def _error(found: dict[str, np.ndarray], truth: dict[str, np.ndarray], unit: float) -> tuple[float, float]:
    distances = center_distances(*_paired(found, truth)) / unit
    return round(float(np.median(distances)), 4), round(float(distances.max()), 4)


# ---------------------------------------------------------------- result files and table
def save_row(row: Row) -> None:
    ROWS.mkdir(parents=True, exist_ok=True)
    artifacts.write_json(ROWS / f"{row.name}.json", asdict(row))


def load_rows() -> list[Row]:
    """All there are, by name."""
    return [Row(**artifacts.read_json(path)) for path in sorted(ROWS.glob("*.json"))]


def adjustment_table(rows: Sequence[Row]) -> str:
    """One row a set or variant."""
    header = [
        "photos", "centre error without", "with", "expected", "freed", "held-out gain %: principal point", "k2",
        "CPU s",
    ]  # fmt: skip
    lines = [
        [
            _shown(row.name),
            *(f"{row.error[key][0]:.3g} {row.unit}" for key in ("without", "with")),
            "-" if row.expected is None else f"{row.expected:.2g} {row.unit}",
            " + ".join(row.freed) or "-",
            *(f"{row.gain_percent[key]:.2f}" if key in row.gain_percent else "-" for key in FREEDOMS),
            f"{row.cpu_s:.1f}",
        ]
        for row in rows
    ]
    return markdown_table(header, lines)


def _shown(name: str) -> str:
    base, _, variant = name.partition("-")
    return (f"{base}: {variant}" if variant in VARIANTS else name).replace("_", " ")


def tables() -> dict[str, str]:
    """The table, from the result files."""
    rows = load_rows()
    return {"last-adjustment": adjustment_table(rows) if rows else NOT_MEASURED}


# ---------------------------------------------------------------- command
def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, nargs="?", help="folder of sets")
    parser.add_argument("rows", nargs="*", help="SET or SET-VARIANT; default: all whose cameras are known")
    parser.add_argument("--models", type=Path, help="folder of workspaces, one a row, in place of finding poses")
    parser.add_argument("--again", action="store_true", help="also rows that have a result")
    parser.add_argument("--table-only", action="store_true", help="run nothing")
    arguments = parser.parse_args(argv)
    failed: list[str] = []
    if not arguments.table_only:
        if arguments.data is None:
            parser.error("name a folder of sets, or --table-only")
        data = arguments.data.resolve()
        done = set() if arguments.again else {row.name for row in load_rows()}
        for row in arguments.rows or [row for row in all_rows(find_sets(data, ())) if has_known_centers(row, data)]:
            if row in done:
                print(f"{row}: has a result (--again measures it anew)", file=sys.stderr)
                continue
            print(f"{row}: running", file=sys.stderr, flush=True)
            try:
                save_row(run_row(row, data, arguments.models))
            except (RuntimeError, ValueError) as error:
                print(f"{row}: {error}", file=sys.stderr)
                failed.append(row)
    write_tables(tables())
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
