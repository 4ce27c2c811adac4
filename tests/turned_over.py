"""Photos of a painted pebble on a printed table, in two passes: as it lies, and turned over in between."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from drawn_rooms import pinhole_rays
from PIL import Image
from rigs import ring

from stages.scenes.noise import ValueNoise
from stages.scenes.photo_files import photo_exif

WIDTH, HEIGHT, FOCAL, FOCAL_35MM = 320, 240, 481.0, 52
HALF_AXES = np.array([0.55, 0.4, 0.3])
LAMP = np.array([0.3, -0.5, 0.8]) / np.linalg.norm([0.3, -0.5, 0.8])
PHOTOS = 16  # of a pass


def world_from_object(turned: bool) -> np.ndarray:
    """[3, 3] how the pebble lies: as it is, or on its back and a little to the side."""
    cos, sin = np.cos(0.7), np.sin(0.7)
    return np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1.0]]) @ np.diag([1.0, -1, -1]) if turned else np.eye(3)


def draw(cam_from_world: np.ndarray, turned: bool) -> tuple[np.ndarray, np.ndarray]:
    """[H, W, 3] uint8 photo and [H, W] bool mask of the pebble, by intersecting each pixel's ray."""
    rotation = cam_from_world[:, :3]
    rays = pinhole_rays(WIDTH, HEIGHT, FOCAL).reshape(-1, 3) @ rotation
    origin = -rotation.T @ cam_from_world[:, 3]
    lies = world_from_object(turned)
    start, way = ((origin - [0, 0, HALF_AXES[2]]) @ lies) / HALF_AXES, (rays @ lies) / HALF_AXES
    a, b, c = (way**2).sum(1), way @ start, start @ start - 1
    inside = b**2 - a * c
    hit = inside > 0
    on_it = (start + ((-b - np.sqrt(np.maximum(inside, 0))) / a)[:, None] * way) * HALF_AXES  # in its own frame
    normals = on_it / HALF_AXES**2
    normals = normals / np.linalg.norm(normals, axis=1, keepdims=True) @ lies.T
    down = np.where(rays[:, 2] < 0, -origin[2] / np.minimum(rays[:, 2], -1e-9), 0)
    table = np.where((down > 0)[:, None], origin + down[:, None] * rays, 0)
    light = np.where(hit, 0.65 + 0.35 * normals @ LAMP, 0.9)
    paint = np.zeros_like(rays)
    paint[hit], paint[~hit] = PEBBLE(on_it[hit]), TABLE(np.clip(table[~hit], -9, 9))
    photo = 255 * np.where((hit | (down > 0))[:, None], paint, 0.5) * light[:, None]
    photo += np.random.default_rng(int(1e6 * abs(origin[0]))).normal(0, 2, photo.shape)
    return photo.clip(0, 255).astype(np.uint8).reshape(HEIGHT, WIDTH, 3), hit.reshape(HEIGHT, WIDTH)


class Paint:
    """Colours [P, 3] in [0, 1] at points [P, 3], with detail down to a pixel."""

    def __init__(self, seed: int, frequency: float) -> None:
        self.frequency = frequency
        self.noises = [ValueNoise(np.random.default_rng(seed + k), size=64) for k in range(3)]

    def __call__(self, points: np.ndarray) -> np.ndarray:
        colours = np.stack([noise.fractal(points, self.frequency, 4) for noise in self.noises], 1)
        return np.clip((colours - 0.5) * 2.8 + 0.5, 0, 1)


PEBBLE, TABLE = Paint(0, 10.0), Paint(3, 4.0)


def poses(turned: bool) -> list[np.ndarray]:
    """[3, 4] cam_from_world of a pass around the pebble, high and low in turn."""
    middle, distance = np.array([0.02, 0.03, 0.25]) if turned else np.array([0, 0, 0.25]), 2.3 if turned else 2.2
    low, high = (ring(middle, count=PHOTOS, distance=distance, pitch_deg=pitch) for pitch in (10, 34))
    return [pose for pair in zip(low[::2], high[1::2], strict=True) for pose in pair]


def write_passes(folder: Path) -> dict[str, np.ndarray]:
    """Write photos/{up,down}/NN.jpg and masks/{up,down}/NN.png; name -> centre of the camera in the pebble's frame."""
    centers = {}
    for name, turned in (("up", False), ("down", True)):
        for kind in ("photos", "masks"):
            (folder / kind / name).mkdir(parents=True)
        for number, pose in enumerate(poses(turned)):
            photo, mask = draw(pose, turned)
            picture = Image.fromarray(photo)
            exif = photo_exif(picture, number, "Pebble", FOCAL_35MM)
            picture.save(folder / "photos" / name / f"{number:02d}.jpg", quality=95, exif=exif)
            Image.fromarray(mask).save(folder / "masks" / name / f"{number:02d}.png")
            center = -pose[:, :3].T @ pose[:, 3] - [0, 0, HALF_AXES[2]]
            centers[f"{name}/{number:02d}.jpg"] = center @ world_from_object(turned)
    return centers
