"""Several textured meshes to one light one with a texture of its own: what is drawn of a large scene from far.

The meshes are joined where they meet and lightened without regard to their charts, which would leave no face to take
away. What is left gets charts anew, and each of its texels the colour of the nearest place of the meshes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from stages.artifacts import AtlasMesh
from stages.blocks import in_blocks
from stages.drawing.rasterizing import rasterize_atlas, surface_points
from stages.drawing.rendering import sample_texture
from stages.surface.decimation import decimate
from stages.surface.levels_of_detail import deviation
from stages.surface.triangle_mesh import face_areas, raycaster, repair_manifold
from stages.texture.charts import ChartsError, UvLayout, smooth_normals, unwrap_projected, unwrap_uvatlas
from stages.texture.padding import pad_charts

if TYPE_CHECKING:
    from jaxtyping import Float, Int, UInt8

# Vertices of two meshes are one if they are no further apart than this part of the extent: neighbouring tiles share
# theirs to some bits of 32-bit numbers, each in a frame of its own.
SAME_PLACE = 1e-5
PADDING = 4  # texels between charts
CHARTS_LIMIT = 120.0  # CPU seconds, after which charts are projected
# Texels that look for their nearest place at a time.
_CHUNK = 1 << 20


@dataclass(frozen=True)
class Textured:
    """A mesh and its texture [S, S, 3] uint8 sRGB, row 0 at v = 1."""

    mesh: AtlasMesh
    texture: UInt8[np.ndarray, "s s 3"]

    @property
    def texel_side(self) -> float:
        """Of a texel on the surface, in the mesh's unit, in the mean."""
        a, b, c = (self.mesh.uvs[self.mesh.faces[:, k]].astype(np.float64) * len(self.texture) for k in range(3))
        (ux, uy), (vx, vy) = (b - a).T, (c - a).T
        texels = 0.5 * np.abs(ux * vy - uy * vx).sum()
        return float(np.sqrt(face_areas(self.mesh.vertices, self.mesh.faces).sum() / max(texels, 1.0)))


def merged(parts: Sequence[Textured], most_faces: int, texture_size: int) -> tuple[Textured, float]:
    """One mesh of about so many faces in place of several, and the greatest distance between its surface and theirs.

    Args:
        parts: in one frame, the first vertices near its origin; one or more.
        most_faces: >= 4.
        texture_size: texels along a side.

    Raises:
        ValueError: no face is left.
    """
    whole = _joined([part.mesh for part in parts])
    vertices, faces = decimate(*repair_manifold(*_welded(whole.vertices, whole.faces)), most_faces)
    if not len(faces):
        raise ValueError("expected meshes with an area, got none")
    layout = _layout(vertices, faces, texture_size)
    mesh = AtlasMesh(
        vertices=vertices[layout.source].astype(np.float32),
        normals=smooth_normals(vertices, faces, layout.source),
        uvs=np.clip(layout.texels / texture_size, 0, 1).astype(np.float32),
        faces=layout.faces,
        texture_size=texture_size,
    )
    return Textured(mesh, _painted(mesh, parts)), deviation(mesh, whole)


def _joined(meshes: Sequence[AtlasMesh]) -> AtlasMesh:
    """All in one, side by side."""
    before = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    return AtlasMesh(
        vertices=np.concatenate([mesh.vertices for mesh in meshes]),
        normals=np.concatenate([mesh.normals for mesh in meshes]),
        uvs=np.concatenate([mesh.uvs for mesh in meshes]),
        faces=np.concatenate([mesh.faces + start for mesh, start in zip(meshes, before, strict=False)]),
        texture_size=meshes[0].texture_size,
    )


def _welded(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]
) -> tuple[Float[np.ndarray, "u 3"], Int[np.ndarray, "f 3"]]:
    """Vertices at one place made one: split along seams of charts, and where two meshes meet."""
    step = SAME_PLACE * max(float(np.ptp(vertices, axis=0).max()), 1e-30)
    _, first, index = np.unique(np.round(vertices / step), axis=0, return_index=True, return_inverse=True)
    return vertices[first], index.reshape(-1)[faces].astype(np.int32)


def _layout(vertices: np.ndarray, faces: np.ndarray, texture_size: int) -> UvLayout:
    try:
        return unwrap_uvatlas(vertices, faces, texture_size, PADDING, CHARTS_LIMIT)
    except ChartsError:
        return unwrap_projected(vertices, faces, texture_size, PADDING)


def _painted(mesh: AtlasMesh, parts: Sequence[Textured]) -> UInt8[np.ndarray, "s s 3"]:
    """The texture of a mesh: each texel as the nearest place of the parts, their textures shrunk to its fineness."""
    import open3d as o3d

    texels = rasterize_atlas(mesh.uvs, mesh.faces, mesh.texture_size)
    side = float(np.sqrt(face_areas(mesh.vertices, mesh.faces).sum() / max(len(texels), 1)))
    textures = [_shrunk(part.texture, side / part.texel_side) for part in parts]
    places = _caster([part.mesh for part in parts])
    colors = np.zeros((len(texels), 3), np.uint8)

    def paint(rows: slice) -> None:
        points, _ = surface_points(mesh, texels.face_ids[rows], texels.corner[rows])
        nearest = places.compute_closest_points(o3d.core.Tensor(points))
        which, face = nearest["geometry_ids"].numpy(), nearest["primitive_ids"].numpy().astype(np.int64)
        v, w = nearest["primitive_uvs"].numpy().T
        corner = np.stack([1 - v - w, v, w], axis=1)
        for k, (part, texture) in enumerate(zip(parts, textures, strict=True)):
            here = which == k
            uvs = np.einsum("pc,pcd->pd", corner[here], part.mesh.uvs[part.mesh.faces[face[here]]])
            colors[rows][here] = np.clip(sample_texture(texture, uvs) + 0.5, 0, 255)

    in_blocks(paint, len(texels), _CHUNK, "texels of a coarse model")
    return pad_charts(*texels.paint(colors))[0]


def _caster(meshes: Sequence[AtlasMesh]) -> Any:
    first, *others = ((mesh.vertices, mesh.faces) for mesh in meshes)
    return raycaster(*first, *others)


def _shrunk(texture: np.ndarray, times: float) -> np.ndarray:
    """The texture with as many times fewer texels along a side, rounded down, each the mean of those it stands for."""
    import cv2

    side = max(len(texture) // max(int(times), 1), 1)
    shrunk: np.ndarray = cv2.resize(texture, (side, side), interpolation=cv2.INTER_AREA)
    return shrunk
