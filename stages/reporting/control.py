"""Ground control points for people: how well each is met, and in which photos its marks miss."""

from __future__ import annotations

from typing import Any

import numpy as np

from stages.geometry.place import ControlPoint, Place


def describe_control(place: Place) -> dict[str, Any] | None:
    """A sentence and a row for each point, the worst first; None where there are none."""
    if not place.control:
        return None
    used = sum(point.used for point in place.control)
    sentence = f"{used} of {sum(not point.check for point in place.control)} control points were used"
    if place.control_residual is not None:
        sentence += f", residual {_length(place.control_residual)}"
    checks = [np.array(point.miss) for point in place.control if point.check and point.miss is not None]
    if checks:
        error = float(np.sqrt(np.mean([miss @ miss for miss in checks])))
        sentence += f"; {len(checks)} only check it, and are missed by {_length(error)} (root mean square)"
    rows = sorted(place.control, key=lambda point: -(point.left_out_m or 0.0))
    return {"sentence": f"{sentence}.", "points": [_row(point) for point in rows]}


def _row(point: ControlPoint) -> dict[str, str]:
    errors = [mark.error_px for mark in point.marks if mark.used and mark.error_px is not None]
    wrong = [f"{mark.photo} ({mark.error_px:.0f} px)" for mark in point.marks if not mark.used and mark.error_px]
    return {
        "name": point.name,
        "use": "check" if point.check else "used" if point.used else "not used",
        "miss": "-" if point.miss is None else " ".join(f"{value:+.3f}" for value in point.miss),
        "left_out": "-" if point.left_out_m is None else _length(point.left_out_m),
        "marks": f"{len(errors)} of {len(point.marks)}",
        "error": f"{np.sqrt(np.mean(np.square(errors))):.1f} px" if errors else "-",
        "wrong": ", ".join(wrong),
    }


def _length(metres: float) -> str:
    return f"{metres:.3f} m"
