"""Captures of known geometry: poses, cameras, scenes and points of the common ways to photograph."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from stages.geometry.cameras import PinholeCameras, PosedScene
from stages.geometry.normalisation import rotation_onto
from stages.geometry.point_cloud import PointCloud
from stages.geometry.similarity import Similarity

EAST, NORTH, UP = np.eye(3)


def look_at(center: np.ndarray, target: np.ndarray, up: np.ndarray = UP) -> np.ndarray:
    """[3, 4] cam_from_world of a level camera."""
    z = (target - center) / np.linalg.norm(target - center)
    x = np.cross(z, up)
    x /= np.linalg.norm(x)
    rotation = np.stack([x, np.cross(z, x), z])
    return np.concatenate([rotation, -(rotation @ center)[:, None]], 1)


def capture(poses: list[np.ndarray], size: tuple[int, int] = (640, 480), focal: float = 600.0) -> PinholeCameras:
    K = np.array([[focal, 0, size[0] / 2], [0, focal, size[1] / 2], [0, 0, 1]])
    return PinholeCameras(
        names=tuple(f"{i:03d}.png" for i in range(len(poses))),
        sizes=np.array([size] * len(poses)),
        intrinsics=np.stack([K] * len(poses)),
        extrinsics=np.stack(poses),
    )


def scene_without_points(
    cameras: PinholeCameras, poses_from_scene: Similarity | None = None, **more: Any
) -> PosedScene:
    """Posed photos and nothing else; +z is up."""
    none = {
        "points": np.zeros((0, 3), np.float32),
        "point_errors": np.zeros(0, np.float32),
        "observations": np.zeros((0, 2), np.int32),
    }
    return PosedScene(cameras, poses_from_scene or Similarity.identity(), **none, up=UP, **more)


def ring(
    target: np.ndarray,
    up: np.ndarray = UP,
    count: int = 12,
    distance: float = 5.0,
    pitch_deg: float = 30.0,
    span_deg: float = 360.0,
) -> list[np.ndarray]:
    """Cameras on a circle about `target`, all looking down by `pitch_deg`."""
    frame = rotation_onto(UP, up)
    pitch = np.radians(pitch_deg)
    poses = []
    for angle in np.radians(np.linspace(0, span_deg, count, endpoint=False)):
        offset = np.array([np.cos(angle) * np.cos(pitch), np.sin(angle) * np.cos(pitch), np.sin(pitch)])
        poses.append(look_at(target + distance * frame @ offset, target, up))
    return poses


def three_rings(
    count: int = 12, distance: float = 2.5, elevations: Sequence[float] = (15, 45, 75), size: int = 160
) -> PinholeCameras:
    """Cameras around and above the origin, looking at it; the unit sphere nearly fills their photos."""
    extrinsics = []
    for i in range(count):
        turn, rise = 2 * np.pi * i / count, np.radians(elevations[i % len(elevations)])
        center = distance * np.array([np.cos(turn) * np.cos(rise), np.sin(turn) * np.cos(rise), np.sin(rise)])
        z = -center / distance
        x = np.cross(z, [0, 0, 1.0])
        x /= np.linalg.norm(x)
        rotation = np.stack([x, np.cross(z, x), z])
        extrinsics.append(np.column_stack([rotation, -rotation @ center]))
    focal = 0.45 * size * np.sqrt(distance**2 - 1)
    K = np.array([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1]])
    return PinholeCameras(
        names=tuple(f"{i:02d}.png" for i in range(count)),
        sizes=np.full((count, 2), size),
        intrinsics=np.repeat(K[None], count, 0),
        extrinsics=np.array(extrinsics),
    )


def sightings(cameras: PinholeCameras, points: np.ndarray) -> np.ndarray:
    """Observations [M, 2] (image, point) of photos that see all that is in their frame."""
    return np.concatenate([
        np.stack([np.full(seen.sum(), i), np.flatnonzero(seen)], 1)
        for i in range(len(cameras))
        for seen in [cameras.in_frame(i, points)]
    ])  # fmt: skip


def dome_on_a_table(seed: int = 0, noise: float = 0.002) -> tuple[PinholeCameras, np.ndarray]:
    """Three rings about a ball of radius 1 that rests on the plane z = 0, and points on both, some of them wrong."""
    random = np.random.default_rng(seed)
    middle = np.array([0.0, 0.0, 1.0])
    poses = [pose for pitch in (10, 30, 60) for pose in ring(middle, count=12, distance=4.0, pitch_deg=pitch)]
    ball = random.normal(size=(600, 3))
    ball = middle + ball / np.linalg.norm(ball, axis=1, keepdims=True)
    table = random.uniform(-3, 3, (1200, 3)) * (1, 1, 0)
    wrong = random.uniform([-3, -3, -1], [3, 3, 4], (60, 3))
    points = np.concatenate([ball, table, wrong])
    return capture(poses), points + noise * random.normal(size=points.shape)


def long_object_on_a_table(seed: int = 0) -> tuple[PinholeCameras, np.ndarray]:
    """A long body, 5 x 1.2 x 1.2, that is printed all over, longer than the photos are wide, on a printed table."""
    random = np.random.default_rng(seed)
    middle = np.array([0.0, 0.0, 0.6])
    poses = [pose for pitch in (15, 40) for pose in ring(middle, count=14, distance=4.0, pitch_deg=pitch)]
    body = random.normal(size=(3000, 3))
    body = middle + body / np.linalg.norm(body, axis=1, keepdims=True) * (2.5, 0.6, 0.6)
    table = random.uniform(-3, 3, (1500, 3)) * (1, 1, 0)
    points = np.concatenate([body, table])
    return capture(poses), points + 0.005 * random.normal(size=points.shape)


def room(seed: int = 0) -> tuple[PinholeCameras, np.ndarray]:
    """A circle of cameras that look outwards in a room of 6 x 5 x 2.5, points on its walls, floor and ceiling."""
    random = np.random.default_rng(seed)
    angles = np.radians(np.arange(0, 360, 15))
    outward = np.stack([np.cos(angles), np.sin(angles), 0 * angles], 1)
    centers = 0.8 * outward + 1.5 * UP + 0.05 * random.normal(size=outward.shape)
    poses = [look_at(center, center + 2 * way) for center, way in zip(centers, outward, strict=True)]
    half = np.array([3.0, 2.5, 1.25])
    points = random.uniform(-half, half, (2000, 3))
    floor = np.array([0, 0, half[2]])
    side, axis = random.choice([-1, 1], 2000), random.integers(0, 3, 2000)
    points[np.arange(2000), axis] = side * half[axis]
    return capture(poses, focal=400.0), points + floor


def room_from_its_walls(seed: int = 0) -> tuple[PinholeCameras, np.ndarray]:
    """The same room, seen from along its walls: the axes meet in the empty middle."""
    _, points = room(seed)
    random = np.random.default_rng(seed)
    around = [(x, y, 1.5) for x in (-2.5, -1, 0.5, 2.5) for y in (-2, 2)] + [(x, 0.0, 1.5) for x in (-2.6, 2.6)]
    poses = [look_at(np.array(center), np.array([0, 0, 1.3]) + 0.2 * random.normal(size=3)) for center in around]
    return capture(poses, focal=400.0), points


def flight(seed: int = 0, tilt_deg: float = 3.0) -> tuple[PinholeCameras, np.ndarray]:
    """A drone that looks down on 200 x 150 from 80, to and fro, on hills of 4, with houses and a little horizon."""
    random = np.random.default_rng(seed)
    poses = []
    for row, y in enumerate(np.linspace(-60, 60, 6)):
        heading = EAST if row % 2 else -EAST  # drones turn at the end of a line
        for x in np.linspace(-80, 80, 9):
            center = np.array([x, y, 80.0]) + random.normal(size=3)
            sway = np.tan(np.radians(tilt_deg)) * 80 * random.normal(size=2)
            poses.append(look_at(center, center + np.array([*sway, -80.0]), heading))
    ground = random.uniform([-100, -75, 0], [100, 75, 0], (3000, 3))
    ground[:, 2] = 4 * np.sin(ground[:, 0] / 40) * np.cos(ground[:, 1] / 40)
    houses = random.uniform([-50, -50, 0], [50, 50, 8], (300, 3))
    horizon = random.uniform([800, -500, 0], [2000, 500, 60], (60, 3))
    return capture(poses, focal=500.0), np.concatenate([ground, houses, horizon])


def oblique_flight(seed: int = 0) -> tuple[PinholeCameras, np.ndarray]:
    """A drone over a town of 200 x 200 amid fields: a grid straight down, then one to each side 42 degrees ahead."""
    random = np.random.default_rng(seed)
    poses = []
    for heading in (None, EAST, NORTH, -EAST, -NORTH):
        reach, count = (75, 4) if heading is None else (60, 3)
        for x in np.linspace(-reach, reach, count):
            for y in np.linspace(-reach, reach, count):
                target = np.array([x, y, 0.0]) + 3 * random.normal(size=3)
                ahead = np.zeros(3) if heading is None else np.tan(np.radians(42)) * 190 * heading
                poses.append(look_at(target - ahead + [0, 0, 190.0], target, NORTH if heading is None else UP))
    town = random.uniform([-100, -100, 0], [100, 100, 50], (3000, 3))
    fields = random.uniform([-400, -400, 0], [400, 400, 1], (3000, 3))
    cameras = capture(poses)
    places = np.concatenate([town, fields])
    # structure from motion has points only where two photos overlap
    return cameras, places[np.bincount(sightings(cameras, places)[:, 1], minlength=len(places)) > 1]


def facade(seed: int = 0) -> tuple[PinholeCameras, np.ndarray]:
    """A strip of cameras along a wall 20 wide and 8 high (y = 10), and trees far behind."""
    random = np.random.default_rng(seed)
    poses = []
    for x in np.linspace(-9, 9, 19):
        center = np.array([x, 0.3 * random.normal(), 1.7])
        poses.append(look_at(center, center + np.array([random.normal(), 10.0, 1.5])))
    wall = random.uniform([-10, 9.8, 0], [10, 10.2, 8], (2500, 3))
    behind = random.uniform([-200, 60, 0], [200, 300, 20], (150, 3))
    return capture(poses), np.concatenate([wall, behind])


def shell(count: int = 400, radius: float = 0.7) -> PointCloud:
    """Dense points of a sphere; the k-th is seen by k % 4 + 1 photos and has the trust k / count."""
    random = np.random.default_rng(0)
    normals = random.normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    seen = np.arange(count) % 4 + 1
    return PointCloud(
        radius * normals,
        normals,
        random.integers(0, 256, (count, 3)).astype(np.uint8),
        np.arange(count) / count,
        np.concatenate([[0], np.cumsum(seen)]),
        np.concatenate([np.arange(n) for n in seen]),
    )
