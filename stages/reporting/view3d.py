"""What the page's 3D view gets: mesh, measures per vertex, cameras, points, ground, region, next photos.

Everything is turned +Y up. Arrays are packed as base64, positions and UVs in 16 bits, normals and measures in 8.
"""

from __future__ import annotations

import base64
from collections.abc import Sequence
from typing import Any

import numpy as np

from stages.artifacts import AtlasMesh, VertexQuality
from stages.drawing.rendering import look_at
from stages.geometry.cameras import PinholeCameras, PosedScene
from stages.geometry.normalisation import perpendicular
from stages.geometry.place import GivenRegion, Place
from stages.geometry.point_cloud import TRUSTED, PointCloud
from stages.geometry.similarity import Similarity
from stages.geometry.up import y_up_rotation
from stages.reporting.next_views import NextView
from stages.reporting.pictures import jpeg_uri, shrink

# Meshes with more faces than this would make the page too heavy: they are decimated to so many.
MAX_FACES = 400_000
TEXTURE_SIDE = 2048
MAX_POINTS = 40_000
# Dense points: at most so many trusted ones in the region and around it, which add 0.6 MB to the page.
MAX_DENSE, MAX_AROUND = 40_000, 10_000
# Measures are packed as 0..254; this says that a vertex has none.
NO_VALUE = 255
# All sparse points within this many radii of the region are drawn, and of all together the nearest, but for this share:
# what a small region leaves out is to be seen, and a stray point far away would coarsen the packed positions.
POINTS_REACH, STRAY = 4.0, 0.02
# The image plane of a drawn camera is this part of the cameras' median distance away, and less than this many radii.
FRUSTUM, MAX_FRUSTUM = 0.05, 0.12
# A camera that is only suggested: its size, and the angle it sees from top to bottom.
NEXT_SIZE, NEXT_FOV_DEG = (3, 2), 2 * np.degrees(np.arctan(0.4))
# The grid on the ground: squares a side, and how far it reaches from the mesh's middle, scene units.
GRID_CELLS, GRID_REACH = 12, 1.2


def light_enough(atlas: AtlasMesh, quality: VertexQuality | None) -> tuple[AtlasMesh, VertexQuality | None]:
    """The mesh, or one of at most about `MAX_FACES` faces with the measures of the nearest vertices."""
    from scipy.spatial import cKDTree

    from stages.surface.levels_of_detail import lightened

    if len(atlas.faces) <= MAX_FACES:
        return atlas, quality
    light = lightened(atlas, MAX_FACES)
    if quality is not None:
        nearest = cKDTree(atlas.vertices).query(light.vertices)[1]
        quality = VertexQuality(**{name: values[nearest] for name, values in vars(quality).items()})
    return light, quality


def pack_mesh(atlas: AtlasMesh, texture: np.ndarray, up: np.ndarray) -> dict[str, Any]:
    """Positions, UVs (origin at the top), normals, faces (16 bits where they suffice) and the texture."""
    turn = y_up_rotation(up)
    uvs = np.clip(np.stack([atlas.uvs[:, 0], 1 - atlas.uvs[:, 1]], 1), 0, 1)
    normals = np.round(np.nan_to_num(atlas.normals @ turn.T).clip(-1, 1) * 127).astype(np.int8)
    small = len(atlas.vertices) <= 1 << 16
    return {
        **_pack_positions(atlas.vertices @ turn.T),
        "uvs": encode(np.round(uvs * 65535).astype("<u2")),
        "normals": encode(normals),
        "faces": encode(atlas.faces.astype("<u2" if small else "<u4")),
        "face_bits": 16 if small else 32,
        "texture": jpeg_uri(shrink(texture, TEXTURE_SIDE), 88),
    }


def pack_overlays(quality: VertexQuality) -> list[dict[str, Any]]:
    """Measures per vertex as bytes between a low and a high end, each with its words for the legend."""
    seen = quality.seen_by > 0
    per_pixel = np.where(seen, quality.texel_density / np.maximum(quality.photo_density, 1e-9), np.nan)
    several = np.where(quality.seen_by > 1, quality.ambiguity, np.nan)
    return [
        _overlay("seen", "Photos that saw it", quality.seen_by, 0, max(8.0, _top(quality.seen_by)), ""),
        _overlay("ambiguity", "Ambiguity: how far photos disagree on its colour (λ)", several, 0,
                 max(1.0, _top(several)), "fewer than two photos"),
        _overlay("density", "Texels for each pixel of the closest photo", per_pixel, 0, max(2.0, _top(per_pixel)),
                 "no photo"),
        _overlay("invented", "Texture that no photo saw", quality.invented, 0, 1, ""),
    ]  # fmt: skip


def pack_scene(
    scene: PosedScene,
    captions: Sequence[dict[str, Any]],
    next_views: Sequence[NextView],
    atlas: AtlasMesh,
) -> dict[str, Any]:
    """Cameras and suggested ones as pyramids, sparse points, a grid on the ground.

    Args:
        captions: for each camera of the scene what the view says of it: "name", "held_out", "error", "points".
    """
    turn, cameras = y_up_rotation(scene.up), scene.cameras
    distance = float(np.median(np.linalg.norm(cameras.centers, axis=1))) if len(cameras) else 1.0
    depth = min(FRUSTUM * distance, MAX_FRUSTUM)
    shapes = [look_at(view.position, view.target, scene.up, *NEXT_SIZE, NEXT_FOV_DEG) for view in next_views]
    return {
        "cameras": [
            {"apex": _plain(turn @ center), "corners": _plain((center + depth * ends) @ turn.T), **caption}
            for center, ends, caption in zip(cameras.centers, _corner_rays(cameras), captions, strict=True)
        ],
        "next": [
            {
                "apex": _plain(turn @ view.position),
                "corners": _plain((view.position + 1.5 * depth * _corner_rays(shape)[0]) @ turn.T),
                "sentence": view.sentence,
            }
            for view, shape in zip(next_views, shapes, strict=True)
        ],
        **_pack_points(scene.points, turn),
        "ground": _plain(_ground_grid(scene, atlas) @ turn.T) if scene.ground is not None else None,
    }


def pack_dense(cloud: PointCloud, scene: PosedScene) -> dict[str, Any] | None:
    """Dense points, a random choice where they are many: positions, colours in 8 bits; None where there are none.

    Args:
        cloud: in the frame of the poses.
    """
    moved, random = cloud.within(scene.poses_from_scene), np.random.default_rng(0)
    distances = np.where(moved.trust >= TRUSTED, np.linalg.norm(moved.points, axis=1), np.inf)
    inside, around = distances <= 1, (distances > 1) & (distances <= POINTS_REACH)
    rows = np.concatenate(
        [random.permutation(np.flatnonzero(some))[:most] for some, most in ((inside, MAX_DENSE), (around, MAX_AROUND))]
    )
    if not len(rows):
        return None
    positions = _pack_positions(moved.points[rows] @ y_up_rotation(scene.up).T)
    return {**positions, "colors": encode(moved.colors[rows]), "shown": len(rows), "total": len(cloud)}


def pack_region(scene: PosedScene, place: Place, given: GivenRegion | None) -> dict[str, Any]:
    """The region in world coordinates, and the way from there into the view.

    The form is that of the given region, else the scene's sphere. The other form is there too, to change to: the sphere
    about a box, as training has it, or the box about the sphere.

    Returns:
        "form": "sphere" or "box"; "center", "radius", "low", "high": world units; "units": their name;
        "view_from_world": [16] row by row.
    """
    world_from_scene = scene.world_from_scene(place)
    center, radius = world_from_scene.translation, world_from_scene.scale
    box = None if given is None else given.box
    low, high = (center - radius, center + radius) if box is None else box
    view_from_scene = Similarity(1.0, y_up_rotation(scene.up), np.zeros(3))
    return {
        "form": "sphere" if box is None else "box",
        "center": center.tolist(),
        "radius": radius,
        "low": low.tolist(),
        "high": high.tolist(),
        "units": place.units,
        "view_from_world": view_from_scene.compose(world_from_scene.inverse()).matrix().ravel().tolist(),
    }


def _pack_points(points: np.ndarray, turn: np.ndarray) -> dict[str, Any]:
    """Sparse points [P, 3], every n-th where they are many, their number in all, and n."""
    distances = np.linalg.norm(points, axis=1)
    near = points[distances <= max(POINTS_REACH, np.quantile(distances, 1 - STRAY))] if len(points) else points
    each = max(1, -(-len(near) // MAX_POINTS))
    thinned = near[::each]
    return {
        "points": _pack_positions(thinned @ turn.T) if len(thinned) else None,
        "points_each": each,
        "points_total": len(points),
    }


def _ground_grid(scene: PosedScene, atlas: AtlasMesh) -> np.ndarray:
    """Line segments [2 L, 3] of a square grid on the ground below the mesh."""
    assert scene.ground is not None
    normal = scene.ground.normal
    side = perpendicular(normal)
    ahead = np.cross(normal, side)
    middle = (atlas.vertices.min(0) + atlas.vertices.max(0)) / 2
    middle = middle - scene.ground.heights(middle[None])[0] * normal
    lines = []
    for t in np.linspace(-GRID_REACH, GRID_REACH, GRID_CELLS + 1):
        for across, along in ((side, ahead), (ahead, side)):
            lines += [t * across - GRID_REACH * along, t * across + GRID_REACH * along]
    return middle + np.array(lines)


def _corner_rays(cameras: PinholeCameras) -> np.ndarray:
    """Scene-frame offsets [N, 4, 3] from each camera's centre to its image corners at depth 1."""
    width, height = cameras.sizes[:, 0], cameras.sizes[:, 1]
    zero = np.zeros(len(cameras))
    x, y = np.stack([zero, width, width, zero], 1), np.stack([zero, zero, height, height], 1)
    K = cameras.intrinsics
    rays = np.stack(
        [(x - K[:, :1, 2]) / K[:, :1, 0], (y - K[:, 1:2, 2]) / K[:, 1:2, 1], np.ones_like(x)], 2
    )  # fmt: skip
    return rays @ cameras.extrinsics[:, :, :3]


def _overlay(key: str, label: str, values: np.ndarray, low: float, high: float, missing: str) -> dict[str, Any]:
    scaled = np.clip((np.asarray(values, dtype=np.float64) - low) / (high - low), 0, 1) * (NO_VALUE - 1)
    packed = np.where(np.isnan(scaled), NO_VALUE, np.round(scaled)).astype(np.uint8)
    return {"key": key, "label": label, "low": low, "high": high, "missing": missing, "values": encode(packed)}


def _top(values: np.ndarray) -> float:
    """The 98th percentile of what is known, rounded up to two digits."""
    known = values[np.isfinite(values)]
    top = float(np.percentile(known, 98)) if len(known) else 1.0
    digits = 10.0 ** (np.floor(np.log10(top)) - 1) if top > 0 else 1.0
    return float(f"{np.ceil(top / digits) * digits:.3g}")


def _pack_positions(points: np.ndarray) -> dict[str, Any]:
    """Points [P, 3] in 16 bits between their lowest and highest corner."""
    low = points.min(0)
    size = np.maximum(points.max(0) - low, 1e-9)
    packed = np.round((points - low) / size * 65535).astype("<u2")
    return {"positions": encode(packed), "low": low.tolist(), "size": size.tolist()}


def _plain(array: np.ndarray) -> list[float]:
    """All numbers in one list, five digits each."""
    return [float(f"{value:.5g}") for value in np.asarray(array).ravel()]


def encode(array: np.ndarray) -> str:
    """The bytes of an array as base64."""
    return base64.b64encode(np.ascontiguousarray(array).tobytes()).decode()
