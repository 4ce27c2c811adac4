"""The demo's photographs: a procedural bird figurine on a printed cloth, rendered with ray casting.

The bird has painted, plain and polished parts, so that the demo shows what the pipeline is for. Nothing is
downloaded: shape, paint, cloth and surroundings come from formulas and a seed. Light that does not depend on
the view is baked (a sum over directions of the environment with ray-cast visibility); mirror-like reflections
are traced per pixel.

Frame: z up, the cloth is z = 0, the bird rests on it and its largest extent is 1. Cameras follow OpenCV axes.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np

from stages.evaluation.known_object import TRUTH_CAMERAS, TRUTH_MESH

SCENE_VERSION = 1  # raise it when the same seed would give other photos
PHOTOS = "photos"

FOCAL_35MM = 50  # equivalent focal length written into EXIF and used exactly: f_px = 50 / 36 * width
CLOTH_SIDE = 3.2
NOISE_SIGMA = 1.0 / 255.0
SUPERSAMPLING = 2
MESH_CELL = 1.0 / 110.0  # of the figurine's design units; shading detail comes from two subdivisions
RAY_OFFSET = 2e-3  # secondary rays start this far off the surface, more than the mesh's own faceting

PAINT, PLAIN, METAL = 0, 1, 2


# ---------------------------------------------------------------- shape
def _ellipsoid(points: np.ndarray, center: tuple, radii: tuple) -> np.ndarray:
    offset = (points - np.array(center)) / np.array(radii)
    return (np.linalg.norm(offset, axis=1) - 1.0) * min(radii)


def _cone_stroke(points: np.ndarray, start: tuple, end: tuple, radius_a: float, radius_b: float) -> np.ndarray:
    """A line segment thickened by a radius that goes linearly from `radius_a` to `radius_b`."""
    a, b = np.array(start), np.array(end)
    along = np.clip((points - a) @ (b - a) / ((b - a) @ (b - a)), 0.0, 1.0)
    nearest = a + along[:, None] * (b - a)
    return np.linalg.norm(points - nearest, axis=1) - (radius_a + along * (radius_b - radius_a))


def _ring(points: np.ndarray, center: tuple, major: float, minor: float) -> np.ndarray:
    """A torus around the x axis."""
    offset = points - np.array(center)
    around = np.hypot(offset[:, 1], offset[:, 2]) - major
    return np.hypot(around, offset[:, 0]) - minor


def _rounded_disc(points: np.ndarray, center: tuple, radius: float, half_height: float, rounding: float) -> np.ndarray:
    offset = points - np.array(center)
    radial = np.hypot(offset[:, 0], offset[:, 1]) - radius + rounding
    vertical = np.abs(offset[:, 2]) - half_height + rounding
    outside = np.hypot(np.maximum(radial, 0), np.maximum(vertical, 0))
    return outside + np.minimum(np.maximum(radial, vertical), 0) - rounding


def _smooth_union(a: np.ndarray, b: np.ndarray, width: float) -> np.ndarray:
    blend = np.maximum(width - np.abs(a - b), 0.0) / width
    return np.minimum(a, b) - blend * blend * width / 4.0


def _parts(points: np.ndarray) -> list[tuple[np.ndarray, int]]:
    """Implicit distance and material of each part, [P] each, in design units."""
    ripples = 0.006 * np.sin(19 * points[:, 0]) * np.sin(17 * points[:, 1] + 1.0) * np.sin(18 * points[:, 2] + 2.0)
    body = _ellipsoid(points, (0.0, 0.0, 0.37), (0.37, 0.27, 0.27)) + ripples
    head = _ellipsoid(points, (0.27, 0.03, 0.70), (0.165, 0.155, 0.16))
    tail = _cone_stroke(points, (-0.28, 0.0, 0.42), (-0.50, -0.05, 0.64), 0.11, 0.045)
    painted = _smooth_union(_smooth_union(body, head, 0.16), tail, 0.10)
    beak = _cone_stroke(points, (0.40, 0.04, 0.68), (0.54, 0.06, 0.63), 0.060, 0.022)
    handle = _ring(points, (-0.03, 0.27, 0.40), 0.135, 0.036)
    foot = _rounded_disc(points, (0.02, 0.0, 0.07), 0.21, 0.07, 0.03)
    cap = _ellipsoid(points, (0.25, 0.03, 0.855), (0.085, 0.085, 0.075))
    return [(painted, PAINT), (beak, PLAIN), (handle, PLAIN), (foot, METAL), (cap, METAL)]


def figurine_distance(points: np.ndarray) -> np.ndarray:
    """Implicit function [P] of the whole bird at points [P, 3]: positive outside, roughly the distance."""
    distances = [distance for distance, _ in _parts(points)]
    whole = distances[0]
    for distance in distances[1:]:
        whole = _smooth_union(whole, distance, 0.05)
    return whole


def _gradient(points: np.ndarray, step: float = 1e-3) -> np.ndarray:
    """Central differences of `figurine_distance`, [P, 3]."""
    columns = []
    for axis in range(3):
        offset = np.zeros(3)
        offset[axis] = step
        columns.append(figurine_distance(points + offset) - figurine_distance(points - offset))
    return np.stack(columns, 1) / (2 * step)


def _isosurface(low: np.ndarray, shape: tuple[int, int, int], cell: float) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and faces of `figurine_distance` = 0 on a grid, polished by two Newton steps."""
    import open3d as o3d

    axes = [low[i] + cell * np.arange(shape[i]) for i in range(3)]
    values = np.empty(shape, np.float32)
    for i, x in enumerate(axes[0]):  # slab by slab keeps the temporaries small
        y, z = np.meshgrid(axes[1], axes[2], indexing="ij")
        points = np.stack([np.full(y.size, x), y.ravel(), z.ravel()], 1)
        values[i] = figurine_distance(points).reshape(shape[1:])
    surface = o3d.t.geometry.TriangleMesh.create_isosurfaces(
        o3d.core.Tensor(np.ascontiguousarray(values.transpose(2, 1, 0))), [0.0]
    )
    vertices = surface.vertex.positions.numpy().astype(np.float64) * cell + low
    faces = surface.triangle.indices.numpy().astype(np.int32)
    for _ in range(2):
        gradient = _gradient(vertices)
        length2 = np.maximum((gradient**2).sum(1), 1e-6)
        vertices -= (figurine_distance(vertices) / length2)[:, None] * gradient
    corners = vertices[faces]
    face_normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    if np.einsum("ij,ij->", face_normals, _gradient(corners.mean(1))) < 0:
        faces = np.ascontiguousarray(faces[:, ::-1])
    return vertices, faces


@dataclass(frozen=True)
class Figurine:
    """The bird in the demo's frame.

    Attributes:
        vertices: [V, 3] float64; rests on z = 0, largest extent 1.
        faces: [F, 3] int32, outward.
        normals: [V, 3] unit.
        design: [V, 3] the same vertices in design units, where paint is defined.
    """

    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray
    design: np.ndarray

    @property
    def bounds(self) -> np.ndarray:
        """[2, 3] lowest and highest corner."""
        return np.stack([self.vertices.min(0), self.vertices.max(0)])


def make_figurine(cell: float = MESH_CELL) -> Figurine:
    """Mesh the bird with grid cells of `cell` design units."""
    low, high = np.array([-0.62, -0.36, -0.06]), np.array([0.64, 0.52, 1.0])
    counts = np.ceil((high - low) / cell).astype(int) + 1
    design, faces = _isosurface(low, (int(counts[0]), int(counts[1]), int(counts[2])), cell)
    normals = _gradient(design)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    lowest, highest = design.min(0), design.max(0)
    center = np.array([*(lowest + highest)[:2] / 2, lowest[2]])
    vertices = (design - center) / (highest - lowest).max()
    return Figurine(vertices, faces, normals, design)


# ---------------------------------------------------------------- paint
class ValueNoise:
    """Smooth periodic noise in [0, 1] from a lattice of random numbers."""

    def __init__(self, rng: np.random.Generator, size: int = 32) -> None:
        self.size = size
        self.lattice = rng.random((size, size, size), dtype=np.float32)

    def __call__(self, points: np.ndarray, frequency: float) -> np.ndarray:
        """Noise [P] at points [P, 3] with `frequency` lattice cells per unit."""
        scaled = points * frequency
        base = np.floor(scaled).astype(np.int64)
        t = (scaled - base).astype(np.float32)
        t = t * t * (3 - 2 * t)
        low, high = base % self.size, (base + 1) % self.size
        total = np.zeros(len(points), np.float32)
        for corner in range(8):
            index, weight = [], np.ones(len(points), np.float32)
            for axis in range(3):
                upper = corner >> axis & 1
                index.append((high if upper else low)[:, axis])
                weight = weight * (t[:, axis] if upper else 1 - t[:, axis])
            total += weight * self.lattice[tuple(index)]
        return total

    def fractal(self, points: np.ndarray, frequency: float, octaves: int) -> np.ndarray:
        """Sum of octaves, each with twice the frequency and 0.7 of the strength, in [0, 1]."""
        strengths = 0.7 ** np.arange(octaves)
        layers = [s * self(points + 7.3 * i, frequency * 2**i) for i, s in enumerate(strengths)]
        return sum(layers) / strengths.sum()


def figurine_materials(design: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Linear albedo [V, 3], metalness [V] and gloss [V] of the bird at points in design units."""
    from scipy.spatial import cKDTree

    parts = _parts(design)
    part = np.argmin(np.stack([distance for distance, _ in parts]), axis=0)
    material = np.array([kind for _, kind in parts])[part]
    noise = ValueNoise(rng)

    # Painted feathers: a mosaic of random cells with grout lines, over several octaves of speckle.
    seeds = rng.uniform(design.min(0), design.max(0), size=(1500, 3))
    distance, cell = cKDTree(seeds).query(design, k=2)
    palette = np.array(
        [[0.62, 0.16, 0.10], [0.80, 0.55, 0.15], [0.12, 0.30, 0.50], [0.75, 0.70, 0.58], [0.10, 0.36, 0.22]]
    )
    albedo = palette[rng.integers(len(palette), size=len(seeds))[cell[:, 0]]]
    albedo = albedo * (0.75 + 0.5 * rng.random(len(seeds))[cell[:, 0], None])
    grout = (distance[:, 1] - distance[:, 0]) < 0.006
    albedo = np.where(grout[:, None], 0.06, albedo)
    speckle = noise.fractal(design, 24.0, 4)
    albedo = albedo * np.clip(0.35 + 1.3 * speckle, 0.2, 1.5)[:, None]

    plain = np.where((part == 1)[:, None], [0.78, 0.34, 0.05], [0.10, 0.22, 0.55])
    albedo = np.where((material == PLAIN)[:, None], plain, albedo)
    metal = np.where((part == 3)[:, None], [0.86, 0.68, 0.38], [0.80, 0.81, 0.84])
    albedo = np.where((material == METAL)[:, None], metal, albedo)
    gloss = np.array([0.15, 0.6, 1.0])[material]
    return np.clip(albedo, 0.02, 0.95), (material == METAL).astype(float), gloss


def make_cloth(rng: np.random.Generator, size: int = 2048) -> np.ndarray:
    """A printed cloth: linear albedo [size, size, 3] with detail at every scale and no repetition."""
    import cv2

    colors = np.array(
        [[0.75, 0.70, 0.60], [0.30, 0.42, 0.48], [0.52, 0.24, 0.18], [0.20, 0.22, 0.26], [0.62, 0.55, 0.30]]
    )
    cloth = np.full((size, size, 3), colors[0], np.float32)
    for radius in np.sort(np.exp(rng.uniform(np.log(3), np.log(90), size=9000)))[::-1]:
        color = tuple(float(c) for c in colors[rng.integers(len(colors))] * rng.uniform(0.6, 1.3))
        center = rng.integers(0, size, 2)
        if rng.random() < 0.4:
            cv2.circle(cloth, center.tolist(), int(radius * 0.6), color, -1, cv2.LINE_AA)
        else:
            corners = center + radius * rng.uniform(-1, 1, size=(int(rng.integers(3, 6)), 2))
            cv2.fillConvexPoly(cloth, cv2.convexHull(corners.astype(np.int32)), color, cv2.LINE_AA)
    weave = rng.normal(1.0, 0.12, size=(size, size, 1)).astype(np.float32)
    return np.clip(cloth * weave, 0.02, 0.9)


# ---------------------------------------------------------------- light
def make_environment(rng: np.random.Generator, height: int = 128) -> np.ndarray:
    """Radiance [height, 2 * height, 3] of the room by direction: sky gradient, two windows, dim furniture."""
    import cv2

    directions = _sphere_directions(height)
    up = directions[..., 2:]
    sky = np.where(up > 0, 0.45 + 0.35 * up, 0.25) * np.array([0.85, 0.95, 1.1])
    environment = np.ascontiguousarray(sky, dtype=np.float32)
    width = 2 * height
    for _ in range(10):  # furniture: darker blocks at the horizon
        x, w = int(rng.integers(width)), int(rng.integers(width // 30, width // 10))
        top = int(height * rng.uniform(0.30, 0.45))
        cv2.rectangle(environment, (x, top), (x + w, int(0.55 * height)), (rng.uniform(0.05, 0.3, 3)).tolist(), -1)
    windows = ((0.10, 0.14, 0.13, 0.20, 9.0), (0.62, 0.20, 0.10, 0.16, 4.0))  # left, top, width, height, radiance
    for left, upper, wide, high, radiance in windows:
        corner = (int(left * width), int(upper * height))
        opposite = (int((left + wide) * width), int((upper + high) * height))
        cv2.rectangle(environment, corner, opposite, (radiance, 0.96 * radiance, 0.88 * radiance), -1)
    return environment


def _sphere_directions(height: int) -> np.ndarray:
    """Unit directions [height, 2 * height, 3] of an equirectangular map's pixels, row 0 at the zenith."""
    polar = (np.arange(height) + 0.5) / height * np.pi
    azimuth = (np.arange(2 * height) + 0.5) / height * np.pi
    z, ring = np.cos(polar)[:, None], np.sin(polar)[:, None]
    z = np.broadcast_to(z, (height, 2 * height))
    return np.stack([ring * np.cos(azimuth), ring * np.sin(azimuth), z], -1)


def _blur_environment(environment: np.ndarray, sigma: float) -> np.ndarray:
    """Gaussian blur in pixels, wrapped around the horizon."""
    import cv2

    pad = environment.shape[1] // 4
    wrapped = np.concatenate([environment[:, -pad:], environment, environment[:, :pad]], 1)
    return cv2.GaussianBlur(wrapped, (0, 0), sigma)[:, pad:-pad]


def _look_up(environment: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Radiance [P, 3] seen in unit directions [P, 3], bilinear."""
    import cv2

    height, width = environment.shape[:2]
    row = np.arccos(np.clip(directions[:, 2], -1, 1)) / np.pi * height - 0.5
    column = np.arctan2(directions[:, 1], directions[:, 0]) % (2 * np.pi) / (2 * np.pi) * width - 0.5
    return _remap(environment, column, row, cv2.BORDER_REPLICATE)


def _remap(image: np.ndarray, x: np.ndarray, y: np.ndarray, border: int) -> np.ndarray:
    """Bilinear samples [P, C] of an image at pixel positions; folded because cv2 limits a side to 32767."""
    import cv2

    count, row_length = len(x), 4096
    padded = -(-count // row_length) * row_length
    maps = []
    for values in (x, y):
        full = np.zeros(padded, np.float32)
        full[:count] = values
        maps.append(full.reshape(-1, row_length))
    return cv2.remap(image, maps[0], maps[1], cv2.INTER_LINEAR, borderMode=border).reshape(padded, -1)[:count]


def _light_samples(environment: np.ndarray, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Directions [count, 3] drawn by brightness; the radiance times solid angle [count, 3] of each."""
    height = environment.shape[0]
    directions = _sphere_directions(height).reshape(-1, 3)
    solid_angle = np.repeat(np.sin((np.arange(height) + 0.5) / height * np.pi), 2 * height) * np.pi**2 / height**2
    power = environment.reshape(-1, 3).mean(1) * solid_angle
    cumulative = np.cumsum(power) / power.sum()
    chosen = np.searchsorted(cumulative, (np.arange(count) + rng.random(count)) / count).clip(0, len(power) - 1)
    probability = power[chosen] / power.sum()
    weights = environment.reshape(-1, 3)[chosen] * (solid_angle[chosen] / probability / count)[:, None]
    return directions[chosen], weights


def _irradiance(
    scene: object, points: np.ndarray, normals: np.ndarray, directions: np.ndarray, weights: np.ndarray
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
        hidden = scene.test_occlusions(o3d.core.Tensor(rays)).numpy()  # type: ignore[attr-defined]
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
        bounds: [2, 3] of the figurine.
    """

    raycaster: object
    faces: np.ndarray
    normals: np.ndarray
    diffuse: np.ndarray
    specular: np.ndarray
    gloss: np.ndarray
    cloth: np.ndarray
    floor: np.ndarray
    sharp: np.ndarray
    soft: np.ndarray
    bounds: np.ndarray


def _subdivide(faces: np.ndarray, attributes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Split every triangle in four; attributes [V, C] of new vertices are the mean of their edge's ends."""
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    unique, inverse = np.unique(edges[:, 0].astype(np.int64) << 32 | edges[:, 1], return_inverse=True)
    ends = np.stack([unique >> 32, unique & 0xFFFFFFFF], 1)
    middle = (len(attributes) + inverse).reshape(3, -1).T.astype(np.int32)
    a, b, c = faces.T
    ab, bc, ca = middle.T
    split = np.concatenate([np.stack(t, 1) for t in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))])
    return split, np.concatenate([attributes, attributes[ends].mean(1)])


def _make_raycaster(vertices: np.ndarray, faces: np.ndarray, threads: int = 0) -> object:
    import open3d as o3d

    scene = o3d.t.geometry.RaycastingScene(nthreads=threads)
    scene.add_triangles(
        o3d.core.Tensor(np.ascontiguousarray(vertices, np.float32)),
        o3d.core.Tensor(np.ascontiguousarray(faces, np.uint32)),
    )
    return scene


def light_scene(figurine: Figurine, seed: int, light_samples: int = 128, cloth_size: int = 2048) -> LitScene:
    """Paint the bird, print the cloth, and bake all light that does not depend on the view."""
    import cv2

    rng = np.random.default_rng(seed)
    environment = make_environment(rng)
    directions, weights = _light_samples(environment, light_samples, rng)
    coarse = _make_raycaster(figurine.vertices, figurine.faces)
    light = _irradiance(coarse, figurine.vertices, figurine.normals, directions, weights)

    faces, attributes = (
        figurine.faces,
        np.hstack([figurine.vertices, figurine.normals, figurine.design, light]),
    )
    for _ in range(2):
        faces, attributes = _subdivide(faces, attributes)
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
        raycaster=_make_raycaster(vertices, faces),
        faces=faces,
        normals=normals.astype(np.float32),
        diffuse=diffuse.astype(np.float32),
        specular=specular.astype(np.float32),
        gloss=gloss.astype(np.float32),
        cloth=cloth.astype(np.float32),
        floor=(0.32 * ground_light[0, 0] / np.pi).astype(np.float32),
        sharp=_blur_environment(environment, 1.0),
        soft=_blur_environment(environment, 8.0),
        bounds=figurine.bounds,
    )


# ---------------------------------------------------------------- pictures
def camera_ring(num_photos: int, rng: np.random.Generator) -> np.ndarray:
    """[N, 4, 4] world-to-camera matrices: three rings of hand-held photographs around the bird."""
    rings = np.array([0.5, 0.33, 0.17]) * num_photos
    counts = np.floor(rings).astype(int)
    counts[0] += num_photos - counts.sum()
    poses = []
    for ring, (count, elevation, distance) in enumerate(zip(counts, (24, 42, 62), (2.45, 2.5, 2.6), strict=True)):
        for i in range(count):
            azimuth = 2 * np.pi * (i + 0.37 * ring + rng.uniform(-0.08, 0.08)) / count
            tilt = np.radians(elevation + rng.uniform(-2.5, 2.5))
            radius = distance + rng.uniform(-0.12, 0.12)
            center = radius * np.array([np.cos(tilt) * np.cos(azimuth), np.cos(tilt) * np.sin(azimuth), np.sin(tilt)])
            target = np.array([0, 0, 0.38]) + rng.uniform(-0.03, 0.03, 3)
            poses.append(_look_at(center, target, roll=np.radians(rng.uniform(-3, 3))))
    return np.array(poses)


def _look_at(center: np.ndarray, target: np.ndarray, roll: float) -> np.ndarray:
    """World-to-camera matrix, OpenCV axes, world up +z."""
    forward = (target - center) / np.linalg.norm(target - center)
    right = np.cross(forward, [0, 0, 1])
    right /= np.linalg.norm(right)
    down = np.cross(forward, right)
    right, down = np.cos(roll) * right + np.sin(roll) * down, np.cos(roll) * down - np.sin(roll) * right
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, down, forward])
    pose[:3, 3] = -pose[:3, :3] @ center
    return pose


def _ground_radiance(scene: LitScene, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Radiance [P, 3] of the cloth, or of the floor beyond it."""
    import cv2

    size = scene.cloth.shape[0]
    column, row = (x / CLOTH_SIDE + 0.5) * size - 0.5, (y / CLOTH_SIDE + 0.5) * size - 0.5
    color = _remap(scene.cloth, column, row, cv2.BORDER_REPLICATE)
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
    hit = scene.raycaster.cast_rays(o3d.core.Tensor(rays))  # type: ignore[attr-defined]
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


def _box_on_screen(bounds: np.ndarray, cam_from_world: np.ndarray, focal: float, width: int, height: int) -> tuple:
    """Columns and rows [x0, x1), [y0, y1) that can show the bird."""
    corners = np.array([[bounds[i, 0], bounds[j, 1], bounds[k, 2]] for i in (0, 1) for j in (0, 1) for k in (0, 1)])
    in_cam = corners @ cam_from_world[:3, :3].T + cam_from_world[:3, 3]
    pixels = focal * in_cam[:, :2] / in_cam[:, 2:] + [width / 2, height / 2]
    low, high = np.floor(pixels.min(0)).astype(int) - 1, np.ceil(pixels.max(0)).astype(int) + 1
    return max(low[0], 0), min(high[0], width), max(low[1], 0), min(high[1], height)


def render(scene: LitScene, cam_from_world: np.ndarray, focal: float, size: tuple[int, int]) -> np.ndarray:
    """Linear radiance [height, width, 3] of one photograph, averaged over 2x2 samples a pixel."""
    width, height = (SUPERSAMPLING * side for side in size)
    focal = SUPERSAMPLING * focal
    rotation = cam_from_world[:3, :3]
    center = -rotation.T @ cam_from_world[:3, 3]
    x, y = np.meshgrid((np.arange(width) + 0.5 - width / 2) / focal, (np.arange(height) + 0.5 - height / 2) / focal)
    directions = np.stack([x, y, np.ones_like(x)], -1) @ rotation
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    flat = directions.reshape(-1, 3)
    image = _surroundings(scene, np.broadcast_to(center, flat.shape), flat, scene.sharp).reshape(height, width, 3)

    x0, x1, y0, y1 = _box_on_screen(scene.bounds, cam_from_world, focal, width, height)
    views = directions[y0:y1, x0:x1].reshape(-1, 3)
    hit, chosen = _cast(scene, np.broadcast_to(center, views.shape), views)
    points = center + hit["t_hit"].numpy()[chosen, None] * views[chosen]
    box = image[y0:y1, x0:x1].reshape(-1, 3)
    box[chosen] = _shade_figurine(scene, hit, chosen, points, views[chosen])
    image[y0:y1, x0:x1] = box.reshape(y1 - y0, x1 - x0, 3)
    shape = (size[1], SUPERSAMPLING, size[0], SUPERSAMPLING, 3)
    return image.reshape(shape).mean((1, 3))


def develop(radiance: np.ndarray, rng: np.random.Generator, exposure: float) -> np.ndarray:
    """8-bit sRGB picture with sensor noise from linear radiance."""
    linear = np.clip(radiance * exposure, 0.0, 1.0)
    srgb = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    noisy = srgb + rng.normal(0, NOISE_SIGMA, srgb.shape)
    return (np.clip(noisy, 0, 1) * 255 + 0.5).astype(np.uint8)


# ---------------------------------------------------------------- files
def photos_are_complete(folder: Path, num_photos: int, size: tuple[int, int], seed: int) -> bool:
    """Whether `make_demo_photos` with the same arguments has finished in `folder` before."""
    try:
        truth = json.loads((folder / TRUTH_CAMERAS).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False
    same = truth.get("made_with") == _recipe(num_photos, size, seed)
    return same and all((folder / frame["file_path"]).is_file() for frame in truth["frames"])


def _recipe(num_photos: int, size: tuple[int, int], seed: int) -> dict[str, object]:
    return {"scene_version": SCENE_VERSION, "num_photos": num_photos, "size": list(size), "seed": seed}


def make_demo_photos(
    folder: Path,
    num_photos: int = 24,
    size: tuple[int, int] = (640, 480),
    seed: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> None:
    """Render the demo's photos and write the truth beside them.

    Writes `photos/000.jpg` ... (with EXIF), `gt_mesh.ply` (z up, rests on z = 0, largest extent 1) and, last,
    `transforms.json` (pinhole intrinsics; per frame `transform_matrix`: camera to world with OpenGL axes, and
    `w2c_opencv`: world to camera with OpenCV axes). Same arguments, same photos.
    """
    import trimesh
    from PIL import Image

    if num_photos < 6:
        raise ValueError(f"the demo needs at least 6 photos, got {num_photos}")
    (folder / PHOTOS).mkdir(parents=True, exist_ok=True)
    (folder / TRUTH_CAMERAS).unlink(missing_ok=True)
    for stale in (folder / PHOTOS).glob("[0-9][0-9][0-9].jpg"):
        stale.unlink()
    figurine = make_figurine()
    scene = light_scene(figurine, seed)
    trimesh.Trimesh(figurine.vertices, figurine.faces, process=False).export(folder / TRUTH_MESH)
    rng = np.random.default_rng(seed + 1)
    focal = FOCAL_35MM / 36 * size[0]
    poses = camera_ring(num_photos, rng)
    exposure = 0.0
    frames = []
    for i, cam_from_world in enumerate(poses):
        radiance = render(scene, cam_from_world, focal, size)
        if i == 0:  # one exposure for all, from the first photo
            exposure = float(0.5 / np.percentile(radiance, 90))
        picture = Image.fromarray(develop(radiance, rng, exposure))
        name = f"{PHOTOS}/{i:03d}.jpg"
        picture.save(folder / name, quality=95, exif=photo_exif(picture, i, "Demo camera", FOCAL_35MM))
        frames.append(
            {
                "file_path": name,
                "transform_matrix": (np.linalg.inv(cam_from_world) @ np.diag([1.0, -1, -1, 1])).tolist(),
                "w2c_opencv": cam_from_world.tolist(),
            }
        )
        if progress is not None:
            progress(i + 1, num_photos)
    truth = {
        "camera_model": "PINHOLE",
        "w": size[0],
        "h": size[1],
        "fl_x": focal,
        "fl_y": focal,
        "cx": size[0] / 2,
        "cy": size[1] / 2,
        "made_with": _recipe(num_photos, size, seed),
        "frames": frames,
    }
    (folder / TRUTH_CAMERAS).write_text(json.dumps(truth, indent=1) + "\n", encoding="utf-8")


def photo_exif(picture: object, index: int, model: str, focal_35mm: int) -> object:
    """What a camera would note: maker, model, time, and the focal length SfM starts from (35 mm equivalent)."""
    from PIL import ExifTags

    exif = picture.getexif()  # type: ignore[attr-defined]
    taken = datetime(2025, 6, 1, 12, 0, 0) + timedelta(seconds=5 * index)
    exif[ExifTags.Base.Make] = "HiNeuS"
    exif[ExifTags.Base.Model] = model
    exif[ExifTags.Base.DateTime] = taken.strftime("%Y:%m:%d %H:%M:%S")
    details = exif.get_ifd(ExifTags.IFD.Exif)
    details[ExifTags.Base.FocalLength] = float(focal_35mm)
    details[ExifTags.Base.FocalLengthIn35mmFilm] = focal_35mm
    return exif
