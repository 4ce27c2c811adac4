"""How far a mesh is from the known surface: accuracy, completeness and their mean. Arrays in, numbers out.

The definition, used by the demo and by the benchmarks:

- The known surface counts where some camera sees it (first hit of the rays through the pixels): hidden inner
  faces ask nothing of a method that works from photos.
- The predicted mesh counts inside the known object's box, grown by `BOX_MARGIN`, and above `GROUND_MARGIN`:
  the table it may contain is not judged.
- accuracy: mean distance from points sampled uniformly on the predicted surface to the known surface.
- completeness: mean distance from the seen known surface to those points.

All distances are in percent of the known object's largest extent.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np

from stages.surface.triangle_mesh import raycaster

BOX_MARGIN = 0.04  # of the extent: a bulge just outside the object's box is still the method's fault
FACE_MARGIN = 0.05  # of the extent: faces that lie inside this box are the ones that are sampled again
GROUND_MARGIN = 0.012  # of the extent above the lowest point: the seam of object and table is nobody's surface
SEEN_SPACING = 0.004  # of the extent: one point of the seen surface a voxel, so that near views do not outvote
SAMPLES = 400_000
SCORE_THRESHOLDS = (0.005, 0.01)  # of the extent


@dataclass(frozen=True)
class SurfaceScore:
    """Distances in percent of the known object's largest extent; F-scores in percent.

    Attributes:
        accuracy, completeness: means.
        mean: of accuracy and completeness; the number to compare.
        accuracy_median, completeness_median: the same with medians.
        f_half_percent, f_one_percent: harmonic mean of the shares of points nearer than 0.5 % and 1 %.
    """

    accuracy: float
    completeness: float
    mean: float
    accuracy_median: float
    completeness_median: float
    f_half_percent: float
    f_one_percent: float

    def as_dict(self) -> dict[str, float]:
        """Rounded to a thousandth, for JSON and tables."""
        return {name: round(value, 3) for name, value in asdict(self).items()}


@dataclass(frozen=True)
class KnownSurface:
    """The true object and who looked at it.

    Attributes:
        vertices: [V, 3] in the truth's frame, z up.
        faces: [F, 3] int.
        intrinsics: [3, 3] pinhole intrinsics of all cameras, pixels.
        size: width and height in pixels.
        cam_from_world: [N, 4, 4] world-to-camera matrices, OpenCV axes.
    """

    vertices: np.ndarray
    faces: np.ndarray
    intrinsics: np.ndarray
    size: tuple[int, int]
    cam_from_world: np.ndarray

    @property
    def extent(self) -> float:
        """The largest side of the bounding box."""
        return float(np.ptp(self.vertices, axis=0).max())


def seen_surface(known: KnownSurface) -> np.ndarray:
    """Points [P, 3] of the known surface that at least one camera's pixel centre sees, evenly thinned."""
    import open3d as o3d

    scene = raycaster(known.vertices, known.faces)
    points = []
    for cam_from_world in known.cam_from_world:
        rays = o3d.t.geometry.RaycastingScene.create_rays_pinhole(
            o3d.core.Tensor(known.intrinsics), o3d.core.Tensor(cam_from_world), *known.size
        )
        distance = scene.cast_rays(rays)["t_hit"].numpy()
        hit = np.isfinite(distance)
        chosen = rays.numpy()[hit]
        points.append(chosen[:, :3] + distance[hit][:, None] * chosen[:, 3:])
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(np.concatenate(points)))
    return np.asarray(cloud.voxel_down_sample(SEEN_SPACING * known.extent).points)


def sample_surface(vertices: np.ndarray, faces: np.ndarray, count: int, seed: int = 0) -> np.ndarray:
    """Points [count, 3], uniform by area, on a triangle mesh.

    Raises:
        ValueError: the mesh has no area.
    """
    return sample_faces(vertices, faces, count, seed)[0]


def sample_faces(
    vertices: np.ndarray, faces: np.ndarray, count: int, seed: int = 0
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """As `sample_surface`, and the face [count] of each point."""
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


def score_surface(vertices: np.ndarray, faces: np.ndarray, known: KnownSurface, samples: int = SAMPLES) -> SurfaceScore:
    """Compare a predicted mesh (vertices [V, 3], faces [F, 3], in the truth's frame) with the known surface.

    Raises:
        ValueError: no predicted surface lies inside the known object's box.
    """
    import open3d as o3d
    from scipy.spatial import cKDTree

    extent = known.extent
    low, high = known.vertices.min(0), known.vertices.max(0)
    margin, ground = BOX_MARGIN * extent, low[2] + GROUND_MARGIN * extent

    def crop(points: np.ndarray) -> np.ndarray:
        inside = np.all((points > low - margin) & (points < high + margin), axis=1)
        return points[inside & (points[:, 2] > ground)]

    predicted = crop(sample_surface(vertices, faces, samples))
    if len(predicted) < samples // 4:
        # The object is a small part of the mesh: sample it as if it stood alone.
        in_box = np.all((vertices > low - FACE_MARGIN * extent) & (vertices < high + FACE_MARGIN * extent), 1)
        near = in_box[faces].all(1)
        if near.any():
            predicted = crop(sample_surface(vertices, faces[near], samples))
    if len(predicted) == 0:
        raise ValueError("no surface of the mesh lies inside the known object's box: is it in the same frame?")
    seen = seen_surface(known)
    seen = seen[seen[:, 2] > ground]

    scene = raycaster(known.vertices, known.faces)
    to_known = scene.compute_distance(o3d.core.Tensor(predicted.astype(np.float32))).numpy() / extent
    to_predicted = cKDTree(predicted).query(seen, workers=-1)[0] / extent
    f_scores = [f_score(to_known, to_predicted, threshold) for threshold in SCORE_THRESHOLDS]
    return SurfaceScore(
        accuracy=100 * float(to_known.mean()),
        completeness=100 * float(to_predicted.mean()),
        mean=50 * float(to_known.mean() + to_predicted.mean()),
        accuracy_median=100 * float(np.median(to_known)),
        completeness_median=100 * float(np.median(to_predicted)),
        f_half_percent=f_scores[0],
        f_one_percent=f_scores[1],
    )


def f_score(one_way: np.ndarray, other_way: np.ndarray, threshold: float) -> float:
    """Harmonic mean of the shares of distances nearer than the threshold, percent, of both ways between two surfaces.

    Where one of them is the truth: of precision and recall (Knapitsch et al. 2017).
    """
    precision, recall = (one_way < threshold).mean(), (other_way < threshold).mean()
    return float(200 * precision * recall / max(precision + recall, 1e-9))
