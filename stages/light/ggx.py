"""Reflection off rough surfaces: the microfacets of glTF 2.0 (appendix B) under an environment map.

Light from all around is split in two (Karis, "Real Shading in Unreal Engine 4", 2013):

    reflected = light(r, roughness) · (F0 · scale(n·v, roughness) + bias(n·v, roughness)),

the light blurred by the lobe around the mirrored direction r, as if seen along n = v = r, and what a white light would
give. D is GGX, V is Smith's height-correlated masking and shadowing, F is Schlick's, alpha = roughness².
"""

from __future__ import annotations

from functools import cache

import numpy as np

from stages.light.environment import directions, solid_angles

# F0 of what is no metal: an index of refraction of 1.5.
DIELECTRIC = 0.04
# Roughnesses of the blurred maps; between them one interpolates.
ROUGHNESSES = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0)
TABLE_SIDE = 64
_TABLE_PATHS = 512
# A pixel's own width takes part in the lobe: alpha of a lobe as wide as a pixel, in pixel widths (radians). The half
# vector moves half as far as the light, and a square of side s has the standard deviation s / sqrt(12).
_PIXEL_ALPHA = 0.5 / np.sqrt(12) * np.sqrt(2)


def lobe_matrix(roughness: float, rows_out: int, rows_in: int) -> np.ndarray:
    """The blur of a map of `rows_in` rows by the lobe of a roughness, at the pixels of one of `rows_out` rows.

    A row holds D(n·h) (n·l) dω of each incoming direction l, h halfway between l and n = r, divided by their sum.

    Returns:
        [2 rows_out², 2 rows_in²] float32; each row sums to 1.
    """
    towards, incoming = directions(rows_out).reshape(-1, 3), directions(rows_in).reshape(-1, 3)
    cosine = np.clip(towards @ incoming.T, -1, 1)
    alpha2 = np.float32(roughness**4 + (_PIXEL_ALPHA * np.pi / rows_in) ** 2)
    half2 = (1 + cosine) / 2  # (n·h)², by the half angle
    weights = np.maximum(cosine, 0) / (1 + half2 * (alpha2 - 1)) ** 2
    weights *= solid_angles(rows_in).reshape(-1)
    return weights / weights.sum(1, keepdims=True)


@cache
def lobe_matrices(rows_out: int, rows_in: int) -> np.ndarray:
    """`lobe_matrix` of all ROUGHNESSES [R, 2 rows_out², 2 rows_in²]."""
    return np.stack([lobe_matrix(roughness, rows_out, rows_in) for roughness in ROUGHNESSES])


def blurred(radiance: np.ndarray, roughness: float) -> np.ndarray:
    """A map [H, 2 H, 3] blurred by the lobe of one roughness, which may lie between ROUGHNESSES."""
    height = len(radiance)
    return (lobe_matrix(roughness, height, height) @ radiance.reshape(-1, 3)).reshape(radiance.shape)


def blur(lobes: np.ndarray, light: np.ndarray) -> np.ndarray:
    """A light [P, 3] blurred by lobes [R, P, P]: [R, P, 3]."""
    return np.stack([lobe @ light for lobe in lobes])


def blur_back(lobes: np.ndarray, values: np.ndarray) -> np.ndarray:
    """The transposed `blur`: [P, 3] from [R, P, 3]."""
    return np.sum([lobe.T @ each for lobe, each in zip(lobes, values, strict=True)], axis=0)


@cache
def split_sum_table() -> np.ndarray:
    """Scale and bias [TABLE_SIDE, TABLE_SIDE, 2] float32: row = roughness, column = n·v, both at (i + 1/2) / side.

    By importance sampling of D on a fixed lattice (Karis 2013; Smith's term as in glTF's appendix B.3.2).
    """
    grid = (np.arange(TABLE_SIDE) + 0.5) / TABLE_SIDE
    first = (np.arange(_TABLE_PATHS) + 0.5) / _TABLE_PATHS
    second = (np.arange(_TABLE_PATHS) * 0.6180339887498949) % 1
    alpha2 = grid[:, None] ** 4
    cos_h2 = (1 - first) / (1 + (alpha2 - 1) * first)  # [rough, paths]
    sin_h = np.sqrt(np.maximum(1 - cos_h2, 0)) * np.cos(2 * np.pi * second)
    cos_h = np.sqrt(cos_h2)
    view = np.stack([np.sqrt(1 - grid**2), grid], axis=1)  # in the plane of x and n
    vh = view[None, :, None, 0] * sin_h[:, None] + view[None, :, None, 1] * cos_h[:, None]  # [rough, view, paths]
    nl = 2 * vh * cos_h[:, None] - grid[None, :, None]
    nv, a2 = grid[None, :, None], alpha2[..., None]
    lit = np.maximum(nl, 1e-9)
    visibility = 0.5 / (lit * np.sqrt(nv**2 * (1 - a2) + a2) + nv * np.sqrt(lit**2 * (1 - a2) + a2))
    weight = np.where((nl > 0) & (vh > 0), 4 * visibility * lit * vh / cos_h[:, None], 0)
    fresnel = (1 - np.clip(vh, 0, 1)) ** 5
    return np.stack([((1 - fresnel) * weight).mean(2), (fresnel * weight).mean(2)], axis=2).astype(np.float32)


def split_sum(cosine: np.ndarray, roughness: np.ndarray | float) -> tuple[np.ndarray, np.ndarray]:
    """Scale and bias [...] float32 at n·v and roughness that broadcast against each other, by interpolation."""
    cosine, roughness = np.broadcast_arrays(np.asarray(cosine, np.float32), np.asarray(roughness, np.float32))
    table = split_sum_table()
    x, y = (np.clip(value * TABLE_SIDE - 0.5, 0, TABLE_SIDE - 1) for value in (cosine, roughness))
    x0, y0 = np.minimum(x.astype(np.int32), TABLE_SIDE - 2), np.minimum(y.astype(np.int32), TABLE_SIDE - 2)
    fx, fy = (x - x0)[..., None], (y - y0)[..., None]
    top = table[y0, x0] * (1 - fx) + table[y0, x0 + 1] * fx
    bottom = table[y0 + 1, x0] * (1 - fx) + table[y0 + 1, x0 + 1] * fx
    both = top * (1 - fy) + bottom * fy
    return both[..., 0], both[..., 1]
