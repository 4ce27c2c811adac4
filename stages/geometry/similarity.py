"""Similarity transforms: the one way coordinates move between the normalised scene frame and the world."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Similarity:
    """x_target = scale * rotation @ x_source + translation.

    Named target_from_source, e.g. `world_from_scene`.

    Attributes:
        scale: positive number.
        rotation: [3, 3] proper rotation.
        translation: [3].
    """

    scale: float
    rotation: np.ndarray
    translation: np.ndarray

    @staticmethod
    def identity() -> Similarity:
        return Similarity(1.0, np.eye(3), np.zeros(3))

    def apply(self, points: np.ndarray) -> np.ndarray:
        """Map points [..., 3]."""
        return self.scale * points @ self.rotation.T + self.translation

    def inverse(self) -> Similarity:
        rotation = self.rotation.T
        return Similarity(1.0 / self.scale, rotation, -(rotation @ self.translation) / self.scale)

    def compose(self, other: Similarity) -> Similarity:
        """self ∘ other: first `other`, then `self`."""
        return Similarity(
            self.scale * other.scale,
            self.rotation @ other.rotation,
            self.apply(other.translation),
        )

    def matrix(self) -> np.ndarray:
        """[4, 4] homogeneous matrix."""
        matrix = np.eye(4)
        matrix[:3, :3] = self.scale * self.rotation
        matrix[:3, 3] = self.translation
        return matrix
