"""Where the photos of a capture are taken from, hand-held: [N, 4, 4] world-to-camera matrices."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from stages.geometry.normalisation import rotation_onto
from stages.scenes.viewpoints import viewpoint

Vector = Sequence[float] | np.ndarray
STRAY = 0.04  # standard deviation of place and aim, of the distance
ROLL_DEG = 2.0


def shot(eye: Vector, target: Vector, rng: np.random.Generator, framed: tuple[float, float] = (0.0, 0.0)) -> np.ndarray:
    """A photo from `eye` that shows `target` about at `framed`: right and down of the middle, in focal lengths."""
    eye, target = np.array(eye, dtype=float), np.array(target, dtype=float)
    distance = float(np.linalg.norm(target - eye))
    eye, target = (place + STRAY * distance * rng.normal(size=3) for place in (eye, target))
    pose = viewpoint(eye, target, roll=float(np.radians(ROLL_DEG) * rng.normal()))
    ray = np.array([*framed, 1.0])
    turn = np.eye(4)
    turn[:3, :3] = rotation_onto(np.array([0, 0, 1.0]), ray / np.linalg.norm(ray))
    return turn @ pose


def on_circle(
    middle: Vector, radius: float, heights: Sequence[float], span_deg: float, count: int, toward_deg: float = -90.0
) -> list[np.ndarray]:
    """`count` places around `middle` at each height in turn: `span_deg` in all, its middle `toward_deg` of +x."""
    ends = span_deg < 360
    turns = np.linspace(-0.5, 0.5, count, endpoint=ends) * span_deg + toward_deg
    return [
        np.array(middle) * [1, 1, 0] + [radius * np.cos(angle), radius * np.sin(angle), heights[k % len(heights)]]
        for k, angle in enumerate(np.radians(turns))
    ]


def orbit(
    target: Vector, radius: float, heights: Sequence[float], rng: np.random.Generator,
    span_deg: float = 360.0, count: int = 24, framed: tuple[float, float] = (0.0, 0.0),
) -> np.ndarray:  # fmt: skip
    """Photos from a circle about `target` that look at it; see `on_circle`, `shot`."""
    eyes = on_circle(target, radius, heights, span_deg, count)
    return np.array([shot(eye, target, rng, framed) for eye in eyes])


def rows(xs: Iterable[float], heights: Iterable[float], distance: float, rng: np.random.Generator) -> np.ndarray:
    """Photos straight at a wall (the plane y = 0) from `distance` before it, towards -y, column by column."""
    heights = tuple(heights)
    return np.array([shot((x, -distance, z), (x, 0, z), rng) for x in xs for z in heights])
