"""An environment map: what light comes from each direction, as if from infinitely far away.

The convention of this package, and of every light that HiNeuS writes or reads: float32 [H, 2 H, 3], linear radiance, in
the frame of the exported GLB (Y up). Row 0 is at +Y. At the share u of the width and v of the height

    direction = (sin θ cos φ, cos θ, sin θ sin φ),  φ = 2π (u - 1/2),  θ = π v,

so the middle of the map looks along +X. three.js reads equirectangular maps so, and Blender after its import of a GLB.
"""

from __future__ import annotations

import numpy as np


def directions(height: int) -> np.ndarray:
    """Unit directions [H, 2 H, 3] float32 of the pixels' centres."""
    theta = np.pi * (np.arange(height) + 0.5) / height
    phi = np.pi * ((np.arange(2 * height) + 0.5) / height - 1)
    sine, up = np.sin(theta)[:, None], np.cos(theta)[:, None] * np.ones(2 * height)
    return np.stack([sine * np.cos(phi), up, sine * np.sin(phi)], axis=2).astype(np.float32)


def solid_angles(height: int) -> np.ndarray:
    """Solid angle [H, 2 H] float32 of each pixel, steradians; all together 4π."""
    bounds = np.cos(np.pi * np.arange(height + 1) / height)
    rows = (bounds[:-1] - bounds[1:]) * np.pi / height
    return np.repeat(rows[:, None], 2 * height, axis=1).astype(np.float32)


def mean_radiance(radiance: np.ndarray) -> float:
    """Of a map [H, 2 H, 3], over the sphere and its channels."""
    return float((radiance.mean(2) * solid_angles(len(radiance))).sum() / (4 * np.pi))


def bilinear(towards: np.ndarray, height: int) -> tuple[np.ndarray, np.ndarray]:
    """Which pixels of a map of `height` rows answer for directions, and with which weights.

    Args:
        towards: [P, 3] unit.

    Returns:
        [P, 4] int32 row-major pixels and [P, 4] float32 weights that sum to 1. The map closes around; beyond its first
        and last row the row itself answers.
    """
    v = np.arccos(np.clip(towards[:, 1], -1, 1)) * (height / np.pi) - 0.5
    u = (np.arctan2(towards[:, 2], towards[:, 0]) / np.pi + 1) * height - 0.5
    above, left = np.floor(v).astype(np.int32), np.floor(u).astype(np.int32)
    fv, fu = (v - above).astype(np.float32), (u - left).astype(np.float32)
    rows = np.clip(np.stack([above, above, above + 1, above + 1], axis=1), 0, height - 1)
    columns = np.stack([left, left + 1, left, left + 1], axis=1) % (2 * height)
    weights = np.stack([(1 - fv) * (1 - fu), (1 - fv) * fu, fv * (1 - fu), fv * fu], axis=1)
    return rows * (2 * height) + columns, weights


def look_up(radiance: np.ndarray, towards: np.ndarray) -> np.ndarray:
    """Radiance [..., C] float32 of a map [H, 2 H, C] from unit directions [..., 3]."""
    height, width, channels = radiance.shape
    pixels, weights = bilinear(towards.reshape(-1, 3), height)
    values = radiance.reshape(height * width, channels)[pixels]
    return np.einsum("pk,pkc->pc", weights, values).reshape(*towards.shape[:-1], channels).astype(np.float32)


def resized(radiance: np.ndarray, height: int) -> np.ndarray:
    """A map [H, 2 H, C] at another size; where it shrinks, a pixel is the mean, by solid angle, of what it covers."""
    full = len(radiance)
    if height >= full:
        return look_up(radiance, directions(height))
    from scipy.sparse import csr_matrix

    # Solid angle is an area in cos θ and φ, so that shares of rows and columns multiply, and no light is lost.
    rows = _shares(np.cos(np.pi * np.arange(height + 1) / height), np.cos(np.pi * np.arange(full + 1) / full))
    columns = _shares(np.arange(2 * height + 1) / height, np.arange(2 * full + 1) / full)
    fewer_rows = (csr_matrix(rows) @ radiance.reshape(full, -1)).reshape(height, 2 * full, -1)
    by_column = fewer_rows.swapaxes(0, 1)
    small = (csr_matrix(columns) @ by_column.reshape(2 * full, -1)).reshape(2 * height, height, -1)
    return np.ascontiguousarray(small.swapaxes(0, 1), dtype=np.float32)


def _shares(bounds: np.ndarray, fine: np.ndarray) -> np.ndarray:
    """Part [n, m] float32 that each of m intervals has of each of n; rows sum to 1.

    Args:
        bounds, fine: [n + 1], [m + 1] bounds of the intervals, both ascending or both descending.
    """
    low, high = np.minimum(bounds[:-1], bounds[1:]), np.maximum(bounds[:-1], bounds[1:])
    inside = np.clip(fine, low[:, None], high[:, None])
    return (np.abs(np.diff(inside, axis=1)) / (high - low)[:, None]).astype(np.float32)


def turned(radiance: np.ndarray, degrees: float) -> np.ndarray:
    """The same light turned about the vertical: what came from φ comes from φ + `degrees`."""
    height = len(radiance)
    angle = np.radians(degrees)
    cosine, sine = np.cos(angle), np.sin(angle)
    # looked up where it comes from, so by the opposite turn
    back = np.array([[cosine, 0, sine], [0, 1, 0], [-sine, 0, cosine]])
    return look_up(radiance, directions(height) @ back.T.astype(np.float32))
