"""Settings that are written as a line of text, and what they say."""

from __future__ import annotations

from typing import Literal

LEAST, MOST = 1e-6, 1e9  # of lengths, and of coordinates: those around the Earth's centre reach 6.4e6 metres
BALL_FORM = "KIND:PHOTO:X,Y,RADIUS with chrome or grey as KIND"
REGION_FORMS = "auto, 'sphere X Y Z RADIUS' or 'box X0 Y0 Z0 X1 Y1 Z1'"


def read_region(text: str) -> tuple[str, tuple[float, ...]]:
    """("auto", ()), ("sphere", (x, y, z, radius)) or ("box", (x0, y0, z0, x1, y1, z1)).

    Raises:
        ValueError: it is none of these, or has no volume.
    """
    form, *rest = text.split() or [""]
    expected = {"auto": 0, "sphere": 4, "box": 6}.get(form)
    if expected is None:
        raise ValueError(f"it must be {REGION_FORMS}")
    numbers = _numbers(rest, expected, f"'{form}'")
    if form == "sphere" and numbers[3] < LEAST:
        raise ValueError(f"the sphere's radius must be at least {LEAST:g}, not {numbers[3]:g}")
    if form == "box" and any(high - low < LEAST for low, high in zip(numbers[:3], numbers[3:], strict=True)):
        raise ValueError(f"each of the box's X1 Y1 Z1 must be larger than its X0 Y0 Z0, by at least {LEAST:g}")
    return form, numbers


def read_distance(text: str) -> tuple[tuple[float, ...], tuple[float, ...], float]:
    """Two points and the metres between them, from 'X1 Y1 Z1 X2 Y2 Z2 METRES'.

    Raises:
        ValueError: it is not that, the points are one, or the length is not positive.
    """
    numbers = _numbers(text.split(), 7, "'X1 Y1 Z1 X2 Y2 Z2 METRES'")
    first, second, metres = numbers[:3], numbers[3:6], numbers[6]
    if first == second:
        raise ValueError("the two points must not be the same")
    if metres < LEAST:
        raise ValueError(f"the distance must be at least {LEAST:g} metres, not {metres:g}")
    return first, second, metres


def read_ball(text: str) -> tuple[Literal["chrome", "grey"], str, tuple[float, ...]]:
    """Kind, photo, and (x, y, radius) of the circle in it, pixels, from 'chrome:IMG_1.jpg:1520,840,120'.

    Raises:
        ValueError: it is not that, or the radius is not positive.
    """
    kind, _, rest = text.strip().partition(":")
    photo, _, circle = rest.rpartition(":")
    if kind not in ("chrome", "grey") or not photo.strip():
        raise ValueError(f"a ball is {BALL_FORM}, not {text[:80]!r}")
    numbers = _numbers(circle.split(","), 3, "a ball's 'X,Y,RADIUS'")
    if numbers[2] <= 0:
        raise ValueError(f"a ball's radius must be positive, not {numbers[2]:g}")
    return "chrome" if kind == "chrome" else "grey", photo.strip(), numbers


def _numbers(words: list[str], expected: int, what: str) -> tuple[float, ...]:
    try:
        numbers = tuple(float(word) for word in words)
    except ValueError:
        raise ValueError(f"{what} takes {expected} numbers, got {' '.join(words)!r}") from None
    if len(numbers) != expected:
        raise ValueError(f"{what} takes {expected} numbers, got {len(numbers)}")
    if not all(abs(number) <= MOST for number in numbers):
        raise ValueError(f"{what} takes numbers from -{MOST:g} to {MOST:g}, got {' '.join(words)}")
    return numbers
