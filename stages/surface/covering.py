"""How much of a surface dense points cover."""

from __future__ import annotations

import numpy as np

from stages.geometry.cameras import PinholeCameras
from stages.geometry.plane import Plane
from stages.geometry.point_cloud import TRUSTED, PointCloud
from stages.surface.border import off_ground
from stages.surface.selection import count_views

# What is asked: places of the surface within this radius, off the ground, that so many photos see.
WITHIN, SEEN_BY = 0.9, 2
# A place is covered where this part of the points lie within `REACH` (scene units) that would lie there if each pixel
# of one photo had one.
REACH, COVERED = 0.05, 0.1
MAX_PLACES = 2000


def covered_share(
    vertices: np.ndarray, faces: np.ndarray, cameras: PinholeCameras, ground: Plane | None, cloud: PointCloud
) -> float:
    """Share of a mesh's surface, where photos see it and off the ground, that trusted points cover.

    Args:
        vertices, faces, cameras, ground, cloud: in the scene frame; the mesh's vertices are spread evenly.

    Returns:
        0 where nothing is seen.
    """
    from scipy.spatial import cKDTree

    points = cloud.points[(cloud.trust >= TRUSTED) & (np.linalg.norm(cloud.points, axis=1) < 1)]
    if not len(faces) or not len(points):
        return 0.0
    asked = off_ground(vertices, faces, ground) & (np.linalg.norm(vertices, axis=1) < WITHIN)
    rows = np.flatnonzero(asked & (count_views(vertices, faces, cameras, SEEN_BY) >= SEEN_BY))
    if not len(rows):
        return 0.0
    places = vertices[rows[:: -(-len(rows) // MAX_PLACES)]]
    counts = cKDTree(points).query_ball_point(places, REACH, return_length=True)
    distances = np.linalg.norm(cameras.centers - places.mean(0), axis=1)
    pixel = float(np.median(distances / cameras.intrinsics[:, 0, 0]))
    return float((counts > COVERED * np.pi * (REACH / pixel) ** 2).mean())
