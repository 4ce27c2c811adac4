"""Triangles to pixels: which face covers each pixel centre, with a depth test. CPU, numba.

The same kernel makes depth maps of photos (perspective) and the texel map of an atlas (UV space). It is used
in place of ray casting because it finds the same faces several times faster at photo resolution.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stages.artifacts import AtlasMesh
from stages.artifacts.mesh import Mesh
from stages.blocks import in_blocks
from stages.compiling import njit
from stages.geometry.cameras import PinholeCameras
from stages.geometry.vectors import unit

NO_FACE = -1
# Triangles reaching closer to the projection centre than this (scene units; the object's radius is 1) are
# dropped.
NEAR = 1e-3
# Texels worked on at a time.
_CHUNK = 1 << 20


@njit(nogil=True, cache=True)
def _fill(xy, inverse_depth, faces, face_map, depth_map):  # pragma: no cover - compiled
    height, width = face_map.shape
    for f in range(faces.shape[0]):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        wa, wb, wc = inverse_depth[a], inverse_depth[b], inverse_depth[c]
        if wa <= 0 or wb <= 0 or wc <= 0:
            continue
        ax, ay, bx, by, cx, cy = xy[a, 0], xy[a, 1], xy[b, 0], xy[b, 1], xy[c, 0], xy[c, 1]
        area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        if area == 0 or not np.isfinite(area):
            continue
        x0 = max(0, int(np.ceil(min(ax, bx, cx) - 0.5)))
        x1 = min(width - 1, int(np.floor(max(ax, bx, cx) - 0.5)))
        y0 = max(0, int(np.ceil(min(ay, by, cy) - 0.5)))
        y1 = min(height - 1, int(np.floor(max(ay, by, cy) - 0.5)))
        for y in range(y0, y1 + 1):
            py = y + 0.5
            for x in range(x0, x1 + 1):
                px = x + 0.5
                u = ((bx - px) * (cy - py) - (by - py) * (cx - px)) / area
                v = ((cx - px) * (ay - py) - (cy - py) * (ax - px)) / area
                t = 1.0 - u - v
                # An edge that two faces share may round to just outside of both: let each reach a hair
                # further.
                if u < -1e-9 or v < -1e-9 or t < -1e-9:
                    continue
                w = u * wa + v * wb + t * wc
                if w > depth_map[y, x]:
                    depth_map[y, x] = w
                    face_map[y, x] = f


@njit(nogil=True, cache=True)
def _weights(xy, inverse_depth, faces, face_ids, points, out):  # pragma: no cover - compiled
    for i in range(face_ids.shape[0]):
        f = face_ids[i]
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        px, py = points[i, 0], points[i, 1]
        ax, ay, bx, by, cx, cy = xy[a, 0], xy[a, 1], xy[b, 0], xy[b, 1], xy[c, 0], xy[c, 1]
        area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        u = ((bx - px) * (cy - py) - (by - py) * (cx - px)) / area
        v = ((cx - px) * (ay - py) - (cy - py) * (ax - px)) / area
        u, v, t = u * inverse_depth[a], v * inverse_depth[b], (1.0 - u - v) * inverse_depth[c]
        total = u + v + t
        out[i, 0], out[i, 1], out[i, 2] = u / total, v / total, t / total


def rasterize(
    xy: np.ndarray, inverse_depth: np.ndarray, faces: np.ndarray, width: int, height: int
) -> tuple[np.ndarray, np.ndarray]:
    """The nearest face at each pixel centre.

    Args:
        xy: [V, 2] pixel coordinates (the first pixel's centre is at .5, .5).
        inverse_depth: [V] 1 / depth; faces with a vertex <= 0 (behind the camera) are dropped.
        faces: [F, 3].
        width, height: pixels.

    Returns:
        face of each pixel [height, width] int32, `NO_FACE` where none; inverse depth [height, width]
        float32, 0 where none.
    """
    face_map = np.full((height, width), NO_FACE, dtype=np.int32)
    depth_map = np.zeros((height, width), dtype=np.float32)
    _fill(
        np.ascontiguousarray(xy, dtype=np.float64),
        np.ascontiguousarray(inverse_depth, dtype=np.float64),
        np.ascontiguousarray(faces, dtype=np.int32),
        face_map,
        depth_map,
    )
    return face_map, depth_map


def corner_weights(
    xy: np.ndarray, inverse_depth: np.ndarray, faces: np.ndarray, face_ids: np.ndarray, points: np.ndarray
) -> np.ndarray:
    """Perspective-correct barycentric weights [P, 3] float32 of pixel positions `points` [P, 2] in faces
    `face_ids` [P]."""
    out = np.empty((len(face_ids), 3), dtype=np.float32)
    _weights(
        np.ascontiguousarray(xy, dtype=np.float64),
        np.ascontiguousarray(inverse_depth, dtype=np.float64),
        np.ascontiguousarray(faces, dtype=np.int32),
        np.ascontiguousarray(face_ids, dtype=np.int32),
        np.ascontiguousarray(points, dtype=np.float64),
        out,
    )
    return out


def projected(cameras: PinholeCameras, index: int, vertices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixel coordinates [V, 2] and inverse depths [V] of vertices in one camera; 0 for those nearer than
    `NEAR`."""
    xy, depth = cameras.project(index, vertices.astype(np.float64))
    return xy, np.where(depth > NEAR, 1.0 / np.maximum(depth, NEAR), 0.0)


def depth_map(
    cameras: PinholeCameras,
    index: int,
    vertices: np.ndarray,
    faces: np.ndarray,
    others: Mesh | None = None,
    window: tuple[int, int, int, int] | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """What one camera sees of a mesh.

    Args:
        others: vertices and faces that may be in the way.
        window: left, top, right and bottom of the pixels that are asked for; None: all of them.

    Returns:
        Face [H, W] int32 and inverse depth [H, W] float32 at pixel centres; `NO_FACE` and 0 where there is none, or
        another one is nearer.
    """
    own = len(faces)
    if others is not None:
        vertices, faces = np.concatenate([vertices, others[0]]), np.concatenate([faces, others[1] + len(vertices)])
    xy, inverse_depth = projected(cameras, index, vertices)
    left, top, right, bottom = window or (0, 0, *(int(side) for side in cameras.sizes[index]))
    face_map, inverse_depth = rasterize(xy - (left, top), inverse_depth, faces, right - left, bottom - top)
    hidden = face_map >= own
    face_map[hidden], inverse_depth[hidden] = NO_FACE, 0
    return face_map, inverse_depth


@dataclass(frozen=True)
class Texels:
    """The texels of a square texture whose centres lie in a chart.

    Attributes:
        size: side of the texture.
        index: [T] row-major.
        face_ids: [T] int32.
        corner: [T, 3] float32 barycentric weights of the face's corners.
    """

    size: int
    index: np.ndarray
    face_ids: np.ndarray
    corner: np.ndarray

    def __len__(self) -> int:
        return len(self.index)

    def paint(self, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """A texture [S, S, C] that holds `values` [T, C], 0 elsewhere, and where it does [S, S] bool."""
        image = np.zeros((self.size * self.size, values.shape[1]), dtype=values.dtype)
        image[self.index] = values
        inside = np.zeros(self.size * self.size, dtype=bool)
        inside[self.index] = True
        return image.reshape(self.size, self.size, -1), inside.reshape(self.size, self.size)


def rasterize_atlas(uvs: np.ndarray, faces: np.ndarray, size: int) -> Texels:
    """The texels whose centres lie in a chart.

    Args:
        uvs: [V, 2] in [0, 1], origin at the bottom-left.
        faces: [F, 3].
        size: side of the texture in texels.
    """
    xy = np.stack([uvs[:, 0] * size, (1.0 - uvs[:, 1]) * size], 1)
    ones = np.ones(len(xy))
    face_map = rasterize(xy, ones, faces, size, size)[0].ravel()
    index = np.flatnonzero(face_map != NO_FACE)
    face_ids = face_map[index]
    corner = np.empty((len(index), 3), dtype=np.float32)

    def weigh(part: slice) -> None:
        centers = np.stack([index[part] % size, index[part] // size], 1) + 0.5
        corner[part] = corner_weights(xy, ones, faces, face_ids[part], centers)

    in_blocks(weigh, len(index), _CHUNK, "texels in their triangles")
    return Texels(size, index, face_ids, corner)


def surface_points(atlas: AtlasMesh, face_ids: np.ndarray, corner: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Positions and unit normals [T, 3] float32 at barycentric weights `corner` [T, 3] of faces `face_ids`
    [T]."""
    points = np.zeros((len(face_ids), 3), dtype=np.float32)
    normals = np.zeros((len(face_ids), 3), dtype=np.float32)
    for k in range(3):
        ids = atlas.faces[face_ids, k]
        points += corner[:, k, None] * atlas.vertices[ids]
        normals += corner[:, k, None] * atlas.normals[ids]
    return points, unit(normals)
