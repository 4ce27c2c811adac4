"""Similarity transforms: the one way coordinates move between the normalised scene frame and the world."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from jaxtyping import Float


@dataclass(frozen=True)
class Similarity:
    """x_target = scale * rotation @ x_source + translation.

    Named target_from_source, e.g. `world_from_scene`.

    Attributes:
        scale: positive number.
        rotation: proper.
    """

    scale: float
    rotation: Float[np.ndarray, "3 3"]
    translation: Float[np.ndarray, " 3"]

    @staticmethod
    def identity() -> Similarity:
        return Similarity(1.0, np.eye(3), np.zeros(3))

    def apply(self, points: Float[np.ndarray, "*any 3"]) -> Float[np.ndarray, "*any 3"]:
        """Map points."""
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

    def matrix(self) -> Float[np.ndarray, "4 4"]:
        """Homogeneous matrix."""
        matrix = np.eye(4)
        matrix[:3, :3] = self.scale * self.rotation
        matrix[:3, 3] = self.translation
        return matrix


def align_points(source: Float[np.ndarray, "p 3"], target: Float[np.ndarray, "p 3"]) -> Similarity:
    """The similarity `target_from_source` with the least squared error between paired points.

    Source: Umeyama, "Least-squares estimation of transformation parameters between two point patterns", 1991.

    Raises:
        ValueError: fewer than 3 pairs, or all source points on one line.
    """
    if source.shape != target.shape or source.ndim != 2 or source.shape[1] != 3:
        raise ValueError(f"paired points [P, 3] expected, got {source.shape} and {target.shape}")
    if len(source) < 3:
        raise ValueError(f"at least 3 pairs are needed to align, got {len(source)}")
    source_mean, target_mean = source.mean(0), target.mean(0)
    centered = source - source_mean
    covariance = (target - target_mean).T @ centered / len(source)
    left, singular, right = np.linalg.svd(covariance)
    if singular[1] < 1e-12 * max(singular[0], 1e-300):
        raise ValueError("the points lie on one line: the rotation about it cannot be found")
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(left) * np.linalg.det(right))])
    rotation = (left * signs) @ right
    scale = float((singular * signs).sum() / (centered**2).sum(1).mean())
    return Similarity(scale, rotation, target_mean - scale * rotation @ source_mean)
