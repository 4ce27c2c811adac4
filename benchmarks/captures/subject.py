"""How much of a subject a sphere holds, and how tight it is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from benchmarks.captures.model import Capture, joined
from benchmarks.captures.tracks import sight
from stages.evaluation.surfaces import sample_faces
from stages.geometry.region import enclosing_sphere
from stages.surface.triangle_mesh import raycaster

SAMPLES = 6000
MIN_PHOTOS = 2


@dataclass(frozen=True)
class Fit:
    """A sphere about a subject.

    Attributes:
        inside: share of the subject's seen surface within it, percent.
        sphere_ratio: its volume over that of the smallest sphere about the seen surface.
        box_ratio: over that of the box about it, sides along the axes.
    """

    inside: float
    sphere_ratio: float
    box_ratio: float


def seen_points(capture: Capture, samples: int = SAMPLES) -> np.ndarray:
    """Points [P, 3], even by area, on what at least two photos see of the subject, unhidden.

    Raises:
        ValueError: they see nothing of it.
    """
    subject, everything = joined(capture.subject), joined(capture.subject + capture.surroundings)
    points, _ = sample_faces(subject.vertices, subject.faces, samples)
    seen = sight(capture.cameras, points, raycaster(everything.vertices, everything.faces)).seen
    points = points[seen.sum(0) >= MIN_PHOTOS]
    if len(points) == 0:
        raise ValueError("no photo shows the subject")
    return points


def fit(points: np.ndarray, center: np.ndarray, radius: float) -> Fit:
    """How a sphere holds the points [P, 3] of a subject."""
    _, least = enclosing_sphere(points)
    volume = 4 / 3 * np.pi * radius**3
    inside = np.linalg.norm(points - center, axis=1) < radius
    return Fit(100 * float(inside.mean()), float((radius / least) ** 3), float(volume / np.ptp(points, axis=0).prod()))
