"""Tanks and Temples' F-score (Knapitsch et al. 2017), as its Python toolbox has it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stages.evaluation.surfaces import Surface

# Metres; the toolbox's own, by scene.
TAU = {
    "Barn": 0.01,
    "Caterpillar": 0.005,
    "Church": 0.025,
    "Courthouse": 0.025,
    "Ignatius": 0.003,
    "Meetingroom": 0.01,
    "Truck": 0.005,
}


@dataclass(frozen=True)
class CropVolume:
    """A polygon pulled along an axis (the toolbox's JSON, Open3D's SelectionPolygonVolume).

    Attributes:
        axis: 0, 1 or 2, the one it is pulled along.
        low, high: from where to where.
        polygon: [N, 2] corners in the other two axes, in the order of the axes.
    """

    axis: int
    low: float
    high: float
    polygon: np.ndarray

    def holds(self, points: np.ndarray) -> np.ndarray:
        """Which of points [P, 3] lie inside, [P] bool."""
        raise NotImplementedError


@dataclass(frozen=True)
class TanksScore:
    """Shares in percent of points nearer than tau.

    Attributes:
        tau: metres.
        precision, recall, f_score: of the predicted points, of the true points, their harmonic mean.
        predicted_points, true_points: how many were measured.
        matrix: [4, 4] by which the prediction was moved at last, the given alignment included.
    """

    tau: float
    precision: float
    recall: float
    f_score: float
    predicted_points: int
    true_points: int
    matrix: np.ndarray


def tanks_score(
    predicted: Surface,
    true_points: np.ndarray,
    crop: CropVolume,
    tau: float,
    truth_from_predicted: np.ndarray | None = None,
    refine: bool = True,
    seed: int = 0,
) -> TanksScore:
    """Hold a mesh or a cloud against a scan [P, 3].

    The prediction is moved by `truth_from_predicted`, and, with `refine`, by the toolbox's three rounds of ICP with
    scale. Both are cropped and thinned to one point a cube of tau / 2. A mesh is first turned into points, four a
    square of tau / 2.

    Raises:
        ValueError: nothing lies in the crop volume.
    """
    raise NotImplementedError
