"""Six objects, each of one kind of material or of several. Each comes in rough units; `scenes.py` makes it 1 large."""

from __future__ import annotations

import numpy as np

from benchmarks.synthetic import objects
from benchmarks.synthetic.model import Paint, Part, Principled, plain
from benchmarks.synthetic.shapes import cylinder, mesh_of
from stages.scenes.implicit import ellipsoid, union
from stages.scenes.noise import ValueNoise

PLASTER, PAINT = Principled(1.0, 0.0), Principled(0.8, 0.0)
PLASTIC = Principled(0.2, 0.0)
POLISHED, ROUGH_METAL = Principled(0.15, 1.0), Principled(0.45, 1.0)
HANDLE_GAP = 0.05  # from the middle of the jug's wall to what is the handle's
STEEL, COPPER, GOLD = (0.66, 0.64, 0.61), (0.93, 0.60, 0.48), (0.95, 0.74, 0.36)


def plaster_bracket(rng: np.random.Generator) -> list[Part]:
    """A machine part with bores, a slot and ribs, of one diffuse colour."""
    return [_of(part, PLASTER, plain(0.66, 0.52, 0.40)) for part in objects.bracket(rng)]


def painted_bird(rng: np.random.Generator) -> list[Part]:
    """The demo's bird, matte, in patches of many colours."""
    return [_of(part, PAINT, patches(rng, part.vertices)) for part in objects.metal_bird(rng)]


def polished_dog(rng: np.random.Generator) -> list[Part]:
    """A dog of balloons, of polished steel."""
    return [_of(part, POLISHED, plain(*STEEL)) for part in objects.balloon_dog(rng)]


def copper_knot(rng: np.random.Generator) -> list[Part]:
    """A trefoil of a thick tube, of rough copper."""
    from scipy.spatial import cKDTree

    turn = np.linspace(0, 2 * np.pi, 4000)
    ring = 2 + np.cos(3 * turn)
    line = cKDTree(np.stack([ring * np.cos(2 * turn), ring * np.sin(2 * turn), 1.25 * np.sin(3 * turn)], 1) / 6)

    def shape(points: np.ndarray) -> np.ndarray:
        return line.query(points)[0] - 0.125

    vertices, faces, normals = mesh_of(shape, (-0.66, -0.66, -0.36), (0.66, 0.66, 0.36), 1.2 * objects.CELL)
    return [Part(vertices, faces, ROUGH_METAL, plain(*COPPER), normals)]


def plastic_jug(rng: np.random.Generator) -> list[Part]:
    """A jug of shiny plastic: red with bands of two more colours."""

    def paint(points: np.ndarray, normals: np.ndarray) -> np.ndarray:
        height, radius = points[:, 2], np.hypot(points[:, 0], points[:, 1])
        colors = np.where((height > 0.55)[:, None], [0.80, 0.62, 0.10], [0.60, 0.06, 0.05])
        colors = np.where((height < 0.16)[:, None], [0.05, 0.20, 0.42], colors)
        handle = (points[:, 0] > 0) & (radius > objects.jug_radius(height) + HANDLE_GAP) & (height > 0.16)
        return np.where(handle[:, None], [0.06, 0.06, 0.07], colors)

    return [_of(part, PLASTIC, paint) for part in objects.jug(rng)]


def mixed_lantern(rng: np.random.Generator) -> list[Part]:
    """A painted belly between a gold ring and a foot of rough steel, with a plastic dome and knobs."""
    heights = ("belly", "foot", "ring", "dome", "knobs")
    materials = {
        "belly": PAINT, "foot": ROUGH_METAL, "ring": Principled(0.25, 1.0), "dome": PLASTIC, "knobs": PLASTIC,
    }  # fmt: skip

    def pieces(points: np.ndarray) -> list[np.ndarray]:
        x, y, z = points.T
        ring = np.hypot(np.hypot(x, y) - 0.30, z - 0.62) - 0.062
        foot = union(
            cylinder(points, (0, 0, 0.05), 2, 0.27, 0.10), cylinder(points, (0, 0, 0.14), 2, 0.16, 0.14), width=0.08
        )
        knobs = [
            ellipsoid(points, (0.36 * np.cos(a), 0.36 * np.sin(a), 0.40), (0.085, 0.085, 0.085))
            for a in np.arange(5) * 2 * np.pi / 5
        ]
        return [
            ellipsoid(points, (0, 0, 0.40), (0.36, 0.36, 0.24)),
            foot,
            ring,
            ellipsoid(points, (0, 0, 0.66), (0.25, 0.25, 0.26)),
            union(*knobs),
        ]

    def shape(points: np.ndarray) -> np.ndarray:
        return union(*pieces(points), width=0.015)

    vertices, faces, normals = mesh_of(shape, (-0.5, -0.5, -0.05), (0.5, 0.5, 1.0), objects.CELL)
    nearest = np.argmin(pieces(vertices[faces].mean(1)), axis=0)
    paints: dict[str, Paint] = {
        "belly": patches(rng, vertices), "foot": plain(*STEEL), "ring": plain(*GOLD),
        "dome": plain(0.05, 0.30, 0.16), "knobs": plain(0.70, 0.70, 0.66),
    }  # fmt: skip
    parts = []
    for k, name in enumerate(heights):
        used, corners = np.unique(faces[nearest == k], return_inverse=True)
        parts.append(Part(vertices[used], corners.reshape(-1, 3), materials[name], paints[name], normals[used]))
    return parts


def patches(rng: np.random.Generator, around: np.ndarray) -> Paint:
    """Patches of many colours, each mottled a little, in the box of the points `around`."""
    from scipy.spatial import cKDTree

    seeds = rng.uniform(around.min(0), around.max(0), size=(220, 3))
    colors = np.array(objects.MOSAIC)[rng.integers(len(objects.MOSAIC), size=len(seeds))]
    tree, noise = cKDTree(seeds), ValueNoise(rng)

    def paint(points: np.ndarray, normals: np.ndarray) -> np.ndarray:
        albedo = colors[tree.query(points)[1]]
        return np.clip(albedo * (0.65 + 0.7 * noise.fractal(points, 20.0, 3))[:, None], 0.02, 0.9)

    return paint


def _of(part: Part, finish: Principled, paint: Paint) -> Part:
    """The same shape of another material."""
    return Part(part.vertices, part.faces, finish, paint, part.normals, part.grain)
