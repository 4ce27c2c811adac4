"""Bringing a surface into the truth's frame: by a given matrix, by camera centres, by ICP."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from stages.evaluation.surfaces import Keep, Sampling, Surface, Target, draw_points
from stages.geometry.similarity import Similarity, align_points

# ICP: points of each round, rounds, and the part of the pairs that is kept (the nearest; the rest is other surface).
ICP_SAMPLES, ICP_ROUNDS, ICP_KEPT = 20_000, 60, 0.9
# A round that moves points by less than this part of the extent was the last.
ICP_STILL = 1e-7
PLANE_NEIGHBOURS = 20


def by_cameras(centers: Mapping[str, np.ndarray], true_centers: Mapping[str, np.ndarray]) -> tuple[Similarity, int]:
    """The similarity that takes camera centres [3] to the true ones of the same names, and how many were paired.

    Raises:
        ValueError: fewer than 3 names are shared, or the centres lie on one line.
    """
    shared = sorted(set(centers) & set(true_centers))
    if len(shared) < 3:
        raise ValueError(f"only {len(shared)} of {len(centers)} cameras have a true one of their name (need 3)")
    return align_points(
        np.array([centers[name] for name in shared]), np.array([true_centers[name] for name in shared])
    ), len(shared)


def by_icp(predicted: Surface, truth: Surface, scaled: bool = False, keep: Keep | None = None) -> Similarity:
    """The rigid motion (`scaled`: similarity) that takes a surface nearest to the truth, from where it is.

    Trimmed point-to-plane ICP: Chen and Medioni 1992, with the worst pairs of each round left out. It finds the
    nearest rest, so the two must lie about right to begin with. A cloud without normals gets those of planes through
    20 neighbours.

    Args:
        keep: which points of the prediction are moved, as of `draw_points`.
    """
    target = Target(truth if truth.faces is not None or truth.normals is not None else _with_normals(truth))
    start = draw_points(predicted, Sampling(ICP_SAMPLES), keep).points
    extent = float(np.ptp(start, axis=0).max())
    motion = Similarity.identity()
    moved = start
    for _ in range(ICP_ROUNDS):
        found = target.nearest(moved)
        assert found.normals is not None  # the target has some
        offsets = found.points - moved
        apart = np.linalg.norm(offsets, axis=1)
        kept = (apart <= np.quantile(apart, ICP_KEPT)) & np.isfinite(found.normals).all(1)
        motion = plane_step(moved[kept], offsets[kept], found.normals[kept], scaled).compose(motion)
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


def _with_normals(cloud: Surface) -> Surface:
    import open3d as o3d

    points = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(cloud.points))
    points.estimate_normals(o3d.geometry.KDTreeSearchParamKNN(PLANE_NEIGHBOURS))
    return Surface(cloud.points, None, np.asarray(points.normals))
