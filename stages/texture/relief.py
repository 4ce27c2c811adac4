"""What decimation took away, kept as textures: the full mesh's normals, and how much of the sky a point sees."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from stages.artifacts import AtlasMesh
from stages.blocks import in_blocks
from stages.drawing.rasterizing import Texels, rasterize_atlas, surface_points
from stages.geometry.vectors import unit
from stages.surface.triangle_mesh import MAX_RAYS, RAYS, face_areas, median_edge, raycaster, vertex_normals
from stages.texture.padding import pad_charts
from stages.texture.tangents import to_tangent_space, vertex_tangents

# The full mesh is looked for within this part of the longest edge of the face: decimation moves a surface by far less.
REACH = 0.5
# A ray starts this part of its reach on the other side of the face, or it would miss a surface that lies in it.
BACK = 0.02
# Normals leaning more than this (cosine) from the face's are of another part of the surface.
MIN_COSINE = 0.1
# An occlusion ray starts this far off the face, in median edge lengths, or the face itself would hide the sky.
LIFT = 0.01
# A map needs no more texels than this on an edge of the mesh that it shows, for between vertices nothing new happens.
TEXELS_ON_EDGE = 2
# Smaller textures are not halved for it: their charts would touch.
LARGE = 2048
# Occlusion changes slowly: one sample stands for this many texels in each direction at least, and at most.
COARSENESS, COARSEST = 4, 8
# Texels that take their occlusion from the samples at a time.
SPREAD = 1 << 21
FLAT = (128, 128, 255)
Listener = Callable[[float, float], None]


def relief_texels(atlas: AtlasMesh, texels: Texels, edge: float) -> Texels:
    """The atlas rasterised for maps of a full mesh: at half the texture's side where that mesh has no more to show.

    Args:
        texels: the atlas rasterised for its texture.
        edge: median length of the full mesh's edges, scene units.
    """
    if texels.size < LARGE or edge < 2 * TEXELS_ON_EDGE * _texel_side(atlas, texels):
        return texels
    return rasterize_atlas(atlas.uvs, atlas.faces, texels.size // 2)


def _texel_side(atlas: AtlasMesh, texels: Texels) -> float:
    """Mean side of a texel in scene units."""
    return float(np.sqrt(face_areas(atlas.vertices, atlas.faces).sum() / max(len(texels), 1)))


# ---------------------------------------------------------------- normals
def bake_normals(
    atlas: AtlasMesh, texels: Texels, vertices: np.ndarray, faces: np.ndarray, listener: Listener | None = None
) -> tuple[np.ndarray, float]:
    """The normals of a full mesh as a tangent-space normal map of the light one.

    From each texel a ray goes along the interpolated normal both ways; the nearer hit that faces the same way gives
    the full mesh's normal, which is interpolated there, too. Where there is none the map is flat.

    Args:
        atlas: the light mesh.
        texels: the atlas rasterised.
        vertices, faces: [V, 3], [F, 3], the full one in the same frame.
        listener: told (done, total).

    Returns:
        [size, size, 3] uint8, row 0 at v = 1: x, y (up) and z of the frame `tangents.vertex_tangents` from -1..1;
        the share of the charts' texels that met the full mesh.
    """
    tell = listener or (lambda done, total: None)
    tangents = vertex_tangents(atlas)
    corners = atlas.vertices[atlas.faces]
    reach = REACH * np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(1)
    scene, full_normals = raycaster(vertices, faces), vertex_normals(vertices, faces).astype(np.float32)
    colors = np.empty((len(texels), 3), dtype=np.uint8)
    colors[:] = FLAT

    def look(part: slice) -> int:
        ids, weights = texels.face_ids[part], texels.corner[part]
        points, normals = surface_points(atlas, ids, weights)
        found, normals_there = _normals_near(scene, full_normals, faces, points, normals, reach[ids])
        frame = np.einsum("tk,tkc->tc", weights[found], tangents[atlas.faces[ids[found]]])
        colors[part][found] = encode(to_tangent_space(normals_there[found], normals[found], frame))
        tell(part.stop, len(texels))
        return int(np.count_nonzero(found))

    met = sum(in_blocks(look, len(texels), MAX_RAYS // 2, RAYS))
    filled, _ = pad_charts(*texels.paint(colors))
    return filled, met / max(len(texels), 1)


def _normals_near(
    scene: Any, full_normals: np.ndarray, faces: np.ndarray, points: np.ndarray, normals: np.ndarray,
    reach: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Whether the full mesh is within `reach` [T] along the normals both ways [T] bool, and its normals [T, 3]."""
    import open3d as o3d

    nearest = np.full(len(points), np.inf, dtype=np.float32)
    answer = np.zeros((len(points), 3), dtype=np.float32)
    back = (BACK * reach)[:, None]
    for side in (1.0, -1.0):
        direction = (side * normals).astype(np.float32)
        rays = np.concatenate([points - back * direction, direction], axis=1).astype(np.float32)
        hit = scene.cast_rays(o3d.core.Tensor(rays))
        distance = np.abs(hit["t_hit"].numpy() - back[:, 0])
        rows = np.flatnonzero(distance < np.minimum(reach, nearest))
        u, v = hit["primitive_uvs"].numpy()[rows].T
        corners = full_normals[faces[hit["primitive_ids"].numpy()[rows]]]
        there = unit(np.einsum("kt,tkc->tc", np.stack([1 - u - v, u, v]), corners))
        alike = (there * normals[rows]).sum(1) > MIN_COSINE
        nearest[rows[alike]], answer[rows[alike]] = distance[rows[alike]], there[alike]
    return np.isfinite(nearest), answer


def encode(normals: np.ndarray) -> np.ndarray:
    """Colours [P, 3] uint8 of unit normals [P, 3]: 255 (n + 1) / 2, to which glTF's reading is the inverse."""
    return np.clip(127.5 * (normals + 1) + 0.5, 0, 255).astype(np.uint8)


# ---------------------------------------------------------------- occlusion
def bake_occlusion(
    atlas: AtlasMesh, texels: Texels, rays: int = 64, reach: float = 0.5, listener: Listener | None = None
) -> np.ndarray:
    """How open each texel is to light from all around: 255 to the whole hemisphere, 0 to none of it.

    Cast for one texel in a square of about an edge of the mesh and carried to those between (`spread_samples`).

    Args:
        atlas: the mesh, which hides itself.
        texels: the atlas rasterised.
        rays: from each sample.
        reach: what lies further off, in scene units, hides nothing.
        listener: told (done, total).

    Returns:
        [size, size] uint8, row 0 at v = 1.
    """
    on_edge = median_edge(atlas.vertices, atlas.faces) / _texel_side(atlas, texels)
    side = int(np.clip(on_edge, COARSENESS, COARSEST))
    chosen, cell_of = _one_a_cell(texels, side)
    points, normals = surface_points(atlas, texels.face_ids[chosen], texels.corner[chosen])
    openness = sky_seen(atlas.vertices, atlas.faces, points, normals, rays, reach, listener)
    grey = np.empty((len(texels), 1), dtype=np.uint8)

    def carry(part: slice) -> None:
        there, _ = surface_points(atlas, texels.face_ids[part], texels.corner[part])
        spread = spread_samples(openness, points, cell_of, texels.index[part], there, texels.size, side)
        grey[part, 0] = np.clip(255 * spread + 0.5, 0, 255)

    in_blocks(carry, len(texels), SPREAD, "texels that take their occlusion")
    image, inside = texels.paint(np.repeat(grey, 3, axis=1))
    return pad_charts(image, inside)[0][..., 0].copy()


def sky_seen(
    vertices: np.ndarray,
    faces: np.ndarray,
    points: np.ndarray,
    normals: np.ndarray,
    rays: int,
    reach: float,
    listener: Listener | None = None,
) -> np.ndarray:
    """Share [P] of rays from points on a mesh that meet nothing within `reach`.

    Directions have the density cos(angle to the normal) / pi, so the share is the cosine-weighted one of the
    hemisphere: 1/pi of the integral of V(w) (n . w) dw. They are evenly spread (a Fibonacci spiral on the disk below
    the hemisphere) and turned by another angle at each point, so that no pattern shows.
    """
    import open3d as o3d

    tell = listener or (lambda done, total: None)
    scene = raycaster(vertices, faces)
    starts = points + LIFT * median_edge(vertices, faces) * normals
    side = np.cross(normals, np.eye(3)[np.abs(normals).argmin(1)])
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    ahead = np.cross(normals, side)
    turns = np.random.default_rng(0).random(len(points)) * 2 * np.pi
    order = np.arange(rays) + 0.5
    radius, angle = np.sqrt(order / rays), np.pi * (1 + np.sqrt(5)) * order
    free = np.zeros(len(points))

    def look(part: slice) -> None:
        turned = angle + turns[part, None]
        x, y = radius * np.cos(turned), radius * np.sin(turned)
        z = np.sqrt(1 - radius**2)
        directions = (
            x[..., None] * side[part, None] + y[..., None] * ahead[part, None] + z[:, None] * normals[part, None]
        )
        bundle = np.concatenate([np.broadcast_to(starts[part, None], directions.shape), directions], axis=2)
        hidden = scene.test_occlusions(o3d.core.Tensor(bundle.astype(np.float32)), tnear=0.0, tfar=reach).numpy()
        free[part] = 1 - hidden.mean(1)
        tell(part.stop, len(points))

    in_blocks(look, len(points), max(MAX_RAYS // rays, 1), "points that look at the sky", least=1)
    return free


def _one_a_cell(texels: Texels, side: int) -> tuple[np.ndarray, np.ndarray]:
    """Rows [S] of the texels, the middlemost of each square of `side` texels that has any; and the number of each
    square's [cells, cells] int32, -1 where it has none."""
    size = texels.size
    y, x = texels.index // size, texels.index % size
    cells = -(-size // side)
    cell = (y // side) * cells + x // side
    middle = (side - 1) / 2
    off_center = (y % side - middle) ** 2 + (x % side - middle) ** 2
    order = np.lexsort((off_center, cell))
    occupied, first = np.unique(cell[order], return_index=True)
    number = np.full(cells * cells, -1, dtype=np.int32)
    number[occupied] = np.arange(len(occupied))
    return order[first], number.reshape(cells, cells)


def spread_samples(
    values: np.ndarray, positions: np.ndarray, cell_of: np.ndarray, texels: np.ndarray, points: np.ndarray, size: int,
    side: int = COARSENESS,
) -> np.ndarray:  # fmt: skip
    """Values [T] at texels from samples on a coarser grid: bilinear weights times closeness on the surface.

    Charts that are neighbours on the texture only are far apart in space, so nothing bleeds from one to another (joint
    bilateral upsampling, Kopf et al. 2007, with the position as guide).

    Args:
        values, positions: [S], [S, 3] of the samples.
        cell_of: [cells, cells] sample of each square of texels, or -1.
        texels: [T] row-major indices.
        points: [T, 3] of the texels.
        size: side of the texture.
        side: of a square, in texels.
    """
    cells = len(cell_of)
    y, x = (texels // size + 0.5) / side - 0.5, (texels % size + 0.5) / side - 0.5
    y0, x0 = np.floor(y).astype(np.int64), np.floor(x).astype(np.int64)
    own = cell_of[(texels // size) // side, (texels % size) // side]
    # A square's side on the surface, from the texels' distances to the sample of their own square.
    spacing = 2 * float(np.sqrt(np.mean((points - positions[own]) ** 2) * 3)) + 1e-12
    total, weights = np.zeros(len(texels)), np.zeros(len(texels))
    for dy in (0, 1):
        for dx in (0, 1):
            sample = cell_of[np.clip(y0 + dy, 0, cells - 1), np.clip(x0 + dx, 0, cells - 1)]
            bilinear = np.abs(1 - dy - (y - y0)) * np.abs(1 - dx - (x - x0))
            apart = ((points - positions[sample]) ** 2).sum(1) / spacing**2
            weight = np.where(sample >= 0, (bilinear + 1e-6) * np.exp(-np.minimum(apart, 30.0)), 0.0)
            total += weight * values[sample]
            weights += weight
    return np.where(weights > 1e-12, total / np.maximum(weights, 1e-12), values[own])
