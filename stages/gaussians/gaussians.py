"""Oriented 3D Gaussians with colours that depend on the direction (Kerbl et al. 2023, "3D Gaussian Splatting").

Everything is kept as 3DGS files keep it: logarithms of scales, logits of opacities, harmonics around a mid grey.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np


@dataclass(frozen=True)
class Gaussians:
    """N Gaussians, all arrays float32 but the last.

    Attributes:
        centers: [N, 3], in the frame of the mesh they belong to.
        rotations: [N, 4] unit quaternions (w, x, y, z); the columns of their matrices are the Gaussians' axes.
        log_scales: [N, 3], natural logarithms of the standard deviations along the axes, in the centers' units.
        opacity_logits: [N].
        harmonics: [N, K, 3], K = (degree + 1)², degree 0 to 3, of sRGB values: colour = 0.5 + sum of harmonics times
            the basis of 3DGS at the direction from the camera to the center.
        anchored: [N] bool, whether the Gaussian lies on the surface; free ones stand for what has none.
    """

    centers: np.ndarray
    rotations: np.ndarray
    log_scales: np.ndarray
    opacity_logits: np.ndarray
    harmonics: np.ndarray
    anchored: np.ndarray

    def __len__(self) -> int:
        return len(self.centers)

    @property
    def degree(self) -> int:
        """Of the harmonics, 0 to 3."""
        return int(np.sqrt(self.harmonics.shape[1])) - 1

    @property
    def opacities(self) -> np.ndarray:
        """[N] float32, 0 to 1."""
        half = 0.5 * self.opacity_logits  # the logistic function as a tangent, which does not overflow
        return 0.5 + 0.5 * np.tanh(half)

    def select(self, rows: np.ndarray) -> Gaussians:
        """Those at `rows`, indices or a mask [N]."""
        return Gaussians(**{field.name: getattr(self, field.name)[rows] for field in fields(self)})

    @staticmethod
    def joined(parts: Sequence[Gaussians]) -> Gaussians:
        """Those of all parts, in order; the parts are of one degree."""
        names = [field.name for field in fields(Gaussians)]
        return Gaussians(**{name: np.concatenate([getattr(part, name) for part in parts]) for name in names})
