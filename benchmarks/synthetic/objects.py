"""The made-up objects that stand on a printed table. Each comes in rough units; `scenes.py` makes it 1 large."""

from __future__ import annotations

import numpy as np

from benchmarks.synthetic.model import Paint, Part, plain
from benchmarks.synthetic.shapes import box, cylinder, mesh_of, profile, without
from stages.scenes.figurine import make_figurine
from stages.scenes.implicit import ellipsoid, tube, union
from stages.scenes.noise import ValueNoise

CELL = 1 / 240  # of the grid that shapes are meshed from: about one and a half pixels of the photos
GRAIN = 0.02  # longest painted edge of rods

WHITE = plain(0.78, 0.77, 0.75)
MOSAIC = ((0.62, 0.16, 0.10), (0.80, 0.55, 0.15), (0.12, 0.30, 0.50), (0.75, 0.70, 0.58), (0.10, 0.36, 0.22))
# The middle of a jug's wall: radius and height.
JUG_CURVE = np.array(
    [[0, 0.03], [0.12, 0.03], [0.22, 0.05], [0.31, 0.16], [0.35, 0.32], [0.30, 0.50], [0.19, 0.64],
     [0.155, 0.74], [0.18, 0.86], [0.22, 0.92]]
)  # fmt: skip


def jug_radius(height: np.ndarray) -> np.ndarray:
    """[P] of the middle of its wall, at heights [P]."""
    return np.interp(height, JUG_CURVE[:, 1], JUG_CURVE[:, 0])


def jug(rng: np.random.Generator) -> list[Part]:
    """A painted jug, hollow, with a spout, a handle and flutes."""
    wall = 0.022
    vessel = profile(JUG_CURVE)
    handle = [(0.19, 0, 0.86), (0.32, 0, 0.88), (0.44, 0, 0.78), (0.46, 0, 0.62), (0.42, 0, 0.46), (0.33, 0, 0.36)]
    spout = [(-0.14, 0, 0.80), (-0.22, 0, 0.86), (-0.33, 0, 0.93)]

    def shape(points: np.ndarray) -> np.ndarray:
        angle = np.arctan2(points[:, 1], points[:, 0])
        belly = np.exp(-(((points[:, 2] - 0.33) / 0.16) ** 2))
        outside = np.hypot(points[:, 0], points[:, 1]) > jug_radius(points[:, 2])
        flutes = 0.012 * belly * np.cos(14 * angle + 9 * points[:, 2]) * outside
        hollow = without(
            union(vessel(points) - wall - flutes, tube(points, spout, (0.07, 0.06, 0.045)), width=0.04),
            tube(points, [(-0.08, 0, 0.78), *spout[1:], (-0.40, 0, 0.98)], (0.06, 0.040, 0.028, 0.028)),
        )
        foot = box(points, (0, 0, 0.022), (0.36, 0.36, 0.044), 0.015)
        return union(hollow, tube(points, handle, (0.032, 0.030, 0.028, 0.027, 0.028, 0.034)), foot, width=0.03)

    vertices, faces, normals = mesh_of(shape, (-0.45, -0.42, -0.03), (0.54, 0.42, 1.0), CELL)
    return [Part(vertices, faces, "glossy", mosaic(rng, vertices), normals)]


def mosaic(rng: np.random.Generator, around: np.ndarray) -> Paint:
    """Coloured cells with dark lines between them and speckle at several sizes, in the box of the points `around`."""
    from scipy.spatial import cKDTree

    seeds = rng.uniform(around.min(0), around.max(0), size=(1800, 3))
    tree, noise = cKDTree(seeds), ValueNoise(rng)
    colors = np.array(MOSAIC)[rng.integers(len(MOSAIC), size=len(seeds))] * rng.uniform(0.7, 1.2, (len(seeds), 1))

    def paint(points: np.ndarray, normals: np.ndarray) -> np.ndarray:
        distance, cell = tree.query(points, k=2)
        albedo = np.where((distance[:, 1] - distance[:, 0] < 0.006)[:, None], 0.06, colors[cell[:, 0]])
        return np.clip(albedo * (0.3 + 1.4 * noise.fractal(points, 24.0, 4))[:, None], 0.02, 0.9)

    return paint


def metal_bird(rng: np.random.Generator) -> list[Part]:
    """The demo's bird, all of aluminium."""
    bird = make_figurine(cell=1 / 180)
    return [Part(bird.vertices, bird.faces, "metal", WHITE, bird.normals)]


def bracket(rng: np.random.Generator) -> list[Part]:
    """A white machine part: plates with bores and a slot, ribs, a hollow boss."""

    def shape(points: np.ndarray) -> np.ndarray:
        base = box(points, (0, 0, 0.05), (1.0, 0.6, 0.10), 0.01)
        upright = box(points, (-0.25, 0, 0.36), (0.10, 0.6, 0.62), 0.01)
        slope = 0.62 - 1.1 * (points[:, 0] + 0.22)
        ribs = [
            np.maximum(box(points, (-0.02, y, 0.31), (0.5, 0.06, 0.5)), (points[:, 2] - slope) / 1.49)
            for y in (-0.2, 0.2)
        ]
        boss = cylinder(points, (0.27, 0, 0.18), 2, 0.14, 0.24)
        holes = [
            cylinder(points, (0.27, 0, 0.20), 2, 0.085, 0.5),
            cylinder(points, (-0.41, 0.2, 0.05), 2, 0.045, 0.4),
            cylinder(points, (-0.41, -0.2, 0.05), 2, 0.045, 0.4),
            cylinder(points, (-0.25, 0, 0.50), 0, 0.09, 0.4),
            box(points, (-0.25, 0, 0.26), (0.4, 0.22, 0.07)),
        ]
        return without(union(base, upright, *ribs, boss), *holes)

    vertices, faces, _ = mesh_of(shape, (-0.54, -0.34, -0.03), (0.54, 0.34, 0.72), CELL)
    return [Part(vertices, faces, "matte", WHITE)]


def balloon_dog(rng: np.random.Generator) -> list[Part]:
    """A dog of balloons, a mirror all over."""

    def shape(points: np.ndarray) -> np.ndarray:
        pieces = [tube(points, [(-0.20, 0, 0.43), (0.14, 0, 0.43)], (0.115, 0.115))]
        for y in (-0.085, 0.085):
            pieces += [
                tube(points, [(-0.27, y, 0.33), (-0.30, 1.25 * y, 0.10)], (0.075, 0.085)),
                tube(points, [(0.20, y, 0.33), (0.23, 1.25 * y, 0.10)], (0.075, 0.085)),
                tube(points, [(0.27, 0.9 * y, 0.80), (0.23, 1.5 * y, 0.94)], (0.055, 0.065)),
            ]
        pieces += [
            tube(points, [(0.22, 0, 0.52), (0.27, 0, 0.68)], (0.075, 0.08)),
            tube(points, [(0.33, 0, 0.77), (0.50, 0, 0.70)], (0.085, 0.095)),
            ellipsoid(points, (0.61, 0, 0.665), (0.035, 0.035, 0.035)),
            tube(points, [(-0.29, 0, 0.50), (-0.42, 0.03, 0.72)], (0.045, 0.075)),
            ellipsoid(points, (-0.45, 0.035, 0.80), (0.03, 0.03, 0.03)),
        ]
        return union(*pieces, width=0.035)

    vertices, faces, normals = mesh_of(shape, (-0.55, -0.26, -0.02), (0.68, 0.26, 1.04), CELL)
    return [Part(vertices, faces, "mirror", WHITE, normals)]


def bicycle(rng: np.random.Generator) -> list[Part]:
    """A bicycle with spokes, a wire basket and a plant in it: nothing is thicker than a few pixels but the saddle."""
    noise = ValueNoise(rng)

    def enamel(*color: float) -> Paint:
        return lambda points, normals: np.array(color) * (0.6 + 0.8 * noise.fractal(points, 30.0, 3))[:, None]

    red, black, grey, green = enamel(0.6, 0.1, 0.07), plain(0.05, 0.05, 0.05), plain(0.5, 0.5, 0.52), (0.13, 0.36, 0.08)
    parts = []
    back, front, radius = np.array([-0.29, 0, 0.225]), np.array([0.29, 0, 0.225]), 0.205
    for hub in (back, front):
        parts += [_torus(hub, radius, 0.014, black), _torus(hub, radius - 0.018, 0.006, grey)]
        parts.append(_rod(hub - [0, 0.03, 0], hub + [0, 0.03, 0], 0.014, grey))
        for i in range(18):
            rim = hub + (radius - 0.018) * np.array([np.cos(i * np.pi / 9), 0, np.sin(i * np.pi / 9)])
            parts.append(_rod(hub + [0, 0.02 * (-1) ** i, 0], rim, 0.0035, grey))
    crank, seat, head = np.array([-0.04, 0, 0.20]), np.array([-0.12, 0, 0.50]), np.array([0.20, 0, 0.53])
    tubes = [(crank, seat), (seat, head), (crank, head - [-0.02, 0, 0.06]), (seat, seat + [-0.02, 0, 0.09]),
             (head - [-0.03, 0, 0.08], head + [-0.02, 0, 0.08])]  # fmt: skip
    parts += [_rod(start, end, 0.014, red) for start, end in tubes]
    for y in (-0.028, 0.028):
        stays = [(crank, back), (seat, back), (head - [-0.03, 0, 0.08], front)]
        parts += [_rod(start, end + [0, y, 0], 0.008, red) for start, end in stays]
    bar = head + [-0.02, 0, 0.08]
    parts += [_rod(bar - [0, 0.16, 0], bar + [0, 0.16, 0], 0.009, grey)]
    parts += [_rod(bar + [0, y, 0], bar + [-0.09, y, 0.02], 0.012, black) for y in (-0.16, 0.16)]
    parts += [_ball(seat + [-0.03, 0, 0.10], (0.085, 0.045, 0.022), black), _torus(crank, 0.055, 0.005, grey)]
    for y, swing in ((-0.045, 0.09), (0.045, -0.09)):
        end = crank + [swing, y, -0.02]
        parts += [_rod(crank + [0, y, 0], end, 0.007, grey), _ball(end + [0, y * 0.7, 0], (0.03, 0.025, 0.008), black)]
    # stands that keep it upright
    parts += [_rod(hub, hub + [0.02, y, -0.215], 0.006, grey) for hub in (back, front) for y in (-0.12, 0.12)]
    parts += _basket(bar + [0.13, 0, -0.05], grey)
    for _ in range(16):
        direction = np.array([*rng.normal(0, 0.7, 2), rng.uniform(0.6, 1.2)])
        root = bar + [0.13, 0, -0.10] + [*rng.uniform(-0.03, 0.03, 2), 0]
        tip = root + rng.uniform(0.16, 0.26) * direction / np.linalg.norm(direction)
        parts.append(_rod(root, tip, 0.003, enamel(0.20, 0.30, 0.08)))
        parts.append(
            _leaf(tip, direction, 0.05 * rng.uniform(0.8, 1.3), enamel(*(np.array(green) * rng.uniform(0.7, 1.4))))
        )
    return parts


def _basket(center: np.ndarray, paint: Paint) -> list[Part]:
    """Wires along the edges and over the sides of an open box."""
    x, y, z = 0.075, 0.09, 0.06
    wires = []
    for height in (-z, 0.0, z):
        ring = [np.array([a * x, b * y, height]) for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
        wires += list(zip(ring, [*ring[1:], ring[0]], strict=True))
    for along in np.linspace(-1, 1, 5):
        wires += [(np.array([along * x, s * y, -z]), np.array([along * x, s * y, z])) for s in (-1, 1)]
        wires += [(np.array([s * x, along * y, -z]), np.array([s * x, along * y, z])) for s in (-1, 1)]
        wires.append((np.array([along * x, -y, -z]), np.array([along * x, y, -z])))
    return [_rod(center + start, center + end, 0.0035, paint) for start, end in wires]


def _rod(start: np.ndarray, end: np.ndarray, radius: float, paint: Paint) -> Part:
    from trimesh.creation import cylinder as rod

    mesh = rod(radius, segment=np.array([start, end], float), sections=12)
    return Part(np.asarray(mesh.vertices), np.asarray(mesh.faces), "glossy", paint, grain=GRAIN)


def _torus(center: np.ndarray, radius: float, thickness: float, paint: Paint) -> Part:
    """A ring that turns around the y axis."""
    from trimesh.creation import torus

    mesh = torus(radius, thickness, major_sections=96, minor_sections=12)
    vertices = np.asarray(mesh.vertices)[:, [0, 2, 1]] * [1, -1, 1]  # a quarter turn around x
    return _smooth(vertices + center, np.asarray(mesh.faces), "glossy", paint)


def _ball(center: np.ndarray, radii: tuple[float, float, float], paint: Paint) -> Part:
    from trimesh.creation import icosphere

    mesh = icosphere(subdivisions=3)
    return _smooth(np.asarray(mesh.vertices) * radii + center, np.asarray(mesh.faces), "glossy", paint)


def _leaf(root: np.ndarray, direction: np.ndarray, length: float, paint: Paint) -> Part:
    """A bent blade, a hundredth of its length thick at the rim."""
    forward = direction / np.linalg.norm(direction)
    side = np.cross(forward, [0, 0, 1.0])
    side /= np.linalg.norm(side)
    blade = _ball(np.zeros(3), (1.0, 0.5, 0.03), paint)
    x, y, z = blade.vertices.T
    z = z + 0.25 * y**2 - 0.3 * x**2
    frame = np.stack([forward, side, np.cross(forward, side)])
    vertices = root + length * (np.stack([x + 1.0, y, z], 1) @ frame)
    # The frame (forward, side, forward x side) is right-handed, so faces stay outward.
    return _smooth(vertices, blade.faces, "matte", paint)


def _smooth(vertices: np.ndarray, faces: np.ndarray, finish: str, paint: Paint) -> Part:
    """A part that is shaded with the mean normals of the faces around each vertex."""
    import trimesh

    normals = np.asarray(trimesh.Trimesh(vertices, faces, process=False).vertex_normals)
    return Part(vertices, faces, finish, paint, normals)
