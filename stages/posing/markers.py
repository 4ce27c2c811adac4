"""Printed markers of known size (ArUco): found in photos, placed in space, measured."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from stages.geometry.cameras import PinholeCameras
from stages.geometry.region import meeting_point

if TYPE_CHECKING:
    from jaxtyping import Float, UInt8

# Rays from two photos tell a corner's depth from this angle on, degrees.
MIN_PARALLAX_DEG = 3.0
# A corner that misses its sightings by more than this (median, pixels) was not seen right.
MAX_MISS_PX = 3.0


@dataclass(frozen=True)
class MarkerScale:
    """What markers say of the scale.

    Attributes:
        factor: metres per world unit.
        error: relative standard error of it, from the spread over sides.
        markers, sides: how many were measured.
    """

    factor: float
    error: float
    markers: int
    sides: int


def detect_markers(image: UInt8[np.ndarray, "h w 3"], dictionary: str) -> dict[int, Float[np.ndarray, "4 2"]]:
    """Corners in pixels (centres at .5) of each marker in an RGB image, by its number.

    A number seen twice in one image names no one marker, and is left out.
    """
    import cv2

    options = cv2.aruco.DetectorParameters()
    options.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    known = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{dictionary}"))
    corners, found, _ = cv2.aruco.ArucoDetector(known, options).detectMarkers(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))
    numbers = [] if found is None else [int(number) for number in np.ravel(found)]
    return {
        number: np.asarray(quad, dtype=np.float64).reshape(4, 2) + 0.5
        for number, quad in zip(numbers, corners, strict=True)
        if numbers.count(number) == 1
    }


def measure_markers(
    cameras: PinholeCameras, seen: Sequence[dict[int, Float[np.ndarray, "4 2"]]], size: float
) -> MarkerScale | None:
    """The scale from markers seen in at least two photos, or None where no side could be measured.

    Args:
        cameras: in a frame of unknown scale.
        seen: one dictionary per camera, see `detect_markers`.
        size: true length of a side, metres.
    """
    sightings: dict[int, list[tuple[int, Float[np.ndarray, "4 2"]]]] = defaultdict(list)
    for index, markers in enumerate(seen):
        for number, quad in markers.items():
            sightings[number].append((index, quad))
    ratios, measured = [], 0
    for number in sorted(sightings):
        corners = [_place_corner(cameras, [(i, quad[k]) for i, quad in sightings[number]]) for k in range(4)]
        sides = [
            size / float(np.linalg.norm(a - b))
            for a, b in zip(corners, corners[1:] + corners[:1], strict=True)
            if a is not None and b is not None
        ]
        ratios += sides
        measured += bool(sides)
    if not ratios:
        return None
    factor = float(np.median(ratios))
    spread = 1.4826 * float(np.median(np.abs(np.array(ratios) / factor - 1)))
    return MarkerScale(factor, spread / np.sqrt(measured), measured, len(ratios))


def _place_corner(
    cameras: PinholeCameras, sightings: Sequence[tuple[int, Float[np.ndarray, " 2"]]]
) -> Float[np.ndarray, " 3"] | None:
    """Where a corner is that these cameras see at these pixels, or None where they do not tell."""
    rays = [cameras.rays(i, pixel[None]) for i, pixel in sightings]
    origins = np.concatenate([origin for origin, _ in rays])
    directions = np.concatenate([direction for _, direction in rays])
    if len(rays) < 2 or (directions @ directions.T).min() > np.cos(np.radians(MIN_PARALLAX_DEG)):
        return None
    corner, _ = meeting_point(origins, directions)
    misses = [np.linalg.norm(cameras.project(i, corner[None])[0][0] - pixel) for i, pixel in sightings]
    return corner if np.median(misses) <= MAX_MISS_PX else None
