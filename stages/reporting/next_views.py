"""Where to stand for the next photos: places from which weakly seen surface shows best.

Each vertex has a need in 0..1: few photos, only slanted ones, or made-up texture. Places are tried around an object
(or in front of needy surface, for rooms and facades), and the best is taken again and again, each time with the needs
that the places before it leave. Only places above the ground with a free line of sight to the front of the surface
count, so none is below it or inside something.

Shapes: V vertices, C candidate places, P sample points.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import PurePosixPath
from typing import Any

import numpy as np

from stages.artifacts import VertexQuality
from stages.geometry.cameras import PosedScene
from stages.geometry.normalisation import perpendicular
from stages.surface.triangle_mesh import face_areas, raycaster, sum_around

# From this many photos on a vertex is seen well, if the best of them looks at it within about 60 degrees.
ENOUGH_PHOTOS = 4
SQUARE_COS = 0.5
# A photo helps where it sees the surface within about 70 degrees of its normal, and leaves this part of the need.
USEFUL_COS = 0.35
LEFT_OVER = 0.3
# A place shows what lies within about 35 degrees of its optical axis.
FRAME_COS = 0.82
MOST = 6
# The surface's mean need must be more than this, and a place must show at least this part of it.
MIN_NEED, MIN_GAIN = 0.004, 0.03
# Needs are sampled at this many points, and places tried in this many directions.
POINTS, DIRECTIONS = 3000, 400
MIN_APART_DEG = 20.0
# A place is at least this far above the ground, in radii of the region; surface this far under it needs no photo.
ABOVE_GROUND = 0.05
UNDER_GROUND = 0.02
# A place is at least this far from the object's middle, in its bounding radii.
CLEARANCE = 1.3
# Without a ground, places are at most this much lower than the lowest photo, seen from the object.
LOWER_DEG = 10.0
# Lines of sight leave out this much at both ends, scene units: the surface itself hides nothing.
GAP = 0.01
# Words: the same height, the same direction, level, and a side that no photo shows.
SAME_HEIGHT_DEG, SAME_DIRECTION_DEG, LEVEL_DEG, FAR_DEG = 8.0, 5.0, 10.0, 60.0


@dataclass(frozen=True)
class NextView:
    """A place for one more photo.

    Attributes:
        position: [3] scene frame.
        target: [3] where to look.
        gain: part (0..1) of the surface's need that it shows.
        sentence: how to find it from the photos that are there.
    """

    position: np.ndarray
    target: np.ndarray
    gain: float
    sentence: str


@dataclass(frozen=True)
class Advice:
    """What more photos could mend.

    Attributes:
        views: best place first; none where all is well seen.
        weak: part (0..1) of the surface's area above the ground that is in need.
        shown: part (0..1) of that need which the places show together.
        hidden: part (0..1) of that need which no place sees: the underside, deep hollows.
    """

    views: tuple[NextView, ...]
    weak: float
    shown: float
    hidden: float


def vertex_needs(quality: VertexQuality) -> np.ndarray:
    """How much each vertex needs another photo [V], 0 (well seen) to 1 (no photo saw it)."""
    few = 1 - np.minimum(quality.seen_by / ENOUGH_PHOTOS, 1)
    slanted = 1 - np.minimum(quality.facing / SQUARE_COS, 1)
    return np.maximum.reduce([few, slanted, quality.invented]).astype(np.float64)


def suggest_views(
    vertices: np.ndarray, normals: np.ndarray, faces: np.ndarray, needs: np.ndarray, scene: PosedScene
) -> Advice:
    """The next photos to take.

    Args:
        vertices, normals, faces: the mesh, scene frame; normals [V, 3] point outward.
        needs: [V] 0..1, see `vertex_needs`.
        scene: its cameras, up, ground and kind.
    """
    areas = sum_around(faces, face_areas(vertices, faces)[:, None] / 3, len(vertices))[:, 0]
    if scene.ground is not None:  # nobody looks up through the table
        areas = np.where(scene.ground.heights(vertices) < -UNDER_GROUND, 0, areas)
    weighed = areas * needs
    weak = float(areas[needs > 0.5].sum() / max(areas.sum(), 1e-20))
    if not len(scene.cameras) or weighed.sum() <= MIN_NEED * areas.sum():
        return Advice((), weak, 0.0, 0.0)
    # each point stands for the same need
    chosen = np.random.default_rng(0).choice(len(vertices), POINTS, p=weighed / weighed.sum())
    points, outward = vertices[chosen].astype(np.float64), normals[chosen].astype(np.float64)
    rays = raycaster(vertices, faces)
    around = scene.kind == "object"
    places = _places_around(vertices, scene) if around else _places_before(points, outward, rays, scene)
    if scene.ground is not None:
        places = places[scene.ground.heights(places[:, 0]) > ABOVE_GROUND]
    helps = _help(points, outward, places, rays)
    hidden = float(1 - (helps > 0).any(0).mean())
    extent = _extent(vertices, scene) if around else None
    left = np.ones(POINTS)
    views: list[NextView] = []
    while len(views) < MOST and len(helps):
        gains = helps @ left / POINTS
        best = int(gains.argmax())
        if gains[best] < MIN_GAIN:
            break
        position, target = places[best]
        views.append(NextView(position, target, float(gains[best]), describe_place(position, target, scene, extent)))
        left *= 1 - (1 - LEFT_OVER) * helps[best]
        apart = _angles(places[:, 0] - target, position - target) > MIN_APART_DEG
        places, helps = places[apart], helps[apart]
    return Advice(tuple(views), weak, float((left < 1).mean()), hidden)


# ---------------------------------------------------------------- places
def _places_around(vertices: np.ndarray, scene: PosedScene) -> np.ndarray:
    """Positions all around an object, as far off as the photos are, and its middle as the target of each [C, 2, 3]."""
    middle = (vertices.min(0) + vertices.max(0)).astype(np.float64) / 2
    radius = np.linalg.norm(vertices - middle, axis=1).max()
    off = scene.cameras.centers - middle
    distance = max(float(np.median(np.linalg.norm(off, axis=1))), CLEARANCE * radius)
    turn = np.arange(DIRECTIONS) * np.pi * (3 - np.sqrt(5))  # Fibonacci sphere
    z = 1 - (2 * np.arange(DIRECTIONS) + 1) / DIRECTIONS
    flat = np.sqrt(1 - z * z)
    directions = np.stack([flat * np.cos(turn), flat * np.sin(turn), z], 1)
    if scene.ground is None:  # nobody says what is free below: hardly lower than the photos were
        lowest = min(_elevations(off, scene.up).min() - LOWER_DEG, 0.0)
        directions = directions[_elevations(directions, scene.up) >= lowest]
    return np.stack([middle + distance * directions, np.broadcast_to(middle, directions.shape)], 1)


def _places_before(points: np.ndarray, outward: np.ndarray, rays: Any, scene: PosedScene) -> np.ndarray:
    """Positions straight before points of a room or facade, as far off as photos are, and those points [C, 2, 3]."""
    cameras = scene.cameras
    axes = np.concatenate([cameras.centers, cameras.forward], 1).astype(np.float32)
    lengths = rays.cast_rays(axes)["t_hit"].numpy()
    met = lengths[np.isfinite(lengths)]
    distance = float(np.median(met)) if len(met) else 1.0
    positions = points[:DIRECTIONS] + distance * outward[:DIRECTIONS]
    free = rays.compute_distance(positions.astype(np.float32)).numpy() > 0.5 * distance
    return np.stack([positions[free], points[:DIRECTIONS][free]], 1)


def _help(points: np.ndarray, outward: np.ndarray, places: np.ndarray, rays: Any) -> np.ndarray:
    """How well each place shows each point [C, P]: 0 where it is hidden, slanted or out of frame, 1 square on."""
    helps = np.zeros((len(places), len(points)))
    for row, (position, target) in zip(helps, places, strict=True):
        offsets = position - points
        distances = np.linalg.norm(offsets, axis=1)
        directions = offsets / distances[:, None]
        cos = (directions * outward).sum(1)
        ahead = (position - target) / np.linalg.norm(position - target)
        maybe = np.flatnonzero((cos > USEFUL_COS) & (directions @ ahead > FRAME_COS))
        starts = points[maybe] + GAP * directions[maybe]
        lines = np.concatenate([starts, directions[maybe]], 1).astype(np.float32)
        hits = rays.cast_rays(lines)["t_hit"].numpy()
        free = hits > distances[maybe] - GAP
        row[maybe[free]] = np.minimum((cos[maybe[free]] - USEFUL_COS) / (SQUARE_COS - USEFUL_COS), 1)
    return helps


# ---------------------------------------------------------------- words
def describe_place(
    position: np.ndarray, target: np.ndarray, scene: PosedScene, extent: tuple[float, float] | None = None
) -> str:
    """How to find a place: by the photos nearest to it, as seen from the target, then height and tilt.

    Args:
        position, target: [3] scene frame.
        scene: its cameras and up; its place, for metres.
        extent: lowest and highest coordinate of the object along up, to tell the height by.
    """
    cameras, place = scene.cameras, position - target
    off = cameras.centers - target
    turns, rises = _azimuths(off, place, scene.up), _elevations(off, scene.up)
    rise = float(_elevations(place[None], scene.up)[0])
    away = _angles(off, place)
    nearest = int(away.argmin())
    name = _photo_name(cameras.names[nearest])
    # Who stands at a photo's place and looks at the object goes counter-clockwise, seen from above, to the right.
    way = f"{_degrees(turns[nearest])} degrees around to the {'right' if turns[nearest] < 0 else 'left'} of {name}"
    compared = [nearest]
    if away[nearest] > FAR_DEG:
        where = f"From a side that no photo shows, {way}"
    elif abs(turns[nearest]) < SAME_DIRECTION_DEG:
        where = f"From the direction of {name}"
    else:
        beyond = (np.sign(turns) == -np.sign(turns[nearest])) & (np.abs(turns) < 90)
        if beyond.any():
            other = int(np.where(beyond, away, np.inf).argmin())
            compared.append(other)
            where = f"Between {name} and {_photo_name(cameras.names[other])}"
        else:
            where = way[0].upper() + way[1:]
    higher = rise - float(rises[compared].mean())
    if abs(higher) < SAME_HEIGHT_DEG:
        where += ", at the same height"
    else:
        where += f", about {_degrees(higher)} degrees {'higher' if higher > 0 else 'lower'}"
    looks = "level" if abs(rise) < LEVEL_DEG else f"{'down' if rise > 0 else 'up'} by about {_degrees(rise)} degrees"
    parts = [where, *_heights(position, scene, extent), f"looking {looks}"]
    return ", ".join(parts) + "."


def _heights(position: np.ndarray, scene: PosedScene, extent: tuple[float, float] | None) -> list[str]:
    """The camera's height in heights of the object, where that says something."""
    if extent is None:
        return []
    low, high = extent
    share = (float(position @ scene.up) - low) / max(high - low, 1e-9)
    if share < 0.25:
        return ["the camera near the height of its foot" if share > -0.25 else "the camera below it"]
    if share < 0.75:
        return ["the camera at the height of its middle"]
    if share < 1.25:
        return ["the camera at the height of its top"]
    return [f"the camera {share:.1f} times as high as its top"]


def _photo_name(name: str) -> str:
    return PurePosixPath(name).with_suffix("").as_posix()


def _degrees(angle: float) -> int:
    return 5 * round(abs(float(angle)) / 5)


# ---------------------------------------------------------------- angles and heights
def _azimuths(directions: np.ndarray, reference: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Degrees [N] that directions [N, 3] lie counter-clockwise of a reference [3], seen from above; -180..180."""
    flat = reference - (reference @ up) * up
    if np.linalg.norm(flat) < 1e-6 * np.linalg.norm(reference):  # straight up: any side is as good
        flat = perpendicular(up)
    return np.degrees(np.arctan2(directions @ np.cross(up, flat) / np.linalg.norm(up), directions @ flat))


def _elevations(directions: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Degrees [N] above the horizon of directions [N, 3]."""
    return np.degrees(np.arcsin(np.clip(directions @ up / np.linalg.norm(directions, axis=1), -1, 1)))


def _angles(directions: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Degrees [N] between directions [N, 3] and another [3]."""
    cos = directions @ other / (np.linalg.norm(directions, axis=1) * np.linalg.norm(other))
    return np.degrees(np.arccos(np.clip(cos, -1, 1)))


def _extent(vertices: np.ndarray, scene: PosedScene) -> tuple[float, float]:
    """Coordinates along up of the object's foot (the ground, where it is known) and top."""
    heights = vertices @ scene.up
    return float(heights.min() if scene.ground is None else scene.ground.offset), float(heights.max())
