"""A printed ball on a printed floor, drawn in closed form with its true depths: for what compares photos."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image
from scipy.ndimage import map_coordinates

from stages import artifacts
from stages.geometry.cameras import PinholeCameras, PosedScene
from stages.geometry.similarity import Similarity

RADIUS, FLOOR = 0.5, -0.5
_GRID = np.random.default_rng(7).uniform(-1, 1, (32, 32, 32))
POSES_FROM_SCENE = Similarity(2.0, np.eye(3), np.array([1.0, 2, 3]))


def printed(points: np.ndarray) -> np.ndarray:
    """Grey [n] in [0, 1] of places [n, 3]: noise of three sizes, the same from everywhere."""
    waves = (
        map_coordinates(_GRID, (f * points + f).T, order=1, mode="grid-wrap") / k for k, f in enumerate((6, 13, 27), 1)
    )
    return np.clip(0.5 + 0.35 * sum(waves), 0.02, 1)


def plain(points: np.ndarray) -> np.ndarray:
    """Like `printed`, of a wall without any texture."""
    return np.full(len(points), 0.7)


@dataclass(frozen=True)
class Drawn:
    """Photos [h, w, 3] uint8 of the scene, and the true depth [h, w] of each."""

    scene: PosedScene
    photos: list[np.ndarray]
    depths: list[np.ndarray]

    def write(self, folder: Path, masks: list[np.ndarray] | None = None) -> Path:
        """As undistort would have published it."""
        artifacts.FIRST_SCENE.save(folder, self.scene)
        pictures = artifacts.Pictures(folder)
        for k, name in enumerate(self.scene.cameras.names):
            pictures.path(name).parent.mkdir(parents=True, exist_ok=True)
            Image.fromarray(self.photos[k]).save(pictures.path(name))
            if masks is not None:
                pictures.mask_path(name).parent.mkdir(parents=True, exist_ok=True)
                Image.fromarray(np.uint8(255 * masks[k])).save(pictures.mask_path(name))
        return folder


def camera(center: np.ndarray, target: np.ndarray | None = None, roll_deg: float = 0.0) -> np.ndarray:
    """[3, 4] camera from the scene, z up, then rolled about its axis."""
    forward = (np.zeros(3) if target is None else target) - center
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0, 0, 1])
    right /= np.linalg.norm(right)
    c, s = np.cos(np.radians(roll_deg)), np.sin(np.radians(roll_deg))
    rotation = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) @ np.stack([right, np.cross(forward, right), forward])
    return np.c_[rotation, -rotation @ center]


def around(azimuths_deg: np.ndarray, distance: float = 2.5, elevation_deg: float = 30.0) -> np.ndarray:
    """Centres [n, 3] around the ball."""
    a, e = np.radians(azimuths_deg), np.radians(elevation_deg) * np.ones(len(azimuths_deg))
    return distance * np.stack([np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), np.sin(e)], 1)


def cameras(extrinsics: list[np.ndarray], sizes: list[tuple[int, int]], focals: list[float]) -> PinholeCameras:
    """Principal points in the middle."""
    K = [np.array([[f, 0, w / 2], [0, f, h / 2], [0, 0, 1]]) for f, (w, h) in zip(focals, sizes, strict=True)]
    names = tuple(f"{k:03d}.png" for k in range(len(sizes)))
    return PinholeCameras(names, np.array(sizes), np.stack(K), np.stack(extrinsics))


def ring(
    count: int = 12, step_deg: float = 9.0, size: tuple[int, int] = (160, 120), focal: float = 190.0
) -> PinholeCameras:
    centers = around(step_deg * np.arange(count), elevation_deg=25.0)
    centers[::2] *= [1, 1, 1.4]
    return cameras([camera(center) for center in centers], [size] * count, [focal] * count)


def first_hit(cams: PinholeCameras, k: int, pixels: np.ndarray) -> np.ndarray:
    """Places [n, 3] on ball or floor that rays through pixels [n, 2] meet first; NaN where they meet nothing."""
    origins, directions = cams.rays(k, pixels)
    middle = -(origins * directions).sum(1)
    half = RADIUS**2 - ((origins + middle[:, None] * directions) ** 2).sum(1)
    with np.errstate(invalid="ignore", divide="ignore"):
        ball = middle - np.sqrt(half)
        floor = (FLOOR - origins[:, 2]) / directions[:, 2]
    distance = np.where(ball > 0, ball, np.where(floor > 0, floor, np.nan))
    return origins + distance[:, None] * directions


def draw(cams: PinholeCameras, colour: Callable[[np.ndarray], np.ndarray] = printed, points: int = 400) -> Drawn:
    """Photos with noise, and sparse points on what they show, seen by all photos from which nothing hides them."""
    rng = np.random.default_rng(0)
    photos, depths, sparse = [], [], []
    for k, (width, height) in enumerate(cams.sizes):
        v, u = np.mgrid[:height, :width]
        hit = first_hit(cams, k, np.stack([u.ravel() + 0.5, v.ravel() + 0.5], 1))
        seen = ~np.isnan(hit[:, 0])
        grey = np.full(len(hit), 0.5)
        grey[seen] = colour(hit[seen])
        noisy = np.clip(255 * grey + rng.normal(0, 1.2, len(grey)), 0, 255)
        photos.append(np.repeat(np.uint8(noisy).reshape(height, width, 1), 3, 2))
        depths.append(np.where(seen, cams.project(k, np.nan_to_num(hit))[1], 0).reshape(height, width))
        sparse.append(hit[rng.choice(np.flatnonzero(seen), points // len(cams), replace=False)])
    places = np.concatenate(sparse)
    observations = np.concatenate(
        [
            np.column_stack([np.full(rows.sum(), k), np.flatnonzero(rows)])
            for k in range(len(cams))
            for rows in [_sees(cams, k, places)]
        ]
    )
    errors = np.full(len(places), 0.3, np.float32)
    up = np.array([0.0, 0, 1])
    return Drawn(
        PosedScene(cams, POSES_FROM_SCENE, places.astype(np.float32), errors, observations, up), photos, depths
    )


def _sees(cams: PinholeCameras, k: int, points: np.ndarray) -> np.ndarray:
    framed = cams.in_frame(k, points)
    hit = first_hit(cams, k, cams.project(k, points)[0])
    return framed & (np.linalg.norm(np.nan_to_num(hit) - points, axis=1) < 1e-3)
