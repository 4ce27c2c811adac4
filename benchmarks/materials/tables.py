"""The tables of docs/benchmarks/materials.md, from the result files."""

from __future__ import annotations

from collections.abc import Sequence
from statistics import fmean
from typing import Any

from benchmarks.materials.scenes import SUBJECTS
from benchmarks.pages import NOT_MEASURED, markdown_table
from benchmarks.run_sets import GIB
from benchmarks.run_sets import RESULTS as ALL_RESULTS
from stages import artifacts

RESULTS = ALL_RESULTS / "materials"
JUDGED = RESULTS / "judge"  # of the truth itself
BASELINES = ("baked", "baked, fitted")
# Key of a score, its heading, digits.
MAPS = (
    ("base_color_psnr", "base colour: PSNR", 2),
    ("roughness_mae", "roughness: mean error", 3),
    ("metallic_mae", "metallic: mean error", 3),
    ("told_apart", "metal told from the rest", 3),
    ("light_error_deg", "main source off, °", 1),
    ("novel_psnr", "learned light: PSNR", 2),
)


def load_results(judged: bool = False) -> list[dict[str, Any]]:
    """All results, in the order of the suite."""
    folder = JUDGED if judged else RESULTS
    paths = [folder / f"{name}.json" for name in SUBJECTS]
    return [artifacts.read_json(path) for path in paths if path.is_file()]


def relit_table(results: Sequence[dict[str, Any]]) -> str:
    """A row an object: its pictures under the unseen lights, by what they were made with."""
    labels = ("ours", *BASELINES)
    header = ["object", "photographed under"]
    header += [f"{label}: {kind}" for label in labels for kind in ("PSNR", "SSIM")] + ["fitted roughness"]
    rows = [
        [result["name"], result["light"], *_relit_cells(result["scores"], labels), _text(result["fitted_roughness"], 2)]
        for result in results
    ]
    mean = {label: _means([result["scores"].get(label, {}) for result in results]) for label in labels}
    return markdown_table(header, [*rows, ["mean", "", *_relit_cells(mean, labels), ""]])


def maps_table(results: Sequence[dict[str, Any]]) -> str:
    """A row an object: what was learned against what is known, the base colour of the bake beside it, and the cost."""
    header = ["object", *(heading for _, heading, _ in MAPS), "baked: base colour: PSNR", "stage s", "GiB"]
    rows = []
    for result in results:
        cost = result.get("cost")
        cells = [f"{cost['wall_s']:.0f}", f"{cost['peak_rss'] / GIB:.2f}"] if cost else ["-", "-"]
        rows.append([result["name"], *_map_cells(result["scores"]), *cells])
    mean = {label: _means([result["scores"].get(label, {}) for result in results]) for label in ("ours", "baked")}
    return markdown_table(header, [*rows, ["mean", *_map_cells(mean), "", ""]])


def judge_table(results: Sequence[dict[str, Any]]) -> str:
    """A row an object: what the judge says of the truth itself."""
    header = ["object", "relit: PSNR", "SSIM", *(heading for _, heading, _ in MAPS)]
    rows = []
    for result in results:
        ours = result["scores"]["ours"]
        cells = [_text(ours[key], digits) for key, _, digits in MAPS]
        rows.append([result["name"], _text(ours["relit_psnr"], 2), _text(ours["relit_ssim"], 3), *cells])
    return markdown_table(header, rows)


def tables() -> dict[str, str]:
    """All tables, from the result files."""
    results, judged = load_results(), load_results(judged=True)
    return {
        "materials-relit": relit_table(results) if results else NOT_MEASURED,
        "materials-maps": maps_table(results) if results else NOT_MEASURED,
        "materials-judge": judge_table(judged) if judged else NOT_MEASURED,
    }


def _relit_cells(scores: dict[str, dict[str, float]], labels: Sequence[str]) -> list[str]:
    return [
        _text(scores.get(label, {}).get(f"relit_{key}"), digits)
        for label in labels
        for key, digits in (("psnr", 2), ("ssim", 3))
    ]


def _map_cells(scores: dict[str, dict[str, float]]) -> list[str]:
    ours = [_text(scores.get("ours", {}).get(key), digits) for key, _, digits in MAPS]
    return [*ours, _text(scores.get("baked", {}).get("base_color_psnr"), 2)]


def _means(scores: Sequence[dict[str, float]]) -> dict[str, float]:
    keys = dict.fromkeys(key for score in scores for key in score)
    return {key: fmean(score[key] for score in scores if key in score) for key in keys}


def _text(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"
