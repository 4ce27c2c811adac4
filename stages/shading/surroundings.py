"""What a point on the surface has around it: open sky, or the surface itself with a colour of its own."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stages.artifacts import AtlasMesh
from stages.drawing.rendering import sample_texture
from stages.light.environment import directions
from stages.surface.triangle_mesh import MAX_RAYS, median_edge, raycaster

# Rows of the grid of directions in which points look around.
ROWS = 16
# A ray starts this far off the face, in median edge lengths, or the face itself would hide the sky.
LIFT = 0.5


@dataclass(frozen=True)
class Surroundings:
    """What S points see in each of the directions of a map of ROWS rows, in the light's frame.

    Attributes:
        open: [S, 2 ROWS²] float32, 1 where nothing is in the way.
        bounced: [S, 2 ROWS², 3] float32 linear radiance of the surface that is; 0 where open. The paper's
            self-reflection: the surface's own colour, as photographed, lights its other parts.
    """

    open: np.ndarray
    bounced: np.ndarray


def look_around(
    mesh: AtlasMesh, radiance: np.ndarray, positions: np.ndarray, normals: np.ndarray, light_from_scene: np.ndarray
) -> Surroundings:
    """Cast rays from points [S, 3] with unit normals [S, 3] over their hemispheres.

    Args:
        mesh: what hides, scene frame.
        radiance: [T, T, 3] texture of what it radiates, linear.
        light_from_scene: rotation [3, 3].
    """
    import open3d as o3d

    scene = raycaster(mesh.vertices, mesh.faces)
    towards = (directions(ROWS).reshape(-1, 3) @ light_from_scene).astype(np.float32)  # scene frame
    count, sides = len(positions), len(towards)
    opened, bounced = np.ones((count, sides), np.float32), np.zeros((count, sides, 3), np.float32)
    starts = (positions + LIFT * median_edge(mesh.vertices, mesh.faces) * normals).astype(np.float32)
    for begin in range(0, count, max(MAX_RAYS // sides, 1)):
        part = slice(begin, begin + max(MAX_RAYS // sides, 1))
        rows, columns = np.nonzero(normals[part] @ towards.T > 0)
        rays = np.concatenate([starts[part][rows], towards[columns]], axis=1)
        hit = scene.cast_rays(o3d.core.Tensor(rays))
        faces = hit["primitive_ids"].numpy()
        met = np.isfinite(hit["t_hit"].numpy())
        rows, columns, faces = rows[met] + begin, columns[met], faces[met].astype(np.int64)
        u, v = hit["primitive_uvs"].numpy()[met].T
        uvs = np.einsum("kp,pkc->pc", np.stack([1 - u - v, u, v]), mesh.uvs[mesh.faces[faces]])
        opened[rows, columns] = 0
        bounced[rows, columns] = sample_texture(radiance, uvs)
    return Surroundings(opened, bounced)
