"""Levels of detail: lighter versions of a textured mesh that are drawn with the same textures."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from stages.artifacts import AtlasMesh
from stages.geometry.vectors import unit
from stages.surface.decimation import decimate_textured
from stages.surface.triangle_mesh import raycaster, vertex_normals

# Faces of a level for one of the level before.
RATIO = 0.5
# A normal that leans further than this (cosine) from the level's own was found on another side of a thin part.
MIN_AGREEMENT = 0.2


def levels_of_detail(atlas: AtlasMesh, count: int) -> Iterator[AtlasMesh]:
    """`count` meshes, each with half the faces of the one before, the first with half of `atlas`.

    Normals are those of `atlas` at the nearest point, as its normal map is relative to them. Seams set a limit: with a
    handful of faces a chart the texture slides.

    Args:
        atlas: of one or more faces.
        count: >= 0.
    """
    targets = [max(int(len(atlas.faces) * RATIO**level), 4) for level in range(1, count + 1)]
    for light in decimate_textured(atlas.vertices, atlas.faces, atlas.uvs, targets):
        yield _split(*light, atlas)


def lightened(atlas: AtlasMesh, faces: int) -> AtlasMesh:
    """A level of detail of about so many faces, >= 4 and fewer than `atlas` has."""
    return _split(*next(decimate_textured(atlas.vertices, atlas.faces, atlas.uvs, [faces])), atlas)


def deviation(light: AtlasMesh, atlas: AtlasMesh) -> float:
    """The greatest distance between two surfaces, either way, at their vertices and the middles of their faces."""
    return max(_farthest(light, atlas), _farthest(atlas, light))


def _farthest(a: AtlasMesh, b: AtlasMesh) -> float:
    """The greatest distance of points of `a` from `b`."""
    import open3d as o3d

    points = np.concatenate([a.vertices, a.vertices[a.faces].mean(1)]).astype(np.float32)
    return float(raycaster(b.vertices, b.faces).compute_distance(o3d.core.Tensor(points)).numpy().max())


def _split(vertices: np.ndarray, faces: np.ndarray, corner_uvs: np.ndarray, atlas: AtlasMesh) -> AtlasMesh:
    """An atlas mesh of UVs [3F, 2] for the corners of faces [F, 3]: a vertex for each position and UV."""
    vertices, corner_uvs = vertices.astype(np.float32), np.clip(corner_uvs, 0, 1).astype(np.float32)
    corners = np.concatenate([vertices[faces.ravel()], corner_uvs], axis=1)
    _, first, index = np.unique(corners, axis=0, return_index=True, return_inverse=True)
    index = index.reshape(-1, 3).astype(np.int32)
    a, b, c = index.T
    source = faces.ravel()[first]
    normals = _normals_at(vertices, vertex_normals(vertices, faces), atlas)
    return AtlasMesh(
        vertices=vertices[source],
        normals=normals[source].astype(np.float32),
        uvs=corner_uvs[first],
        faces=index[(a != b) & (b != c) & (c != a)],
        texture_size=atlas.texture_size,
    )


def _normals_at(points: np.ndarray, own: np.ndarray, atlas: AtlasMesh) -> np.ndarray:
    """Unit normals [P, 3] of `atlas` at the points of its surface nearest to points [P, 3] with normals `own`."""
    import open3d as o3d

    nearest = raycaster(atlas.vertices, atlas.faces).compute_closest_points(o3d.core.Tensor(points))
    corners = atlas.faces[nearest["primitive_ids"].numpy().astype(np.int64)]
    v, w = nearest["primitive_uvs"].numpy().astype(np.float64).T
    found = unit(np.einsum("pc,pcd->pd", np.stack([1 - v - w, v, w], axis=1), atlas.normals[corners]))
    agree = (found * own).sum(1, keepdims=True) > MIN_AGREEMENT
    return np.where(agree, found, own)
