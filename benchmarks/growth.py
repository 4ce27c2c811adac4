"""How time and memory grow: with the number of photos, with their size, and with the mesh's resolution.

python -m benchmarks.growth DATA                     from the photos of DATA/synth_plaster
python -m benchmarks.growth DATA synth_helmet        of another set
python -m benchmarks.growth --table-only             only rewrite the table of docs/benchmarks/growth.md

Photos are left out evenly; larger ones are the same photos enlarged, so that they hold more pixels and no more detail.
Training is cut to a few hundred steps: a step costs the same whatever the photos, and the table shows what steps cost.
The last row is training alone on 300 photos of two megapixels, of noise, which is what it holds in memory.

One result a row goes to benchmarks/results/growth/; rows that are there are not measured again without --again.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from benchmarks.pages import NOT_MEASURED, markdown_table, write_tables
from benchmarks.run_sets import GIB, OUT, RESULTS, ROOT, find_sets, machine, photos_of, run_hineus

STEPS = 400
ROWS = RESULTS / "growth"
FOLDER = OUT / "growth"
BIG_PHOTOS, BIG_SIZE, BIG_STEPS = 300, (1632, 1224), 20
# name of the row -> photos taken (None: all), enlarged by, resolution of the mesh
SIZES: dict[str, tuple[int | None, int, int]] = {
    "12 photos": (12, 1, 256),
    "24 photos": (24, 1, 256),
    "all photos": (None, 1, 256),
    "all photos, twice as wide": (None, 2, 256),
    "all photos, mesh 128": (None, 1, 128),
    "all photos, mesh 512": (None, 1, 512),
}
BIG = f"training on {BIG_PHOTOS} photos of {BIG_SIZE[0]} x {BIG_SIZE[1]}"
STAGES = ("sfm", "undistort", "densify", "train", "extract", "cleanup", "atlas", "bake", "report")


@dataclass(frozen=True)
class Row:
    """One measurement.

    Attributes:
        name: of the row. set: whose photos. photos: how many. pixels: of the largest photo.
        seconds: wall seconds a stage; of `train` a thousand steps.
        peak_rss: bytes a stage.
        faces: of the mesh before cleanup, or None where none was made.
    """

    name: str
    set: str
    photos: int
    pixels: int
    seconds: dict[str, float]
    peak_rss: dict[str, int]
    faces: int | None
    machine: dict[str, str]


def make_photos(source: Path, count: int | None, enlarged: int, folder: Path) -> tuple[int, int]:
    """Write `count` of the photos in `source`, evenly chosen, enlarged; returns how many and the largest's pixels."""
    from PIL import Image

    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    files = sorted(path for path in source.iterdir() if path.is_file())
    count = min(count or len(files), len(files))
    pixels = 0
    for index in range(count):
        file = files[index * len(files) // count]
        with Image.open(file) as photo:
            pixels = max(pixels, photo.width * photo.height * enlarged**2)
            if enlarged == 1:
                shutil.copyfile(file, folder / file.name)
                continue
            large = photo.resize((photo.width * enlarged, photo.height * enlarged), Image.Resampling.LANCZOS)
            large.save(folder / file.name, exif=photo.getexif(), quality=97)
    return count, pixels


def measure(name: str, data: Path, set_name: str) -> Row:
    """Run the pipeline for one row.

    Raises:
        RuntimeError: `hineus` failed.
    """
    count, enlarged, resolution = SIZES[name]
    source = photos_of(data / set_name)
    assert source is not None  # find_sets looked
    # Rows that differ in the mesh alone go on in one workspace.
    workspace = FOLDER / f"{set_name}-{count or 'all'}-x{enlarged}"
    photos, pixels = make_photos(source, count, enlarged, FOLDER / f"{workspace.name}-photos")
    budget = [f"train.steps={STEPS}", "train.steps_if_covered=1", "train.minutes=null"]
    settings = [*budget, f"extract.resolution={resolution}"]
    arguments = [word for text in settings for word in ("--set", text)]
    answer = run_hineus(
        ["run", str(FOLDER / f"{workspace.name}-photos"), "--workspace", str(workspace), *arguments, "--json"]
    )
    stages = {stage["name"]: stage for stage in answer["stages"]}
    seconds = {stage: round(stages[stage]["wall_s"], 2) for stage in STAGES}
    seconds["train"] = round(stages["train"]["numbers"]["train_seconds"] * 1000 / STEPS, 1)
    rss = {stage: int(stages[stage]["peak_rss"]) for stage in STAGES}
    return Row(name, set_name, photos, pixels, seconds, rss, stages["extract"]["numbers"]["faces"], machine())


# ---------------------------------------------------------------- many large photos
def measure_big() -> Row:
    """Training on many large photos, in a process of its own, whose peak is nothing else's."""
    done = subprocess.run(
        [sys.executable, "-m", "benchmarks.growth", "--big"], cwd=ROOT, stdout=subprocess.PIPE, text=True, check=True
    )
    seconds, peak = json.loads(done.stdout.splitlines()[-1])
    pixels = BIG_SIZE[0] * BIG_SIZE[1]
    return Row(BIG, "", BIG_PHOTOS, pixels, {"train": seconds}, {"train": peak}, None, machine())


def big_training() -> tuple[float, int]:
    """Seconds a thousand steps, and this process's peak of memory in bytes."""
    import resource
    import time

    import numpy as np

    from benchmarks import ball_heap
    from configs.training import TrainParams
    from stages.geometry.cameras import PinholeCameras
    from stages.neural.trainer import Trainer
    from stages.neural.training_photos import Photos

    heap = ball_heap.dome_of_cameras()
    chosen = np.arange(BIG_PHOTOS) % len(heap)
    larger = BIG_SIZE[0] / heap.sizes[0, 0]
    cameras = PinholeCameras(
        tuple(f"{i:03}.png" for i in range(BIG_PHOTOS)),
        np.tile(BIG_SIZE, (BIG_PHOTOS, 1)),
        heap.intrinsics[chosen] * np.array([larger, larger, 1.0])[:, None],
        heap.extrinsics[chosen],
    )
    noise = np.random.default_rng(0)
    images = (noise.integers(0, 255, (BIG_SIZE[1], BIG_SIZE[0], 3), dtype=np.uint8) for _ in range(BIG_PHOTOS))
    photos = Photos(cameras, images, None, "cpu")
    trainer = Trainer(photos, *ball_heap.sightings(heap, "cpu"), TrainParams(), "cpu")
    trainer.step(0.5)
    began = time.perf_counter()
    for _ in range(BIG_STEPS):
        trainer.step(0.5)
    seconds = (time.perf_counter() - began) * 1000 / BIG_STEPS
    return round(seconds, 1), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


# ---------------------------------------------------------------- table
def row_path(name: str) -> Path:
    return ROWS / f"{name.replace(', ', '-').replace(' ', '_')}.json"


def load_rows() -> list[Row]:
    """All rows that were measured, in the table's order."""
    paths = [row_path(name) for name in (*SIZES, BIG)]
    return [Row(**json.loads(path.read_text(encoding="utf-8"))) for path in paths if path.exists()]


def growth_table(rows: Sequence[Row]) -> str:
    """A row a measurement: seconds of each stage, the run's peak and training's, faces."""
    header = [
        "photos", "MP each", "mesh faces", *STAGES[:3], "train, a 1000 steps", *STAGES[4:], "peak GiB", "train GiB",
    ]  # fmt: skip
    body = [
        [
            row.name.replace("all photos", f"{row.photos} photos"),
            f"{row.pixels / 1e6:.1f}",
            "-" if row.faces is None else str(row.faces),
            *(f"{row.seconds[stage]:.1f}" if stage in row.seconds else "-" for stage in STAGES),
            f"{max(row.peak_rss.values()) / GIB:.2f}",
            f"{row.peak_rss['train'] / GIB:.2f}",
        ]
        for row in rows
    ]
    return markdown_table(header, body)


def tables() -> dict[str, str]:
    """The table, from the result files."""
    rows = load_rows()
    return {"growth": growth_table(rows) if rows else NOT_MEASURED}


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", nargs="?", type=Path, help="folder of sets")
    parser.add_argument("set", nargs="?", default="synth_plaster", help="whose photos; default synth_plaster")
    parser.add_argument("--again", action="store_true", help="measure rows that have a result, too")
    parser.add_argument("--table-only", action="store_true", help="only rewrite the table")
    parser.add_argument("--big", action="store_true", help=argparse.SUPPRESS)
    arguments = parser.parse_args(argv)
    if arguments.big:
        print(json.dumps(big_training()))
        return 0
    if not arguments.table_only:
        if arguments.data is None:
            parser.error("name the folder of sets")
        find_sets(arguments.data, [arguments.set])
        ROWS.mkdir(parents=True, exist_ok=True)
        for name in (*SIZES, BIG):
            if row_path(name).exists() and not arguments.again:
                continue
            row = measure_big() if name == BIG else measure(name, arguments.data, arguments.set)
            row_path(name).write_text(json.dumps(asdict(row), indent=1) + "\n", encoding="utf-8")
            print(f"{name}: done", file=sys.stderr, flush=True)
    write_tables(tables())
    return 0


if __name__ == "__main__":
    sys.exit(main())
