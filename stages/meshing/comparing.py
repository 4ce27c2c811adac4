"""How far two meshes are from each other, both ways. Arrays in, numbers out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from stages.geometry.similarity import Similarity
from stages.meshing.cleaning import raycaster
from stages.meshing.evaluation import f_score, sample_surface

SAMPLES = 200_000
# Parts of the larger mesh's largest extent at which the F-score is taken.
THRESHOLDS = (0.002, 0.005, 0.01, 0.02)
# ICP: points of each round, rounds, and the part of the pairs that is kept (the nearest; the rest is other surface).
ICP_SAMPLES, ICP_ROUNDS, ICP_KEPT = 20_000, 60, 0.9
# A round that moves points by less than this part of the extent was the last.
ICP_STILL = 1e-7


@dataclass(frozen=True)
class Distances:
    """Distances from points on one surface to another, in the meshes' units.

    Attributes:
        mean, median, p95, max: of the points.
    """

    mean: float
    median: float
    p95: float
    max: float

    @staticmethod
    def of(distances: np.ndarray) -> Distances:
        """Of distances [P]."""
        return Distances(
            float(distances.mean()),
            float(np.median(distances)),
            float(np.quantile(distances, 0.95)),
            float(distances.max()),
        )


@dataclass(frozen=True)
class Comparison:
    """Two meshes held against each other.

    Attributes:
        a_to_b, b_to_a: distances of points, uniform by area, on one to the surface of the other.
        extent: the larger mesh's largest extent, the unit of thresholds.
        f_scores: threshold as a part of the extent -> harmonic mean of the shares of points nearer than it, percent.
    """

    a_to_b: Distances
    b_to_a: Distances
    extent: float
    f_scores: dict[float, float]


def compare_surfaces(
    a: tuple[np.ndarray, np.ndarray], b: tuple[np.ndarray, np.ndarray], samples: int = SAMPLES
) -> Comparison:
    """Compare two meshes, each vertices [V, 3] and faces [F, 3], in one frame.

    Raises:
        ValueError: a mesh has no area.
    """
    to_b = distances_to(sample_surface(*a, samples), b)
    to_a = distances_to(sample_surface(*b, samples), a)
    extent = max(float(np.ptp(vertices[np.unique(faces)], axis=0).max()) for vertices, faces in (a, b))
    f_scores = {threshold: f_score(to_b, to_a, threshold * extent) for threshold in THRESHOLDS}
    return Comparison(Distances.of(to_b), Distances.of(to_a), extent, f_scores)


def distances_to(points: np.ndarray, mesh: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """Distances [P] of points [P, 3] to the surface of a mesh."""
    import open3d as o3d

    # Single precision inside: far from the origin it would eat the digits.
    center = mesh[0].mean(0)
    scene = raycaster(mesh[0] - center, mesh[1])
    return scene.compute_distance(o3d.core.Tensor((points - center).astype(np.float32))).numpy()


def align_by_icp(a: tuple[np.ndarray, np.ndarray], b: tuple[np.ndarray, np.ndarray]) -> Similarity:
    """The rigid motion that takes mesh a nearest to mesh b, from where it is, see `icp`."""
    import open3d as o3d

    center = b[0].mean(0)
    scene = raycaster(b[0] - center, b[1])

    def nearest(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        found = scene.compute_closest_points(o3d.core.Tensor((points - center).astype(np.float32)))
        return found["points"].numpy() + center, found["primitive_normals"].numpy()

    return icp(sample_surface(*a, ICP_SAMPLES), nearest)


def icp(
    start: np.ndarray, nearest: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]], scaled: bool = False
) -> Similarity:
    """The rigid motion (`scaled`: similarity) that takes points [P, 3] nearest to a surface, from where they are.

    Trimmed point-to-plane ICP: Chen and Medioni 1992, with the worst pairs of each round left out. It finds the
    nearest rest, so the two must lie about right to begin with.

    Args:
        nearest: points [P, 3] -> the nearest on the surface [P, 3] and its normals there [P, 3].
    """
    extent = float(np.ptp(start, axis=0).max())
    motion = Similarity.identity()
    moved = start
    for _ in range(ICP_ROUNDS):
        places, normals = nearest(moved)
        offsets = places - moved
        apart = np.linalg.norm(offsets, axis=1)
        kept = apart <= np.quantile(apart, ICP_KEPT)
        motion = plane_step(moved[kept], offsets[kept], normals[kept], scaled).compose(motion)
        before, moved = moved, motion.apply(start)
        if np.abs(moved - before).max() < ICP_STILL * extent:
            break
    return motion


def plane_step(points: np.ndarray, offsets: np.ndarray, normals: np.ndarray, scaled: bool = False) -> Similarity:
    """The small rigid motion (`scaled`: similarity) after which points [P, 3] lie best in planes, by least squares.

    The plane of each goes through point + offset [P, 3] at right angles to its normal [P, 3]; turn and growth are
    about the points' middle. Motions that change nothing (of a sphere about its centre) are left out.
    """
    from scipy.spatial.transform import Rotation

    middle = points.mean(0)
    rows = np.concatenate([np.cross(points - middle, normals), normals], axis=1)
    if scaled:
        rows = np.concatenate([rows, ((points - middle) * normals).sum(1, keepdims=True)], axis=1)
    solution = np.linalg.lstsq(rows, (offsets * normals).sum(1), rcond=1e-6)[0]
    rotation = Rotation.from_rotvec(solution[:3]).as_matrix()
    scale = 1.0 + float(solution[6]) if scaled else 1.0
    return Similarity(scale, rotation, solution[3:6] + middle - scale * rotation @ middle)


def distance_colors(distances: np.ndarray, largest: float) -> np.ndarray:
    """Colours [P, 3] uint8 of distances [P]: from blue at 0 over green to red at `largest` and beyond."""
    import cv2

    levels = np.clip(255 * distances / max(largest, 1e-30), 0, 255).astype(np.uint8)
    return cv2.applyColorMap(levels[:, None], cv2.COLORMAP_TURBO)[:, 0, ::-1]
