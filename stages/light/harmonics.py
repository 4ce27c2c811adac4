"""Real spherical harmonics of a light, up to degree 3, and the irradiance that they give.

The basis is the one of Ramamoorthi & Hanrahan, "An Efficient Representation for Irradiance Environment Maps" (2001),
orthonormal over the sphere, without the Condon-Shortley phase, in the order (l, m) = (0, 0), (1, -1), (1, 0), (1, 1),
(2, -2), ... with their z being our up (+Y), their x our +Z and their y our +X: a turn of the axes, so handedness stays.
"""

from __future__ import annotations

import numpy as np

from stages.light.environment import directions, solid_angles

# A clamped cosine's own coefficients, which turn radiance into irradiance (the same paper, eq. 8).
COSINE = (np.pi, 2 * np.pi / 3, np.pi / 4, 0.0)


def basis(towards: np.ndarray, degree: int = 3) -> np.ndarray:
    """Values [..., (degree + 1)²] of the harmonics at unit directions [..., 3]; degree 3 at most."""
    if not 0 <= degree <= 3:
        raise ValueError(f"expected a degree of 0 to 3, got {degree}")
    y, z, x = np.moveaxis(np.asarray(towards, dtype=np.float64), -1, 0)
    one = np.ones_like(x)
    values = [
        0.282095 * one,
        0.488603 * y, 0.488603 * z, 0.488603 * x,
        1.092548 * x * y, 1.092548 * y * z, 0.315392 * (3 * z * z - 1), 1.092548 * x * z, 0.546274 * (x * x - y * y),
        0.590044 * y * (3 * x * x - y * y), 2.890611 * x * y * z, 0.457046 * y * (5 * z * z - 1),
        0.373176 * z * (5 * z * z - 3), 0.457046 * x * (5 * z * z - 1), 1.445306 * z * (x * x - y * y),
        0.590044 * x * (x * x - 3 * y * y),
    ]  # fmt: skip
    return np.stack(values[: (degree + 1) ** 2], axis=-1)


def project(radiance: np.ndarray, degree: int = 3) -> np.ndarray:
    """Coefficients [(degree + 1)², 3] of a map [H, 2 H, 3]: the integral of radiance times each harmonic."""
    height = len(radiance)
    weighted = basis(directions(height), degree) * solid_angles(height)[..., None]
    return np.einsum("hwk,hwc->kc", weighted, radiance)


def irradiance(coefficients: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Irradiance [..., 3] on surfaces with unit normals [..., 3]; from below zero, which ringing gives, it is cut."""
    degree = int(np.sqrt(len(coefficients))) - 1
    cosine = np.repeat(COSINE[: degree + 1], [2 * l + 1 for l in range(degree + 1)])
    return np.maximum(basis(normals, degree) @ (cosine[:, None] * coefficients), 0)
