"""Tanks and Temples' F-score (Knapitsch et al. 2017), as its Python toolbox has it."""

from __future__ import annotations

import re
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from stages.errors import InputError
from stages.evaluation.alignment import by_cameras
from stages.evaluation.reading import Cameras, own_cameras, read_matrix, read_prediction, read_surface
from stages.evaluation.surfaces import Sampling, Surface, Target, draw_points, moved, score_at
from stages.evaluation.thinning import one_a_cube
from stages.inputs.texts import read_json, read_text
from stages.posing.known import reading
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
        points, matrix = moved(points, step), step @ matrix
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
        for cloud in (_cropped(moved(points, matrix), crop, "predicted"), true_points):
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


def _cropped(points: np.ndarray, crop: CropVolume, what: str) -> np.ndarray:
    kept = points[crop.holds(points)]
    if not len(kept):
        raise ValueError(f"none of {len(points)} {what} points lies in the crop volume; is it in the scan's frame?")
    return kept


# ---------------------------------------------------------------- files
def evaluate_tanks(
    predicted: Path,
    data: Path,
    cameras: Path | None = None,
    tau: float | None = None,
    refine: bool = True,
    matrix: Path | None = None,
    seed: int = 0,
) -> dict[str, Any]:
    """Numbers of `TanksScore` and what was done, from a scene's folder.

    Args:
        data: folder with `SCENE.ply`, `SCENE.json` and, to align by cameras, `SCENE_COLMAP_SfM.log` and
            `SCENE_trans.txt`.
        cameras: of the prediction, a file of poses whose photos are numbered from 1; those of a workspace are known.
        tau: metres; None: the toolbox's for this scene.
        refine: follow the toolbox's rounds of ICP.
        matrix: file with 4 x 4 numbers, scan from prediction, instead of the cameras.

    Raises:
        InputError: a file cannot be read, tau is not known, or nothing is left to measure.
    """
    truth, (path, ours) = read_tanks(data), read_prediction(predicted)
    tau = tau or TAU.get(truth.name)
    if tau is None:
        raise InputError(
            f"The scene {truth.name} is none of {', '.join(TAU)}: its tau is not known.", "Say it: `--tau 0.005`."
        )
    start, how = np.eye(4), "none, taken to be in the scan's frame"
    if matrix is not None:
        start, how = read_matrix(matrix), f"by the matrix of {matrix}"
    elif truth.centers is not None and (known := own_cameras(predicted, cameras)) is not None:
        start, paired = _by_numbers(known, truth.centers, data)
        how = f"similarity by {paired} camera centres of {known.origin} and of the scene's trajectory"
    try:
        found = tanks_score(ours, truth.points, truth.crop, tau, start, refine, seed)
    except ValueError as error:
        raise InputError(
            f"{path} cannot be held against {data}: {error}.", "Align it: see `--cameras` and `--matrix`."
        ) from error
    return {
        "predicted": str(path),
        "truth": str(data),
        "unit": "m",
        **asdict(found),
        "matrix": found.matrix.tolist(),
        "done": [
            "protocol: Tanks and Temples, as its Python toolbox",
            f"alignment: {how}" + (", then three rounds of ICP with scale" if refine else ""),
            f"cut: the crop volume of {truth.name}.json; thinned to one point a cube of {tau / 2:g} m",
            "sampling: "
            + ("the cloud's points" if ours.faces is None else f"four points a square of {tau / 2:g} m, seed {seed}"),
        ],
    }


def _by_numbers(known: Cameras, true_centers: np.ndarray, data: Path) -> tuple[np.ndarray, int]:
    """Scan from prediction [4, 4] by cameras whose photos' names are numbers from 1, and how many were paired."""
    numbered = {}
    for stem, center in known.centers.items():
        digits = re.search(r"(\d+)\D*$", stem)
        if digits:
            numbered[str(int(digits[1]) - 1)] = center
    try:
        motion, paired = by_cameras(numbered, {str(i): center for i, center in enumerate(true_centers)})
    except ValueError as error:
        raise InputError(
            f"The cameras of {known.origin} cannot be paired with the {len(true_centers)} of {data}: {error}.",
            "Their photos are numbered from 1 as in the data set (000001.jpg); or align with `--matrix`.",
        ) from error
    return motion.matrix(), paired


@dataclass(frozen=True)
class TanksTruth:
    """A scene of Tanks and Temples.

    Attributes:
        name: of the scene.
        points: [P, 3] of the scan.
        crop: where it is scored.
        centers: [N, 3] of the reference cameras in the scan's frame, in the order of the photos; None: not there.
    """

    name: str
    points: np.ndarray
    crop: CropVolume
    centers: np.ndarray | None


def read_tanks(data: Path) -> TanksTruth:
    """A scene from its folder: `SCENE.ply`, `SCENE.json`, `SCENE_COLMAP_SfM.log`, `SCENE_trans.txt`.

    Raises:
        InputError: the scan or the crop volume is missing, or a file cannot be read.
    """
    scene = data.resolve().name
    scan, crop = data / f"{scene}.ply", data / f"{scene}.json"
    missing = [path.name for path in (scan, crop) if not path.is_file()]
    if missing:
        raise InputError(
            f"{data} lacks {', '.join(missing)}.",
            "`--data` takes a scene's folder of Tanks and Temples' training data, whose name is the scene's.",
        )
    log, trans = data / f"{scene}_COLMAP_SfM.log", data / f"{scene}_trans.txt"
    centers = None
    if log.is_file() and trans.is_file():
        centers = moved(_trajectory(log), read_matrix(trans))
    return TanksTruth(scene, read_surface(scan).points, _crop_volume(crop), centers)


def _crop_volume(path: Path) -> CropVolume:
    with reading(f"The crop volume {path}", "orthogonal_axis, axis_min, axis_max, bounding_polygon, as Open3D writes"):
        data: dict[str, Any] = read_json(path)
        axis = "XYZ".index(data["orthogonal_axis"].upper())
        corners = np.array(data["bounding_polygon"], dtype=np.float64)
        if corners.ndim != 2 or corners.shape[1] != 3 or len(corners) < 3:
            raise ValueError(f"its polygon is {corners.shape}")
        return CropVolume(axis, float(data["axis_min"]), float(data["axis_max"]), np.delete(corners, axis, axis=1))


def _trajectory(path: Path) -> np.ndarray:
    """Camera centres [N, 3] of a log: for each camera a line of three numbers and a matrix [4, 4] world_from_cam."""
    with reading(f"The trajectory {path}", "a line of three numbers and four of four, a camera each"):
        numbers = np.array(read_text(path).split(), dtype=np.float64).reshape(-1, 19)
        if not np.isfinite(numbers).all():
            raise ValueError("it has numbers that are not finite")
    return numbers[:, 3:].reshape(-1, 4, 4)[:, :3, 3]
