"""DTU's evaluation (Jensen et al. 2014), as the community's Python version of it has it (jzhangbs/DTUeval-python).

All in millimetres, in the frame of the data set's cameras.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stages.evaluation.surfaces import Surface

DENSITY = 0.2  # mm between points at least
PATCH = 60.0  # mm around the box of the observed part: beyond it nothing is looked at
MAX_DISTANCE = 20.0  # mm: what is farther counts neither way


@dataclass(frozen=True)
class DtuTruth:
    """One scan's truth.

    Attributes:
        points: [P, 3] of the structured light scan.
        observed: [X, Y, Z] bool, the cells that were observed (`ObsMask`).
        box: [2, 3] lowest and highest corner of the cells (`BB`).
        resolution: side of a cell (`Res`).
        ground: [4] the plane a x + b y + c z + d; points with a positive value lie above the table (`P`).
    """

    points: np.ndarray
    observed: np.ndarray
    box: np.ndarray
    resolution: float
    ground: np.ndarray


@dataclass(frozen=True)
class DtuScore:
    """Means in mm of the distances below `MAX_DISTANCE`.

    Attributes:
        accuracy: from the predicted to the scanned points ("d2s").
        completeness: from the scanned to the predicted points ("s2d").
        overall: mean of the two, the number in papers' tables.
        predicted_points, true_points: how many were measured.
        predicted_far, true_far: shares in percent of them that are `MAX_DISTANCE` and more away, and left out.
    """

    accuracy: float
    completeness: float
    overall: float
    predicted_points: int
    true_points: int
    predicted_far: float
    true_far: float


def dtu_score(predicted: Surface, truth: DtuTruth, seed: int = 0) -> DtuScore:
    """Hold a mesh or a cloud against a scan.

    A mesh is turned into its vertices and a lattice of points on each triangle, `DENSITY` apart; in random order
    (`seed`) each point takes away all within `DENSITY` of it. Of what is within `PATCH` of the box, the part in
    observed cells is measured against the scan; the part of the scan above the ground plane is measured against all.

    Raises:
        ValueError: no predicted point lies in observed cells, or no distance is below `MAX_DISTANCE`.
    """
    raise NotImplementedError
