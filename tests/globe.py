"""A ball with UVs: two charts with a seam between them."""

from __future__ import annotations

import numpy as np

from stages.artifacts import AtlasMesh


def globe(rows: int = 48) -> AtlasMesh:
    """A unit ball as two charts, cut along the circle x = 0: each half is laid flat by (y, z)."""
    from stages.surface.solids import cut_at_plane, cut_to_ball, extract_solid

    parts = []
    surface = extract_solid(lambda p: np.linalg.norm(p, axis=1) - 0.5, rows)
    whole = cut_to_ball(surface.vertices, surface.faces, 0.9)
    for side in (1.0, -1.0):
        vertices, faces = cut_at_plane(*whole, np.array([side, 0.0, 0.0]), 0.0)
        lid = (np.abs(vertices[faces][:, :, 0]) < 1e-6).all(1)
        used, index = np.unique(faces[~lid], return_inverse=True)
        flat = vertices[used, 1:] * 0.45 + 0.25
        parts.append((vertices[used], index.reshape(-1, 3), flat + np.array([0.5 * (side < 0), 0])))
    (va, fa, ua), (vb, fb, ub) = parts
    vertices = np.concatenate([va, vb])
    normals = vertices / np.linalg.norm(vertices, axis=1, keepdims=True)
    return AtlasMesh(
        vertices.astype(np.float32),
        normals.astype(np.float32),
        np.concatenate([ua, ub]).astype(np.float32),
        np.concatenate([fa, fb + len(va)]).astype(np.int32),
        64,
    )
