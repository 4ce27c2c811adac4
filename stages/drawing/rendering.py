"""A small software renderer, to look at textured meshes: turntable stills for reports, documentation and
tests."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from stages.artifacts import AtlasMesh
from stages.drawing.rasterizing import NO_FACE, corner_weights, projected, rasterize
from stages.geometry.cameras import PinholeCameras
from stages.geometry.normalisation import perpendicular
from stages.geometry.vectors import unit

BACKGROUND = (255, 255, 255)
FOV_DEG, ELEVATION_DEG = 35.0, 20.0


def look_at(
    eye: np.ndarray, target: np.ndarray, up: np.ndarray, width: int, height: int, fov_deg: float = FOV_DEG
) -> PinholeCameras:
    """One camera at `eye` looking at `target`; `fov_deg` is the vertical field of view."""
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, up)
    if np.linalg.norm(right) < 1e-6:  # looking straight up or down
        right = perpendicular(forward)
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    focal = 0.5 * height / np.tan(np.radians(fov_deg) / 2)
    return PinholeCameras(
        names=("view",),
        sizes=np.array([[width, height]]),
        intrinsics=np.array([[[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]]], dtype=np.float64),
        extrinsics=np.concatenate([rotation, -(rotation @ eye)[:, None]], 1)[None],
    )


def turntable(
    vertices: np.ndarray,
    up: np.ndarray,
    count: int = 4,
    width: int = 480,
    height: int = 480,
    front: np.ndarray | None = None,
) -> list[PinholeCameras]:
    """`count` cameras around the vertices' bounding sphere, evenly spaced about `up`, each seeing all of it.

    The first is at the unit vector `front`, at right angles to `up`, or at any; the others follow counter-clockwise,
    seen from above.
    """
    up = up / np.linalg.norm(up)
    center = (vertices.min(0) + vertices.max(0)) / 2
    radius = max(float(np.linalg.norm(vertices - center, axis=1).max()), 1e-9)
    side = perpendicular(up) if front is None else front
    ahead = np.cross(up, side)
    distance = 1.03 * radius / np.sin(np.radians(FOV_DEG) / 2) * max(1.0, height / width)
    elevation = np.radians(ELEVATION_DEG)
    views = []
    for angle in np.linspace(0, 2 * np.pi, count, endpoint=False):
        direction = np.cos(elevation) * (np.cos(angle) * side + np.sin(angle) * ahead) + np.sin(elevation) * up
        views.append(look_at(center + distance * direction, center, up, width, height))
    return views


def sample_texture(texture: np.ndarray, uvs: np.ndarray) -> np.ndarray:
    """Bilinear colours [P, C] float32 of `texture` [H, W, C] at UVs [P, 2] (origin bottom-left, clamped at
    the border)."""
    height, width = texture.shape[:2]
    x = np.clip(uvs[:, 0] * width - 0.5, 0, width - 1)
    y = np.clip((1.0 - uvs[:, 1]) * height - 0.5, 0, height - 1)
    x0, y0 = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
    x1, y1 = np.minimum(x0 + 1, width - 1), np.minimum(y0 + 1, height - 1)
    fx, fy = (x - x0)[:, None].astype(np.float32), (y - y0)[:, None].astype(np.float32)
    top = texture[y0, x0] * (1 - fx) + texture[y0, x1] * fx
    bottom = texture[y1, x0] * (1 - fx) + texture[y1, x1] * fx
    return (top * (1 - fy) + bottom * fy).astype(np.float32)


def render_textured(
    mesh: AtlasMesh,
    texture: np.ndarray,
    camera: PinholeCameras,
    shaded: bool = False,
    supersample: int = 2,
    background: tuple[int, int, int] = BACKGROUND,
) -> np.ndarray:
    """Draw a textured mesh: see `render_together`."""
    return render_together([(mesh, texture)], camera, shaded, supersample, background)


def render_together(
    meshes: Iterable[tuple[AtlasMesh, np.ndarray]],
    camera: PinholeCameras,
    shaded: bool = False,
    supersample: int = 2,
    background: tuple[int, int, int] = BACKGROUND,
) -> np.ndarray:
    """Draw textured meshes that share a frame.

    Args:
        meshes: each with its texture [S, S, 3] uint8, row 0 at v = 1; a [1, 1, 3] one, shaded, shows the shape alone.
        camera: one camera (the first is used).
        shaded: a headlight shades the colours; else the texture is shown as it is.
        supersample: samples along a pixel's side.

    Returns:
        [H, W, 3] uint8.
    """
    width, height = (int(side) * supersample for side in camera.sizes[0])
    image = np.empty((height * width, 3), dtype=np.float32)
    image[:] = background
    nearest = np.zeros(height * width, dtype=np.float32)  # inverse depth
    for mesh, texture in meshes:
        xy, inverse_depth = projected(camera, 0, mesh.vertices)
        xy = xy * supersample
        face_map, nearness = (each.ravel() for each in rasterize(xy, inverse_depth, mesh.faces, width, height))
        hit = np.flatnonzero((face_map != NO_FACE) & (nearness > nearest))
        if len(hit):
            nearest[hit], face_ids = nearness[hit], face_map[hit]
            centers = np.stack([hit % width, hit // width], 1) + 0.5
            weights = corner_weights(xy, inverse_depth, mesh.faces, face_ids, centers)
            image[hit] = _colors_at(mesh, texture, face_ids, weights, camera.centers[0] if shaded else None)
    image = image.reshape(height // supersample, supersample, width // supersample, supersample, 3).mean((1, 3))
    return np.clip(image + 0.5, 0, 255).astype(np.uint8)


def _colors_at(
    mesh: AtlasMesh, texture: np.ndarray, face_ids: np.ndarray, weights: np.ndarray, headlight: np.ndarray | None
) -> np.ndarray:
    """Colours [P, 3] at barycentric weights [P, 3] of faces [P], shaded by a light at a point where there is one."""
    corners = mesh.faces[face_ids]
    colors = sample_texture(texture, np.einsum("pc,pcd->pd", weights, mesh.uvs[corners]))
    if headlight is None:
        return colors
    shading = unit(np.einsum("pc,pcd->pd", weights, mesh.normals[corners]))
    towards = unit(headlight - np.einsum("pc,pcd->pd", weights, mesh.vertices[corners]))
    facing = np.abs((shading * towards).sum(1, keepdims=True))
    shaded: np.ndarray = colors * (0.35 + 0.65 * facing)
    return shaded
