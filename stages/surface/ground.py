"""The ground in a mesh: where to cut it off, and what of it is left over or made up."""

from __future__ import annotations

import numpy as np

from stages.geometry.cameras import PosedScene
from stages.geometry.plane import Plane, fit_plane
from stages.surface.triangle_mesh import compact, face_adjacency, face_areas, face_normals, label_pieces

# Faces that lean less than this from the ground's plane belong to it, and this much area (in the region's radii
# squared) is enough to fit it.
GROUND_TILT_DEG, MIN_GROUND_AREA = 15.0, 0.02
# Bumps of the ground have less than this part of the largest piece's area.
BUMP_AREA = 0.05
# What hangs under the ground is made up where it is further out than this, unless more than this part of the sparse
# points lies under the ground, too.
BORDER_RADIUS, MAX_UNDER = 0.75, 0.01


def cut_above(vertices: np.ndarray, faces: np.ndarray, ground: Plane, tolerance: float) -> tuple[np.ndarray, float]:
    """Plane (normal [3], offset) a tolerance above the ground, which is fitted anew to the mesh where it shows it."""
    centers = vertices[faces].mean(1).astype(np.float64)
    normals = face_normals(vertices, faces)
    areas = np.linalg.norm(normals, axis=1)
    level = normals @ ground.normal > np.cos(np.radians(GROUND_TILT_DEG)) * areas
    normal, offset = ground.normal, ground.offset
    for reach in (2 * tolerance, tolerance, tolerance):
        on_it = level & (np.abs(centers @ normal - offset) < reach)
        if areas[on_it].sum() / 2 < MIN_GROUND_AREA:
            return ground.normal, ground.offset + tolerance
        normal, offset = fit_plane(centers[on_it], ground.normal, areas[on_it])
    return normal, offset + tolerance


def without_bumps(
    vertices: np.ndarray, faces: np.ndarray, normal: np.ndarray, offset: float, height: float
) -> tuple[np.ndarray, np.ndarray]:
    """The mesh without what a bumpy ground leaves above its cut: small pieces that rise by less than `height`."""
    labels = label_pieces(len(faces), face_adjacency(faces))
    areas = np.bincount(labels, face_areas(vertices, faces))
    tops = np.full(len(areas), -np.inf)
    np.maximum.at(tops, labels, (vertices @ normal - offset)[faces].max(1))
    bumps = (tops < height) & (areas < BUMP_AREA * areas.max())
    return compact(vertices, faces[~bumps[labels]])


def under_the_border(vertices: np.ndarray, scene: PosedScene, depth: float) -> np.ndarray:
    """Vertices [V] bool that hang under the ground by more than `depth` along the region's border.

    Photos show the ground going on there and nothing below it, so that training may leave flaps.
    """
    assert scene.ground is not None
    points = scene.points[np.linalg.norm(scene.points, axis=1) < 1]
    if scene.kind != "object" or (scene.ground.heights(points) < -depth).sum() > MAX_UNDER * len(points):
        return np.zeros(len(vertices), dtype=bool)
    hanging: np.ndarray = np.linalg.norm(vertices, axis=1) > BORDER_RADIUS
    hanging &= scene.ground.heights(vertices) < -depth
    return hanging
