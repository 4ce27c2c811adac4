"""GPS of the photos for people: how far from the cameras it lies, photo by photo."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from stages.errors import HineusError
from stages.geometry.place import Place
from stages.posing.map_coordinates import in_world
from stages.reporting.photo_table import PhotoResult

MOST_ROWS = 20


def describe_gps(results: Sequence[PhotoResult], centers: np.ndarray, place: Place) -> dict[str, Any] | None:
    """A sentence, and rows for the photos whose GPS lies furthest off; None where there is nothing to compare.

    Args:
        centers: [N, 3] of the scene's cameras in the world.
    """
    seen = [(each.record, each.camera) for each in results if each.camera is not None and each.record.gps is not None]
    if not seen:
        return None
    try:
        known = in_world(place, np.array([record.gps for record, _ in seen], dtype=np.float64))
    except HineusError:
        return None
    if known is None:
        return None
    misses = known - centers[[camera for _, camera in seen]]
    distances = np.linalg.norm(misses, axis=1)
    worst = np.argsort(-distances, kind="stable")[:MOST_ROWS]
    rows = [{"name": seen[i][0].source, "miss": _vector(misses[i]), "distance": f"{distances[i]:.2f} m"} for i in worst]
    east, north, up = np.sqrt((misses**2).mean(0))
    source = "the poses and GPS together" if not place.control else "the control points, without GPS"
    sentence = (
        f"GPS of {len(seen)} photo{'s' if len(seen) > 1 else ''} against the cameras as placed by {source}: it misses "
        f"them by {east:.2f} m east, {north:.2f} m north and {up:.2f} m up (root mean square), and by "
        f"{_vector(misses.mean(0))} m on average."
    )
    return {"sentence": sentence, "photos": rows, "left_out": len(seen) - len(rows)}


def _vector(metres: np.ndarray) -> str:
    return " ".join(f"{value:+.2f}" for value in np.round(metres, 2) + 0.0)  # never -0.00
