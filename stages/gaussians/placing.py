"""Flat Gaussians on a mesh: where, how large and how they lie.

Places are a Poisson-disk sample of the surface: nowhere two closer than a distance, nowhere a hole much wider than it.
The distance is shorter where the texture has detail.
"""

from __future__ import annotations

import numpy as np

from stages.artifacts import AtlasMesh
from stages.compiling import njit
from stages.gaussians.gaussians import Gaussians
from stages.gaussians.kernels import C0
from stages.geometry.cameras import PinholeCameras
from stages.geometry.vectors import unit
from stages.surface.triangle_mesh import face_areas

# Standard deviation in the surface, in mean distances of neighbours, and along the normal, in those in the surface.
WIDTH, THICKNESS = 0.77, 0.1
OPACITY = 0.98
# Of those without a surface: opacity at first, and the nearest others that say how wide one is (3DGS).
FREE_OPACITY, FREE_NEIGHBORS = 0.5, 3
# None is wider than so many times the middle one: wrong points lie alone.
WIDEST_FREE = 4.0
# Gaussians on a unit of surface where the texture has most detail, in those where it has none.
MOST_DENSITY = 4.0
# Side in texels of the squares that detail is looked at in, and its standard deviation (colour levels) that makes
# Gaussians twice as dense.
DETAIL_SIDE, DETAIL_LEVELS = 5, 12.0
# Points that are tried for each Gaussian, and the area of a disk's radius squared that each Gaussian has then.
CANDIDATES, AREA_PER_RADIUS = 6, 1.4
# Sides of a sheet thinner than the distance each have their own: the normals' cosine above which points are neighbours.
SAME_SIDE = 0.3
# When the photos decide how many there are.
LEAST_COUNT, MOST_COUNT = 20_000, 150_000
_ASKED = 2000  # vertices
_TRIES = 3
_TABLE_BITS = 20


def place(atlas: AtlasMesh, texture: np.ndarray, count: int, degree: int = 0) -> tuple[Gaussians, np.ndarray]:
    """About `count` grey Gaussians on the surface, and their unit normals [N, 3] float32.

    Args:
        texture: [S, S, 3] uint8, row 0 at v = 1.
        degree: of their harmonics.
    """
    density = detail_density(texture)
    corner_uv = atlas.uvs[atlas.faces]
    of_face = _looked_up(density, corner_uv.mean(1))
    areas = face_areas(atlas.vertices, atlas.faces)
    rng = np.random.default_rng(0)
    face_ids, corner = _spread(areas * of_face, CANDIDATES * count, rng)
    points, normals, uvs = (
        np.einsum("ij,ijk->ik", corner, values[atlas.faces[face_ids]]).astype(np.float32)
        for values in (atlas.vertices, atlas.normals, atlas.uvs)
    )
    normals = unit(normals)
    per_root = 1 / np.sqrt(_looked_up(density, uvs))
    radius = np.sqrt((areas * of_face).sum() / (AREA_PER_RADIUS * count))
    order = rng.permutation(len(points))
    points, normals, per_root = points[order], normals[order], per_root[order].astype(np.float32)
    for _ in range(_TRIES):
        chosen = np.zeros(len(points), np.bool_)
        _throw(points, normals, (radius * per_root).astype(np.float32), chosen)
        found = int(chosen.sum())
        if abs(found / count - 1) < 0.02:
            break
        radius *= np.sqrt(found / count)
    spacing = np.sqrt(AREA_PER_RADIUS) * radius * per_root[chosen]
    return flat_gaussians(points[chosen], normals[chosen], spacing, degree), normals[chosen]


def count_for(atlas: AtlasMesh, cameras: PinholeCameras) -> int:
    """As many as pixels that a typical photo shows of the whole surface, within `LEAST_COUNT` and `MOST_COUNT`.

    The typical one is, of each point, the middle one of the photos that show it, hidden or not.
    """
    some = atlas.vertices[:: max(1, len(atlas.vertices) // _ASKED)].astype(np.float64)
    per_pixel = np.full((len(cameras), len(some)), np.nan)
    for index in range(len(cameras)):
        framed = cameras.in_frame(index, some)
        focal = np.sqrt(cameras.intrinsics[index, 0, 0] * cameras.intrinsics[index, 1, 1])
        per_pixel[index, framed] = (cameras.project(index, some[framed])[1] / focal) ** 2
    shown = per_pixel[:, np.isfinite(per_pixel).any(0)]
    if not shown.size:
        return LEAST_COUNT
    area = float(np.median(np.nanmedian(shown, axis=0)))
    pixels = float(face_areas(atlas.vertices, atlas.faces).sum()) / area
    return int(np.clip(pixels, LEAST_COUNT, MOST_COUNT))


def flat_gaussians(points: np.ndarray, normals: np.ndarray, spacing: np.ndarray, degree: int = 0) -> Gaussians:
    """Grey ones at points [N, 3] with unit normals [N, 3], flat, as wide as neighbours are apart, `spacing` [N]."""
    count = len(points)
    log_scales = np.log(WIDTH * np.maximum(spacing, 1e-9))[:, None] + np.log([1.0, 1.0, THICKNESS])
    return Gaussians(
        centers=np.ascontiguousarray(points, np.float32),
        rotations=turns_to(normals),
        log_scales=log_scales.astype(np.float32),
        opacity_logits=np.full(count, np.log(OPACITY / (1 - OPACITY)), np.float32),
        harmonics=np.zeros((count, (degree + 1) ** 2, 3), np.float32),
        anchored=np.ones(count, bool),
    )


def free_gaussians(points: np.ndarray, colors: np.ndarray, around: np.ndarray, count: int, degree: int) -> Gaussians:
    """At most `count` round ones for what has no surface: at points that lie apart from those on it, each as wide as
    the nearest others are away.

    Args:
        points: [P, 3] trusted ones, on the surface or not.
        colors: [P, 3] uint8 sRGB.
        around: [N, 3] centers of the Gaussians on the surface.
    """
    from scipy.spatial import cKDTree

    on_surface = cKDTree(around)
    apart = 2 * float(np.median(on_surface.query(around, k=2)[0][:, 1]))
    rows = np.flatnonzero(on_surface.query(points, distance_upper_bound=apart)[0] > apart)
    rows = np.sort(np.random.default_rng(0).permutation(rows)[:count])
    if len(rows) <= FREE_NEIGHBORS:
        rows, scales = rows[:0], np.zeros(0)
    else:
        scales = cKDTree(points[rows]).query(points[rows], k=FREE_NEIGHBORS + 1)[0][:, 1:].mean(1)
        scales = np.minimum(scales, WIDEST_FREE * np.median(scales))
    harmonics = np.zeros((len(rows), (degree + 1) ** 2, 3), np.float32)
    harmonics[:, 0] = (colors[rows] / 255 - 0.5) / float(C0)
    return Gaussians(
        centers=np.ascontiguousarray(points[rows], np.float32),
        rotations=np.tile(np.array([1, 0, 0, 0], np.float32), (len(rows), 1)),
        log_scales=np.log(np.maximum(scales, 1e-9))[:, None].repeat(3, 1).astype(np.float32),
        opacity_logits=np.full(len(rows), np.log(FREE_OPACITY / (1 - FREE_OPACITY)), np.float32),
        harmonics=harmonics,
        anchored=np.zeros(len(rows), bool),
    )


def turns_to(normals: np.ndarray) -> np.ndarray:
    """Unit quaternions [N, 4] float32 (w, x, y, z) of the shortest turns of the z axis to unit normals [N, 3]."""
    x, y, z = np.asarray(normals, np.float64).T
    quaternions = np.stack([1 + z, -y, x, np.zeros_like(x)], axis=1)
    quaternions[z < -1 + 1e-6] = (0, 1, 0, 0)  # the other way round: any half turn
    return (quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)).astype(np.float32)


def detail_density(texture: np.ndarray) -> np.ndarray:
    """[S, S] float32 from 1 to `MOST_DENSITY`: how dense Gaussians are on the texels of a texture [S, S, 3] uint8."""
    import cv2

    image = texture.astype(np.float32)
    sides = (DETAIL_SIDE, DETAIL_SIDE)
    variance = (cv2.blur(image * image, sides) - cv2.blur(image, sides) ** 2).mean(2)
    density: np.ndarray = np.minimum(1 + np.sqrt(np.maximum(variance, 0)) / DETAIL_LEVELS, MOST_DENSITY)
    return cv2.blur(density, sides)


def _looked_up(image: np.ndarray, uvs: np.ndarray) -> np.ndarray:
    """Values [P] of an image [S, S] at UVs [P, 2]."""
    size = len(image)
    column = np.clip(uvs[:, 0] * size, 0, size - 1).astype(np.int64)
    row = np.clip((1 - uvs[:, 1]) * size, 0, size - 1).astype(np.int64)
    values: np.ndarray = image[row, column]
    return values


def _spread(weights: np.ndarray, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Faces [count], as often as their weights [F] say, and a random place in each, barycentric [count, 3]."""
    ends = np.cumsum(weights)
    face_ids = np.searchsorted(ends, (np.arange(count) + rng.random()) * (ends[-1] / count))
    u, v = rng.random((2, count))
    root = np.sqrt(u)
    return np.minimum(face_ids, len(weights) - 1), np.stack([1 - root, root * (1 - v), root * v], 1)


@njit(nogil=True, cache=True)
def _throw(points, normals, radii, chosen):  # pragma: no cover - compiled
    """Dart throwing (Cook 1986): mark points [P], in order, that lie no closer than their radius to one marked before.

    Marked ones lie in cells of the largest radius, in lists of a table by the hash of the cell.
    """
    side = radii.max()
    mask = (1 << _TABLE_BITS) - 1
    heads = np.full(mask + 1, -1, np.int32)
    following = np.empty(points.shape[0], np.int32)
    for i in range(points.shape[0]):
        cx, cy = int(np.floor(points[i, 0] / side)), int(np.floor(points[i, 1] / side))
        cz = int(np.floor(points[i, 2] / side))
        least = radii[i] * radii[i]
        free = True
        for dx in range(-1, 2):
            for dy in range(-1, 2):
                for dz in range(-1, 2):
                    cell = ((cx + dx) * 73856093 ^ (cy + dy) * 19349663 ^ (cz + dz) * 83492791) & mask
                    j = heads[cell]
                    while free and j >= 0:
                        x, y, z = points[i, 0] - points[j, 0], points[i, 1] - points[j, 1], points[i, 2] - points[j, 2]
                        cosine = (
                            normals[i, 0] * normals[j, 0]
                            + normals[i, 1] * normals[j, 1]
                            + normals[i, 2] * normals[j, 2]
                        )
                        free = x * x + y * y + z * z >= least or cosine < SAME_SIDE
                        j = following[j]
        if free:
            chosen[i] = True
            cell = (cx * 73856093 ^ cy * 19349663 ^ cz * 83492791) & mask
            following[i] = heads[cell]
            heads[cell] = i
