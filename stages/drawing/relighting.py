"""Pictures of a textured mesh under a light from all around: the split sum of `stages.light.ggx`, without shadows that
the occlusion map does not hold.

A point shows, with the glTF 2.0 material (appendix B) of base colour ρ, roughness and metalness m,

    (1 - m) ((1 - F) ρ o E + F s L) + m (ρ scale + bias) s L,    F = 0.04 scale + bias,

E what a white matte surface shows of the light (irradiance / π), L the light blurred by the roughness around the
mirrored direction, o the occlusion, s the specular occlusion that Lagarde & de Rousiers make of it ("Moving Frostbite
to Physically Based Rendering", 2014, section 4.10.2): |(n·v + o)^(2^(-16 alpha - 1)) - 1 + o|, clamped to [0, 1].
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stages.artifacts import AtlasMesh
from stages.compiling import njit
from stages.drawing.rasterizing import NO_FACE, corner_weights, projected, rasterize
from stages.geometry.cameras import PinholeCameras
from stages.light.ggx import DIELECTRIC, split_sum_table
from stages.light.levels import Levels
from stages.light.srgb import decoded

# What a picture shows where there is nothing: the light itself, white, or nothing (alpha).
BACKGROUNDS = ("light", "white", "transparent")
# Which of the levels is shown behind.
_BEHIND = 2


@dataclass(frozen=True)
class Material:
    """The images of a material, 8 bits, row 0 at v = 1; an image of one pixel stands for all.

    Attributes:
        base_color: [S, S, 3] sRGB.
        orm: [S, S, 3] occlusion, roughness, metalness.
        normal: [S, S, 3] tangent-space normals, +Y up, as `stages.texture.tangents` says; or None.
    """

    base_color: np.ndarray
    orm: np.ndarray
    normal: np.ndarray | None = None


def relit(
    mesh: AtlasMesh,
    material: Material,
    light: Levels,
    camera: PinholeCameras,
    tangents: np.ndarray | None = None,
    turn_deg: float = 0.0,
    supersample: int = 2,
) -> tuple[np.ndarray, np.ndarray]:
    """What a camera sees of a mesh.

    Args:
        mesh: in the light's frame, Y up.
        camera: one camera (the first is used).
        tangents: [V, 4] of the normal map; see `stages.texture.tangents.vertex_tangents`.
        turn_deg: the light is turned by, as `stages.light.environment.turned` does.
        supersample: samples along a pixel's side.

    Returns:
        [H, W, 3] float32 linear radiance, 0 where nothing is and shared with it at edges; [H, W] float32 coverage.

    Raises:
        ValueError: a normal map without tangents.
    """
    if (material.normal is None) != (tangents is None):
        raise ValueError("expected a normal map and tangents, or neither")
    width, height = (int(side) * supersample for side in camera.sizes[0])
    xy, inverse_depth = projected(camera, 0, mesh.vertices)
    xy = xy * supersample
    face_map, _ = rasterize(xy, inverse_depth, mesh.faces, width, height)
    image = np.zeros((height * width, 3), dtype=np.float32)
    hit = np.flatnonzero(face_map.ravel() != NO_FACE)
    if len(hit):
        faces = face_map.ravel()[hit]
        centers = np.stack([hit % width, hit // width], 1) + 0.5
        weights = corner_weights(xy, inverse_depth, mesh.faces, faces, centers)
        image[hit] = _shaded(mesh, material, light, camera.centers[0], faces, weights, tangents, turn_deg)
    blocks = (height // supersample, supersample, width // supersample, supersample)
    coverage = (face_map != NO_FACE).reshape(blocks).mean((1, 3), dtype=np.float32)
    return image.reshape(*blocks, 3).mean((1, 3)), coverage


def behind(light: Levels, camera: PinholeCameras, turn_deg: float = 0.0) -> np.ndarray:
    """The light, blurred, as a camera sees it where nothing is in front: [H, W, 3] float32 linear radiance."""
    from stages.light.environment import look_up

    width, height = (int(side) for side in camera.sizes[0])
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    inverse = np.linalg.inv(camera.intrinsics[0])
    rays = np.stack([x, y, np.ones_like(x)], axis=2) @ inverse.T @ camera.extrinsics[0, :, :3]
    rays /= np.linalg.norm(rays, axis=2, keepdims=True)
    return look_up(light.maps[_BEHIND], rays @ turned_back(turn_deg).T)


def turned_back(degrees: float) -> np.ndarray:
    """[3, 3] where a direction lay before the light was turned by so much."""
    cosine, sine = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([[cosine, 0, sine], [0, 1, 0], [-sine, 0, cosine]])


def _shaded(
    mesh: AtlasMesh,
    material: Material,
    light: Levels,
    center: np.ndarray,
    faces: np.ndarray,
    weights: np.ndarray,
    tangents: np.ndarray | None,
    turn_deg: float,
) -> np.ndarray:
    """Radiance [P, 3] of points at barycentric `weights` [P, 3] of `faces` [P], seen from `center`."""
    linear = decoded(np.arange(256) / 255).astype(np.float32)
    rows = np.array([len(level) for level in light.maps])
    out = np.empty((len(faces), 3), dtype=np.float32)
    _shade(
        faces,
        weights,
        np.ascontiguousarray(mesh.faces, np.int32),
        np.ascontiguousarray(mesh.vertices, np.float32),
        np.ascontiguousarray(mesh.normals, np.float32),
        np.ascontiguousarray(mesh.uvs, np.float32),
        np.zeros((0, 4), np.float32) if tangents is None else np.ascontiguousarray(tangents, np.float32),
        np.ascontiguousarray(material.base_color),
        np.ascontiguousarray(material.orm),
        np.zeros((1, 1, 3), np.uint8) if material.normal is None else np.ascontiguousarray(material.normal),
        linear,
        np.concatenate([level.reshape(-1, 3) for level in light.maps]),
        np.concatenate([[0], np.cumsum(2 * rows**2)[:-1]]),
        rows,
        np.array(light.roughnesses, np.float32),
        light.matte.reshape(-1, 3),
        split_sum_table(),
        center.astype(np.float32),
        turned_back(turn_deg).astype(np.float32),
        out,
    )
    return out


# ---------------------------------------------------------------- the kernel
@njit(nogil=True, cache=True)
def _place(value, count):  # pragma: no cover - compiled
    """The cell before a place in 0..1 of `count` cells, clamped to them, and the share of the next."""
    at = min(max(value * count - 0.5, 0.0), count - 1.0)
    first = min(int(at), max(count - 2, 0))
    return first, at - first


@njit(nogil=True, cache=True)
def _texel(texture, decoded, is_coded, u, v, out):  # pragma: no cover - compiled
    """Bilinear, in 0..1, linear."""
    height, width = texture.shape[0], texture.shape[1]
    x0, fx = _place(u, width)
    y0, fy = _place(1 - v, height)
    x1, y1 = min(x0 + 1, width - 1), min(y0 + 1, height - 1)
    for c in range(3):
        a, b, d, e = texture[y0, x0, c], texture[y0, x1, c], texture[y1, x0, c], texture[y1, x1, c]
        if is_coded:
            top = decoded[a] * (1 - fx) + decoded[b] * fx
            out[c] = top * (1 - fy) + (decoded[d] * (1 - fx) + decoded[e] * fx) * fy
        else:
            out[c] = ((a * (1 - fx) + b * fx) * (1 - fy) + (d * (1 - fx) + e * fx) * fy) / 255


@njit(nogil=True, cache=True)
def _add_light(flat, start, rows, u, v, share, out):  # pragma: no cover - compiled
    """Add a share of a map's radiance at u, v in 0..1; the map closes around."""
    y0, fy = _place(v, rows)
    x = u * 2 * rows - 0.5
    left = np.floor(x)
    fx = x - left
    x0 = int(left) % (2 * rows)
    x1 = (x0 + 1) % (2 * rows)
    top, bottom = start + y0 * 2 * rows, start + min(y0 + 1, rows - 1) * 2 * rows
    for c in range(3):
        upper = flat[top + x0, c] * (1 - fx) + flat[top + x1, c] * fx
        lower = flat[bottom + x0, c] * (1 - fx) + flat[bottom + x1, c] * fx
        out[c] += share * (upper * (1 - fy) + lower * fy)


@njit(nogil=True, cache=True)
def _on_map(turn, x, y, z):  # pragma: no cover - compiled
    """u and v in 0..1 of a direction on the map of a light that is turned."""
    a = turn[0, 0] * x + turn[0, 1] * y + turn[0, 2] * z
    b = turn[1, 0] * x + turn[1, 1] * y + turn[1, 2] * z
    c = turn[2, 0] * x + turn[2, 1] * y + turn[2, 2] * z
    return np.arctan2(c, a) / (2 * np.pi) + 0.5, np.arccos(min(max(b, -1.0), 1.0)) / np.pi


@njit(nogil=True, cache=True)
def _length(x, y, z):  # pragma: no cover - compiled
    return np.sqrt(x * x + y * y + z * z) + 1e-20


@njit(nogil=True, cache=True)
def _shade(
    faces,
    weights,
    triangles,
    vertices,
    normals,
    uvs,
    tangents,
    base_color,
    orm,
    normal_map,
    decoded,
    flat,
    starts,
    rows,
    roughnesses,
    matte,
    table,
    center,
    turn,
    out,
):  # pragma: no cover - compiled
    color, packed, relief = np.empty(3), np.empty(3), np.empty(3)
    mirrored, around = np.empty(3), np.empty(3)
    side = table.shape[0]
    for i in range(faces.shape[0]):
        px = py = pz = nx = ny = nz = tx = ty = tz = tw = u = v = 0.0
        for k in range(3):
            corner, w = triangles[faces[i], k], weights[i, k]
            px, py, pz = px + w * vertices[corner, 0], py + w * vertices[corner, 1], pz + w * vertices[corner, 2]
            nx, ny, nz = nx + w * normals[corner, 0], ny + w * normals[corner, 1], nz + w * normals[corner, 2]
            u, v = u + w * uvs[corner, 0], v + w * uvs[corner, 1]
            if tangents.shape[0]:
                tx, ty = tx + w * tangents[corner, 0], ty + w * tangents[corner, 1]
                tz, tw = tz + w * tangents[corner, 2], tw + w * tangents[corner, 3]
        length = _length(nx, ny, nz)
        nx, ny, nz = nx / length, ny / length, nz / length
        vx, vy, vz = center[0] - px, center[1] - py, center[2] - pz
        length = _length(vx, vy, vz)
        vx, vy, vz = vx / length, vy / length, vz / length

        if tangents.shape[0]:
            _texel(normal_map, decoded, False, u, v, relief)
            a, b, c = 2 * relief[0] - 1, 2 * relief[1] - 1, 2 * relief[2] - 1
            length = _length(tx, ty, tz)
            tx, ty, tz = tx / length, ty / length, tz / length
            if tw < 0:
                b = -b
            bx, by, bz = ny * tz - nz * ty, nz * tx - nx * tz, nx * ty - ny * tx
            nx, ny, nz = a * tx + b * bx + c * nx, a * ty + b * by + c * ny, a * tz + b * bz + c * nz
            length = _length(nx, ny, nz)
            nx, ny, nz = nx / length, ny / length, nz / length

        p, q, r = triangles[faces[i], 0], triangles[faces[i], 1], triangles[faces[i], 2]
        ex, ey, ez = vertices[q, 0] - vertices[p, 0], vertices[q, 1] - vertices[p, 1], vertices[q, 2] - vertices[p, 2]
        fx, fy, fz = vertices[r, 0] - vertices[p, 0], vertices[r, 1] - vertices[p, 1], vertices[r, 2] - vertices[p, 2]
        if (ey * fz - ez * fy) * vx + (ez * fx - ex * fz) * vy + (ex * fy - ey * fx) * vz < 0:  # seen from behind
            nx, ny, nz = -nx, -ny, -nz
        facing = min(max(nx * vx + ny * vy + nz * vz, 1e-3), 1.0)

        _texel(base_color, decoded, True, u, v, color)
        _texel(orm, decoded, False, u, v, packed)
        occlusion, roughness, metallic = packed[0], packed[1], packed[2]
        x0, sx = _place(facing, side)
        y0, sy = _place(roughness, side)
        scale = (table[y0, x0, 0] * (1 - sx) + table[y0, x0 + 1, 0] * sx) * (1 - sy) + (
            table[y0 + 1, x0, 0] * (1 - sx) + table[y0 + 1, x0 + 1, 0] * sx
        ) * sy
        bias = (table[y0, x0, 1] * (1 - sx) + table[y0, x0 + 1, 1] * sx) * (1 - sy) + (
            table[y0 + 1, x0, 1] * (1 - sx) + table[y0 + 1, x0 + 1, 1] * sx
        ) * sy
        open_part = (facing + occlusion) ** (2.0 ** (-16 * roughness * roughness - 1)) - 1 + occlusion
        open_part = min(max(open_part, 0.0), 1.0)

        level = 0
        while level < roughnesses.shape[0] - 2 and roughness > roughnesses[level + 1]:
            level += 1
        share = min(max((roughness - roughnesses[level]) / (roughnesses[level + 1] - roughnesses[level]), 0.0), 1.0)
        s, t = _on_map(turn, 2 * facing * nx - vx, 2 * facing * ny - vy, 2 * facing * nz - vz)
        mirrored[:] = 0
        _add_light(flat, starts[level], rows[level], s, t, (1 - share) * open_part, mirrored)
        _add_light(flat, starts[level + 1], rows[level + 1], s, t, share * open_part, mirrored)
        s, t = _on_map(turn, nx, ny, nz)
        around[:] = 0
        _add_light(matte, 0, int(np.sqrt(matte.shape[0] // 2)), s, t, occlusion, around)
        fresnel = DIELECTRIC * scale + bias
        for c in range(3):
            plain = (1 - fresnel) * color[c] * around[c] + fresnel * mirrored[c]
            out[i, c] = (1 - metallic) * plain + metallic * (color[c] * scale + bias) * mirrored[c]
