"""The tables of docs/benchmarks/ and docs/what-to-expect.md: made from result files, written between markers.

python -m benchmarks.pages     write all of them anew

Table NAME stands between `<!-- table NAME -->` and `<!-- end NAME -->`, once, on whichever page has the markers: pages
can be split and joined without a change here. `--table-only` of a benchmark writes its own tables alone.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from importlib import import_module
from pathlib import Path

DOCS = Path(__file__).parent.parent / "docs"
NOT_MEASURED = "Not measured yet."
# Each has `tables()`: names and Markdown.
BENCHMARKS = (
    "run_sets", "stereo", "held_out", "textures", "hard_variants", "last_adjustment", "ablate", "suites", "growth",
    "many_photos", "regions", "region_cuts", "auto_masks", "charts", "splats", "materials.tables", "what_to_expect",
)  # fmt: skip


def markdown_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Markdown: the first column to the left, the others to the right."""
    lines = [header, ["---"] + ["---:"] * (len(header) - 1), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def with_tables(pages: Mapping[Path, str], tables: Mapping[str, str]) -> dict[Path, str]:
    """The pages with these tables between their markers.

    Raises:
        ValueError: a table's markers are not on the pages, or there more than once.
    """
    made = dict(pages)
    for name, body in tables.items():
        begin, end = f"<!-- table {name} -->", f"<!-- end {name} -->"
        if any(sum(page.count(marker) for page in made.values()) != 1 for marker in (begin, end)):
            raise ValueError(f"the markers {begin} and {end} are expected once each")
        path = next(path for path, page in made.items() if begin in page)
        before, rest = made[path].split(begin)
        made[path] = f"{before}{begin}\n{body}\n{end}{rest.split(end)[1]}"
    return made


def read_pages() -> dict[Path, str]:
    return {path: path.read_text(encoding="utf-8") for path in sorted(DOCS.rglob("*.md"))}


def write_tables(tables: Mapping[str, str]) -> None:
    """Write these tables into the pages under `DOCS`.

    Raises:
        ValueError: as `with_tables`.
    """
    before = read_pages()
    for path, page in with_tables(before, tables).items():
        if page != before[path]:
            path.write_text(page, encoding="utf-8")


def all_tables() -> dict[str, str]:
    """The tables of all benchmarks."""
    return {
        name: body
        for benchmark in BENCHMARKS
        for name, body in import_module(f"benchmarks.{benchmark}").tables().items()
    }


if __name__ == "__main__":
    write_tables(all_tables())
    sys.exit(0)
