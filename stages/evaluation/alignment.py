"""Bringing a surface into the truth's frame: by a given matrix, by camera centres, by ICP."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from stages.evaluation.surfaces import Sampling, Surface, Target, draw_points
from stages.geometry.similarity import Similarity, align_points
from stages.meshing.comparing import ICP_SAMPLES, icp

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


def by_icp(predicted: Surface, truth: Surface, scaled: bool = False) -> Similarity:
    """The rigid motion (`scaled`: similarity) that takes a surface nearest to the truth, from where it is.

    Trimmed point-to-plane ICP (Chen and Medioni 1992), see `stages.meshing.comparing`. A cloud without normals gets
    those of planes through 20 neighbours.
    """
    target = Target(truth if truth.faces is not None or truth.normals is not None else _with_normals(truth))

    def nearest(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        found = target.nearest(points)
        assert found.normals is not None
        return found.points, found.normals

    return icp(draw_points(predicted, Sampling(ICP_SAMPLES)).points, nearest, scaled)


def _with_normals(cloud: Surface) -> Surface:
    import open3d as o3d

    points = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(cloud.points))
    points.estimate_normals(o3d.geometry.KDTreeSearchParamKNN(PLANE_NEIGHBOURS))
    return Surface(cloud.points, None, np.asarray(points.normals))
