"""The things that captures are made of: blocks, lumps, rods, reliefs, and the places they stand in."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from benchmarks.captures.model import Thing
from stages.geometry.normalisation import perpendicular, rotation_onto
from stages.scenes.noise import ValueNoise

Vector = Sequence[float] | np.ndarray
UP = np.array([0, 0, 1.0])
WOOD, STONE, PLASTER, FUR = (0.35, 0.22, 0.12), (0.45, 0.43, 0.40), (0.75, 0.73, 0.70), (0.22, 0.14, 0.08)
GREEN, BRICK, CLOTH, METAL = (0.12, 0.28, 0.08), (0.45, 0.18, 0.12), (0.55, 0.45, 0.30), (0.6, 0.6, 0.62)


def block(center: Vector, sides: Vector, texture: float, color: tuple[float, float, float] = WOOD) -> Thing:
    """A box with sides along the axes."""
    import trimesh

    box = trimesh.creation.box(extents=sides)
    return Thing(box.vertices + np.array(center), np.asarray(box.faces), texture, color)


def lump(
    center: Vector,
    sides: Vector,
    texture: float,
    color: tuple[float, float, float] = STONE,
    rng: np.random.Generator | None = None,
    roughness: float = 0.15,
) -> Thing:
    """An ellipsoid with these extents; with `rng`, bumps in and out of it by `roughness` of its radii at most."""
    import trimesh

    sphere = trimesh.creation.icosphere(subdivisions=4)
    directions = np.asarray(sphere.vertices)
    scale = np.ones((len(directions), 1))
    if rng is not None:
        scale += roughness * (2 * ValueNoise(rng).fractal(directions + 5, 1.7, 3)[:, None] - 1)
    return Thing(np.array(center) + directions * scale * np.array(sides) / 2, np.asarray(sphere.faces), texture, color)


def rod(
    begin: Vector,
    end: Vector,
    radius: float,
    texture: float,
    color: tuple[float, float, float] = WOOD,
    taper: float = 1.0,
) -> Thing:
    """A closed cylinder between two points; `taper` times as thick at its end."""
    import trimesh

    begin, end = np.array(begin, dtype=float), np.array(end, dtype=float)
    length = float(np.linalg.norm(end - begin))
    cylinder = trimesh.creation.cylinder(radius=radius, height=length, sections=32)
    vertices = np.array(cylinder.vertices)
    along = vertices[:, 2:] / length + 0.5
    vertices[:, :2] *= 1 + (taper - 1) * along
    turned = (vertices + UP * length / 2) @ rotation_onto(UP, (end - begin) / length).T
    return Thing(turned + begin, np.asarray(cylinder.faces), texture, color)


def tube(
    begin: Vector, height: float, radius: float, wall: float, texture: float, rng: np.random.Generator,
    open_deg: float = 0.0,
) -> Thing:  # fmt: skip
    """An upright hollow trunk: bark outside, a rough edge above, open over `open_deg` towards -y."""
    around = np.radians(np.linspace(open_deg / 2, 360 - open_deg / 2, 72) - 90)
    noise = ValueNoise(rng)
    ring = np.stack([np.cos(around), np.sin(around), np.zeros_like(around)], 1)
    top = height * (1 + 0.25 * (noise.fractal(2 * ring + 7, 1.0, 2) - 0.5))
    levels = np.linspace(0, 1, 40)
    rows = []
    for level in levels:
        bark = (
            radius * (1 + 0.25 * np.exp(-6 * level)) * (1 + 0.12 * (noise.fractal(2 * ring + 3 * level, 1.5, 3) - 0.5))
        )
        rows.append(ring * bark[:, None] + UP * (level * top)[:, None])
    inner = [row - ring * wall for row in rows[::-1]]
    vertices, faces = _woven(np.stack(rows + inner))
    return Thing(vertices + np.array(begin), faces, texture, WOOD)


def sheet(
    center: Vector,
    normal: Vector,
    sides: tuple[float, float],
    texture: float,
    color: tuple[float, float, float] = PLASTER,
    rng: np.random.Generator | None = None,
    depth: float = 0.0,
    frequency: float = 3.0,
) -> Thing:
    """A rectangle that faces `normal`: `sides` across and up; with `rng`, a relief that stands out up to `depth`.

    Args:
        frequency: bumps of the relief along the shorter side.
    """
    facing = np.array(normal, dtype=float) / np.linalg.norm(normal)
    across = np.cross(UP, facing) if abs(facing[2]) < 0.99 else perpendicular(facing)
    across /= np.linalg.norm(across)
    up = np.cross(facing, across)
    counts = [2, 2] if rng is None else [max(round(120 * side / max(sides)), 8) for side in sides]
    u, v = np.meshgrid(*(np.linspace(-0.5, 0.5, count) for count in counts), indexing="ij")
    vertices = u[..., None] * sides[0] * across + v[..., None] * sides[1] * up
    if rng is not None:
        bumps = ValueNoise(rng).fractal(vertices.reshape(-1, 3) + 50, frequency / min(sides), 3).reshape(u.shape)
        rim = np.clip(8 * (0.5 - np.maximum(abs(u), abs(v))), 0, 1)  # the relief ends in its wall
        vertices += (depth * rim * np.clip(1.6 * bumps - 0.3, 0, 1))[..., None] * facing
    vertices, faces = _woven(vertices)
    return Thing(vertices + np.array(center), faces, texture, color)


def room(center: Vector, sides: Vector, walls: float, floor: float) -> tuple[Thing, ...]:
    """Floor and four walls, seen from within; `center` on the floor; textures of walls and floor.

    The ceiling is open: it would be plain, and light comes in there.
    """
    x, y, z = center
    wide, deep, high = sides
    return (
        flat(center, wide, deep, floor, WOOD),
        sheet((x - wide / 2, y, z + high / 2), (1, 0, 0), (deep, high), walls),
        sheet((x + wide / 2, y, z + high / 2), (-1, 0, 0), (deep, high), walls),
        sheet((x, y - deep / 2, z + high / 2), (0, 1, 0), (wide, high), walls),
        sheet((x, y + deep / 2, z + high / 2), (0, -1, 0), (wide, high), walls),
    )


def flat(center: Vector, wide: float, deep: float, texture: float, color: tuple[float, float, float] = WOOD) -> Thing:
    """A level rectangle."""
    corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * np.array([wide, deep, 0]) / 2
    return Thing(corners + np.array(center), np.array([[0, 1, 2], [0, 2, 3]]), texture, color)


def ground(side: float, texture: float, color: tuple[float, float, float] = STONE) -> Thing:
    """A level square."""
    return flat((0, 0, 0), side, side, texture, color)


def wood(rng: np.random.Generator, count: int, near: float, far: float) -> tuple[Thing, ...]:
    """Leaf-strewn ground and trunks between two distances from the origin."""
    angles, distances = rng.uniform(0, 2 * np.pi, count), rng.uniform(near, far, count)
    feet = np.stack([distances * np.cos(angles), distances * np.sin(angles), np.zeros(count)], 1)
    trunks = (rod(foot, foot + 8 * UP, rng.uniform(0.1, 0.3), 0.7, WOOD, 0.6) for foot in feet)
    return (ground(3 * far, 0.8, GREEN), *trunks)


def clutter(
    rng: np.random.Generator, count: int, low: Vector, high: Vector, sides: tuple[float, float], texture: float = 0.8
) -> tuple[Thing, ...]:
    """Boxes and balls of random sizes that stand on z = low[2], at random places between two corners."""
    things = []
    for k in range(count):
        extent = rng.uniform(*sides, 3)
        place = rng.uniform(low, high) * [1, 1, 0] + [0, 0, low[2] + extent[2] / 2]
        color = tuple(rng.uniform(0.1, 0.7, 3))
        things.append(block(place, extent, texture, color) if k % 2 else lump(place, extent, texture, color))
    return tuple(things)


def figure(
    foot: Vector, height: float, texture: float, rng: np.random.Generator, color: tuple[float, float, float] = STONE
) -> tuple[Thing, ...]:
    """A standing figure on a plinth: legs, robe, arms, head; about 0.4 of its height wide."""
    x, y, z = foot
    h = height

    def at(across: float, up: float, out: float = 0.0) -> tuple[float, float, float]:
        return (x + across * h, y + out * h, z + up * h)

    return (
        block(at(0, 0.06), (0.32 * h, 0.32 * h, 0.12 * h), texture, color),
        lump(at(0, 0.34), (0.28 * h, 0.24 * h, 0.5 * h), texture, color, rng),
        lump(at(0, 0.64), (0.30 * h, 0.2 * h, 0.32 * h), texture, color, rng),
        lump(at(0, 0.89), (0.15 * h, 0.18 * h, 0.22 * h), texture, color, rng),
        rod(at(0.14, 0.72), at(0.22, 0.5, -0.12), 0.035 * h, texture, color),
        rod(at(-0.14, 0.72), at(-0.19, 0.88, -0.08), 0.035 * h, texture, color),
    )


def _woven(grid: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and faces of a grid [A, B, 3] of points."""
    a, b = grid.shape[:2]
    index = np.arange(a * b).reshape(a, b)
    corner, right, above, across = index[:-1, :-1], index[1:, :-1], index[:-1, 1:], index[1:, 1:]
    faces = np.concatenate([np.stack([corner, right, across], -1), np.stack([corner, across, above], -1)])
    return grid.reshape(-1, 3), faces.reshape(-1, 3)
