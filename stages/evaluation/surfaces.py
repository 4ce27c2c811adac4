"""A surface against the truth: how far, how much of it within a threshold, how differently turned.

P points. Distances are in the surfaces' unit. Both ways:

- accuracy: from points on the predicted surface to the true one,
- completeness: from points on the true surface to the predicted one.

Points are uniform by area on a mesh; a cloud's points are taken as they are. The distance to a mesh is that to its
nearest triangle, the distance to a cloud that to its nearest point.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from stages.evaluation.thinning import check_cubes
from stages.surface.triangle_mesh import face_normals, raycaster

SAMPLES = 200_000
# A selection that leaves few of the points is drawn again from this many times the points at most.
MAX_OVERDRAW = 16
MOST_DRAWN = 20_000_000  # points on a mesh: they take 3 GB
# As a part of the truth's largest extent, where nobody asks for others.
DEFAULT_THRESHOLDS = (0.002, 0.005, 0.01, 0.02)

Keep = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True)
class Surface:
    """A mesh, or a cloud of points.

    Attributes:
        points: [V, 3] vertices, or the cloud's points.
        faces: [F, 3] int; None: a cloud.
        normals: [V, 3] of a cloud's points, unit; None: not known. A mesh has those of its faces.
    """

    points: np.ndarray
    faces: np.ndarray | None = None
    normals: np.ndarray | None = None

    @property
    def box(self) -> np.ndarray:
        """[2, 3] lowest and highest corner of the box around it; of a mesh, around its faces."""
        used = self.points if self.faces is None else self.points[np.unique(self.faces)]
        return np.stack([used.min(0), used.max(0)])

    @property
    def extent(self) -> float:
        """The largest side of its box."""
        return float(np.ptp(self.box, axis=0).max())

    def moved(self, matrix: np.ndarray) -> Surface:
        """It in another frame, by a [4, 4] similarity."""
        turn = matrix[:3, :3] / np.cbrt(np.linalg.det(matrix[:3, :3]))
        normals = None if self.normals is None else self.normals @ turn.T
        return Surface(moved(self.points, matrix), self.faces, normals)


@dataclass(frozen=True)
class Sampling:
    """How points are chosen on a surface.

    Attributes:
        count: points on a mesh; of a larger cloud as many are drawn.
        spacing: instead of the count, one point a square of this side; a cloud is thinned to one (their mean) a cube
            of this side.
        seed: of the random numbers.
    """

    count: int = SAMPLES
    spacing: float | None = None
    seed: int = 0


@dataclass(frozen=True)
class Nearest:
    """The nearest points on a surface.

    Attributes:
        points: [P, 3].
        distances: [P].
        normals: [P, 3] unit, there; None: not known.
    """

    points: np.ndarray
    distances: np.ndarray
    normals: np.ndarray | None


@dataclass(frozen=True)
class OneWay:
    """Distances from points on one surface to another, in the surfaces' unit.

    Attributes:
        points: how many.
        mean, rms, median, p90, p95, p99, max: of their distances.
    """

    points: int
    mean: float
    rms: float
    median: float
    p90: float
    p95: float
    p99: float
    max: float

    @staticmethod
    def of(distances: np.ndarray) -> OneWay:
        """Of distances [P]."""
        squared = float((distances.astype(np.float64) ** 2).mean())
        at = [float(value) for value in np.quantile(distances, (0.5, 0.9, 0.95, 0.99, 1))]
        return OneWay(len(distances), float(distances.mean(dtype=np.float64)), squared**0.5, *at)


@dataclass(frozen=True)
class FScore:
    """Shares in percent of points nearer than a threshold (Knapitsch et al. 2017).

    Attributes:
        threshold: in the surfaces' unit.
        precision, recall: of the predicted and of the true points.
        f_score: their harmonic mean.
    """

    threshold: float
    precision: float
    recall: float
    f_score: float


@dataclass(frozen=True)
class Turning:
    """Angles between the normals of points and those of the nearest points on the other surface, not oriented: 0..90.

    Attributes:
        mean_deg, median_deg: degrees.
        consistency: mean |cosine|, 1 at best (Mescheder et al. 2019).
    """

    mean_deg: float
    median_deg: float
    consistency: float


@dataclass(frozen=True)
class SurfaceScores:
    """A surface against the truth, in the surfaces' unit.

    Attributes:
        extent: the truth's largest.
        accuracy, completeness: from the predicted points to the truth, and back.
        chamfer: mean of the two means.
        chamfer_sum: their sum, which others call Chamfer distance.
        f_scores: one a threshold.
        accuracy_normals, completeness_normals: None where a side has no normals.
    """

    extent: float
    accuracy: OneWay
    completeness: OneWay
    chamfer: float
    chamfer_sum: float
    f_scores: tuple[FScore, ...]
    accuracy_normals: Turning | None
    completeness_normals: Turning | None


class Target:
    """A surface to measure distances to."""

    def __init__(self, surface: Surface) -> None:
        from scipy.spatial import cKDTree

        self.surface = surface
        # Single precision inside the ray caster: far from the origin it would eat the digits.
        self._center = surface.points.mean(0)
        if surface.faces is None:
            self._tree = cKDTree(surface.points)
        else:
            self._scene = raycaster(surface.points - self._center, surface.faces)

    def nearest(self, points: np.ndarray) -> Nearest:
        """The nearest places to points [P, 3]."""
        import open3d as o3d

        surface = self.surface
        if surface.faces is None:
            distances, rows = self._tree.query(points, workers=-1)
            return Nearest(surface.points[rows], distances, None if surface.normals is None else surface.normals[rows])
        found = self._scene.compute_closest_points(o3d.core.Tensor((points - self._center).astype(np.float32)))
        places = found["points"].numpy() + self._center
        return Nearest(places, np.linalg.norm(places - points, axis=1), found["primitive_normals"].numpy())


def draw_points(surface: Surface, sampling: Sampling, keep: Keep | None = None) -> Surface:
    """Points on a surface as `sampling` says, with normals where they are known.

    Args:
        keep: says which of points [P, 3] count, [P] bool. Where few do, more are drawn.

    Raises:
        ValueError: the mesh has no area or far too much, or no point counts.
    """
    cloud = _draw(surface, sampling, 1.0)
    if keep is None:
        return cloud
    kept = keep(cloud.points)
    if surface.faces is not None and sampling.spacing is None and 0 < kept.sum() < 0.5 * len(kept):
        cloud = _draw(surface, sampling, min(len(kept) / kept.sum(), MAX_OVERDRAW))
        kept = keep(cloud.points)
    if not kept.any():
        raise ValueError(f"none of {len(kept)} points counts: all were cut away")
    return Surface(cloud.points[kept], None, None if cloud.normals is None else cloud.normals[kept])


def measure(
    predicted: Surface,
    truth: Surface,
    thresholds: Sequence[float] | None = None,
    sampling: Sampling | None = None,
    keep_predicted: Keep | None = None,
    keep_true: Keep | None = None,
) -> SurfaceScores:
    """Hold a surface against the truth; both are in one frame.

    What `keep_*` cut away is not asked where it is near to; the other side may still be near to it.

    Args:
        thresholds: of the F-scores, in the surfaces' unit; None: `DEFAULT_THRESHOLDS` of the truth's extent.
        sampling: None: 200 000 points a side.
        keep_predicted, keep_true: say which of points [P, 3] count, [P] bool; see `stages.evaluation.culling`.

    Raises:
        ValueError: a mesh has no area, or no point of a side counts.
    """
    sampling = sampling or Sampling()
    ours, true = draw_points(predicted, sampling, keep_predicted), draw_points(truth, sampling, keep_true)
    return measure_points(ours, true, predicted, truth, thresholds)


def measure_points(
    ours: Surface, true: Surface, predicted: Surface, truth: Surface, thresholds: Sequence[float] | None = None
) -> SurfaceScores:
    """The definition: from points `ours` to the surface `truth` (accuracy), from points `true` to `predicted`."""
    extent = truth.extent
    if thresholds is None:
        thresholds = [part * extent for part in DEFAULT_THRESHOLDS]
    to_truth, to_predicted = Target(truth).nearest(ours.points), Target(predicted).nearest(true.points)
    accuracy, completeness = OneWay.of(to_truth.distances), OneWay.of(to_predicted.distances)
    return SurfaceScores(
        extent=extent,
        accuracy=accuracy,
        completeness=completeness,
        chamfer=0.5 * (accuracy.mean + completeness.mean),
        chamfer_sum=accuracy.mean + completeness.mean,
        f_scores=tuple(score_at(to_truth.distances, to_predicted.distances, each) for each in thresholds),
        accuracy_normals=turning(ours.normals, to_truth.normals),
        completeness_normals=turning(true.normals, to_predicted.normals),
    )


def score_at(to_truth: np.ndarray, to_predicted: np.ndarray, threshold: float) -> FScore:
    """Precision, recall and F-score of distances [P] and [Q] at a threshold."""
    precision, recall = (100 * float((distances < threshold).mean()) for distances in (to_truth, to_predicted))
    return FScore(threshold, precision, recall, 2 * precision * recall / max(precision + recall, 1e-9))


def turning(normals: np.ndarray | None, others: np.ndarray | None) -> Turning | None:
    """Of unit normals [P, 3] against others [P, 3]; None where one side has none. Faces without area have none."""
    if normals is None or others is None:
        return None
    with np.errstate(invalid="ignore"):
        cosines = np.abs((normals * others).sum(1)).clip(0, 1)
    cosines = cosines[np.isfinite(cosines)]
    if not len(cosines):
        return None
    angles = np.degrees(np.arccos(cosines))
    return Turning(float(angles.mean()), float(np.median(angles)), float(cosines.mean()))


def moved(points: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """Points [P, 3] in another frame, by a [4, 4] matrix."""
    return points @ matrix[:3, :3].T + matrix[:3, 3]


def sample_faces(
    vertices: np.ndarray, faces: np.ndarray, count: int, seed: int = 0
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Points [count, 3], uniform by area, on a triangle mesh, and the face [count] of each.

    Raises:
        ValueError: the mesh has no area.
    """
    corners = vertices[faces].astype(np.float64)
    edge_b, edge_c = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area = np.linalg.norm(np.cross(edge_b, edge_c), axis=1)
    if not area.sum() > 0:
        raise ValueError(f"a mesh with area is expected, got {len(faces)} faces with none")
    rng = np.random.default_rng(seed)
    chosen = rng.choice(len(faces), size=count, p=area / area.sum())
    u, v = rng.random((2, count, 1))
    flip = u + v > 1
    u, v = np.where(flip, 1 - u, u), np.where(flip, 1 - v, v)
    return corners[chosen, 0] + u * edge_b[chosen] + v * edge_c[chosen], chosen


def _draw(surface: Surface, sampling: Sampling, times: float) -> Surface:
    if surface.faces is None:
        return _thin(surface, sampling)
    crosses = face_normals(surface.points, surface.faces)
    lengths = np.linalg.norm(crosses, axis=1)
    count = sampling.count if sampling.spacing is None else np.ceil(0.5 * lengths.sum() / sampling.spacing**2)
    if not count <= MOST_DRAWN:
        raise ValueError(f"its area asks for {count:.3g} points, at most {MOST_DRAWN} are drawn: widen the spacing")
    points, chosen = sample_faces(surface.points, surface.faces, int(min(count * times, MOST_DRAWN)), sampling.seed)
    return Surface(points, None, crosses[chosen] / lengths[chosen, None])


def _thin(cloud: Surface, sampling: Sampling) -> Surface:
    """A cloud's points, at most as many as are wanted."""
    import open3d as o3d

    if sampling.spacing is not None:
        check_cubes(cloud.points, sampling.spacing)
        whole = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(cloud.points))
        if cloud.normals is not None:
            whole.normals = o3d.utility.Vector3dVector(cloud.normals)
        thinned = whole.voxel_down_sample(sampling.spacing)
        normals = None if cloud.normals is None else np.asarray(thinned.normalize_normals().normals)
        return Surface(np.asarray(thinned.points), None, normals)
    if len(cloud.points) <= sampling.count:
        return cloud
    rows = np.sort(np.random.default_rng(sampling.seed).choice(len(cloud.points), sampling.count, replace=False))
    return Surface(cloud.points[rows], None, None if cloud.normals is None else cloud.normals[rows])
