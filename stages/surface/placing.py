"""A textured mesh in another frame, with the unit normals that files need."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from stages.artifacts import AtlasMesh
from stages.geometry.similarity import Similarity
from stages.surface.triangle_mesh import face_normals


def placed(mesh: AtlasMesh, target_from_mesh: Similarity) -> AtlasMesh:
    """The mesh elsewhere, its vertices and normals as float64 and the normals unit."""
    normals = unit_normals(mesh.vertices, mesh.normals, mesh.faces) @ target_from_mesh.rotation.T
    return replace(mesh, vertices=target_from_mesh.apply(mesh.vertices.astype(np.float64)), normals=normals)


def turned(mesh: AtlasMesh, rotation: np.ndarray) -> AtlasMesh:
    """The mesh turned about the origin by a rotation [3, 3]."""
    return replace(mesh, vertices=mesh.vertices @ rotation.T, normals=mesh.normals @ rotation.T)


def unit_normals(vertices: np.ndarray, normals: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Vertex normals [V, 3] float64 of length 1: those without a length take an adjoining face's, else +Z."""
    unit = normals.astype(np.float64)
    lengths = np.linalg.norm(unit, axis=1)
    bad = ~np.isfinite(lengths) | (lengths < 1e-6)
    if bad.any():
        flat = face_normals(vertices, faces)
        usable = np.linalg.norm(flat, axis=1) > 0
        unit[bad] = (0, 0, 1)
        for k in range(3):
            takes = usable & bad[faces[:, k]]
            unit[faces[takes, k]] = flat[takes]
        lengths = np.linalg.norm(unit, axis=1)
    unit /= lengths[:, None]
    return unit
