"""The frame in which a normal map is read: what a viewer derives from positions, normals and UVs."""

from __future__ import annotations

import numpy as np

from stages.artifacts import AtlasMesh

# Squared lengths and areas below this count as none: a face or chart without extent says nothing of directions.
_TINY = 1e-20


def vertex_tangents(mesh: AtlasMesh) -> np.ndarray:
    """Tangents as MikkTSpace makes them, for vertices that are split along the seams of the charts.

    A face's tangent is the direction in which u grows, dp/du. At each corner it is turned into the vertex's tangent
    plane and counts by the corner's angle there (MikkTSpace, as glTF 2.0, section 3.7.2.1, asks for). A vertex that
    faces with mirrored and unmirrored UVs share, which MikkTSpace would split, takes the side with the larger angle.

    Returns:
        [V, 4] float32: unit tangent at right angles to the normal, and the sign w of the bitangent w * n x t, which
        points to where v grows. A vertex without a direction of u gets any tangent and w = 1.
    """
    normals, faces, count = mesh.normals.astype(np.float64), mesh.faces, len(mesh.vertices)
    corners, flat = mesh.vertices[faces].astype(np.float64), mesh.uvs[faces].astype(np.float64)
    edges, flat_edges = corners[:, 1:] - corners[:, :1], flat[:, 1:] - flat[:, :1]
    area = flat_edges[:, 0, 0] * flat_edges[:, 1, 1] - flat_edges[:, 0, 1] * flat_edges[:, 1, 0]
    # dp/du times |area|, whose sign is that of the chart
    along_u = np.sign(area)[:, None] * (flat_edges[:, 1, 1:] * edges[:, 0] - flat_edges[:, 0, 1:] * edges[:, 1])
    total, votes = np.zeros((count, 3)), np.zeros(count)
    for k in range(3):
        ids = faces[:, k]
        to_next, to_last = (_in_plane(corners[:, (k + j) % 3] - corners[:, k], normals[ids]) for j in (1, 2))
        angles = np.arccos(np.clip((to_next * to_last).sum(1), -1, 1)) * (np.abs(area) > _TINY)
        weighted = angles[:, None] * _in_plane(along_u, normals[ids])
        for axis in range(3):
            total[:, axis] += np.bincount(ids, weighted[:, axis], minlength=count)
        votes += np.bincount(ids, angles * np.sign(area), minlength=count)
    tangents = _in_plane(total, normals)
    lost = np.linalg.norm(tangents, axis=1) < 0.5
    if lost.any():
        tangents[lost] = _in_plane(np.eye(3)[np.abs(normals[lost]).argmin(1)], normals[lost])
    return np.concatenate([tangents, np.where(votes < 0, -1.0, 1.0)[:, None]], axis=1).astype(np.float32)


def _in_plane(vectors: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Unit vectors [P, 3] of what is left of `vectors` at right angles to unit `normals`; 0 where nothing is left."""
    flat = vectors - (vectors * normals).sum(1, keepdims=True) * normals
    squared = (flat * flat).sum(1, keepdims=True)
    return np.where(squared > _TINY, flat / np.sqrt(np.maximum(squared, _TINY)), 0.0)


def to_tangent_space(directions: np.ndarray, normals: np.ndarray, tangents: np.ndarray) -> np.ndarray:
    """Unit directions [P, 3] in the frame (t, b, n) of a point on the surface.

    A viewer makes x t + y b + z n of what it reads, with n and t interpolated between vertices and normalised, and
    b = w n x t; between vertices t is not quite at right angles to n, so (x, y, z) solves that equation.

    Args:
        directions: [P, 3] unit.
        normals: [P, 3] unit, interpolated.
        tangents: [P, 4], interpolated; see `vertex_tangents`.
    """
    lengths = np.linalg.norm(tangents[:, :3], axis=1, keepdims=True)
    t = tangents[:, :3] / np.maximum(lengths, _TINY)
    b = np.cross(normals, t) * np.where(tangents[:, 3:] < 0, -1.0, 1.0)
    # The volume of the frame; near 0 only where the interpolated tangent runs along the normal.
    volume = (np.cross(t, b) * normals).sum(1, keepdims=True)
    parts = [np.cross(b, normals), np.cross(normals, t), np.cross(t, b)]
    solved = np.concatenate([(directions * part).sum(1, keepdims=True) for part in parts], axis=1)
    solved *= np.where(volume < 0, -1.0, 1.0)
    return solved / np.maximum(np.linalg.norm(solved, axis=1, keepdims=True), _TINY)
