"""How well the region of interest holds what the photos are about: nothing of it cut off, little else in it.

python -m benchmarks.regions                    made-up captures and the scenes of the synthetic suite
python -m benchmarks.regions DATA               and the sets in DATA, posed by `hineus run --until sfm`
python -m benchmarks.regions --only "trophy;pair"   these alone
python -m benchmarks.regions OUT --render trophy    photos of one in OUT/trophy, to run the whole pipeline on
python -m benchmarks.regions --table-only       only rewrite the tables of docs/benchmarks/regions.md

Results go to benchmarks/results/regions/: one file a version of the code (`--version`, by default "now"), rows that
are not measured again stay. Workspaces of sets lie in benchmarks/out/regions/, or where `--workspaces` says.
"""

from __future__ import annotations

import argparse
import statistics
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from benchmarks.captures import kinds, photos, sets, suite
from benchmarks.captures.model import Capture, Posed
from benchmarks.captures.subject import fit, seen_points
from benchmarks.captures.tracks import simulate
from benchmarks.pages import NOT_MEASURED, markdown_table, write_tables
from benchmarks.run_sets import OUT, find_sets, photos_of, run_hineus
from benchmarks.run_sets import RESULTS as ALL_RESULTS
from benchmarks.synthetic.scenes import RECIPES
from stages import artifacts
from stages.geometry.layout import find_layout
from stages.geometry.region import RegionOfInterest
from stages.geometry.subjects import find_subjects

RESULTS, WORKSPACES = ALL_RESULTS / "regions", OUT / "regions"
NOW, BEFORE = "now", "0.1.0"
MADE_UP, SUITE, SETS, PROXY = "made-up", "suite", "sets", "proxy"
WHOLE = 100.0  # percent inside


@dataclass(frozen=True)
class Row:
    """One capture.

    Attributes:
        group: MADE_UP, SUITE, SETS or PROXY.
        name: of the capture. shows: what is hard in it, or what its subject is known from.
        inside: percent of the subject's seen surface (of its points) within the region.
        sphere_ratio, box_ratio: the region's volume over that of the smallest sphere, and of the box, around it.
        kind, source: as `RegionOfInterest` has them.
        reach: the region's radius over the median distance of the cameras to its centre.
        points: sparse points there were.
    """

    group: str
    name: str
    shows: str
    inside: float
    sphere_ratio: float
    box_ratio: float
    kind: str
    source: str
    reach: float
    points: int


def region_of(posed: Posed) -> RegionOfInterest:
    """The region that undistort finds; all that this benchmark asks of the pipeline."""
    subjects = find_subjects(posed.cameras, posed.points, posed.observations)
    photos = subjects[0].photos if len(subjects) > 1 else None
    return find_layout(posed.cameras, posed.points, posed.observations, posed.masks, photos=photos).region


def measured(group: str, name: str, shows: str, posed: Posed, subject: np.ndarray) -> Row:
    """The row of a capture whose subject has the points [P, 3]."""
    region = region_of(posed)
    found = fit(subject, region.center, region.radius)
    reach = region.radius / np.median(np.linalg.norm(posed.cameras.centers - region.center, axis=1))
    return Row(
        group,
        name,
        shows,
        # never rounded up to what is asked for
        inside=float(np.floor(100 * found.inside) / 100),
        sphere_ratio=round(found.sphere_ratio, 2),
        box_ratio=round(found.box_ratio, 2),
        kind=region.kind,
        source=region.source,
        reach=round(float(reach), 3),
        points=len(posed.points),
    )


def simulated(group: str, name: str, shows: str, capture: Capture) -> Row:
    """The row of a made-up capture."""
    posed = simulate(capture, np.random.default_rng(0))
    return measured(group, name, shows, posed, seen_points(capture))


def measure(data: Path | None, workspaces: Path, only: Sequence[str]) -> Iterator[Row]:
    """Rows of all captures, or of those named."""
    for name, kind in kinds.KINDS.items():
        if not only or name in only:
            yield simulated(MADE_UP, name, kind.shows, kinds.make(name))
    for name, recipe in RECIPES.items():
        if not only or name in only:
            yield simulated(SUITE, name, recipe.shows, suite.make(name))
    for name in find_sets(data, []) if data else ():
        if not only or name in only:
            yield from _set_rows(name, data / name, _workspace(data / name, workspaces / name))


def _set_rows(name: str, folder: Path, workspace: Path) -> Iterator[Row]:
    """A set as it is, and with its masks where it has some."""
    posed, masks = sets.load_posed(workspace), sets.find_masks(folder)
    masked = None if masks is None else sets.load_posed(workspace, masks)
    subject, source = sets.subject_of(folder, posed, masked)
    yield measured(PROXY if source == sets.BY_PROXY else SETS, name, source, posed, subject)
    if masked is not None:
        yield measured(SETS, f"{name}, masks", source, masked, subject)


def _workspace(folder: Path, workspace: Path) -> Path:
    """The workspace of a set, with its photos posed; as it is where they are already."""
    if not (workspace / "sfm" / "manifest.json").is_file():
        until = ["--until", "sfm", "--deterministic", "--json"]
        run_hineus(["run", str(photos_of(folder)), "--workspace", str(workspace), *until])
    return workspace


# ---------------------------------------------------------------- results
def load_rows(version: str) -> dict[str, Row]:
    """All rows measured with a version of the code, by name."""
    path = RESULTS / f"{version}.json"
    rows = artifacts.read_json(path) if path.exists() else []
    return {row["name"]: Row(**row) for row in rows}


def save_rows(rows: dict[str, Row], version: str) -> None:
    RESULTS.mkdir(parents=True, exist_ok=True)
    artifacts.write_json(RESULTS / f"{version}.json", [asdict(row) for row in rows.values()])


# ---------------------------------------------------------------- tables
def capture_table(rows: Sequence[Row], before: dict[str, Row]) -> str:
    """A row a capture: the share inside and the volume, before and now."""
    header = [
        "capture", "what", f"{BEFORE}: inside %", "volume", "now: inside %", "volume", "over its box",
        "radius / distance", "kind",
    ]  # fmt: skip
    return markdown_table(header, [_cells(row, before.get(row.name)) for row in rows])


def _cells(row: Row, before: Row | None) -> list[str]:
    then = ["-", "-"] if before is None else [_percent(before.inside), f"{before.sphere_ratio:.1f}"]
    now = [_percent(row.inside), f"{row.sphere_ratio:.1f}", f"{row.box_ratio:.0f}", f"{row.reach:.2f}", row.kind]
    return [row.name, row.shows, *then, *now]


def _percent(value: float) -> str:
    return "100" if value >= WHOLE else f"{value:.2f}"


def summary_table(now: dict[str, Row], before: dict[str, Row]) -> str:
    """A row a group and version: how many are whole, the least share inside, the median volume."""
    header = ["captures", "code", "whole", "least inside %", "median volume", "largest volume"]
    rows = []
    for group, heading in (
        (MADE_UP, "made-up"),
        (SUITE, "synthetic suite"),
        (SETS, "sets with truth"),
        (PROXY, "proxy"),
    ):
        for version, results in ((BEFORE, before), (NOW, now)):
            chosen = [row for row in results.values() if row.group == group]
            if chosen:
                rows.append([heading, version, *_summary(chosen)])
    return markdown_table(header, rows)


def _summary(rows: Sequence[Row]) -> list[str]:
    whole = sum(row.inside >= WHOLE for row in rows)
    volumes = [row.sphere_ratio for row in rows]
    return [
        f"{whole} of {len(rows)}",
        _percent(min(row.inside for row in rows)),
        f"{statistics.median(volumes):.1f}",
        f"{max(volumes):.1f}",
    ]


def tables() -> dict[str, str]:
    """The tables, from the result files."""
    before = load_rows(BEFORE)
    now = load_rows(NOW)
    rows = list(now.values())
    made = {"regions summary": summary_table(now, before) if rows else NOT_MEASURED}
    for table, groups in (
        ("regions made-up", (MADE_UP, SUITE)),
        ("regions sets", (SETS,)),
        ("regions proxy", (PROXY,)),
    ):
        chosen = [row for row in rows if row.group in groups]
        made[table] = capture_table(chosen, before) if chosen else NOT_MEASURED
    return made


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", nargs="?", type=Path, help="folder of sets; with --render, of what is written")
    parser.add_argument("--only", default="", help="names, with semicolons between; default: all")
    parser.add_argument("--workspaces", type=Path, default=WORKSPACES, help="where those of the sets lie or will lie")
    parser.add_argument("--version", default=NOW, help=f"of the code that is measured, e.g. {BEFORE}; default: {NOW}")
    parser.add_argument("--table-only", action="store_true", help="only rewrite the tables")
    parser.add_argument("--render", metavar="NAME", help="write the photos of this made-up capture; needs Mitsuba")
    arguments = parser.parse_args(argv)
    if arguments.render:
        if arguments.data is None or arguments.render not in kinds.KINDS:
            parser.error(f"name a folder, and one of {'; '.join(kinds.KINDS)}")
        folder = arguments.data / arguments.render
        photos.render(kinds.make(arguments.render), arguments.render, folder)
        print(folder / "images")
        return 0
    if not arguments.table_only:
        rows = load_rows(arguments.version)
        for row in measure(arguments.data, arguments.workspaces, list(filter(None, arguments.only.split(";")))):
            rows[row.name] = row
            _say(row)
        save_rows(rows, arguments.version)
        _say_summary(rows)
    if arguments.version == NOW:
        write_tables(tables())
    return 0


def _say(row: Row) -> None:
    print(
        f"{row.group:8} {row.name:24} inside {row.inside:6.2f} %, volume {row.sphere_ratio:8.2f}, "
        f"radius / distance {row.reach:5.2f}, {row.kind}, {row.source}",
        file=sys.stderr, flush=True,
    )  # fmt: skip


def _say_summary(rows: dict[str, Row]) -> None:
    for group in (MADE_UP, SUITE, SETS, PROXY):
        chosen = [row for row in rows.values() if row.group == group]
        if chosen:
            whole, least, median, largest = _summary(chosen)
            print(
                f"{group}: {whole} whole, least {least} %, volume: median {median}, largest {largest}", file=sys.stderr
            )


if __name__ == "__main__":
    sys.exit(main())
