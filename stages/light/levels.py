"""A light as surfaces of every roughness reflect it, each level as fine as its blur needs: for pictures.

Where `ggx.lobe_matrices` would be too large, by importance sampling of the lobe, each sample from a map as coarse as
the sample is wide (Krivanek & Colbert, "Real-time Shading with Filtered Importance Sampling", 2008).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np

from stages.light import ggx
from stages.light.environment import directions, look_up, resized, solid_angles

# Roughness 0 is the light itself, at most so fine; then rows of each of `ggx.ROUGHNESSES`.
MOST_ROWS = 512
ROWS = (96, 64, 32, 32, 32, 16, 16, 16, 16, 16)
COARSE_ROWS = 32
SAMPLES = 48
# A sample is taken from pixels so many times as large as its share of the lobe, or its neighbours show.
_OVERLAP = 4


@dataclass(frozen=True)
class Levels:
    """A light, blurred.

    Attributes:
        maps: roughness 0 and then each of `ggx.ROUGHNESSES`: [h, 2 h, 3] float32, as `stages.light.environment` says.
        matte: [h, 2 h, 3] what a white matte surface shows of it by its normal: irradiance / pi.
    """

    maps: tuple[np.ndarray, ...]
    matte: np.ndarray

    @property
    def roughnesses(self) -> tuple[float, ...]:
        return (0.0, *ggx.ROUGHNESSES)


def levels_of(radiance: np.ndarray) -> Levels:
    """All levels of a map [H, 2 H, 3]."""
    sharp = resized(radiance, min(MOST_ROWS, max(len(radiance), 128)))
    coarse = resized(radiance, COARSE_ROWS)
    flat = coarse.reshape(-1, 3)
    maps = [sharp]
    for roughness, rows in zip(ggx.ROUGHNESSES, ROWS, strict=True):
        if rows > COARSE_ROWS:
            maps.append(_sampled(sharp, roughness, rows))
        else:
            maps.append((_lobe_matrix(roughness, rows) @ flat).reshape(rows, 2 * rows, 3))
    return Levels(tuple(np.ascontiguousarray(level, dtype=np.float32) for level in maps), matte(coarse))


def matte(radiance: np.ndarray) -> np.ndarray:
    """What a white matte surface shows under a map [H, 2 H, 3], by its normal: [COARSE_ROWS, 2 COARSE_ROWS, 3]."""
    coarse = resized(radiance, COARSE_ROWS)
    return (_cosine_matrix() @ coarse.reshape(-1, 3)).reshape(coarse.shape).astype(np.float32)


@cache
def _cosine_matrix() -> np.ndarray:
    """Clamped cosines dω / π of all pixels of a coarse map around all [P, P] float32; rows sum to 1."""
    towards = directions(COARSE_ROWS).reshape(-1, 3)
    weights = np.maximum(towards @ towards.T, 0) * solid_angles(COARSE_ROWS).reshape(-1)
    return weights / weights.sum(1, keepdims=True)


@cache
def _lobe_matrix(roughness: float, rows: int) -> np.ndarray:
    return ggx.lobe_matrix(roughness, rows, COARSE_ROWS)


def _sampled(radiance: np.ndarray, roughness: float, rows: int) -> np.ndarray:
    """A map blurred by the lobe of a roughness around n = v = r, [rows, 2 rows, 3]."""
    ahead = directions(rows).reshape(-1, 3)
    side = np.cross(ahead, np.where(np.abs(ahead[:, 1:2]) < 0.9, [0, 1, 0], [1, 0, 0]))
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    above = np.cross(side, ahead)
    alpha2 = roughness**4
    share = (np.arange(SAMPLES) + 0.5) / SAMPLES
    cosine2 = (1 - share) / (1 + (alpha2 - 1) * share)  # of the half vector, whose density is D (n·h)
    density = alpha2 / (np.pi * (1 + cosine2 * (alpha2 - 1)) ** 2) / 4  # of the light's direction, where n·h = v·h
    finest = np.pi / np.sqrt(_OVERLAP / (SAMPLES * density))  # rows whose pixels are as large as the sample
    cosine = 2 * cosine2 - 1  # of the light
    around = 2 * np.pi * ((np.arange(SAMPLES) * 0.6180339887498949) % 1)
    total, weights = np.zeros_like(ahead), 0.0
    maps: dict[int, np.ndarray] = {}
    for k in np.flatnonzero(cosine > 0):
        height = int(np.clip(2 ** np.floor(np.log2(finest[k])), 4, len(radiance)))
        if height not in maps:
            maps[height] = resized(radiance, height)
        sine = np.sqrt(1 - cosine[k] ** 2)
        towards = cosine[k] * ahead + sine * (np.cos(around[k]) * side + np.sin(around[k]) * above)
        total += cosine[k] * look_up(maps[height], towards)
        weights += cosine[k]
    return (total / weights).reshape(rows, 2 * rows, 3).astype(np.float32)
