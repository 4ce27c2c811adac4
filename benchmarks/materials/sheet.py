"""The contact sheet of an object: truth, ours, baked in rows; its maps and the unseen lights in columns."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

GAP = 4  # pixels
BAND = 14  # of text above


@dataclass(frozen=True)
class Row:
    """One view.

    Attributes:
        label: whose.
        base_color: [H, W, 3] uint8.
        roughness, metallic: [H, W] in 0..1.
        lit: under each unseen light, [H, W, 3] uint8.
        mask: [H, W] bool, what counts.
    """

    label: str
    base_color: np.ndarray
    roughness: np.ndarray
    metallic: np.ndarray
    lit: Sequence[np.ndarray]
    mask: np.ndarray


def write_sheet(rows: Sequence[Row], lights: Sequence[str], path: Path) -> None:
    """All rows, cut to the object."""
    from PIL import Image, ImageDraw

    inside = np.argwhere(rows[0].mask)
    (top, left), (bottom, right) = np.maximum(inside.min(0) - 4, 0), inside.max(0) + 5
    headings = ["base colour", "roughness", "metallic", *lights]
    lines = []
    for row in rows:
        pictures = [row.base_color * row.mask[..., None], _grey(row.roughness), _grey(row.metallic), *row.lit]
        lines.append([picture[top:bottom, left:right] for picture in pictures])
    high, wide = bottom - top + BAND + GAP, right - left + GAP
    sheet = Image.new("RGB", (wide * len(headings), high * len(rows)), "white")
    draw = ImageDraw.Draw(sheet)
    for j, (row, line) in enumerate(zip(rows, lines, strict=True)):
        for i, (heading, picture) in enumerate(zip(headings, line, strict=True)):
            draw.text((i * wide + 2, j * high + 1), f"{row.label}: {heading}", fill="black")
            sheet.paste(Image.fromarray(np.ascontiguousarray(picture)), (i * wide, j * high + BAND))
    path.parent.mkdir(parents=True, exist_ok=True)
    sheet.save(path)


def _grey(values: np.ndarray) -> np.ndarray:
    return np.repeat((np.clip(values, 0, 1) * 255 + 0.5).astype(np.uint8)[..., None], 3, axis=2)
