"""Multiresolution hash encoding with its exact Jacobian (Müller et al. 2022, progressive as in Neuralangelo).

`encode(points, table, grid)` returns features and their spatial Jacobian in ONE forward pass, both differentiable
with respect to the table. A normal is then Jacobian^T times the MLP's gradient with respect to its features, so
training needs first-order autograd only.

Two implementations agree to 1e-5: `encode_reference` (pure torch, any device) and the numba kernels behind
`encode` on the CPU.

Layout: C = levels * features channels, level-major. `table` is [rows, features]; level l owns the rows
offsets[l] .. offsets[l + 1]. A level whose full lattice fits its share is indexed densely, else by the spatial hash.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch

# Müller et al. 2022, eq. 4: the spatial hash's factors for y and z (x has factor 1).
PRIME_Y, PRIME_Z = 2654435761, 805459861
# A table starts as small noise: features begin near zero, so the geometric initialisation is what is rendered.
INITIAL_AMPLITUDE = 1e-4


@dataclass(frozen=True)
class HashGrid:
    """The shape of a hash encoding over the cube [-1, 1]^3.

    Attributes:
        levels: number of lattices, geometrically spaced from `coarsest` to `finest` cells along a side.
        features: channels per level (the CPU kernels are written for 4).
        log2_rows: a level holds at most 2**log2_rows rows.
        coarsest, finest: cells along a side of the first and last level.
    """

    levels: int = 8
    features: int = 4
    log2_rows: int = 17
    coarsest: int = 16
    finest: int = 512

    @property
    def channels(self) -> int:
        return self.levels * self.features

    @cached_property
    def resolutions(self) -> np.ndarray:
        """[L] int64 cells along a side per level."""
        if self.levels == 1:
            return np.array([self.coarsest], dtype=np.int64)
        growth = np.exp(np.log(self.finest / self.coarsest) / (self.levels - 1))
        return np.round(self.coarsest * growth ** np.arange(self.levels)).astype(np.int64)

    @cached_property
    def dense(self) -> np.ndarray:
        """[L] bool: whether the level's (res + 1)^3 lattice fits its rows without hashing."""
        return (self.resolutions + 1) ** 3 <= 2**self.log2_rows

    @cached_property
    def offsets(self) -> np.ndarray:
        """[L + 1] int64 first row of each level; the last entry is the number of rows."""
        rows = np.where(self.dense, (self.resolutions + 1) ** 3, 2**self.log2_rows)
        return np.concatenate([[0], np.cumsum(rows)]).astype(np.int64)

    @property
    def num_rows(self) -> int:
        return int(self.offsets[-1])

    def voxel_size(self, active_levels: int | None = None) -> float:
        """Side of a cell of the finest active level, in scene units."""
        return 2.0 / float(self.resolutions[(active_levels or self.levels) - 1])

    def initial_table(self, generator: torch.Generator) -> torch.Tensor:
        """[rows, features] float32 uniform noise of amplitude `INITIAL_AMPLITUDE`."""
        noise = torch.rand(self.num_rows, self.features, generator=generator)
        return (noise * 2 - 1) * INITIAL_AMPLITUDE


def encode(
    points: torch.Tensor, table: torch.Tensor, grid: HashGrid, active_levels: int
) -> tuple[torch.Tensor, torch.Tensor]:
    """Features [N, C] and Jacobian [N, 3, C] (d feature / d coordinate) of points [N, 3].

    Channels of levels >= active_levels are zero. Points outside [-1, 1]^3 are clamped to it.
    """
    if points.is_cuda or grid.features != 4:
        return encode_reference(points, table, grid, active_levels)
    return _KernelEncode.apply(points, table, grid, active_levels)


def encode_features(points: torch.Tensor, table: torch.Tensor, grid: HashGrid, active_levels: int) -> torch.Tensor:
    """Features [N, C] alone, differentiable with respect to the table: for density without normals."""
    if points.is_cuda or grid.features != 4:
        return _reference_features(points, table, grid, active_levels)
    return _KernelFeatures.apply(points, table, grid, active_levels)


def encode_reference(
    points: torch.Tensor, table: torch.Tensor, grid: HashGrid, active_levels: int
) -> tuple[torch.Tensor, torch.Tensor]:
    """`encode` in plain torch: the reference of the kernels, and the path on CUDA."""
    features, jacobians = [], []
    for level in range(active_levels):
        corners, fraction, scale = _corners(points, grid, level)
        values = table[corners]  # [N, 8, F], corner index = 4 x + 2 y + z
        x, y, z = fraction[:, 0, None], fraction[:, 1, None], fraction[:, 2, None]
        v000, v001, v010, v011, v100, v101, v110, v111 = values.unbind(1)
        # Interpolate along z, then y, then x; keep the differences: they are the derivatives.
        c00, c01, c10, c11 = (
            low + z * (high - low) for low, high in ((v000, v001), (v010, v011), (v100, v101), (v110, v111))
        )
        d00, d01, d10, d11 = v001 - v000, v011 - v010, v101 - v100, v111 - v110
        c0, c1 = c00 + y * (c01 - c00), c10 + y * (c11 - c10)
        dz0, dz1 = d00 + y * (d01 - d00), d10 + y * (d11 - d10)
        dy0, dy1 = c01 - c00, c11 - c10
        features.append(c0 + x * (c1 - c0))
        jacobian = torch.stack([c1 - c0, dy0 + x * (dy1 - dy0), dz0 + x * (dz1 - dz0)], 1)
        jacobians.append(jacobian * scale)
    padding = grid.channels - active_levels * grid.features
    feature, jacobian = torch.cat(features, 1), torch.cat(jacobians, 2)
    return torch.nn.functional.pad(feature, (0, padding)), torch.nn.functional.pad(jacobian, (0, padding))


def _reference_features(points: torch.Tensor, table: torch.Tensor, grid: HashGrid, active_levels: int) -> torch.Tensor:
    features = []
    for level in range(active_levels):
        corners, fraction, _ = _corners(points, grid, level)
        x, y, z = (torch.stack([1 - f, f], 1) for f in fraction.unbind(1))
        weights = (x[:, :, None, None] * y[:, None, :, None] * z[:, None, None, :]).flatten(1)
        features.append((table[corners] * weights[:, :, None]).sum(1))
    padding = grid.channels - active_levels * grid.features
    return torch.nn.functional.pad(torch.cat(features, 1), (0, padding))


def _corners(points: torch.Tensor, grid: HashGrid, level: int) -> tuple[torch.Tensor, torch.Tensor, float]:
    """Table rows [N, 8] of the cell's corners, position in the cell [N, 3], cells per scene unit."""
    resolution = int(grid.resolutions[level])
    scale = resolution / 2
    position = (points.clamp(-1, 1) + 1) * scale
    cell = position.detach().long().clamp(0, resolution - 1)
    fraction = position - cell
    offset = torch.tensor([0, 1], device=points.device)
    x, y, z = (cell[:, i, None] + offset for i in range(3))  # [N, 2] each
    if grid.dense[level]:
        side = resolution + 1
        rows = (x[:, :, None, None] * side + y[:, None, :, None]) * side + z[:, None, None, :]
    else:
        hashed = x[:, :, None, None] ^ (y * PRIME_Y)[:, None, :, None] ^ (z * PRIME_Z)[:, None, None, :]
        rows = hashed & (2**grid.log2_rows - 1)
    return rows.flatten(1) + int(grid.offsets[level]), fraction, scale


class _KernelEncode(torch.autograd.Function):
    """`encode` through the numba kernels; gradients with respect to the table only."""

    @staticmethod
    def forward(ctx, points, table, grid, active_levels):
        from stages.neural import kernels

        features = torch.empty(len(points), grid.channels)
        jacobian = torch.empty(len(points), 3, grid.channels)
        kernels.encode_forward(
            points.detach().numpy(), table.detach().numpy(), grid.resolutions, grid.offsets, grid.dense,
            active_levels, features.numpy(), jacobian.numpy(),
        )  # fmt: skip
        ctx.save_for_backward(points, table)
        ctx.grid, ctx.active_levels = grid, active_levels
        return features, jacobian

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, grad_features, grad_jacobian):
        from stages.neural import kernels

        points, table = ctx.saved_tensors
        grid = ctx.grid
        grad_table = torch.zeros_like(table)
        kernels.encode_backward(
            points.detach().numpy(), grid.resolutions, grid.offsets, grid.dense, ctx.active_levels,
            grad_features.contiguous().numpy(), grad_jacobian.contiguous().numpy(), grad_table.numpy(),
        )  # fmt: skip
        return None, grad_table, None, None


class _KernelFeatures(torch.autograd.Function):
    """`encode_features` through the numba kernels; gradients with respect to the table only."""

    @staticmethod
    def forward(ctx, points, table, grid, active_levels):
        from stages.neural import kernels

        features = torch.empty(len(points), grid.channels)
        kernels.features_forward(
            points.detach().numpy(), table.detach().numpy(), grid.resolutions, grid.offsets, grid.dense,
            active_levels, features.numpy(),
        )  # fmt: skip
        ctx.save_for_backward(points, table)
        ctx.grid, ctx.active_levels = grid, active_levels
        return features

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, grad_features):
        from stages.neural import kernels

        points, table = ctx.saved_tensors
        grid = ctx.grid
        grad_table = torch.zeros_like(table)
        kernels.features_backward(
            points.detach().numpy(), grid.resolutions, grid.offsets, grid.dense, ctx.active_levels,
            grad_features.contiguous().numpy(), grad_table.numpy(),
        )  # fmt: skip
        return None, grad_table, None, None
