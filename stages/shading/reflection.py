"""The light that reaches each observation, as linear functions of the environment map.

Notation: S points, K observations of each, R roughnesses (`ggx.ROUGHNESSES`), L the map [P, 3] of P pixels.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from stages.light import ggx
from stages.light.environment import bilinear, directions, solid_angles
from stages.shading.observations import Observations
from stages.shading.surroundings import ROWS as NEAR_ROWS
from stages.shading.surroundings import Surroundings

# Rows of the light's map that is solved for.
LIGHT_ROWS = 32
LEVELS = len(ggx.ROUGHNESSES)
_OF_POINTS = ("cosine", "bounced_diffuse", "pixels", "shares", "open", "bounced", "scale", "bias")


@dataclass(frozen=True)
class Reflection:
    """What turns a light into what points receive.

    Attributes:
        cosine: [S, P] clamped cosine dω / π of each pixel of the light's map, where it is not hidden: what a white
            matte point shows of it.
        bounced_diffuse: [S, 3] what such a point shows of the surface around it.
        pixels, shares: [S, K, 4] of the light's map around each mirrored direction.
        open: [S, K, R] part of each lobe that sees the light.
        bounced: [S, K, R, 3] what the lobe sees of the surface.
        scale, bias: [S, K, R] of the split sum.
        lobes: [R, P, P] `ggx.lobe_matrices`, for NumPy multiplies by so few columns several times as fast.
    """

    cosine: Tensor
    bounced_diffuse: Tensor
    pixels: Tensor
    shares: Tensor
    open: Tensor
    bounced: Tensor
    scale: Tensor
    bias: Tensor
    lobes: np.ndarray

    def select(self, rows: Tensor) -> Reflection:
        """That of some points."""
        return replace(self, **{name: getattr(self, name)[rows] for name in _OF_POINTS})

    def diffuse(self, light: Tensor) -> Tensor:
        """Radiance [S, 3] of white matte points under a light [P, 3]."""
        return self.cosine @ light + self.bounced_diffuse

    def mirrored(self, light: Tensor) -> Tensor:
        """What the lobes see of a light [P, 3]: [S, K, R, 3]."""
        blurred = torch.from_numpy(ggx.blur(self.lobes, light.numpy())).transpose(0, 1)  # [P, R, 3]
        seen = torch.einsum("skf,skfrc->skrc", self.shares, blurred[self.pixels])
        return seen * self.open[..., None] + self.bounced


def reflection(
    observations: Observations, normals: np.ndarray, around: Surroundings, light_from_scene: np.ndarray
) -> Reflection:
    """What turns light into what is observed of points with unit normals [S, 3] (scene frame)."""
    count, views = observations.weights.shape
    facing = np.clip(np.einsum("skc,sc->sk", observations.towards, normals), 1e-3, 1).astype(np.float32)
    mirrored = 2 * facing[..., None] * normals[:, None] - observations.towards
    mirrored = (mirrored @ light_from_scene.T).reshape(-1, 3)
    pixels, shares = bilinear(mirrored, LIGHT_ROWS)
    near_pixels, near_shares = bilinear(mirrored, NEAR_ROWS)
    lobes = ggx.lobe_matrices(NEAR_ROWS, NEAR_ROWS)
    own = np.repeat(np.arange(count), views)[:, None]
    opened = np.empty((count * views, LEVELS), np.float32)
    bounced = np.empty((count * views, LEVELS, 3), np.float32)
    for level, lobe in enumerate(lobes):
        opened[:, level] = (near_shares * (around.open @ lobe.T)[own, near_pixels]).sum(1)
        for c in range(3):
            bounced[:, level, c] = (near_shares * (around.bounced[..., c] @ lobe.T)[own, near_pixels]).sum(1)
    scale, bias = ggx.split_sum(facing[..., None], np.array(ggx.ROUGHNESSES, np.float32))
    cosine, bounced_diffuse = matte_weights(normals, around, light_from_scene)
    return Reflection(
        cosine=torch.from_numpy(cosine),
        bounced_diffuse=torch.from_numpy(bounced_diffuse),
        pixels=torch.from_numpy(pixels.reshape(count, views, 4).astype(np.int64)),
        shares=torch.from_numpy(shares.reshape(count, views, 4)),
        open=torch.from_numpy(opened.reshape(count, views, LEVELS)),
        bounced=torch.from_numpy(bounced.reshape(count, views, LEVELS, 3)),
        scale=torch.from_numpy(scale.astype(np.float32)),
        bias=torch.from_numpy(bias.astype(np.float32)),
        lobes=ggx.lobe_matrices(LIGHT_ROWS, LIGHT_ROWS),
    )


def matte_weights(
    normals: np.ndarray, around: Surroundings, light_from_scene: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """`Reflection.cosine` and `.bounced_diffuse`."""
    turned = (normals @ light_from_scene.T).astype(np.float32)
    finer = LIGHT_ROWS // NEAR_ROWS

    def weights(rows: int) -> np.ndarray:
        cosine = np.maximum(turned @ directions(rows).reshape(-1, 3).T, 0)
        return cosine * (solid_angles(rows).reshape(-1) / np.float32(np.pi))

    grid = around.open.reshape(-1, NEAR_ROWS, 2 * NEAR_ROWS)
    opened = grid.repeat(finer, axis=1).repeat(finer, axis=2).reshape(len(normals), -1)
    bounced = np.einsum("sp,spc->sc", weights(NEAR_ROWS), around.bounced)
    return weights(LIGHT_ROWS) * opened, bounced.astype(np.float32)
