"""The ground plan of a large scene's blocks as a small SVG drawing."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from markupsafe import Markup

WIDTH = 640.0
_MARGIN = 4.0
_LETTER = 0.62  # width of a letter, as a part of its height


def ground_plan(cores: Mapping[str, np.ndarray], states: Mapping[str, str]) -> Markup:
    """North (+Y of the plan) is up. Each block is a link to `blocks/NAME/` of the class of its state.

    Args:
        cores: lowest and highest corner [2, 2] on the ground, by name; at least one.
        states: "waiting", "running", "failed" or "done", by name.
    """
    corners = np.stack(list(cores.values()))
    low, high = corners[:, 0].min(0), corners[:, 1].max(0)
    scale = (WIDTH - 2 * _MARGIN) / max(float((high - low).max()), 1e-12)
    width, height = (high - low) * scale + 2 * _MARGIN
    drawn = Markup("").join(
        _block(name, (core - low) * scale + _MARGIN, height, states[name]) for name, core in cores.items()
    )
    return Markup('<svg viewBox="0 0 {:.1f} {:.1f}" role="img" aria-label="Plan of the blocks">{}</svg>').format(
        width, height, drawn
    )


def _block(name: str, core: np.ndarray, height: float, state: str) -> Markup:
    (x0, y0), (x1, y1) = core
    wide, high = x1 - x0, y1 - y0
    size = min(16.0, 0.5 * high, 0.9 * wide / (_LETTER * max(len(name), 1)))
    return Markup(
        '<a href="blocks/{}/"><rect class="{}" x="{:.1f}" y="{:.1f}" width="{:.1f}" height="{:.1f}"/>'
        '<text x="{:.1f}" y="{:.1f}" font-size="{:.1f}" text-anchor="middle">{}</text></a>'
    ).format(
        name, state, x0, height - y1, wide, high,
        (x0 + x1) / 2, height - (y0 + y1) / 2 + 0.35 * size, size, name,
    )  # fmt: skip
