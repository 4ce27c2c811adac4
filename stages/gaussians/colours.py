"""Colours that change with the direction, from the photos that see each Gaussian: linear least squares.

Notation: a Gaussian's colour in direction d is 1/2 + sum_k b_k(d) h_k, with the basis b of 3DGS and K harmonics h. Two
ways lead to h. `fit_each` takes each Gaussian by itself, from the photos' colours at its centre: no image is drawn.
`sweep` draws all photos, and each Gaussian takes in what is missing where it shows, in proportion to how much of each
pixel is its own (SIRT, Gilbert 1972): neighbours overlap, and what one has, the other need not add.

Few photos see a Gaussian, and many numbers explain them: what photos do not tell is taken from what a Gaussian's
neighbours have in common, which `fit_each` finds first and both keep to.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from stages.compiling import njit, prange
from stages.gaussians import kernels
from stages.gaussians.drawing import BLACK, Camera, render
from stages.gaussians.gaussians import Gaussians
from stages.gaussians.kernels import fill_basis
from stages.shading.observations import Observations

# Photos for each degree of the harmonics: fewer do not tell so many numbers apart.
PHOTOS_FOR_DEGREE = (1, 6, 12, 24)
# Pull of harmonics, in photos that see the Gaussian fully, to 0 at first and to the neighbours' mean then; that of
# degree 0 only settles what no photo tells.
RIDGE = (1e-3, 0.15, 0.3, 0.45)
# Neighbours with a Gaussian itself, and how many of their mean distances a turn of the normal by one radian counts as.
NEIGHBORS, TURN = 24, 12.0
# Errors beyond this (sRGB, 1 for full scale) count in proportion to their size, not its square (Huber).
HUBER = 0.06
_ROUNDS = 3
# Of what is missing where a Gaussian shows, so much is taken in: one sweep with this does what two with 1 do.
OVER_RELAXATION = np.float32(1.5)


def degree_for(num_photos: int) -> int:
    """Of harmonics that so many photos tell."""
    return max(degree for degree, least in enumerate(PHOTOS_FOR_DEGREE) if num_photos >= least or degree == 0)


def ridges(degree: int) -> np.ndarray:
    """[K] float32 pull of each harmonic to 0."""
    return np.repeat(RIDGE[: degree + 1], [2 * each + 1 for each in range(degree + 1)]).astype(np.float32)


def fit_each(seen: Observations, gains: np.ndarray, prior: np.ndarray) -> np.ndarray:
    """Harmonics [S, K, 3] float32 of points from photos' colours: ridge regression with Huber's loss.

    Args:
        gains: [photos, 3] that make photos agree.
        prior: [S, K, 3] float32 harmonics that they are pulled to.
    """
    colors = (seen.colors * gains[seen.photos]).astype(np.float32)
    harmonics = prior.copy()
    degree = int(np.sqrt(prior.shape[1])) - 1
    _fit_each(colors, seen.weights, seen.towards, ridges(degree), np.float32(HUBER), harmonics)
    return harmonics


def shared(
    harmonics: np.ndarray, centers: np.ndarray, normals: np.ndarray, at: np.ndarray, facing: np.ndarray
) -> np.ndarray:
    """What neighbours have in common [N, K, 3] float32 at N points: means over the nearest ones.

    Args:
        harmonics: [M, K, 3] of neighbours at `centers` and unit `normals` [M, 3].
        at, facing: [N, 3] points, and their unit normals.
    """
    from scipy.spatial import cKDTree

    tree = cKDTree(centers)
    spacing = float(np.median(tree.query(centers[:: max(1, len(centers) // 1000)], k=2)[0][:, 1]))
    tree = cKDTree(np.concatenate([centers, TURN * spacing * normals], axis=1))
    places = np.concatenate([at, TURN * spacing * facing], axis=1)
    nearest = tree.query(places, k=min(NEIGHBORS, len(centers)))[1].reshape(len(places), -1)
    means = np.zeros((len(at), *harmonics.shape[1:]), np.float32)
    for column in nearest.T:
        means += harmonics[column]
    return means / nearest.shape[1]


def sweep(
    gaussians: Gaussians,
    normals: np.ndarray,
    photos: Iterable[tuple[Camera, np.ndarray, np.ndarray]],
    prior: np.ndarray,
) -> Gaussians:
    """The Gaussians with harmonics nearer to the least-squares ones.

    Args:
        normals: [N, 3]; of the Gaussians on the surface those that face away from a photo are not drawn, for what
            faces it hides them.
        photos: camera, what it should see [H, W, 3] float32, and how much each pixel counts [H, W] float32.
        prior: [N, K, 3] float32 harmonics that they are pulled to.
    """
    count, terms = len(gaussians), gaussians.harmonics.shape[1]
    normal = np.zeros((count, terms * (terms + 1) // 2), np.float32)
    right = np.zeros((count, terms, 3), np.float32)
    for camera, photo, trust in photos:
        away = ((camera.position - gaussians.centers) * normals).sum(1) <= 0
        facing = np.flatnonzero(~(away & gaussians.anchored))
        drawing = render(gaussians.select(facing), camera, BLACK)
        found = drawing.ellipses
        # Where Gaussians leave a part of the pixel open, they owe only theirs.
        residual = photo * (1 - drawing.transmittance[..., None]) - drawing.image
        off = np.abs(residual).max(2)
        trust = (trust * np.minimum(1, HUBER / np.maximum(off, 1e-6))).astype(np.float32)
        parts = np.empty((len(found.members), 4), np.float32)
        kernels.weigh(
            found.starts, found.members, found.columns, found.means, found.conics, found.opacities, found.boxes,
            residual, trust, parts,
        )  # fmt: skip
        sums = np.empty((len(found.ids), 4), np.float32)
        kernels.add_parts(found.first, found.places, parts, sums)
        _take_in(facing[found.ids], sums, gaussians.centers, camera.position, normal, right)
    harmonics = gaussians.harmonics.copy()
    _solve_all(normal, right, ridges(gaussians.degree), prior, OVER_RELAXATION, harmonics)
    return replace(gaussians, harmonics=harmonics)


@njit(cache=True, nogil=True)
def _solve(matrix, right):  # pragma: no cover - compiled
    """Solve in place: right [K, 3] becomes matrix^-1 right, by Cholesky; of matrix [K, K] the lower part is used."""
    count = matrix.shape[0]
    for i in range(count):
        for j in range(i + 1):
            value = matrix[i, j]
            for k in range(j):
                value -= matrix[i, k] * matrix[j, k]
            if i == j:
                matrix[i, i] = np.sqrt(max(value, 1e-12))
            else:
                matrix[i, j] = value / matrix[j, j]
    for c in range(3):
        for i in range(count):
            value = right[i, c]
            for k in range(i):
                value -= matrix[i, k] * right[k, c]
            right[i, c] = value / matrix[i, i]
        for i in range(count - 1, -1, -1):
            value = right[i, c]
            for k in range(i + 1, count):
                value -= matrix[k, i] * right[k, c]
            right[i, c] = value / matrix[i, i]


@njit(parallel=True, cache=True, nogil=True)
def _fit_each(colors, weights, towards, ridge, huber, harmonics):  # pragma: no cover - compiled
    """Put the solution into harmonics [S, K, 3], which hold what they are pulled to."""
    count, most = weights.shape
    terms = harmonics.shape[1]
    for s in prange(count):
        basis = np.empty((most, terms), np.float32)
        trust = np.empty(most)
        for v in range(most):
            fill_basis(-towards[s, v, 0], -towards[s, v, 1], -towards[s, v, 2], basis[v])
            trust[v] = weights[s, v]
        for _ in range(_ROUNDS):
            matrix, right = np.zeros((terms, terms)), np.zeros((terms, 3))
            for v in range(most):
                if trust[v] <= 0:
                    continue
                for i in range(terms):
                    weighted = trust[v] * basis[v, i]
                    for j in range(i + 1):
                        matrix[i, j] += weighted * basis[v, j]
                    for c in range(3):
                        right[i, c] += weighted * (colors[s, v, c] - 0.5)
            for i in range(terms):
                matrix[i, i] += ridge[i]
                for c in range(3):
                    right[i, c] += ridge[i] * harmonics[s, i, c]
            _solve(matrix, right)
            for v in range(most):
                if weights[s, v] <= 0:
                    continue
                off = 0.0
                for c in range(3):
                    value = 0.5 - colors[s, v, c]
                    for i in range(terms):
                        value += basis[v, i] * right[i, c]
                    off = max(off, abs(value))
                trust[v] = weights[s, v] * min(1.0, huber / max(off, 1e-6))
        for i in range(terms):
            for c in range(3):
                harmonics[s, i, c] = right[i, c]


@njit(parallel=True, cache=True, nogil=True)
def _take_in(ids, sums, centers, position, normal, right):  # pragma: no cover - compiled
    """Add one photo, see `kernels.weigh`, to the normal equations of `ids`.

    normal: [N, K (K + 1) / 2] their lower parts; right: [N, K, 3] their right sides.
    """
    terms = right.shape[1]
    for m in prange(ids.shape[0]):
        n = ids[m]
        total = sums[m, 0]
        if total <= 0:
            continue
        x, y, z = centers[n, 0] - position[0], centers[n, 1] - position[1], centers[n, 2] - position[2]
        length = np.sqrt(x * x + y * y + z * z)
        basis = np.empty(terms, np.float32)
        fill_basis(x / length, y / length, z / length, basis)
        at = 0
        for i in range(terms):
            for c in range(3):
                right[n, i, c] += basis[i] * sums[m, 1 + c]
            for j in range(i + 1):
                normal[n, at] += total * basis[i] * basis[j]
                at += 1


@njit(parallel=True, cache=True, nogil=True)
def _solve_all(normal, right, ridge, prior, step, harmonics):  # pragma: no cover - compiled
    """Add to harmonics [N, K, 3] the step to the solution of each one's normal equations."""
    count, terms, _ = harmonics.shape
    for n in prange(count):
        if normal[n, 0] <= 0:
            continue
        matrix, change = np.empty((terms, terms)), np.empty((terms, 3))
        at = 0
        for i in range(terms):
            for j in range(i + 1):
                matrix[i, j] = normal[n, at]
                at += 1
            matrix[i, i] += ridge[i]
            for c in range(3):
                change[i, c] = right[n, i, c] + ridge[i] * (prior[n, i, c] - harmonics[n, i, c])
        _solve(matrix, change)
        for i in range(terms):
            for c in range(3):
                harmonics[n, i, c] += step * change[i, c]
