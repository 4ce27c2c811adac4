"""Curves of the training's numbers, as small SVG drawings."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup

from stages.artifacts.own_files import read_own

CHART_POINTS = 240
# Training numbers worth a curve where they are logged, in the order of the page.
CURVES = ("psnr", "loss", "rgb", "eikonal", "mask", "scale")
LARGEST = 1e30  # no number of a training is larger, and those that are cannot be drawn


def training_charts(path: Path) -> list[dict[str, str]]:
    """A small curve for each number of `CURVES` that was logged and changed; lines that cannot be read are left out.

    Raises:
        WorkspaceError: the file is a link, no file, or too large.
    """
    try:
        lines = read_own(path).splitlines()
    except OSError:
        return []
    records = [record for line in lines if isinstance(record := _parsed(line), dict)]
    charts = []
    for key in CURVES:
        points = [
            (step, value)
            for position, record in enumerate(records)
            if (step := _number(record.get("step", position))) is not None
            and (value := _number(record.get(key))) is not None
        ]
        if len({value for _, value in points}) >= 2:
            charts.append({"label": key, "last": f"{points[-1][1]:.4g}", "svg": line_chart(points)})
    return charts


def _parsed(line: bytes) -> Any:
    try:
        return json.loads(line)
    except (ValueError, RecursionError):  # cut off by a kill, being written, or junk
        return None


def _number(value: Any) -> float | None:
    return float(value) if isinstance(value, (int, float)) and abs(value) < LARGEST else None


def line_chart(points: Sequence[tuple[float, float]], width: int = 420, height: int = 180) -> Markup:
    """An SVG curve. Values that are positive and span more than a factor of 30 get a logarithmic axis."""
    step = math.ceil(len(points) / CHART_POINTS)
    xs, ys = np.array([*points[::step], points[-1]]).T
    logarithmic = ys.min() > 0 and ys.max() > 30 * ys.min()
    heights = np.log10(ys) if logarithmic else ys
    left, right, top, bottom = 52, width - 8, 8, height - 22
    across = left + (xs - xs[0]) / max(xs[-1] - xs[0], 1e-12) * (right - left)
    down = bottom - (heights - heights.min()) / max(np.ptp(heights), 1e-12) * (bottom - top)
    path = " ".join(f"{x:.1f},{y:.1f}" for x, y in zip(across, down, strict=True))
    return Markup(  # numbers alone: there is nothing to escape
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
