"""Three lights made by formulas, for products: nothing to download, at any size.

All look well on what stands in the middle and is seen from +Z, where the front of a glTF asset is. Their mean radiance
over the sphere is `MEAN`, so that pictures under them are equally bright.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from stages.light.environment import directions, mean_radiance, resized, solid_angles

MEAN = 0.6
# Each pixel is the mean of so many by so many.
_FINER = 3


def studio(height: int) -> np.ndarray:
    """A photographer's studio: a large softbox from the left, a weaker one from the right, one above, a rim light.

    Returns:
        [height, 2 height, 3] float32 radiance.
    """

    def paint(towards: np.ndarray) -> np.ndarray:
        light = _gradient(towards, below=(0.30, 0.29, 0.28), level=(0.16, 0.16, 0.17), above=(0.10, 0.10, 0.11))
        light = light + 9.0 * _softbox(towards, azimuth=-50, elevation=35, width=60, height=50)
        light = light + 3.0 * _softbox(towards, azimuth=70, elevation=12, width=36, height=80)
        light = light + 4.0 * _softbox(towards, azimuth=0, elevation=88, width=80, height=40)
        return light + 8.0 * _softbox(towards, azimuth=155, elevation=30, width=14, height=70)

    return _painted(paint, height)


def sun(height: int) -> np.ndarray:
    """A clear sky with the sun at 45 degrees, over sand.

    The sky is the standard clear one of ISO 15469 (CIE S 011, type 12), bluer away from the horizon; the sun is larger
    and so much less bright, that small maps hold it. The ground sends back a quarter of what falls on it.

    Returns:
        [height, 2 height, 3] float32 radiance.
    """
    place = _towards(azimuth=-40, elevation=45)
    ground_color = np.array([0.30, 0.25, 0.19])

    def sky(towards: np.ndarray) -> np.ndarray:
        rise = np.clip(towards[..., 1], 0.02, 1)
        angle = np.arccos(np.clip(towards @ place, -1, 1))
        gradation = 1 - np.exp(-0.32 / rise)
        scattering = 1 + 10 * (np.exp(-3 * angle) - np.exp(-1.5 * np.pi)) + 0.45 * np.cos(angle) ** 2
        color = _mix((0.80, 0.92, 1.15), (0.45, 0.75, 1.55), rise[..., None] ** 0.5)
        disc = 1500 * np.exp(-((angle / np.radians(2.5)) ** 2))
        return (gradation * scattering)[..., None] * color + disc[..., None] * np.array([1.0, 0.9, 0.72])

    def paint(towards: np.ndarray) -> np.ndarray:
        coarse = directions(64)
        falling = np.where(coarse[..., 1:2] > 0, sky(coarse) * coarse[..., 1:2], 0) * solid_angles(64)[..., None]
        ground = ground_color * falling.sum((0, 1)) / np.pi
        return _mix(ground, sky(towards), _step(towards[..., 1:2], 0.02))

    return _painted(paint, height)


def window(height: int) -> np.ndarray:
    """A room of 6 by 5 m and 2.8 m high, daylight through a window of four panes on the left, from 1.2 m above its
    wooden floor.

    Walls, floor and ceiling show the window's light by the form factor of a small patch, and what all get from all.

    Returns:
        [height, 2 height, 3] float32 radiance.
    """
    room = np.array([[-2.5, -1.2, -3.0], [2.5, 1.6, 3.0]])
    colors = {0: (0.72, 0.68, 0.62), 2: (0.72, 0.68, 0.62)}
    middle, half = np.array([-2.5, 0.35, 0.9]), (0.85, 0.75)  # of the window, and its half sides along y and z

    def paint(towards: np.ndarray) -> np.ndarray:
        with np.errstate(divide="ignore"):
            reach = np.where(towards > 0, room[1], room[0]) / towards
        axis = np.abs(reach).argmin(-1)
        point = towards * np.abs(reach).min(-1)[..., None]
        normal = -np.sign(np.take_along_axis(towards, axis[..., None], -1))[..., 0]
        side = point[..., 1:] - middle[1:]
        inside = ((np.abs(side) < half).all(-1) & (axis == 0) & (towards[..., 0] < 0))[..., None]
        bars = (np.abs(side) < 0.03).any(-1)[..., None]
        outside = _mix((5.0, 6.5, 4.2), (20.0, 23.0, 27.0), _step(towards[..., 1:2] - 0.05, 0.1))
        from_window = point - middle
        squared = (from_window**2).sum(-1)
        along = np.take_along_axis(from_window, axis[..., None], -1)[..., 0]
        facing = np.clip(from_window[..., 0], 0, None) * np.clip(-normal * along, 0, None)
        lit = 21 * facing / (squared**2 + 0.3) * 4 * half[0] * half[1] / np.pi + 0.9
        wall = np.where((axis == 1)[..., None], _mix((0.42, 0.27, 0.16), (0.85, 0.84, 0.80), towards[..., 1:2] > 0),
                        np.array(colors[0]))  # fmt: skip
        return np.where(inside, np.where(bars, 0.5, outside), wall * lit[..., None])

    return _painted(paint, height)


LIGHTS: dict[str, Callable[[int], np.ndarray]] = {"studio": studio, "sun": sun, "window": window}


# ---------------------------------------------------------------- brushes
def _painted(paint: Callable[[np.ndarray], np.ndarray], height: int) -> np.ndarray:
    fine = paint(directions(_FINER * height).astype(np.float64)).astype(np.float32)
    light = resized(fine, height)
    return (light * (MEAN / mean_radiance(light))).astype(np.float32)


def _towards(azimuth: float, elevation: float) -> np.ndarray:
    """Unit direction; degrees, azimuth 0 at +Z where the viewer stands, positive to the viewer's right (+X)."""
    around, rise = np.radians(azimuth), np.radians(elevation)
    return np.array([np.cos(rise) * np.sin(around), np.sin(rise), np.cos(rise) * np.cos(around)])


def _softbox(towards: np.ndarray, azimuth: float, elevation: float, width: float, height: float) -> np.ndarray:
    """A rectangle of so many degrees [..., 1] that faces the middle: 1 there, soft edges, brighter in its middle."""
    ahead = _towards(azimuth, elevation)
    right = _towards(azimuth + 90, 0)
    up = np.cross(ahead, right)
    depth = np.maximum(towards @ ahead, 1e-3)
    x = towards @ right / depth / np.tan(np.radians(width / 2))
    y = towards @ up / depth / np.tan(np.radians(height / 2))
    edges = [_step(1 - np.abs(side), 0.08) for side in (x, y)]
    return (edges[0] * edges[1] * (1 - 0.25 * np.clip(x * x + y * y, 0, 2) / 2) * (towards @ ahead > 0))[..., None]


def _gradient(
    towards: np.ndarray, below: tuple[float, ...], level: tuple[float, ...], above: tuple[float, ...]
) -> np.ndarray:
    """Three colours, from straight down over the horizon to straight up."""
    rise = towards[..., 1:2]
    return np.where(rise < 0, _mix(level, below, np.abs(rise) ** 0.5), _mix(level, above, np.abs(rise)))


def _mix(first: object, second: object, share: np.ndarray) -> np.ndarray:
    return np.asarray(first) * (1 - share) + np.asarray(second) * share


def _step(value: np.ndarray, softness: float) -> np.ndarray:
    """From 0 to 1 around 0, within `softness` on both sides, without a corner."""
    share = np.clip(value / (2 * softness) + 0.5, 0, 1)
    return share * share * (3 - 2 * share)
