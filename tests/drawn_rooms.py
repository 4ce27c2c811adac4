"""Pictures of a textured room by ray casting, of whatever rays a camera has: for panoramas and pinhole photos."""

from __future__ import annotations

import numpy as np

from stages.scenes.noise import ValueNoise

HALF = np.array([3.0, 2.5, 1.3])  # of the room's sides, metres; its middle is the origin, z is up


class Room:
    """Six walls with paint of so many sizes, each half of the one before."""

    def __init__(self, seed: int = 0, octaves: int = 5) -> None:
        random = np.random.default_rng(seed)
        self.octaves = octaves
        self.noises = [ValueNoise(random, size=64) for _ in range(3)]

    def draw(self, origin: np.ndarray, rays: np.ndarray) -> np.ndarray:
        """[..., 3] uint8 colours seen from `origin` [3] along `rays` [..., 3] in the world."""
        shape, rays = rays.shape[:-1], rays.reshape(-1, 3)
        with np.errstate(divide="ignore"):
            reach = np.where(rays > 0, HALF - origin, -HALF - origin) / rays
        points = origin + rays * np.nanmin(np.abs(reach), axis=1)[:, None]
        colours = np.stack([noise.fractal(points, 2.0, self.octaves) for noise in self.noises], 1)
        return (255 * np.clip((colours - 0.5) * 2.2 + 0.5, 0, 1)).astype(np.uint8).reshape(*shape, 3)


def sphere_rays(height: int) -> np.ndarray:
    """[H, 2 H, 3] of an equirectangular picture in its frame (z forward, x right, y down)."""
    row, column = (np.mgrid[0:height, 0 : 2 * height] + 0.5) / height
    pitch, yaw = (row - 0.5) * np.pi, (column - 1) * np.pi
    return np.stack([np.cos(pitch) * np.sin(yaw), np.sin(pitch), np.cos(pitch) * np.cos(yaw)], -1)


def pinhole_rays(width: int, height: int, focal: float) -> np.ndarray:
    """[H, W, 3] of a camera that looks along z."""
    y, x = np.mgrid[0:height, 0:width] + 0.5
    return np.stack([(x - width / 2) / focal, (y - height / 2) / focal, np.ones_like(x)], -1)


def heading(yaw_deg: float, pitch_deg: float = 0.0) -> np.ndarray:
    """[3, 3] world_from_camera of a camera held upright, pitched upwards."""
    yaw, pitch = np.radians([yaw_deg, pitch_deg])
    forward = np.array([np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), np.sin(pitch)])
    right = np.array([np.sin(yaw), -np.cos(yaw), 0.0])
    return np.stack([right, np.cross(forward, right), forward], 1)
