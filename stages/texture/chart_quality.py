"""How good charts are: how many, how full the texture, how long the seams, how much they stretch."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stages.surface.triangle_mesh import edge_use, face_areas
from stages.texture.charts import UvLayout

# Faces with less of a texel than this count as points of the texture: what they stretch to has no bound.
LEAST_AREA = 1e-6


@dataclass(frozen=True)
class ChartQuality:
    """Numbers of a layout.

    Attributes:
        charts: how many.
        fill: part of the texture that is covered.
        seam_length: see `seam_length`.
        stretch: see `stretch`.
        mirrored: part of the faces that lie the other way around in the texture.
    """

    charts: int
    fill: float
    seam_length: float
    stretch: float
    mirrored: float


def chart_quality(vertices: np.ndarray, faces: np.ndarray, layout: UvLayout, texture_size: int) -> ChartQuality:
    """The numbers of a layout of this mesh on a texture of this side."""
    area = signed_areas(layout)
    return ChartQuality(
        charts=int(layout.charts.max(initial=-1)) + 1,
        fill=float(np.abs(area).sum() / texture_size**2),
        seam_length=seam_length(vertices, faces, layout),
        stretch=stretch(vertices, faces, layout),
        mirrored=float((area < 0).mean()),
    )


def signed_areas(layout: UvLayout) -> np.ndarray:
    """Texels [F] that each face covers; negative where it is mirrored."""
    u, v = np.moveaxis(layout.texels[layout.faces], 2, 0)
    return ((u[:, 1] - u[:, 0]) * (v[:, 2] - v[:, 0]) - (u[:, 2] - u[:, 0]) * (v[:, 1] - v[:, 0])) / 2


def seam_length(vertices: np.ndarray, faces: np.ndarray, layout: UvLayout) -> float:
    """Length of the edges whose two faces lie apart in the texture, in square roots of the surface's area.

    Borders of the surface are no seams. A cube cut into its six sides has 12 edges of length 1 on an area of 6: 4.9.
    """
    use = edge_use(faces)
    first, second = use.manifold_pairs()

    def ends(half: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        face, slot = use.face[half], use.slot[half]
        return layout.faces[face, slot], layout.faces[face, (slot + 1) % 3]

    (a, b), (c, d) = ends(first), ends(second)
    seam = (a != d) | (b != c)
    points = vertices[layout.source].astype(np.float64)
    length = np.linalg.norm(points[b[seam]] - points[a[seam]], axis=1).sum()
    return float(length / np.sqrt(max(face_areas(vertices, faces).sum(), 1e-30)))


def stretch(vertices: np.ndarray, faces: np.ndarray, layout: UvLayout) -> float:
    """L2 stretch of the surface in the texture: 1 where all charts keep lengths at one scale, more the less they do.

    Sander et al., "Texture Mapping Progressive Meshes", 2001, section 3: with the singular values G and g of the map
    from texture to surface, the root of the mean over the surface of (G^2 + g^2) / 2, at the scale at which both have
    the same area. Faces that are points of the texture are left out.
    """
    s = vertices[faces].astype(np.float64)
    u, v = np.moveaxis(layout.texels[layout.faces], 2, 0)
    flat, area = np.abs(signed_areas(layout)), face_areas(vertices, faces)
    used = flat > LEAST_AREA
    if not used.any():
        return float("inf")
    s, u, v, flat, area = s[used], u[used], v[used], flat[used], area[used]
    # dS/du and dS/dv times twice the area in the texture
    along_u = sum(s[:, k] * (v[:, (k + 1) % 3] - v[:, (k + 2) % 3])[:, None] for k in range(3))
    along_v = sum(s[:, k] * (u[:, (k + 2) % 3] - u[:, (k + 1) % 3])[:, None] for k in range(3))
    squares = ((along_u**2).sum(1) + (along_v**2).sum(1)) / (2 * flat) ** 2 / 2
    return float(np.sqrt((squares * area).sum() / area.sum() * flat.sum() / area.sum()))
