"""Three lights from all around, made from formulas: a studio, an open sky, a room.

Each is a map as `Scene.sky` is one: linear radiance [H, 2 H, 3] float32, row 0 at the zenith (z up), column 0 at +x,
towards +y. Rows are finer than any edge of a lamp, so that an edge is a slope and not a stair.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from stages.scenes.room import sphere_directions

HEIGHT = 512
EDGE = np.radians(180 / HEIGHT)  # over which a lamp's rim fades, radians
SUN_RADIUS_DEG = 1.5
SUN_DEG = (35.0, 48.0)  # azimuth and elevation
SUN_SHARE = 2.0  # of the sky's own light on level ground
GROUND_ALBEDO = (0.30, 0.26, 0.20)
# The room around the object: from wall to wall, x, y, z; the object is in the middle of it, a little low.
ROOM_LOW, ROOM_HIGH = np.array([-2.2, -1.8, -1.1]), np.array([2.0, 2.4, 1.6])


def studio(height: int = HEIGHT) -> np.ndarray:
    """Three softboxes on a dim grey."""
    d = sphere_directions(height)
    light = (0.22 + 0.10 * d[..., 2:]) * np.ones(3)
    for azimuth, elevation, wide, high, radiance in (
        (40, 42, 42, 32, (9.0, 8.6, 8.0)),
        (165, 12, 22, 54, (3.0, 3.3, 3.7)),
        (275, 60, 60, 12, (5.0, 5.0, 5.0)),
    ):
        light = light + softbox(d, azimuth, elevation, wide, high)[..., None] * np.array(radiance)
    return light.astype(np.float32)


def open_sky(height: int = HEIGHT) -> np.ndarray:
    """A blue sky, brighter towards the horizon and the sun, a sun of three degrees, and ground lit by both."""
    d = sphere_directions(height)
    up = d[..., 2:]
    sun = towards(*SUN_DEG)
    haze = np.exp(-np.maximum(up, 0) / 0.22)
    glow = np.exp((d @ sun - 1) / 0.06)[..., None]
    above = (1 - haze) * [0.25, 0.45, 0.95] + haze * [0.80, 0.88, 1.0] + glow * [0.9, 0.8, 0.6]
    level = np.sin(np.radians(SUN_DEG[1]))
    # What a level ground gets of a sky of radiance 1 is pi; of the sun its radiance, cosine and solid angle.
    solid_angle = 2 * np.pi * (1 - np.cos(np.radians(SUN_RADIUS_DEG)))
    radiance = SUN_SHARE * np.pi * 0.7 / (solid_angle * level)
    below = np.array(GROUND_ALBEDO) * 0.7 * (1 + SUN_SHARE)
    horizon = np.clip(up / EDGE + 0.5, 0, 1)
    light = horizon * above + (1 - horizon) * below
    return (light + disc(d, sun, SUN_RADIUS_DEG)[..., None] * radiance * np.array([1.0, 0.94, 0.84])).astype(np.float32)


def room(height: int = HEIGHT) -> np.ndarray:
    """A room with one window, walls of four colours, and two lamps."""
    d = sphere_directions(height)
    far = np.where(d > 0, ROOM_HIGH, ROOM_LOW) / np.where(np.abs(d) < 1e-9, 1e-9, d)
    wall = np.argmin(far, axis=2)
    point = d * far.min(2, keepdims=True)
    side = np.take_along_axis(d, wall[..., None], axis=2)[..., 0] > 0
    paint = np.array(
        [[(0.62, 0.16, 0.12), (0.70, 0.66, 0.58)], [(0.16, 0.34, 0.55), (0.22, 0.50, 0.26)],
         [(0.36, 0.24, 0.14), (0.80, 0.80, 0.78)]]
    )  # fmt: skip
    window_at, lamp_at = np.array([2.0, 0.4, 0.5]), np.array([-1.3, -1.5, 0.9])
    lit = sum(
        power / (0.6 + ((point - at) ** 2).sum(2)) for at, power in ((window_at, 1.3), (lamp_at, 0.5))
    )  # fmt: skip
    light = paint[wall, side.astype(int)] * (0.15 + lit)[..., None]
    light += pane(point, side & (wall == 0))[..., None] * np.array([6.5, 7.4, 8.6])
    light += disc(d, lamp_at / np.linalg.norm(lamp_at), 5.0)[..., None] * np.array([34.0, 25.0, 14.0])
    light += disc(d, towards(125, 38), 4.0)[..., None] * np.array([26.0, 21.0, 14.0])
    return light.astype(np.float32)


LIGHTS: dict[str, Callable[[], np.ndarray]] = {"studio": studio, "sky": open_sky, "room": room}


# ---------------------------------------------------------------- lamps
def towards(azimuth_deg: float, elevation_deg: float) -> np.ndarray:
    """Unit direction [3]."""
    azimuth, elevation = np.radians([azimuth_deg, elevation_deg])
    return np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])


def disc(directions: np.ndarray, center: np.ndarray, radius_deg: float) -> np.ndarray:
    """1 within a cone around a direction, 0 outside."""
    angle = 2 * np.arcsin(np.clip(np.linalg.norm(directions - center, axis=-1) / 2, 0, 1))
    return np.clip((np.radians(radius_deg) - angle) / EDGE + 0.5, 0, 1)


def softbox(
    directions: np.ndarray, azimuth_deg: float, elevation_deg: float, wide_deg: float, high_deg: float
) -> np.ndarray:
    """1 within a rectangle that stands across a direction, 0 outside."""
    ahead = towards(azimuth_deg, elevation_deg)
    right = np.cross(ahead, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    depth = directions @ ahead
    across = (
        np.stack([directions @ right, directions @ np.cross(right, ahead)], -1) / np.maximum(depth, 1e-3)[..., None]
    )
    half = np.tan(np.radians([wide_deg, high_deg]) / 2)
    inside = np.clip((half - np.abs(across)) / EDGE + 0.5, 0, 1).prod(-1)
    return np.where(depth > 0, inside, 0)


def pane(point: np.ndarray, on_wall: np.ndarray) -> np.ndarray:
    """1 where the room's window is, at points of its wall: two panes with a bar between them."""
    y, z = np.abs(point[..., 1] - 0.4), np.abs(point[..., 2] - 0.5)
    blur = 2 * EDGE
    whole = np.clip((0.75 - y) / blur + 0.5, 0, 1) * np.clip((0.6 - z) / blur + 0.5, 0, 1)
    return np.where(on_wall, whole * np.clip((y - 0.05) / blur + 0.5, 0, 1), 0)
