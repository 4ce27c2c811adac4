"""Pictures of the figurine on its cloth, by ray casting.

Light that does not depend on the view is baked (a sum over directions of the environment with ray-cast visibility);
mirror-like reflections are traced per pixel.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from stages.scenes.figurine import Figurine, figurine_materials
from stages.scenes.room import CLOTH_SIDE, make_cloth, make_environment, sphere_directions
from stages.surface.triangle_mesh import raycaster

SUPERSAMPLING = 2
RAY_OFFSET = 2e-3  # secondary rays start this far off the surface, more than the mesh's own faceting


# ---------------------------------------------------------------- light
def _blur_environment(environment: np.ndarray, sigma: float) -> np.ndarray:
    """Gaussian blur in pixels, wrapped around the horizon."""
    import cv2

    pad = environment.shape[1] // 4
    wrapped = np.concatenate([environment[:, -pad:], environment, environment[:, :pad]], 1)
    return cv2.GaussianBlur(wrapped, (0, 0), sigma)[:, pad:-pad]


def _look_up(environment: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Radiance [P, 3] seen in unit directions [P, 3], bilinear."""
    height, width = environment.shape[:2]
    row = np.arccos(np.clip(directions[:, 2], -1, 1)) / np.pi * height - 0.5
    column = np.arctan2(directions[:, 1], directions[:, 0]) % (2 * np.pi) / (2 * np.pi) * width - 0.5
    return _remap(environment, column, row)


def _remap(image: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Bilinear samples [P, C] of an image at pixel positions; folded because cv2 limits a side to 32767."""
    import cv2

    count, row = len(x), 4096
    x, y = (np.pad(values.astype(np.float32), (0, -count % row)).reshape(-1, row) for values in (x, y))
    samples = cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return samples.reshape(-1, image.shape[2])[:count]


def _light_samples(environment: np.ndarray, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Directions [count, 3] drawn by brightness; the radiance times solid angle [count, 3] of each."""
    height = environment.shape[0]
    directions = sphere_directions(height).reshape(-1, 3)
    solid_angle = np.repeat(np.sin((np.arange(height) + 0.5) / height * np.pi), 2 * height) * np.pi**2 / height**2
    power = environment.reshape(-1, 3).mean(1) * solid_angle
    cumulative = np.cumsum(power) / power.sum()
    chosen = np.searchsorted(cumulative, (np.arange(count) + rng.random(count)) / count).clip(0, len(power) - 1)
    probability = power[chosen] / power.sum()
    weights = environment.reshape(-1, 3)[chosen] * (solid_angle[chosen] / probability / count)[:, None]
    return directions[chosen], weights


def _irradiance(
    scene: Any, points: np.ndarray, normals: np.ndarray, directions: np.ndarray, weights: np.ndarray
) -> np.ndarray:
    """Light [P, 3] arriving at surface points from the unoccluded part of the environment."""
    import open3d as o3d

    origins = (points + RAY_OFFSET * normals).astype(np.float32)
    total = np.zeros((len(points), 3), np.float32)
    for direction, weight in zip(directions.astype(np.float32), weights, strict=True):
        cosine = normals.astype(np.float32) @ direction
        facing = np.flatnonzero(cosine > 0)
        rays = np.empty((len(facing), 6), np.float32)
        rays[:, :3], rays[:, 3:] = origins[facing], direction
        hidden = scene.test_occlusions(o3d.core.Tensor(rays)).numpy()
        total[facing] += (cosine[facing] * ~hidden)[:, None] * weight
    return total


# ---------------------------------------------------------------- the lit scene
@dataclass(frozen=True)
class LitScene:
    """Everything a picture needs. Radiances are linear.

    Attributes:
        raycaster: Open3D scene holding the subdivided figurine.
        faces: [F, 3] of the subdivided figurine.
        normals, diffuse, specular, gloss: per subdivided vertex; diffuse is outgoing radiance,
            specular is the reflectance at normal incidence.
        cloth: [H, W, 3] outgoing radiance of the cloth.
        floor: [3] outgoing radiance of the floor around the cloth.
        sharp, soft: environment maps for polished and for painted parts.
    """

    raycaster: Any
    faces: np.ndarray
    normals: np.ndarray
    diffuse: np.ndarray
    specular: np.ndarray
    gloss: np.ndarray
    cloth: np.ndarray
    floor: np.ndarray
    sharp: np.ndarray
    soft: np.ndarray


def light_scene(figurine: Figurine, seed: int, light_samples: int = 128, cloth_size: int = 2048) -> LitScene:
    """Paint the bird, print the cloth, and bake all light that does not depend on the view."""
    import cv2
    from trimesh.remesh import subdivide

    rng = np.random.default_rng(seed)
    environment = make_environment(rng)
    directions, weights = _light_samples(environment, light_samples, rng)
    coarse = raycaster(figurine.vertices, figurine.faces)
    light = _irradiance(coarse, figurine.vertices, figurine.normals, directions, weights)

    faces, attributes = figurine.faces, np.hstack([figurine.vertices, figurine.normals, figurine.design, light])
    for _ in range(2):  # what stands at a new vertex is the mean of its edge's ends
        attributes, faces = subdivide(attributes, faces)
    vertices, normals, design, light = np.split(attributes, [3, 6, 9], axis=1)
    normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    albedo, metalness, gloss = figurine_materials(design, rng)
    diffuse = (1 - metalness)[:, None] * albedo * light / np.pi
    specular = np.where(metalness[:, None] > 0.5, albedo, 0.04)

    grid = 160
    axis = ((np.arange(grid) + 0.5) / grid - 0.5) * CLOTH_SIDE
    x, y = np.meshgrid(axis, axis)
    ground = np.stack([x.ravel(), y.ravel(), np.zeros(grid * grid)], 1)
    up = np.broadcast_to([0.0, 0.0, 1.0], ground.shape)
    ground_light = _irradiance(coarse, ground, up, directions, weights).reshape(grid, grid, 3)
    ground_light = cv2.GaussianBlur(ground_light, (0, 0), 1.2)
    cloth = make_cloth(rng, cloth_size) * cv2.resize(ground_light, (cloth_size, cloth_size)) / np.pi

    return LitScene(
        raycaster=raycaster(vertices, faces),
        faces=faces,
        normals=normals.astype(np.float32),
        diffuse=diffuse.astype(np.float32),
        specular=specular.astype(np.float32),
        gloss=gloss.astype(np.float32),
        cloth=cloth.astype(np.float32),
        floor=(0.32 * ground_light[0, 0] / np.pi).astype(np.float32),
        sharp=_blur_environment(environment, 1.0),
        soft=_blur_environment(environment, 8.0),
    )


# ---------------------------------------------------------------- pictures
def _ground_radiance(scene: LitScene, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Radiance [P, 3] of the cloth, or of the floor beyond it."""
    size = scene.cloth.shape[0]
    column, row = (x / CLOTH_SIDE + 0.5) * size - 0.5, (y / CLOTH_SIDE + 0.5) * size - 0.5
    color = _remap(scene.cloth, column, row)
    beyond = (np.abs(x) > CLOTH_SIDE / 2) | (np.abs(y) > CLOTH_SIDE / 2)
    color[beyond] = scene.floor
    return color


def _surroundings(scene: LitScene, origins: np.ndarray, directions: np.ndarray, environment: np.ndarray) -> np.ndarray:
    """Radiance [P, 3] along rays that miss the bird: the ground below, the room above."""
    color = np.empty((len(directions), 3), np.float32)
    down = directions[:, 2] < -1e-6
    if not down.all():
        color[~down] = _look_up(environment, directions[~down])
    distance = -origins[down, 2] / directions[down, 2]
    hit = origins[down, :2] + distance[:, None] * directions[down, :2]
    color[down] = _ground_radiance(scene, hit[:, 0], hit[:, 1])
    return color


def _interpolate(scene: LitScene, hit: dict, chosen: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Vertex values at the ray hits `chosen`, by barycentric weights."""
    corners = scene.faces[hit["primitive_ids"].numpy()[chosen].astype(np.int64)]
    uv = hit["primitive_uvs"].numpy()[chosen]
    weights = np.stack([1 - uv.sum(1), uv[:, 0], uv[:, 1]], 1).astype(np.float32)
    if values.ndim == 1:
        return (values[corners] * weights).sum(1)
    return np.einsum("pkc,pk->pc", values[corners], weights)


def _cast(scene: LitScene, origins: np.ndarray, directions: np.ndarray) -> tuple[dict, np.ndarray]:
    """Open3D's answer and the indices of the rays that hit the bird."""
    import open3d as o3d

    rays = np.concatenate([origins, directions], 1).astype(np.float32)
    hit = scene.raycaster.cast_rays(o3d.core.Tensor(rays))
    return hit, np.flatnonzero(np.isfinite(hit["t_hit"].numpy()))


def _shade_figurine(
    scene: LitScene, hit: dict, chosen: np.ndarray, points: np.ndarray, views: np.ndarray
) -> np.ndarray:
    """Radiance [P, 3] towards the camera: baked diffuse light and a mirrored ray (Schlick's Fresnel)."""
    normals = _interpolate(scene, hit, chosen, scene.normals)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    cosine = np.clip(-(normals * views).sum(1), 0.0, 1.0)
    reflected = views + 2 * cosine[:, None] * normals
    origins = points + RAY_OFFSET * normals
    gloss = _interpolate(scene, hit, chosen, scene.gloss)

    polished = gloss > 0.8
    mirror = np.empty_like(points, dtype=np.float32)
    mirror[~polished] = _surroundings(scene, origins[~polished], reflected[~polished], scene.soft)
    mirror[polished] = _surroundings(scene, origins[polished], reflected[polished], scene.sharp)
    second, again = _cast(scene, origins, reflected)
    mirror[again] = _interpolate(scene, second, again, scene.diffuse)

    base = _interpolate(scene, hit, chosen, scene.specular)
    fresnel = base + (1 - base) * ((1 - cosine) ** 5)[:, None]
    strength = np.where(polished, 1.0, gloss)[:, None]
    return _interpolate(scene, hit, chosen, scene.diffuse) + strength * fresnel * mirror


def render(scene: LitScene, cam_from_world: np.ndarray, focal: float, size: tuple[int, int]) -> np.ndarray:
    """Linear radiance [height, width, 3] of one photograph, averaged over 2x2 samples a pixel."""
    width, height = (SUPERSAMPLING * side for side in size)
    focal = SUPERSAMPLING * focal
    rotation = cam_from_world[:3, :3]
    center = -rotation.T @ cam_from_world[:3, 3]
    x, y = np.meshgrid((np.arange(width) + 0.5 - width / 2) / focal, (np.arange(height) + 0.5 - height / 2) / focal)
    directions = np.stack([x, y, np.ones_like(x)], -1) @ rotation
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    views = directions.reshape(-1, 3)
    centers = np.broadcast_to(center, views.shape)
    image = _surroundings(scene, centers, views, scene.sharp)
    hit, chosen = _cast(scene, centers, views)
    points = center + hit["t_hit"].numpy()[chosen, None] * views[chosen]
    image[chosen] = _shade_figurine(scene, hit, chosen, points, views[chosen])
    shape = (size[1], SUPERSAMPLING, size[0], SUPERSAMPLING, 3)
    return image.reshape(shape).mean((1, 3))
