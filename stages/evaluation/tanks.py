"""Tanks and Temples' F-score (Knapitsch et al. 2017), as its Python toolbox has it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stages.evaluation.surfaces import Sampling, Surface, Target, draw_points, score_at
from stages.evaluation.thinning import one_a_cube
from stages.surface.triangle_mesh import face_normals

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
# The toolbox's rounds of ICP, each of 20 steps: points a cube of this many tau (None: all), pairs within so many tau.
ROUNDS = ((1.0, 80.0), (0.5, 20.0), (None, 2.0))
ROUND_STEPS = 20
LAST_ROUND_POINTS = 4_000_000
MOST_POINTS = 20_000_000  # drawn on a mesh


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
        """Which of points [P, 3] lie inside, [P] bool; inside the polygon by the even-odd rule."""
        along = points[:, self.axis]
        inside = (along >= self.low) & (along <= self.high)
        u, v = np.delete(points[inside], self.axis, axis=1).T
        odd = np.zeros(len(u), dtype=bool)
        for (u0, v0), (u1, v1) in zip(self.polygon, np.roll(self.polygon, -1, axis=0), strict=True):
            crossing = (v0 > v) != (v1 > v)
            odd[crossing] ^= u[crossing] < u0 + (v[crossing] - v0) * (u1 - u0) / (v1 - v0)
        inside[inside] = odd
        return inside


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
    square of tau / 2 (`MOST_POINTS` at most).

    Raises:
        ValueError: nothing lies in the crop volume.
    """
    matrix = np.eye(4) if truth_from_predicted is None else truth_from_predicted
    predicted = predicted.moved(matrix)
    points = predicted.points if predicted.faces is None else _points_on(predicted, crop, tau, seed)
    true = _cropped(true_points, crop, "scanned")
    if refine:
        step = refined(points, true, crop, tau)
        points, matrix = _moved(points, step), step @ matrix
    ours = one_a_cube(_cropped(points, crop, "predicted"), tau / 2)
    true = one_a_cube(true, tau / 2)
    to_truth = Target(Surface(true)).nearest(ours).distances
    to_predicted = Target(Surface(ours)).nearest(true).distances
    found = score_at(to_truth, to_predicted, tau)
    return TanksScore(tau, found.precision, found.recall, found.f_score, len(ours), len(true), matrix)


def refined(points: np.ndarray, true_points: np.ndarray, crop: CropVolume, tau: float) -> np.ndarray:
    """The [4, 4] similarity by which the toolbox's rounds of ICP move points [P, 3] to the true ones [Q, 3]."""
    import open3d as o3d

    registration = o3d.pipelines.registration
    matrix = np.eye(4)
    for cube, reach in ROUNDS:
        sides = []
        for cloud in (_cropped(_moved(points, matrix), crop, "predicted"), true_points):
            thinned = (
                cloud[:: max(1, round(len(cloud) / LAST_ROUND_POINTS))]
                if cube is None
                else one_a_cube(cloud, cube * tau)
            )
            sides.append(o3d.geometry.PointCloud(o3d.utility.Vector3dVector(thinned)))
        found = registration.registration_icp(
            *sides, reach * tau, np.eye(4), registration.TransformationEstimationPointToPoint(True),
            registration.ICPConvergenceCriteria(1e-6, max_iteration=ROUND_STEPS),
        )  # fmt: skip
        matrix = found.transformation @ matrix
    return matrix


def _points_on(mesh: Surface, crop: CropVolume, tau: float, seed: int) -> np.ndarray:
    """Points [P, 3] on the part of a mesh that the crop volume, or ICP's first round, may reach."""
    assert mesh.faces is not None
    reach = ROUNDS[0][1] * tau
    low = np.insert(crop.polygon.min(0), crop.axis, crop.low) - reach
    high = np.insert(crop.polygon.max(0), crop.axis, crop.high) + reach
    corners = mesh.points[mesh.faces]
    near = ((corners.min(1) <= high) & (corners.max(1) >= low)).all(1)
    if not near.any():
        raise ValueError(f"none of {len(near)} faces lies near the crop volume; is the mesh in the scan's frame?")
    part = Surface(mesh.points, mesh.faces[near])
    area = 0.5 * np.linalg.norm(face_normals(part.points, mesh.faces[near]), axis=1).sum()
    return draw_points(part, Sampling(min(int(area / (tau / 4) ** 2) + 1, MOST_POINTS), seed=seed)).points


def _moved(points: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    return points @ matrix[:3, :3].T + matrix[:3, 3]


def _cropped(points: np.ndarray, crop: CropVolume, what: str) -> np.ndarray:
    kept = points[crop.holds(points)]
    if not len(kept):
        raise ValueError(f"none of {len(points)} {what} points lies in the crop volume; is it in the scan's frame?")
    return kept
