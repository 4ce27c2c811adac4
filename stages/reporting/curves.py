"""Curves of the training's numbers, as small SVG drawings."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

CHART_POINTS = 240
# Training numbers worth a curve where they are logged, in the order of the page.
CURVES = ("psnr", "loss", "rgb", "eikonal", "mask", "scale")


def training_charts(path: Path) -> list[dict[str, str]]:
    """A small curve for each number of `CURVES` that was logged and changed."""
    records = []
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except OSError:
        return []
    for line in lines:
        try:
            record = json.loads(line)
        except ValueError:  # a line cut off by a kill
            continue
        if isinstance(record, dict):
            records.append(record)
    charts = []
    for key in CURVES:
        points = [
            (float(record.get("step", position)), float(record[key]))
            for position, record in enumerate(records)
            if isinstance(record.get(key), (int, float)) and math.isfinite(record[key])
        ]
        if len({value for _, value in points}) >= 2:
            charts.append({"label": key, "last": f"{points[-1][1]:.4g}", "svg": line_chart(points)})
    return charts


def line_chart(points: Sequence[tuple[float, float]], width: int = 420, height: int = 180) -> str:
    """An SVG curve. Values that are positive and span more than a factor of 30 get a logarithmic axis."""
    step = math.ceil(len(points) / CHART_POINTS)
    xs, ys = np.array([*points[::step], points[-1]]).T
    logarithmic = ys.min() > 0 and ys.max() / ys.min() > 30
    heights = np.log10(ys) if logarithmic else ys
    left, right, top, bottom = 52, width - 8, 8, height - 22
    across = left + (xs - xs[0]) / max(xs[-1] - xs[0], 1e-12) * (right - left)
    down = bottom - (heights - heights.min()) / max(np.ptp(heights), 1e-12) * (bottom - top)
    path = " ".join(f"{x:.1f},{y:.1f}" for x, y in zip(across, down, strict=True))
    return (
        f'<svg viewBox="0 0 {width} {height}" role="img">'
        f'<line x1="{left}" y1="{bottom}" x2="{right}" y2="{bottom}"/>'
        f'<line x1="{left}" y1="{top}" x2="{left}" y2="{bottom}"/>'
        f'<text x="{left - 5}" y="{top + 8}" text-anchor="end">{ys.max():.3g}</text>'
        f'<text x="{left - 5}" y="{bottom}" text-anchor="end">{ys.min():.3g}</text>'
        f'<text x="{left}" y="{height - 7}">{xs[0]:.0f}</text>'
        f'<text x="{right}" y="{height - 7}" text-anchor="end">step {xs[-1]:.0f}</text>'
        f'<text x="{right}" y="{top + 8}" text-anchor="end">{"log" if logarithmic else ""}</text>'
        f'<polyline points="{path}"/></svg>'
    )
