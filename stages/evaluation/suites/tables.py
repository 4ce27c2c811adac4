"""Tables of benchmark results, as rows of text for a console or a page: ours beside the paper's, and what each took."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from stages.evaluation.suites.paper import PaperTable, paper_tables
from stages.evaluation.suites.registry import Suite
from stages.evaluation.suites.runs import OURS

GIB = 1 << 30
NONE = "-"
Result = Mapping[str, Any]


@dataclass(frozen=True)
class TextTable:
    """A heading and rows of cells, the first column of each a name."""

    title: str
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    note: str = ""


def tables_of(suite: Suite, results: Sequence[Result]) -> list[TextTable]:
    """All tables of one suite's results: its score beside the paper's, costs, view synthesis where there is any."""
    good = [result for result in results if "error" not in result]
    found = [score_table(suite, good), cost_table(suite, good)]
    return found + ([views_table(suite, good)] if any(_at(result, "scores.views") for result in good) else [])


def score_table(suite: Suite, results: Sequence[Result]) -> TextTable:
    """One row a method, one column a scene that was run; averages are over these scenes, the paper's figures, too."""
    paper = paper_tables().get(suite.name)
    names = {result["scene"] for result in results}
    known = paper.scenes if paper else ()
    scenes = [*(name for name in known if name in names), *sorted(names - set(known), key=_natural)]
    rows = [*(_paper_rows(paper, scenes, suite.decimals) if paper else ())]
    for label, runs in _by_method(results).items():
        scores = [[score_of(suite, run) for run in runs if run["scene"] == name] for name in scenes]
        average = _average([_mean(own) for own in scores], suite.decimals)
        rows.append((label, *(_spread(own, suite.decimals) for own in scores), average))
    note = ""
    if paper:
        note = f"Rows that are neither ours nor a peer's are the paper's ({paper.label}), over the scenes shown."
        if not set(scenes) & set(paper.scenes):
            note = f"None of these scenes is in the paper's table ({paper.label})."
    unit = f", {suite.unit}" if suite.unit else ""
    return TextTable(f"{suite.title}: {suite.score_name}{unit}", ("method", *scenes, "average"), tuple(rows), note)


def cost_table(suite: Suite, results: Sequence[Result]) -> TextTable:
    """One row a run: what it took."""
    rows = [
        (
            result["scene"],
            label_of(result),
            _number(result.get("seed"), 0),
            _number(result.get("photos"), 0),
            _number(result["wall_s"] / 60, 2),
            # peers start from photos that have poses, so all of their time is after that
            _number(result.get("wall_after_poses_s", result["wall_s"]) / 60, 2),
            _number(result["cpu_s"] / 60, 2),
            _number(result["peak_rss"] / GIB, 2),
        )
        for result in results
    ]
    header = ("scene", "method", "seed", "photos", "wall min", "after the poses", "CPU min", "peak GiB")
    return TextTable(f"{suite.title}: time and memory", header, tuple(rows))


VIEW_SCORES = (
    ("field, whole", "field.whole"),
    ("field, object", "field.object"),
    ("mesh, whole", "mesh.whole"),
    ("mesh, object", "mesh.object"),
    ("splats, whole", "splats.whole"),
    ("splats, object", "splats.object"),
)


def views_table(suite: Suite, results: Sequence[Result]) -> TextTable:
    """One row a run: PSNR and SSIM of test photos that no stage has seen, of the field, of the textured mesh and, where
    a run has any, of Gaussian splats."""
    rows = []
    judged = [result for result in results if _at(result, "scores.views")]
    with_splats = any(_at(result, "scores.views.mean.splats") for result in judged)
    shown = [(name, key) for name, key in VIEW_SCORES if with_splats or not key.startswith("splats")]
    for result in judged:
        cells = [result["scene"], label_of(result), _number(result.get("seed"), 0)]
        cells.append(_number(_at(result, "scores.views.counted"), 0))
        for _, key in shown:
            psnr, ssim = (_at(result, f"scores.views.mean.{key}.{name}") for name in ("psnr", "ssim"))
            cells.append(NONE if psnr is None else f"{psnr:.2f} / {ssim:.3f}")
        rows.append(tuple(cells))
    header = ("scene", "method", "seed", "test photos", *(name for name, _ in shown))
    return TextTable(f"{suite.title}: test photos, PSNR dB / SSIM", header, tuple(rows))


def score_of(suite: Suite, result: Result) -> float | None:
    """The score that the suite's papers compare; None where the run has none."""
    score = _at(result, f"scores.{suite.score}")
    return None if score is None else float(score)


def label_of(result: Result) -> str:
    """A run's method, with what its settings are."""
    if result["method"] != OURS:
        return f"peer: {result['method']}"
    own = [f"{key}={value}" for key, value in (result.get("asked") or {}).items()]
    return ", ".join([f"ours ({result['preset']}{', masks' if result['masks'] else ''})", *own])


def _by_method(results: Sequence[Result]) -> dict[str, list[Result]]:
    """Runs by label, ours last: below the rows they are to be compared with."""
    labels: dict[str, list[Result]] = {}
    for result in sorted(results, key=lambda result: result["method"] == OURS):
        labels.setdefault(label_of(result), []).append(result)
    return labels


def _paper_rows(paper: PaperTable, scenes: Sequence[str], decimals: int) -> list[tuple[str, ...]]:
    rows = []
    for row in paper.rows:
        figures = [row.scores.get(name) for name in scenes]
        if any(figure is not None for figure in figures):
            average = _average(figures, decimals)
            if set(scenes) >= set(paper.scenes) and row.deviates(decimals):
                average = f"{average} (printed: {row.printed:.{decimals}f})"
            rows.append((row.method, *(_number(figure, decimals) for figure in figures), average))
    return rows


def _at(result: Result, path: str) -> Any:
    """The value at a dotted path, None where there is none."""
    value: Any = result
    for key in path.split("."):
        if not isinstance(value, Mapping) or value.get(key) is None:
            return None
        value = value[key]
    return value


def _mean(values: Sequence[float | None]) -> float | None:
    """Mean of what is known; None where nothing is."""
    known = [value for value in values if value is not None]
    return sum(known) / len(known) if known else None


def _spread(values: Sequence[float | None], decimals: int) -> str:
    """The mean over seeds and, of several, the lowest and the highest."""
    known = [value for value in values if value is not None]
    span = f" ({min(known):.{decimals}f} to {max(known):.{decimals}f})" if len(known) > 1 else ""
    return f"{_number(_mean(values), decimals)}{span}"


def _average(values: Sequence[float | None], decimals: int) -> str:
    """Of all scenes, or a dash where one is missing: averages over other scenes do not compare."""
    complete = len(values) > 0 and all(value is not None for value in values)
    return _number(_mean(values), decimals) if complete else NONE


def _number(value: float | None, decimals: int) -> str:
    return NONE if value is None else f"{value:.{decimals}f}"


def _natural(name: str) -> tuple[int, str]:
    return (int(name), "") if name.isdigit() else (1 << 30, name)
