"""Photos of a chrome and of a grey ball under a light that is known, drawn ray by ray."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from stages.geometry.vectors import unit
from stages.light.environment import directions, look_up, resized, solid_angles
from stages.light.srgb import as_bytes

SIZE = (320, 240)
FINER = 2
REFLECTANCE = 0.5  # of the grey ball
LAMPS = (np.array([0.5, 0.7, 0.3]), np.array([-0.6, 0.3, -0.7]))


@dataclass(frozen=True)
class Drawn:
    """A photo [H, W, 3] uint8, and the circle that somebody would draw around the ball in it."""

    pixels: np.ndarray
    center: tuple[float, float]
    radius: float


def lens(k: float = 0.0, focal: float = 320.0) -> Any:
    """A pycolmap camera with one radial coefficient."""
    import pycolmap

    width, height = SIZE
    return pycolmap.Camera(
        model="SIMPLE_RADIAL", width=width, height=height, params=[focal, width / 2, height / 2, k], camera_id=1
    )


def rays_through(camera: Any) -> Callable[[np.ndarray], np.ndarray]:
    return lambda pixels: np.concatenate([camera.cam_from_img(pixels), np.ones((len(pixels), 1))], axis=1)


def lamps(strength: float) -> np.ndarray:
    """[64, 128, 3]: a sky that is brighter above, a warm lamp, and a cold one of a quarter of its strength."""
    towards = directions(64)
    light = 0.25 + 0.25 * np.clip(towards[..., 1:2], 0, 1) * np.array([0.6, 0.8, 1.2])
    for place, power, color in zip(LAMPS, (strength, strength / 4), ((1, 0.95, 0.8), (0.8, 0.9, 1)), strict=True):
        light = light + power * np.exp((towards @ unit(place) - 1) / 0.01)[..., None] * np.array(color)
    return light.astype(np.float32)


def matte(light: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """What a white matte surface shows at normals [N, 3]: an integral over the sphere, from a table of them."""
    small = resized(light, 32)
    cosine = np.maximum(directions(32).reshape(-1, 3) @ directions(32).reshape(-1, 3).T, 0)
    table = cosine @ (small * solid_angles(32)[..., None]).reshape(-1, 3) / np.pi
    return look_up(table.reshape(32, 64, 3), normals)


def drawn(
    kind: str,
    light: np.ndarray,
    light_from_cam: np.ndarray,
    center: np.ndarray,
    radius: float,
    camera: Any,
    exposure: float,
) -> Drawn:
    """The photo of a ball at a place in the camera's frame."""
    width, height = SIZE
    x, y = np.meshgrid((np.arange(FINER * width) + 0.5) / FINER, (np.arange(FINER * height) + 0.5) / FINER)
    rays = unit(rays_through(camera)(np.stack([x.ravel(), y.ravel()], axis=1)))
    along = rays @ center
    under = along**2 - (center @ center - radius**2)
    hit = under > 0
    normals = ((along - np.sqrt(np.maximum(under, 0)))[:, None] * rays - center)[hit] / radius
    image = np.full((len(rays), 3), 0.18)
    if kind == "chrome":
        mirrored = rays[hit] - 2 * (rays[hit] * normals).sum(1, keepdims=True) * normals
        image[hit] = look_up(light, mirrored @ light_from_cam.T)
    else:
        image[hit] = REFLECTANCE * matte(light, normals @ light_from_cam.T)
    means = image.reshape(height, FINER, width, FINER, 3).mean((1, 3))
    edge = camera.img_from_cam(edge_of(center, radius))
    low, high = edge.min(0), edge.max(0)
    middle = (low + high) / 2
    pixels = as_bytes(np.clip(exposure * means, 0, 1))
    return Drawn(pixels, (float(middle[0]), float(middle[1])), float((high - low).mean() / 2))


def edge_of(center: np.ndarray, radius: float) -> np.ndarray:
    """Rays [360, 3] that touch a ball."""
    axis, turn = unit(center), 2 * np.pi * np.arange(360)[:, None] / 360
    side = unit(np.cross(axis, [0.3, 1.0, 0.2]))
    around = np.cos(turn) * side + np.sin(turn) * np.cross(axis, side)
    sine = radius / np.linalg.norm(center)
    return np.sqrt(1 - sine**2) * axis + sine * around


def main_source(light: np.ndarray) -> np.ndarray:
    """Unit direction in which what is brighter than the median, blurred by about 15 degrees, is brightest."""
    small, towards = resized(light, 32).mean(2), directions(32).reshape(-1, 3)
    above = (np.maximum(small - np.median(small), 0) * solid_angles(32)).reshape(-1)
    return towards[int(np.argmax(np.exp((towards @ towards.T - 1) / 0.034) @ above))]


def apart_deg(first: np.ndarray, second: np.ndarray) -> float:
    return float(np.degrees(np.arccos(np.clip(unit(first) @ unit(second), -1, 1))))
