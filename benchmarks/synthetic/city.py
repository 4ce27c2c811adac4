"""A made-up city block: houses, towers, courtyards, a church, trees and cars on a street grid. 1 unit is `METRES`.

Boxes are split into small faces before they are painted, so that windows can be painted at their vertices.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from benchmarks.synthetic.model import Paint, Part, plain
from stages.scenes.noise import ValueNoise

METRES = 200.0
STREET = 0.05  # wide
LOTS = (4, 3)
FLOOR = 0.017  # height of a storey
WINDOW = 0.014  # from one window to the next
FINEST = 0.003  # longest edge of a painted face; half of the faces' edges are half as long, about a pixel
CAR_COLORS = ((0.5, 0.05, 0.04), (0.7, 0.7, 0.7), (0.05, 0.08, 0.25), (0.04, 0.04, 0.04), (0.5, 0.45, 0.1))
GLASS = (0.06, 0.07, 0.09)

BOX_FACES = np.array([[0, 2, 1], [0, 3, 2], [4, 5, 6], [4, 6, 7], [0, 1, 5], [0, 5, 4],
                      [1, 2, 6], [1, 6, 5], [2, 3, 7], [2, 7, 6], [3, 0, 4], [3, 4, 7]])  # fmt: skip


def city_block(rng: np.random.Generator) -> list[Part]:
    """All parts; the ground of the block, a square of side 1 at z = 0, is the first."""
    noise = ValueNoise(rng)
    parts = [Part(*_pavement(), "matte", _streets(noise), grain=FINEST)]
    kinds = ["row", "tower", "court", "church", "park", "row", "flat", "court", "tower", "park", "flat", "row"]
    centers = [(i, j) for j in range(LOTS[1]) for i in range(LOTS[0])]
    for kind, (i, j) in zip(kinds, centers, strict=True):
        low = np.array([i / LOTS[0], j / LOTS[1]]) - 0.5 + STREET / 2
        high = np.array([(i + 1) / LOTS[0], (j + 1) / LOTS[1]]) - 0.5 - STREET / 2
        parts += KINDS[kind](low, high, rng, noise)
    for _ in range(26):
        parts += _car(rng)
    return parts


# ---------------------------------------------------------------- what stands on a lot
def _row(low: np.ndarray, high: np.ndarray, rng: np.random.Generator, noise: ValueNoise) -> list[Part]:
    """Six houses with gables in two rows, and gardens between."""
    parts = []
    width = (high[0] - low[0]) / 3
    for i in range(3):
        for y in (low[1] + 0.02, high[1] - 0.095):
            corner = np.array([low[0] + i * width + rng.uniform(0.004, 0.012), y + rng.uniform(-0.008, 0.008)])
            size = np.array([width - 0.018, rng.uniform(0.065, 0.075)])
            height = FLOOR * rng.integers(2, 4) + 0.006
            parts += _house(corner, size, height, rng.uniform(0.025, 0.04), rng, noise)
    for _ in range(4):
        x, _ = rng.uniform(low + 0.03, high - 0.03)
        parts.append(_tree(np.array([x, (low[1] + high[1]) / 2]), rng, noise))
    return parts


def _house(
    corner: np.ndarray, size: np.ndarray, height: float, roof: float, rng: np.random.Generator, noise: ValueNoise
) -> list[Part]:  # fmt: skip
    (x0, y0), (x1, y1) = corner, corner + size
    eave, middle = 0.006, (y0 + y1) / 2
    ring = ((x0 - eave, y0 - eave), (x1 + eave, y0 - eave), (x1 + eave, y1 + eave), (x0 - eave, y1 + eave))
    base = [(*corner, height) for corner in ring] + [(x, middle, height + roof) for x in (x0 - eave, x1 + eave)]
    sides = [[0, 2, 1], [0, 3, 2], [0, 1, 5], [0, 5, 4], [2, 3, 4], [2, 4, 5], [1, 2, 5], [3, 0, 4]]
    x = rng.uniform(x0 + 0.01, x1 - 0.02)
    chimney = (x, middle + 0.008, height), (x + 0.009, middle + 0.017, height + roof + 0.012)
    tiles = _tiles(rng.uniform(0.7, 1.2) * np.array([0.42, 0.17, 0.10]), noise)
    return [
        _block((x0, y0, 0), (x1, y1, height), _facade(rng, noise)),
        Part(np.array(base), np.array(sides), "matte", tiles, grain=FINEST),
        _block(*chimney, _speckled((0.3, 0.16, 0.12), noise)),
    ]


def _flat(low: np.ndarray, high: np.ndarray, rng: np.random.Generator, noise: ValueNoise) -> list[Part]:
    """An office block with a parapet and machines on its roof, a lower hall beside it."""
    split = low[0] + 0.5 * (high[0] - low[0])
    parts = []
    for (x0, x1), floors in (((low[0] + 0.01, split), rng.integers(5, 8)), ((split + 0.02, high[0] - 0.01), 3)):
        parts += _with_parapet((x0, low[1] + 0.02), (x1, high[1] - 0.03), floors * FLOOR, rng, noise)
    return parts


def _with_parapet(low: tuple, high: tuple, height: float, rng: np.random.Generator, noise: ValueNoise) -> list[Part]:
    wall, rim = 0.006, 0.012
    facade, gravel = _facade(rng, noise), _speckled((0.42, 0.41, 0.38), noise)
    steel = _speckled((0.5, 0.52, 0.55), noise)
    parts = [_block((*low, 0), (*high, height), facade)]
    edges = [((low[0], low[1]), (high[0], low[1] + wall)), ((low[0], high[1] - wall), (high[0], high[1])),
             ((low[0], low[1] + wall), (low[0] + wall, high[1] - wall)),
             ((high[0] - wall, low[1] + wall), (high[0], high[1] - wall))]  # fmt: skip
    parts += [_block((*a, height), (*b, height + rim), gravel) for a, b in edges]
    for _ in range(4):
        corner = rng.uniform(np.array(low) + 0.01, np.array(high) - 0.035)
        size = [*rng.uniform(0.012, 0.024, 2), rng.uniform(0.008, 0.02)]
        parts.append(_block((*corner, height), (*(corner + size[:2]), height + size[2]), steel))
    return parts


def _court(low: np.ndarray, high: np.ndarray, rng: np.random.Generator, noise: ValueNoise) -> list[Part]:
    """Four wings around a yard with trees, one with a gateway."""
    depth, height = 0.055, FLOOR * rng.integers(3, 6)
    (x0, y0), (x1, y1) = low + 0.012, high - 0.012
    gate = (x0 + x1) / 2
    facade, top = _facade(rng, noise), height + 0.003
    wings = [((x0, y0, 0), (gate - 0.014, y0 + depth, top)), ((gate + 0.014, y0, 0), (x1, y0 + depth, top)),
             ((gate - 0.014, y0, 1.6 * FLOOR), (gate + 0.014, y0 + depth, top)),
             ((x0, y1 - depth, 0), (x1, y1, height)), ((x0, y0 + depth, 0), (x0 + depth, y1 - depth, height)),
             ((x1 - depth, y0 + depth, 0), (x1, y1 - depth, height))]  # fmt: skip
    parts = [_block(a, b, facade) for a, b in wings]
    yard = np.array([[x0, y0], [x1, y1]]) + [[depth + 0.02], [-depth - 0.02]]
    return parts + [_tree(rng.uniform(*yard), rng, noise) for _ in range(2)]


def _tower(low: np.ndarray, high: np.ndarray, rng: np.random.Generator, noise: ValueNoise) -> list[Part]:
    """A tower that steps back twice, on a podium."""
    center = (low + high) / 2 + rng.uniform(-0.01, 0.01, 2)
    facade = _facade(rng, noise)
    levels = ((0.085, 0.10, 0.0, 2), (0.06, 0.07, 2, 7), (0.045, 0.05, 7, 11), (0.018, 0.018, 11, 13))
    return [
        _block((*(center - (a, b)), start * FLOOR), (*(center + (a, b)), end * FLOOR), facade)
        for a, b, start, end in levels
    ]


def _church(low: np.ndarray, high: np.ndarray, rng: np.random.Generator, noise: ValueNoise) -> list[Part]:
    """A nave with a steep roof, a tower with a spire, trees around."""
    middle = (low[1] + high[1]) / 2
    parts = _house(np.array([low[0] + 0.07, middle - 0.035]), np.array([0.11, 0.07]), 0.06, 0.06, rng, noise)
    stone = _speckled((0.45, 0.40, 0.32), noise)
    x0, x1, y0, y1 = low[0] + 0.03, low[0] + 0.074, middle - 0.022, middle + 0.022
    parts.append(_block((x0, y0, 0), (x1, y1, 0.15), stone))
    slate, eave = _tiles(np.array([0.16, 0.24, 0.22]), noise), 0.002
    parts.append(_pyramid((x0 - eave, y0 - eave), (x1 + eave, y1 + eave), 0.15, 0.26, slate))
    corners = [(low[0] + 0.02, low[1] + 0.03), (high[0] - 0.02, low[1] + 0.03), (high[0] - 0.03, high[1] - 0.03)]
    return parts + [_tree(np.array(corner), rng, noise) for corner in corners]


def _park(low: np.ndarray, high: np.ndarray, rng: np.random.Generator, noise: ValueNoise) -> list[Part]:
    """Trees, and a pavilion on posts."""
    center = (low + high) / 2
    wood, tiles = _speckled((0.5, 0.45, 0.4), noise), _tiles(np.array([0.38, 0.2, 0.1]), noise)
    feet = [center + [a, b] for a in (-0.035, 0.027) for b in (-0.035, 0.027)]
    parts = [_block((*foot, 0), (*(foot + 0.008), 0.035), wood) for foot in feet]
    parts.append(_pyramid(center - 0.045, center + 0.045, 0.035, 0.065, tiles))
    places = []
    while len(places) < 11:
        place = rng.uniform(low + 0.015, high - 0.015)
        if np.abs(place - center).max() > 0.06 and all(np.linalg.norm(place - other) > 0.03 for other in places):
            places.append(place)
    return parts + [_tree(place, rng, noise) for place in places]


KINDS = {"row": _row, "tower": _tower, "court": _court, "church": _church, "park": _park, "flat": _flat}


def _tree(place: np.ndarray, rng: np.random.Generator, noise: ValueNoise) -> Part:
    """A lumpy crown that hangs down to the ground."""
    from trimesh.creation import icosphere

    ball = icosphere(subdivisions=4)
    unit = np.asarray(ball.vertices)
    radius, tall = rng.uniform(0.014, 0.024), rng.uniform(1.1, 1.7)
    lumps = 0.75 + 0.5 * noise.fractal(unit + 10 * rng.random(3), 3.0, 3)
    crown = unit * lumps[:, None] * radius * [1, 1, tall]
    crown[:, 2] += 0.9 * radius * tall
    crown[:, 2] = np.maximum(crown[:, 2], 0.0)
    tint = rng.uniform(0.7, 1.4) * np.array([0.10, 0.20, 0.05])
    return Part(crown + [*place, 0], np.asarray(ball.faces), "matte", _speckled(tint, noise, 400.0))


def _car(rng: np.random.Generator) -> list[Part]:
    """A car that is parked or drives along a street."""
    color = CAR_COLORS[rng.integers(len(CAR_COLORS))]
    along, across = rng.uniform(-0.47, 0.47), rng.choice((-0.011, 0.011))
    axis = 0 if rng.random() < 0.5 else 1  # that of the street
    lanes = LOTS[1 - axis]
    line = rng.integers(1, lanes) / lanes - 0.5 + across
    body = np.array([[along, line - 0.0045, 0], [along + 0.022, line + 0.0045, 0.0045]])
    cabin = np.array([[along + 0.005, line - 0.004, 0.0045], [along + 0.017, line + 0.004, 0.0075]])
    turned = [axis, 1 - axis, 2]
    return [
        Part(*_box(*(corner[turned] for corner in shape)), "glossy", plain(*tint))
        for shape, tint in ((body, color), (cabin, GLASS))
    ]


# ---------------------------------------------------------------- shapes
def _box(low: Sequence[float], high: Sequence[float]) -> tuple[np.ndarray, np.ndarray]:
    (x0, y0, z0), (x1, y1, z1) = low, high
    bottom, top = [[(x, y, z) for x, y in ((x0, y0), (x1, y0), (x1, y1), (x0, y1))] for z in (z0, z1)]
    return np.array(bottom + top, float), BOX_FACES


def _block(low: Sequence[float], high: Sequence[float], paint: Paint) -> Part:
    """A painted box between two corners."""
    return Part(*_box(low, high), "matte", paint, grain=FINEST)


def _pyramid(low: Sequence[float], high: Sequence[float], bottom: float, top: float, paint: Paint) -> Part:
    """A roof over the rectangle from `low` to `high`, from height `bottom` to `top`."""
    (x0, y0), (x1, y1) = low, high
    corners = [
        (x0, y0, bottom),
        (x1, y0, bottom),
        (x1, y1, bottom),
        (x0, y1, bottom),
        ((x0 + x1) / 2, (y0 + y1) / 2, top),
    ]
    sides = np.array([[0, 2, 1], [0, 3, 2], [0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]])
    return Part(np.array(corners), sides, "matte", paint, grain=FINEST)


def _pavement() -> tuple[np.ndarray, np.ndarray]:
    corners = np.array([[-0.5, -0.5, 0], [0.5, -0.5, 0], [0.5, 0.5, 0], [-0.5, 0.5, 0]])
    return corners, np.array([[0, 1, 2], [0, 2, 3]])


# ---------------------------------------------------------------- paint
def _speckled(color: np.ndarray | tuple, noise: ValueNoise, frequency: float = 150.0) -> Paint:
    def paint(points: np.ndarray, normals: np.ndarray) -> np.ndarray:
        return np.clip(np.array(color) * (0.45 + 1.1 * noise.fractal(points, frequency, 2))[:, None], 0.01, 0.9)

    return paint


def _tiles(color: np.ndarray, noise: ValueNoise) -> Paint:
    """Rows of tiles along the slope, each tile a little different."""

    def paint(points: np.ndarray, normals: np.ndarray) -> np.ndarray:
        row = np.floor(points[:, 2] / 0.005)
        tint = 0.75 + 0.5 * noise(np.stack([points[:, 0] * 160, points[:, 1] * 160, row * 3.1], 1), 1.0)
        stain = 0.6 + 0.8 * noise.fractal(points, 60.0, 2)
        return np.clip(color * (tint * stain)[:, None], 0.01, 0.9)

    return paint


def _facade(rng: np.random.Generator, noise: ValueNoise) -> Paint:
    """Rows of windows in a wall of one tint with stains; the top is a roof of gravel and felt."""
    tint = (
        rng.uniform(0.5, 1.0)
        * np.array([[0.70, 0.62, 0.50], [0.55, 0.50, 0.48], [0.62, 0.40, 0.30], [0.5, 0.55, 0.6]])[rng.integers(4)]
    )
    ribbon = rng.random() < 0.4
    salt = rng.uniform(0, 100)

    def paint(points: np.ndarray, normals: np.ndarray) -> np.ndarray:
        along = np.where(np.abs(normals[:, 0]) > np.abs(normals[:, 1]), points[:, 1], points[:, 0])
        column, floor = np.floor(along / WINDOW), np.floor(points[:, 2] / FLOOR)
        u, v = along / WINDOW - column, points[:, 2] / FLOOR - floor
        window = (v > 0.3) & (v < 0.8) & (ribbon | ((u > 0.25) & (u < 0.75)))
        pane = noise(np.stack([column * 1.7, floor * 2.3, np.full(len(along), salt)], 1), 1.0)
        wall = tint * (0.55 + 0.9 * noise.fractal(points, 70.0, 3))[:, None]
        glass = np.array([0.10, 0.13, 0.17]) * (0.4 + 2.4 * pane)[:, None]
        roof = np.array([0.33, 0.31, 0.29]) * (0.4 + 1.2 * noise.fractal(points, 90.0, 3))[:, None]
        side = np.where(window[:, None], glass, wall)
        return np.clip(np.where(normals[:, 2:] > 0.5, roof, side), 0.01, 0.9)

    return paint


def _streets(noise: ValueNoise) -> Paint:
    """Asphalt with lines along the grid, pavements beside it, grass and gravel on the lots."""

    def paint(points: np.ndarray, normals: np.ndarray) -> np.ndarray:
        away = [
            np.abs((points[:, i] + 0.5) * LOTS[i] - np.round((points[:, i] + 0.5) * LOTS[i])) / LOTS[i] for i in (0, 1)
        ]
        nearest = np.minimum(*away)
        along = np.where(away[0] < away[1], points[:, 1], points[:, 0])
        grain = noise.fractal(points, 120.0, 3)[:, None]
        grass = noise.fractal(points + 3.0, 18.0, 3)[:, None] > 0.5
        lot = np.where(grass, [0.13, 0.22, 0.07], [0.36, 0.32, 0.26]) * (0.3 + 1.4 * grain)
        asphalt = np.array([0.16, 0.16, 0.17]) * (0.5 + grain)
        line = (nearest < 0.0018) & (np.mod(along, 0.024) < 0.013)
        crossing = (np.maximum(*away) < 0.035) & (np.maximum(*away) > 0.024) & (np.mod(nearest, 0.006) < 0.003)
        asphalt = np.where((line | (crossing & (nearest < 0.02)))[:, None], 0.65, asphalt)
        paved = np.array([0.40, 0.39, 0.37]) * (0.6 + 0.8 * grain)
        street = np.where((nearest < 0.019)[:, None], asphalt, np.where((nearest < STREET / 2)[:, None], paved, lot))
        return np.clip(street, 0.01, 0.9)

    return paint


def fields(rng: np.random.Generator, size: int, side: float) -> np.ndarray:
    """Linear albedo [size, size, 3] of the land around: fields, hedges and tracks, `side` wide."""
    from scipy.spatial import cKDTree

    noise = ValueNoise(rng)
    axis = ((np.arange(size) + 0.5) / size - 0.5) * side
    x, y = np.meshgrid(axis, axis)
    points = np.stack([x.ravel(), y.ravel(), np.zeros(size * size)], 1)
    wobble = points + 0.05 * np.stack([noise(points, 7.0), noise(points + 5, 7.0), np.zeros(len(points))], 1)
    seeds = np.concatenate([rng.uniform(-side / 2, side / 2, (260, 2)), np.zeros((260, 1))], 1)
    distance, cell = cKDTree(seeds).query(wobble, k=2)
    crops = np.array(
        [[0.16, 0.24, 0.07], [0.38, 0.32, 0.14], [0.24, 0.17, 0.10], [0.10, 0.18, 0.05], [0.30, 0.30, 0.12]]
    )
    color = crops[rng.integers(len(crops), size=len(seeds))[cell[:, 0]]]
    hedge = (distance[:, 1] - distance[:, 0] < 0.02)[:, None]
    color = np.where(hedge, [0.05, 0.10, 0.03], color) * (0.35 + 1.3 * noise.fractal(points, 40.0, 4))[:, None]
    return np.clip(color, 0.01, 0.9).reshape(size, size, 3)
