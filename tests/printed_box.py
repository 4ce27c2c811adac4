"""Photos of a printed box on a printed floor, for structure from motion: rendered by intersecting every ray."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from stages import artifacts
from stages.artifacts import ImageRecord, ImageSet

WIDTH, HEIGHT, FOCAL = 320, 240, 350.0
BOX = np.array([0.5, 0.35, 0.45])  # half sides; it stands on the floor z = 0


def texture(seed: int) -> np.ndarray:
    """[256, 256] float32 grey with detail at all scales, so that SIFT finds corners at any distance."""
    generator = np.random.default_rng(seed)
    layers = [
        cv2.resize(generator.uniform(0, 1, (n, n)).astype(np.float32), (256, 256), interpolation=cv2.INTER_CUBIC)
        for n in (8, 16, 32, 64, 128)
    ]
    mixed = sum(layers) / len(layers)
    return np.clip((mixed - 0.5) * 3 + 0.5, 0, 1) * 255


TEXTURES = {seed: texture(seed) for seed in range(4)}  # floor, and the faces across x, y, z


def render(cam_from_world: np.ndarray, seed: int) -> np.ndarray:
    """[H, W] uint8 photo of a printed box on a printed floor, by intersecting every pixel's ray, with noise."""
    x, y = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    in_cam = np.stack([(x - WIDTH / 2) / FOCAL, (y - HEIGHT / 2) / FOCAL, np.ones_like(x)], -1).reshape(-1, 3)
    rotation = cam_from_world[:, :3]
    origin, rays = -rotation.T @ cam_from_world[:, 3], in_cam @ rotation
    with np.errstate(divide="ignore"):
        floor = np.where(rays[:, 2] < 0, -origin[2] / rays[:, 2], np.inf)
        slabs = np.stack([(sign * BOX + [0, 0, BOX[2]] - origin) / rays for sign in (-1, 1)])
    near, far = slabs.min(0), slabs.max(0)
    axis, enter = near.argmax(1), near.max(1)
    hits_box = (enter < far.min(1)) & (enter > 0) & (enter < floor)
    distance = np.where(hits_box, enter, floor)
    surface = np.where(hits_box, axis + 1, 0)
    points = origin + np.where(np.isfinite(distance), distance, 0)[:, None] * rays
    photo = np.full((HEIGHT, WIDTH), 128.0, np.float32)
    across = {0: (0, 1), 1: (1, 2), 2: (0, 2), 3: (0, 1)}
    for index, plane in across.items():
        chosen = (surface == index) & np.isfinite(distance)
        scale = 40.0 if index == 0 else 120.0  # texels a unit
        at = np.where(chosen[:, None], points[:, plane] * scale, 0).astype(np.float32).reshape(HEIGHT, WIDTH, 2)
        printed = cv2.remap(TEXTURES[index], at, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
        photo = np.where(chosen.reshape(HEIGHT, WIDTH), printed, photo)
    noise = np.random.default_rng(seed).normal(0, 1.5, photo.shape)
    return np.clip(photo + noise, 0, 255).astype(np.uint8)


def ingested(folder: Path, photos: list[np.ndarray], focal: float | None = None) -> Path:
    records = []
    for i, photo in enumerate(photos):
        name = f"{i:03d}.png"
        path = artifacts.image_path(folder, name)
        path.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(path), cv2.cvtColor(photo, cv2.COLOR_GRAY2BGR))
        height, width = photo.shape
        records.append(ImageRecord(name, name, width, height, focal, f"{width} x {height}", 1.0, False, str(i)))
    artifacts.IMAGE_SET.save(folder, ImageSet(tuple(records)))
    return folder
