"""What a made-up object stands on and in: a printed cloth, a room with windows."""

from __future__ import annotations

import numpy as np

CLOTH_SIDE = 3.2


def make_cloth(rng: np.random.Generator, size: int = 2048) -> np.ndarray:
    """A printed cloth: linear albedo [size, size, 3] with detail at every scale and no repetition."""
    import cv2

    colors = np.array(
        [[0.75, 0.70, 0.60], [0.30, 0.42, 0.48], [0.52, 0.24, 0.18], [0.20, 0.22, 0.26], [0.62, 0.55, 0.30]]
    )
    cloth = np.full((size, size, 3), colors[0], np.float32)
    for radius in np.sort(np.exp(rng.uniform(np.log(3), np.log(90), size=9000)))[::-1]:
        color = tuple(float(c) for c in colors[rng.integers(len(colors))] * rng.uniform(0.6, 1.3))
        center = rng.integers(0, size, 2)
        if rng.random() < 0.4:
            cv2.circle(cloth, center.tolist(), int(radius * 0.6), color, -1, cv2.LINE_AA)
        else:
            corners = center + radius * rng.uniform(-1, 1, size=(int(rng.integers(3, 6)), 2))
            cv2.fillConvexPoly(cloth, cv2.convexHull(corners.astype(np.int32)), color, cv2.LINE_AA)
    weave = rng.normal(1.0, 0.12, size=(size, size, 1)).astype(np.float32)
    return np.clip(cloth * weave, 0.02, 0.9)


def make_environment(rng: np.random.Generator, height: int = 128) -> np.ndarray:
    """Radiance [height, 2 * height, 3] of the room by direction: sky gradient, two windows, dim furniture."""
    import cv2

    directions = sphere_directions(height)
    up = directions[..., 2:]
    sky = np.where(up > 0, 0.45 + 0.35 * up, 0.25) * np.array([0.85, 0.95, 1.1])
    environment = np.ascontiguousarray(sky, dtype=np.float32)
    width = 2 * height
    for _ in range(10):  # furniture: darker blocks at the horizon
        x, w = int(rng.integers(width)), int(rng.integers(width // 30, width // 10))
        top = int(height * rng.uniform(0.30, 0.45))
        cv2.rectangle(environment, (x, top), (x + w, int(0.55 * height)), (rng.uniform(0.05, 0.3, 3)).tolist(), -1)
    windows = ((0.10, 0.14, 0.13, 0.20, 9.0), (0.62, 0.20, 0.10, 0.16, 4.0))  # left, top, width, height, radiance
    for left, upper, wide, high, radiance in windows:
        corner = (int(left * width), int(upper * height))
        opposite = (int((left + wide) * width), int((upper + high) * height))
        cv2.rectangle(environment, corner, opposite, (radiance, 0.96 * radiance, 0.88 * radiance), -1)
    return environment


def sphere_directions(height: int) -> np.ndarray:
    """Unit directions [height, 2 * height, 3] of an equirectangular map's pixels, row 0 at the zenith."""
    polar = (np.arange(height) + 0.5) / height * np.pi
    azimuth = (np.arange(2 * height) + 0.5) / height * np.pi
    z, ring = np.cos(polar)[:, None], np.sin(polar)[:, None]
    z = np.broadcast_to(z, (height, 2 * height))
    return np.stack([ring * np.cos(azimuth), ring * np.sin(azimuth), z], -1)
