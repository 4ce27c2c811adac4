"""DTU's evaluation (Jensen et al. 2014), as the community's Python version of it has it (jzhangbs/DTUeval-python).

All in millimetres, in the frame of the data set's cameras.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from stages.errors import InputError
from stages.evaluation.reading import read_prediction, read_surface
from stages.evaluation.surfaces import Surface, Target
from stages.evaluation.thinning import thin
from stages.inputs.bounded import reason

DENSITY = 0.2  # mm between points at least
PATCH = 60.0  # mm below the box of the observed part, and half of what is looked at above it, as published
MOST_POINTS = 100_000_000  # of a lattice; that of a table of 1 x 1 m has a quarter
MOST_CELLS = 1 << 28  # of the observed part
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
    (`seed`) each point takes away all within `DENSITY` of it. Of what is in the box grown by `PATCH`, the part
    in observed cells is measured against the scan; the part of the scan above the ground plane is measured against all.

    Raises:
        ValueError: no predicted point lies in observed cells, or no distance is below `MAX_DISTANCE`.
    """
    points = predicted.points if predicted.faces is None else lattice(predicted.points, predicted.faces, DENSITY)
    points = thin(np.random.default_rng(seed).permutation(points), DENSITY)
    near = points[((points >= truth.box[0] - PATCH) & (points < truth.box[1] + 2 * PATCH)).all(1)]
    measured = near[observed(near, truth)]
    above = truth.points[truth.points @ truth.ground[:3] + truth.ground[3] > 0]
    for name, found in (("predicted", measured), ("scanned", above)):
        if not len(found):
            raise ValueError(f"no {name} point lies in the observed part; is it in the scan's frame, in millimetres?")
    to_truth = Target(Surface(truth.points)).nearest(measured).distances
    to_predicted = Target(Surface(near)).nearest(above).distances
    means = []
    for name, distances in (("predicted", to_truth), ("scanned", to_predicted)):
        if not (distances < MAX_DISTANCE).any():
            raise ValueError(f"no {name} point is nearer than {MAX_DISTANCE:g} mm to the other surface")
        means.append(float(distances[distances < MAX_DISTANCE].mean()))
    return DtuScore(
        accuracy=means[0],
        completeness=means[1],
        overall=0.5 * (means[0] + means[1]),
        predicted_points=len(measured),
        true_points=len(above),
        predicted_far=100 * float((to_truth >= MAX_DISTANCE).mean()),
        true_far=100 * float((to_predicted >= MAX_DISTANCE).mean()),
    )


def observed(points: np.ndarray, truth: DtuTruth) -> np.ndarray:
    """Which of points [P, 3] lie in observed cells, [P] bool; a cell's index is that of its nearest corner."""
    cells = np.around((points - truth.box[0]) / truth.resolution).astype(np.int64)
    inside = ((cells >= 0) & (cells < truth.observed.shape)).all(1)
    inside[inside] = truth.observed[tuple(cells[inside].T)]
    return inside


def lattice(vertices: np.ndarray, faces: np.ndarray, spacing: float) -> np.ndarray:
    """The vertices [V, 3], and points on each triangle in a lattice along two of its sides, about `spacing` apart.

    Raises:
        ValueError: they are more than `MOST_POINTS`.
    """
    corners = vertices[faces].astype(np.float64)
    sides = corners[:, 1:] - corners[:, :1]
    lengths = np.linalg.norm(sides, axis=2)
    area = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1)
    corners, sides, lengths, area = (each[area > 0] for each in (corners, sides, lengths, area))
    # Slanted lattices are wider spaced along the sides, so that each point has a square of `spacing` to itself.
    steps = np.floor(lengths / (spacing * np.sqrt(lengths.prod(1) / area))[:, None]).astype(np.int64)
    found = [vertices.astype(np.float64)]
    if steps.prod(1, dtype=np.float64).sum() / 2 > MOST_POINTS:
        raise ValueError(f"points {spacing:g} apart on all of it are more than {MOST_POINTS}")
    kinds, kind_of = np.unique(steps, axis=0, return_inverse=True)
    by_kind = np.split(np.argsort(kind_of.ravel(), kind="stable"), np.cumsum(np.bincount(kind_of.ravel()))[:-1])
    for (first, second), rows in zip(kinds, by_kind, strict=True):
        if not first or not second:
            continue
        along = np.indices((first + 1, second + 1)).reshape(2, -1).T + 0.5
        along /= first, second
        along = along[along.sum(1) < 1]
        found.append((corners[rows, None, 0] + along @ sides[rows]).reshape(-1, 3))
    return np.concatenate(found)


# ---------------------------------------------------------------- files
def evaluate_dtu(predicted: Path, data: Path, scan: int, seed: int = 0) -> dict[str, Any]:
    """Numbers of `DtuScore` and what was done, from `data` in the published layout.

    Args:
        predicted: in the frame of the data set's cameras, mm: as `hineus run --poses cameras_sphere.npz` makes it.
        data: folder with `ObsMask/ObsMask24_10.mat`, `ObsMask/Plane24.mat` and `Points/stl/stl024_total.ply`.

    Raises:
        InputError: a file cannot be read, or nothing is left to measure.
    """
    truth, (path, ours) = read_dtu(data, scan), read_prediction(predicted)
    try:
        found = dtu_score(ours, truth, seed)
    except ValueError as error:
        raise InputError(
            f"{path} cannot be held against scan {scan}: {error}.",
            "Reconstruct with the data set's own poses: `hineus run PHOTOS --poses cameras_sphere.npz`.",
        ) from error
    return {
        "predicted": str(path),
        "truth": str(data),
        "scan": scan,
        "unit": "mm",
        **asdict(found),
        "done": [
            "protocol: DTU, as in DTUeval-python",
            "alignment: none, the frame of the data set's cameras",
            f"sampling: a point each {DENSITY:g} mm, thinned to that in random order, seed {seed}",
            f"cut: {PATCH:g} mm below to {2 * PATCH:g} mm above ObsMask's box, observed cells; scan above the ground",
            f"distances of {MAX_DISTANCE:g} mm and more are left out of both means",
        ],
    }


def truth_files(data: Path, scan: int) -> tuple[Path, Path, Path]:
    """Observed cells, ground plane and points of a scan."""
    cells = data / "ObsMask"
    return cells / f"ObsMask{scan}_10.mat", cells / f"Plane{scan}.mat", data / "Points/stl" / f"stl{scan:03}_total.ply"


def read_dtu(data: Path, scan: int) -> DtuTruth:
    """The truth of one scan from `SampleSet/MVS Data` of DTU, with the scans of `Points`.

    Raises:
        InputError: a file is missing or does not hold what it should.
    """
    observed, plane, scanned = truth_files(data, scan)
    missing = [str(path.relative_to(data)) for path in (observed, plane, scanned) if not path.is_file()]
    if missing:
        raise InputError(
            f"{data} lacks {len(missing)} of 3 files of scan {scan}: {', '.join(missing)}.",
            "`--data` takes the folder with ObsMask/ (of DTU's SampleSet) and Points/stl/ (of its Points).",
        )
    cells, box, side = (_matrix(observed, key) for key in ("ObsMask", "BB", "Res"))
    ground = _matrix(plane, "P")
    if cells.ndim != 3 or box.shape != (2, 3) or side.size != 1 or ground.size != 4:
        raise InputError(
            f"{observed} and {plane} hold ObsMask {cells.shape}, BB {box.shape}, Res {side.shape} and P "
            f"{ground.shape}, need [X, Y, Z], (2, 3), 1 and 4 numbers.",
            "Unpack DTU's SampleSet again.",
        )
    return DtuTruth(
        read_surface(scanned).points, cells.astype(bool), box.astype(np.float32), float(side.item()), ground.ravel()
    )


def _matrix(path: Path, key: str) -> np.ndarray:
    from scipy.io import loadmat, whosmat

    try:
        shape = {name: shape for name, shape, _ in whosmat(str(path))}[key]
        if math.prod(shape) > MOST_CELLS:
            raise ValueError(f"it has {math.prod(shape)} cells, at most {MOST_CELLS} are read")
        return np.asarray(loadmat(str(path), variable_names=[key])[key])
    except Exception as error:  # scipy raises nearly anything on a damaged file
        raise InputError(f"{path} holds no matrix {key} ({reason(error)}).", "Unpack DTU's SampleSet again.") from error
