"""Tables of docs/benchmarks/suites.md from what `hineus bench` measured.

python -m benchmarks.suites OUT             take the results under OUT (that of `hineus bench --out`), then the tables
python -m benchmarks.suites --table-only    only rewrite the tables

Results go to benchmarks/results/suites/SUITE/SCENE/; each names its settings and the machine.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks.pages import NOT_MEASURED, markdown_table, write_tables
from benchmarks.run_sets import RESULTS
from stages import artifacts
from stages.evaluation.suites.paper import PaperRow, paper_tables
from stages.evaluation.suites.registry import SUITES
from stages.evaluation.suites.runs import load_results
from stages.evaluation.suites.tables import TextTable, score_of, tables_of

FOLDER = RESULTS / "suites"


def take_results(out: Path) -> int:
    """Copy the results under `out` that did not fail; returns how many."""
    results = load_results(out)
    for result in results:
        name = f"seed{result['seed']}" if "seed" in result else f"peer-{result['method']}"
        file = FOLDER / result["suite"] / result["scene"] / f"{result['preset']}-{name}.json"
        file.parent.mkdir(parents=True, exist_ok=True)
        artifacts.write_json(file, result)
    return len(results)


def suites_tables(results: Sequence[dict[str, Any]]) -> str:
    """All tables of all suites that there are results of."""
    parts = []
    for name, suite in SUITES.items():
        own = [result for result in results if result["suite"] == name]
        if own:
            made = tables_of(suite, own)
            # the paper's figures stand on the page only beside some of ours
            scored = any(score_of(suite, result) is not None for result in own)
            parts += [_markdown(table) for table in (made if scored else made[1:])]
    return "\n\n".join(parts) or NOT_MEASURED


def _markdown(table: TextTable) -> str:
    note = f"\n\n{table.note}" if table.note else ""
    return f"**{table.title}**\n\n{markdown_table(table.header, table.rows)}{note}"


def beyond_rounding(row: PaperRow, decimals: int) -> bool:
    """Whether rounding of every figure and of the average, half a unit each, cannot explain the printed one either."""
    return abs(row.average - row.printed) > 1.001 * 10.0**-decimals


def averages_table() -> str:
    """The paper's printed averages that are not those of the figures beside them."""
    rows = []
    for name, paper in paper_tables().items():
        decimals = SUITES[name].decimals
        rows += [
            [
                SUITES[name].title,
                row.method,
                f"{row.printed:.{decimals}f}",
                f"{row.average:.{decimals + 1}f}",
                "no" if beyond_rounding(row, decimals) else "yes",
            ]
            for row in paper.rows
            if row.deviates(decimals)
        ]
    return markdown_table(["suite", "row", "printed", "of its figures", "rounding may explain it"], rows)


def tables() -> dict[str, str]:
    """The tables of suites, from their result files, and of the paper's averages."""
    return {"suites": suites_tables(load_results(FOLDER)), "paper averages": averages_table()}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path, nargs="?", help="folder of results")
    parser.add_argument("--table-only", action="store_true", help="take no results")
    arguments = parser.parse_args()
    if arguments.out is None and not arguments.table_only:
        parser.error("name a folder of results, or --table-only")
    if arguments.out is not None and take_results(arguments.out) == 0:
        print(f"there are no results in {arguments.out}", file=sys.stderr)
        return 1
    write_tables(tables())
    return 0


if __name__ == "__main__":
    sys.exit(main())
