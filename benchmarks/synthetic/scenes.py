"""The scenes of the suite: what stands where, under which sky, and where the photos are taken from."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from benchmarks.synthetic import city, objects
from benchmarks.synthetic.model import Ground, Part, Scene
from stages.scenes.room import CLOTH_SIDE, make_cloth, make_environment, sphere_directions
from stages.scenes.viewpoints import camera_ring, viewpoint

GROUND_GAP = 1e-4  # under the object: two surfaces in one plane would mix
SKY_HEIGHT = 512
FIELDS_SIDE = 8.0
ROOM_BRIGHTEST = 2.0  # radiance of the windows: brighter ones ask for more paths a pixel
FLIGHT_HEIGHT = 0.95  # over the city, of the block's side
FLIGHT_INSIDE = 0.14  # photos' middles keep so far from its border
OBLIQUE_DEG = 42.0  # of the oblique photos, from straight down


@dataclass(frozen=True)
class Recipe:
    """What a scene is for and how it is made.

    Attributes:
        shows: what it asks of a method.
        make: (random numbers, number of photos) -> scene.
        metres: of a unit, where the camera has GPS; its world is then x east, y north, z up.
    """

    shows: str
    make: Callable[[np.random.Generator, int], Scene]
    metres: float | None = None


def _on_table(make_object: Callable[[np.random.Generator], list[Part]]) -> Callable[[np.random.Generator, int], Scene]:
    """The object, made 1 large, on a printed cloth in a room with windows."""

    def make(rng: np.random.Generator, num_photos: int) -> Scene:
        parts = normalised(make_object(rng))
        ground = Ground(make_cloth(rng), CLOTH_SIDE, -GROUND_GAP)
        room = np.minimum(make_environment(rng, SKY_HEIGHT), ROOM_BRIGHTEST)
        room[SKY_HEIGHT // 2 :] = 0  # the floor hides it, all but a line at the horizon: no path need look there
        return Scene(parts, ground, room, camera_ring(num_photos, rng))

    return make


def normalised(parts: list[Part]) -> tuple[Part, ...]:
    """Moved and scaled to rest on z = 0, around the z axis, with largest extent 1; painted as before."""
    points = np.concatenate([part.vertices for part in parts])
    low, high = points.min(0), points.max(0)
    origin, extent = np.array([*(low + high)[:2] / 2, low[2]]), float((high - low).max())
    return tuple(moved(part, -origin, 1 / extent) for part in parts)


def moved(part: Part, by: np.ndarray, scale: float) -> Part:
    """Moved by [3], then scaled around the origin; painted as before."""
    return Part(
        (part.vertices + by) * scale,
        part.faces,
        part.finish,
        lambda points, normals: part.paint(points / scale - by, normals),
        part.normals,
        None if part.grain is None else part.grain * scale,
    )


def _city(rng: np.random.Generator, num_photos: int) -> Scene:
    """The block among fields under a sunny sky, photographed from the air."""
    parts = tuple(city.city_block(rng))
    return Scene(parts, _fields(rng), sunny_sky(), flight(num_photos, rng))


def _town(side: int) -> Callable[[np.random.Generator, int], Scene]:
    """`side` times as many city blocks each way, all different, painted half as finely; a block's side is 1."""

    def make(rng: np.random.Generator, num_photos: int) -> Scene:
        places = np.arange(side) - (side - 1) / 2
        parts = [
            moved(replace(part, grain=part.grain and 2 * part.grain), np.array([x, y, 0.0]), 1.0)
            for y in places
            for x in places
            for part in city.city_block(rng)
        ]
        return Scene(tuple(parts), _fields(rng), sunny_sky(), flight(num_photos, rng, side))

    return make


def _fields(rng: np.random.Generator) -> Ground:
    return Ground(city.fields(rng, 2048, FIELDS_SIDE), FIELDS_SIDE, -10 * GROUND_GAP)


def sunny_sky(height: int = SKY_HEIGHT) -> np.ndarray:
    """Radiance [height, 2 height, 3]: blue above, bright at the horizon, a soft sun at 50 degrees."""
    directions = sphere_directions(height)
    up = directions[..., 2:]
    haze = np.exp(-np.maximum(up, 0) / 0.25)
    sky = np.where(up > 0, (1 - haze) * [0.35, 0.55, 1.0] + haze * [0.9, 0.95, 1.0], 0.0)
    sun = np.array([0.5, 0.4, np.sin(np.radians(50))])
    glow = 350 * np.exp((directions @ (sun / np.linalg.norm(sun)) - 1) / 0.002)
    return (sky + glow[..., None] * [1.0, 0.93, 0.82]).astype(np.float32)


def flight(num_photos: int, rng: np.random.Generator, side: float = 1.0) -> np.ndarray:
    """[N, 4, 4] world-to-camera matrices: a grid that looks down, then four that look ahead, one to each side, over a
    square of side `side`."""
    down = num_photos * 2 // 5
    groups = [(down, None), *(((num_photos - down + k) // 4, 90 * k) for k in range(4))]
    reach = side / 2 - FLIGHT_INSIDE
    poses = []
    for count, heading in groups:
        for x, y in _grid(count):
            jitter = rng.uniform(-0.03, 0.03, 6)
            target = np.array([reach * x, reach * y, 0.05]) + [*jitter[:2], 0]
            if heading is None:
                ahead = np.array([0.0, 1e-3])  # never exactly straight down: "up" is then any direction
            else:
                angle = np.radians(heading)
                ahead = np.tan(np.radians(OBLIQUE_DEG)) * FLIGHT_HEIGHT * np.array([np.cos(angle), np.sin(angle)])
            eye = target + [*(-ahead), FLIGHT_HEIGHT] + jitter[3:]
            up = np.array([0, 0, 1.0]) if heading is not None else np.array([0, 1.0, 0])
            poses.append(viewpoint(eye, target, up=up))
    return np.array(poses)


def _grid(count: int) -> list[tuple[float, float]]:
    """`count` places in [-1, 1]^2, row by row in turning directions, as a drone flies."""
    rows = max(round(np.sqrt(count)), 1)
    places = []
    for i, row in enumerate(np.array_split(np.arange(count), rows)):
        y = -1 + (2 * i + 1) / rows
        line = [(-1 + (2 * j + 1) / len(row), y) for j in range(len(row))]
        places += line if i % 2 == 0 else line[::-1]
    return places


RECIPES = {
    "textured": Recipe("a painted jug, hollow, with flutes, handle and spout", _on_table(objects.jug)),
    "polished": Recipe("the demo's bird in aluminium", _on_table(objects.metal_bird)),
    "plain": Recipe("a white machine part: bores, slot, ribs", _on_table(objects.bracket)),
    "thin": Recipe("a bicycle: spokes, wire basket, leaves", _on_table(objects.bicycle)),
    "mirror": Recipe("a dog of balloons, a perfect mirror", _on_table(objects.balloon_dog)),
    "city": Recipe("a city block from the air, straight down and oblique", _city),
}
# Larger, and made only when they are named. One block looks like another: their photos carry GPS, as a drone's do.
TOWNS = {
    "town4": Recipe("four city blocks, for `--blocks`: four times as many photos", _town(2), city.METRES),
    "town16": Recipe("sixteen city blocks, for `--blocks`: sixteen times as many photos", _town(4), city.METRES),
}
