"""The hash encoding's kernels on CUDA, tensors in and out (Triton).

What each function computes, and the shapes: `stages.neural.encodings.EncodingKernels`. The arithmetic is that of the
CPU kernels.

A program takes one level of `BLOCK` points. Levels are the slower axis of the launch, so that about one level's rows
are in use at a time and stay in the L2 cache. Features and Jacobian lie channel by channel in memory, [C, N] and
[3, C, N], and are handed on as transposed views: neighbouring threads write neighbouring places, and matrix products
read either order. The backward pass adds to the table with atomics; its order of additions is the device's.

Only the channels of active levels are computed; the rest of what is handed on is zero.
"""

from __future__ import annotations

from functools import cache

import numpy as np
import torch
import triton
import triton.language as tl
from torch import Tensor

from stages.neural.encoding_shapes import HashGrid

BLOCK = 128  # points a program
PRIME_Y, PRIME_Z = tl.constexpr(2654435761), tl.constexpr(805459861)


# ---------------------------------------------------------------- kernels
@triton.jit
def _cell(coordinate, resolution):
    """Cell index and position in the cell of coordinates in [-1, 1]; those beyond are clamped."""
    position = (tl.minimum(tl.maximum(coordinate, -1.0), 1.0) + 1.0) * (0.5 * resolution.to(tl.float32))
    cell = tl.minimum(tl.maximum(position.to(tl.int32), 0), resolution - 1)
    return cell, position - cell.to(tl.float32)


@triton.jit
def _locate(points, levels, level, n, inside):
    """Resolution, first row and kind of a level; cells and positions in them of points `n`."""
    resolution = tl.load(levels + 3 * level)
    offset, dense = tl.load(levels + 3 * level + 1), tl.load(levels + 3 * level + 2)
    x, fx = _cell(tl.load(points + 3 * n, mask=inside, other=0.0), resolution)
    y, fy = _cell(tl.load(points + 3 * n + 1, mask=inside, other=0.0), resolution)
    z, fz = _cell(tl.load(points + 3 * n + 2, mask=inside, other=0.0), resolution)
    return resolution, offset, dense, x, y, z, fx, fy, fz


@triton.jit
def _places(
    x, y, z, corner: tl.constexpr, resolution, offset, dense, ROW_MASK: tl.constexpr, FEATURES: tl.constexpr
):  # fmt: skip
    """Where in the table a corner's row lies, [BLOCK, FEATURES]; corner = 4 x + 2 y + z."""
    x, y, z = (x + corner // 4).to(tl.uint32), (y + corner // 2 % 2).to(tl.uint32), (z + corner % 2).to(tl.uint32)
    side = (resolution + 1).to(tl.uint32)
    lattice = (x * side + y) * side + z
    hashed = (x ^ (y * PRIME_Y) ^ (z * PRIME_Z)) & ROW_MASK
    row = tl.where(dense != 0, lattice, hashed).to(tl.int64) + offset
    return row[:, None] * FEATURES + tl.arange(0, FEATURES)[None, :]


@triton.jit
def _encode(
    points, table, levels, features, jacobian, num_points, axis,
    ROW_MASK: tl.constexpr, FEATURES: tl.constexpr, WITH_JACOBIAN: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Fill features [C, N] and, if asked, jacobian [3, C, N] for one level of a block of points."""
    level = tl.program_id(1)
    n = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    inside = n < num_points
    resolution, offset, dense, x, y, z, fx, fy, fz = _locate(points, levels, level, n, inside)
    fx, fy, fz = fx[:, None], fy[:, None], fz[:, None]
    v0 = tl.load(table + _places(x, y, z, 0, resolution, offset, dense, ROW_MASK, FEATURES))
    v1 = tl.load(table + _places(x, y, z, 1, resolution, offset, dense, ROW_MASK, FEATURES))
    v2 = tl.load(table + _places(x, y, z, 2, resolution, offset, dense, ROW_MASK, FEATURES))
    v3 = tl.load(table + _places(x, y, z, 3, resolution, offset, dense, ROW_MASK, FEATURES))
    v4 = tl.load(table + _places(x, y, z, 4, resolution, offset, dense, ROW_MASK, FEATURES))
    v5 = tl.load(table + _places(x, y, z, 5, resolution, offset, dense, ROW_MASK, FEATURES))
    v6 = tl.load(table + _places(x, y, z, 6, resolution, offset, dense, ROW_MASK, FEATURES))
    v7 = tl.load(table + _places(x, y, z, 7, resolution, offset, dense, ROW_MASK, FEATURES))
    d00, d01, d10, d11 = v1 - v0, v3 - v2, v5 - v4, v7 - v6
    c00, c01, c10, c11 = v0 + fz * d00, v2 + fz * d01, v4 + fz * d10, v6 + fz * d11
    dy0, dy1 = c01 - c00, c11 - c10
    c0, c1 = c00 + fy * dy0, c10 + fy * dy1
    channel = (level * FEATURES + tl.arange(0, FEATURES)).to(tl.int64)
    place = channel[None, :] * num_points + n[:, None]
    kept = inside[:, None]
    tl.store(features + place, c0 + fx * (c1 - c0), mask=kept)
    if WITH_JACOBIAN:
        scale = 0.5 * resolution.to(tl.float32)
        dz0, dz1 = d00 + fy * (d01 - d00), d10 + fy * (d11 - d10)
        tl.store(jacobian + place, scale * (c1 - c0), mask=kept)
        tl.store(jacobian + axis + place, scale * (dy0 + fx * (dy1 - dy0)), mask=kept)
        tl.store(jacobian + 2 * axis + place, scale * (dz0 + fx * (dz1 - dz0)), mask=kept)


@triton.jit
def _add_gradient(
    points, levels, grad_features, grad_gradients, cotangent, grad_table, num_points,
    feature_row, feature_column, cotangent_row, cotangent_column,
    ROW_MASK: tl.constexpr, FEATURES: tl.constexpr, OF_FEATURES: tl.constexpr, OF_JACOBIAN: tl.constexpr,
    BLOCK: tl.constexpr,
):  # fmt: skip
    """Add one level's part of d loss / d table for a block of points.

    A corner's share is w a + (dw . s) u: w = wx wy wz its weight, a and u the incoming gradient of the features and the
    cotangent, s the incoming gradient of their product with the Jacobian in cells.
    """
    level = tl.program_id(1)
    n = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    inside = n < num_points
    resolution, offset, dense, x, y, z, fx, fy, fz = _locate(points, levels, level, n, inside)
    kept = inside[:, None]
    channel = (level * FEATURES + tl.arange(0, FEATURES)).to(tl.int64)[None, :]
    if OF_FEATURES:
        a = tl.load(grad_features + n[:, None] * feature_row + channel * feature_column, mask=kept, other=0.0)
    if OF_JACOBIAN:
        u = tl.load(cotangent + n[:, None] * cotangent_row + channel * cotangent_column, mask=kept, other=0.0)
        scale = 0.5 * resolution.to(tl.float32)
        sx = scale * tl.load(grad_gradients + 3 * n, mask=inside, other=0.0)
        sy = scale * tl.load(grad_gradients + 3 * n + 1, mask=inside, other=0.0)
        sz = scale * tl.load(grad_gradients + 3 * n + 2, mask=inside, other=0.0)
    for corner in tl.static_range(8):
        wx = fx if corner // 4 else 1.0 - fx
        wy = fy if corner // 2 % 2 else 1.0 - fy
        wz = fz if corner % 2 else 1.0 - fz
        share = tl.full((BLOCK, FEATURES), 0.0, tl.float32)
        if OF_FEATURES:
            share += (wx * wy * wz)[:, None] * a
        if OF_JACOBIAN:
            dx = sx if corner // 4 else -sx
            dy = sy if corner // 2 % 2 else -sy
            dz = sz if corner % 2 else -sz
            share += (dx * wy * wz + wx * dy * wz + wx * wy * dz)[:, None] * u
        places = _places(x, y, z, corner, resolution, offset, dense, ROW_MASK, FEATURES)
        tl.atomic_add(grad_table + places, share, mask=kept, sem="relaxed")


@triton.jit
def _vjp(jacobian, cotangent, gradients, num_points, channels, axis, row, column, BLOCK: tl.constexpr):
    """Fill gradients [N, 3] with jacobian [3, C, N] times cotangent [N, C] for a block of points."""
    n = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    inside = n < num_points
    x = tl.full((BLOCK,), 0.0, tl.float32)
    y = tl.full((BLOCK,), 0.0, tl.float32)
    z = tl.full((BLOCK,), 0.0, tl.float32)
    at, of = jacobian + n, cotangent + n * row
    for _ in range(channels):
        u = tl.load(of, mask=inside, other=0.0)
        x += tl.load(at, mask=inside, other=0.0) * u
        y += tl.load(at + axis, mask=inside, other=0.0) * u
        z += tl.load(at + 2 * axis, mask=inside, other=0.0) * u
        at += num_points
        of += column
    tl.store(gradients + 3 * n, x, mask=inside)
    tl.store(gradients + 3 * n + 1, y, mask=inside)
    tl.store(gradients + 3 * n + 2, z, mask=inside)


@triton.jit
def _vjp_gradient(jacobian, grad_gradients, grad_cotangent, num_points, axis, BLOCK: tl.constexpr):
    """Fill one channel of grad_cotangent [C, N] with jacobian^T times grad_gradients [N, 3] for a block of points."""
    n = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    inside = n < num_points
    place = tl.program_id(1).to(tl.int64) * num_points + n
    total = tl.load(grad_gradients + 3 * n, mask=inside, other=0.0) * tl.load(jacobian + place, mask=inside, other=0.0)
    total += tl.load(grad_gradients + 3 * n + 1, mask=inside, other=0.0) * tl.load(
        jacobian + axis + place, mask=inside, other=0.0
    )
    total += tl.load(grad_gradients + 3 * n + 2, mask=inside, other=0.0) * tl.load(
        jacobian + 2 * axis + place, mask=inside, other=0.0
    )
    tl.store(grad_cotangent + place, total, mask=inside)


# ---------------------------------------------------------------- tensors in and out
def forward(
    points: Tensor, table: Tensor, grid: HashGrid, active_levels: int, with_jacobian: bool
) -> tuple[Tensor, Tensor | None]:
    features, active = torch.empty(grid.channels, len(points), device=points.device), active_levels * grid.features
    jacobian = torch.empty(3, active, len(points), device=points.device) if with_jacobian else None
    features[active:].zero_()
    _encode[_programs(points, active_levels)](
        points.detach().contiguous(), table.detach(), _levels_of(grid, points.device), features, jacobian,
        len(points), active * len(points),
        ROW_MASK=2**grid.log2_rows - 1, FEATURES=grid.features, WITH_JACOBIAN=with_jacobian, BLOCK=BLOCK,
    )  # fmt: skip
    return features.T, jacobian


def backward(
    points: Tensor,
    grid: HashGrid,
    active_levels: int,
    grad_features: Tensor | None,
    grad_jacobian: tuple[Tensor, Tensor] | None,
    grad_table: Tensor,
) -> None:
    grad_gradients, cotangent = grad_jacobian or (None, None)
    _add_gradient[_programs(points, active_levels)](
        points.detach().contiguous(), _levels_of(grid, points.device), grad_features,
        None if grad_gradients is None else grad_gradients.contiguous(), cotangent, grad_table, len(points),
        *(grad_features.stride() if grad_features is not None else (0, 0)),
        *(cotangent.stride() if cotangent is not None else (0, 0)),
        ROW_MASK=2**grid.log2_rows - 1, FEATURES=grid.features,
        OF_FEATURES=grad_features is not None, OF_JACOBIAN=cotangent is not None, BLOCK=BLOCK,
    )  # fmt: skip


def vjp_forward(jacobian: Tensor, cotangent: Tensor) -> Tensor:
    _, active, num_points = jacobian.shape
    gradients = torch.empty(num_points, 3, device=jacobian.device)
    _vjp[(triton.cdiv(num_points, BLOCK),)](
        jacobian, cotangent.detach(), gradients, num_points, active, active * num_points, *cotangent.stride(),
        BLOCK=BLOCK,
    )  # fmt: skip
    return gradients


def vjp_backward(jacobian: Tensor, grad_gradients: Tensor, channels: int) -> Tensor:
    _, active, num_points = jacobian.shape
    grad_cotangent = torch.empty(channels, num_points, device=jacobian.device)
    grad_cotangent[active:].zero_()
    _vjp_gradient[(triton.cdiv(num_points, BLOCK), active)](
        jacobian, grad_gradients.contiguous(), grad_cotangent, num_points, active * num_points, BLOCK=BLOCK
    )
    return grad_cotangent.T


def _programs(points: Tensor, active_levels: int) -> tuple[int, int]:
    return triton.cdiv(len(points), BLOCK), active_levels


@cache
def _levels_of(grid: HashGrid, device: torch.device) -> Tensor:
    """[L, 3] int32 on the device: cells along a side, first row, whether it is dense. Kept: an upload waits."""
    levels = np.stack([grid.resolutions, grid.offsets[:-1], grid.dense], 1).astype(np.int32)
    return torch.from_numpy(levels).to(device)
