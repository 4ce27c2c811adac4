"""Gaussians in another frame, their colours with them."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from stages.gaussians.gaussians import Gaussians
from stages.gaussians.harmonics import basis
from stages.geometry.similarity import Similarity
from stages.geometry.vectors import unit

if TYPE_CHECKING:
    from jaxtyping import Float

# Directions to fit a degree's rotation from: more than the 7 unknowns of a row at degree 3.
_DIRECTIONS = 32


def transformed(gaussians: Gaussians, target_from_gaussians: Similarity) -> Gaussians:
    """The Gaussians elsewhere: what a camera saw of them it sees again once it is moved along."""
    rotation = target_from_gaussians.rotation
    centers = target_from_gaussians.apply(gaussians.centers.astype(np.float64))
    return replace(
        gaussians,
        centers=centers.astype(np.float32),
        rotations=_turned(gaussians.rotations, rotation).astype(np.float32),
        log_scales=(gaussians.log_scales + np.log(target_from_gaussians.scale)).astype(np.float32),
        harmonics=turned_harmonics(gaussians.harmonics, rotation),
    )


def _turned(rotations: np.ndarray, turn: np.ndarray) -> np.ndarray:
    """Quaternions [N, 4] (w, x, y, z) of what a rotation matrix [3, 3] makes of those: Hamilton's product."""
    from scipy.spatial.transform import Rotation

    x, y, z, w = Rotation.from_matrix(turn).as_quat()
    product = np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])
    turned = rotations.astype(np.float64) @ product.T
    return turned / np.maximum(np.linalg.norm(turned, axis=1, keepdims=True), 1e-12)


def turned_harmonics(
    harmonics: Float[np.ndarray, "n k 3"], rotation: Float[np.ndarray, "3 3"]
) -> Float[np.ndarray, "n k 3"]:
    """Coefficients that say at `rotation @ direction` what `harmonics` say at the direction; exact."""
    degree = int(np.sqrt(harmonics.shape[1])) - 1
    turned = harmonics.astype(np.float64)
    for l in range(1, degree + 1):
        rows = slice(l**2, (l + 1) ** 2)
        turned[:, rows] = np.einsum("jk,nkc->njc", _degree_rotation(rotation, l), turned[:, rows])
    return turned.astype(np.float32)


def _degree_rotation(rotation: np.ndarray, degree: int) -> np.ndarray:
    """[2 l + 1, 2 l + 1] that rotates the coefficients of one degree l.

    Harmonics of a degree stay among themselves when they are rotated, so values of the basis at a few directions d
    and at those that the rotation brings there tell the matrix M: basis(d) @ M = basis(d @ rotation), row vectors.
    """
    directions = unit(np.random.default_rng(0).normal(size=(_DIRECTIONS, 3)))
    own = slice(degree**2, (degree + 1) ** 2)
    here, before = basis(directions, degree)[:, own], basis(directions @ rotation, degree)[:, own]
    return np.linalg.lstsq(here, before, rcond=None)[0]
