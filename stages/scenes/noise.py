"""Smooth noise for paint."""

from __future__ import annotations

import numpy as np


class ValueNoise:
    """Smooth periodic noise in [0, 1] from a lattice of random numbers."""

    def __init__(self, rng: np.random.Generator, size: int = 32) -> None:
        self.size = size
        self.lattice = rng.random((size, size, size), dtype=np.float32)

    def __call__(self, points: np.ndarray, frequency: float) -> np.ndarray:
        """Noise [P] at points [P, 3] with `frequency` lattice cells per unit."""
        scaled = points * frequency
        base = np.floor(scaled).astype(np.int64)
        t = (scaled - base).astype(np.float32)
        t = t * t * (3 - 2 * t)
        low, high = base % self.size, (base + 1) % self.size
        total = np.zeros(len(points), np.float32)
        for corner in range(8):
            index, weight = [], np.ones(len(points), np.float32)
            for axis in range(3):
                upper = corner >> axis & 1
                index.append((high if upper else low)[:, axis])
                weight = weight * (t[:, axis] if upper else 1 - t[:, axis])
            total += weight * self.lattice[tuple(index)]
        return total

    def fractal(self, points: np.ndarray, frequency: float, octaves: int) -> np.ndarray:
        """Sum of octaves, each with twice the frequency and 0.7 of the strength, in [0, 1]."""
        strengths = 0.7 ** np.arange(octaves)
        layers = [s * self(points + 7.3 * i, frequency * 2**i) for i, s in enumerate(strengths)]
        return sum(layers) / strengths.sum()
