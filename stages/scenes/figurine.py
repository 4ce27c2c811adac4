"""The demo's object: a bird with painted, plain and polished parts, so that the demo shows what the pipeline is for.

Frame: z up, it rests on z = 0, its largest extent is 1.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stages.scenes.implicit import differences, ellipsoid, march, tube, union
from stages.scenes.noise import ValueNoise

MESH_CELL = 1.0 / 110.0  # of the figurine's design units; shading detail comes from two subdivisions
STEP = 1e-3  # of the gradient

PAINT, PLAIN, METAL = 0, 1, 2


# ---------------------------------------------------------------- shape
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


def _parts(points: np.ndarray) -> list[tuple[np.ndarray, int]]:
    """Implicit distance and material of each part, [P] each, in design units."""
    ripples = 0.006 * np.sin(19 * points[:, 0]) * np.sin(17 * points[:, 1] + 1.0) * np.sin(18 * points[:, 2] + 2.0)
    body = ellipsoid(points, (0.0, 0.0, 0.37), (0.37, 0.27, 0.27)) + ripples
    head = ellipsoid(points, (0.27, 0.03, 0.70), (0.165, 0.155, 0.16))
    tail = tube(points, [(-0.28, 0.0, 0.42), (-0.50, -0.05, 0.64)], (0.11, 0.045))
    painted = union(union(body, head, width=0.16), tail, width=0.10)
    beak = tube(points, [(0.40, 0.04, 0.68), (0.54, 0.06, 0.63)], (0.060, 0.022))
    handle = _ring(points, (-0.03, 0.27, 0.40), 0.135, 0.036)
    foot = _rounded_disc(points, (0.02, 0.0, 0.07), 0.21, 0.07, 0.03)
    cap = ellipsoid(points, (0.25, 0.03, 0.855), (0.085, 0.085, 0.075))
    return [(painted, PAINT), (beak, PLAIN), (handle, PLAIN), (foot, METAL), (cap, METAL)]


def figurine_distance(points: np.ndarray) -> np.ndarray:
    """Implicit function [P] of the whole bird at points [P, 3]: positive outside, roughly the distance."""
    return union(*(distance for distance, _ in _parts(points)), width=0.05)


def _gradient(points: np.ndarray) -> np.ndarray:
    """Of `figurine_distance`, [P, 3]."""
    return differences(figurine_distance, points, STEP) / (2 * STEP)


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


def make_figurine(cell: float = MESH_CELL) -> Figurine:
    """Mesh the bird with grid cells of `cell` design units, polished by two Newton steps."""
    low, high = np.array([-0.62, -0.36, -0.06]), np.array([0.64, 0.52, 1.0])
    counts = np.ceil((high - low) / cell).astype(int) + 1
    design, faces = march(figurine_distance, [low[i] + cell * np.arange(counts[i]) for i in range(3)], cell)
    for _ in range(2):
        gradient = _gradient(design)
        length2 = np.maximum((gradient**2).sum(1), 1e-6)
        design -= (figurine_distance(design) / length2)[:, None] * gradient
    normals = _gradient(design)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    lowest, highest = design.min(0), design.max(0)
    center = np.array([*(lowest + highest)[:2] / 2, lowest[2]])
    vertices = (design - center) / (highest - lowest).max()
    return Figurine(vertices, faces, normals, design)


# ---------------------------------------------------------------- paint
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
