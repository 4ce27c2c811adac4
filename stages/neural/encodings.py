"""Encodings of positions with their spatial derivatives: a multiresolution hash (Müller et al. 2022), or frequencies
(NeRF); both progressive, coarse levels first (Neuralangelo, BARF).

`encode(points, table, encoding, active_levels)` returns features and their vector-Jacobian product (vjp): a function
from the gradient of anything with respect to the features [N, C] to its gradient with respect to the points [N, 3].
A normal is then the vjp of the MLP's gradient with respect to its inputs. Both are differentiable with respect to the
table and to what the vjp is given, so training needs first-order autograd only.

Three implementations agree to 1e-5: `encode_reference` (pure torch, any device), numba kernels on the CPU and Triton
kernels on CUDA, from which `encode` chooses. Kernels add the table's gradient to `table.grad` themselves:
`torch.autograd.grad` does not see it.

Layout: C channels, level-major. A hash grid's `table` is [rows, features]; level l owns the rows
offsets[l] .. offsets[l + 1]. A level whose full lattice fits its share is indexed densely, else by the spatial hash.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from functools import cache, partial
from typing import TYPE_CHECKING, Protocol, runtime_checkable

import torch
from torch import Tensor

from stages.caches import compiler_folder
from stages.neural.acceleration import takes_kernel
from stages.neural.encoding_shapes import Encoding, Frequencies, HashGrid

if TYPE_CHECKING:
    from jaxtyping import Float, Int

log = logging.getLogger(__name__)

# Müller et al. 2022, eq. 4: the spatial hash's factors for y and z (x has factor 1).
PRIME_Y, PRIME_Z = 2654435761, 805459861
# CUDA kernels that err by more than this, relative to the largest value, are not used: float32 rounding is below.
AGREEMENT = 1e-5


Vjp = Callable[[Tensor], Tensor]


@runtime_checkable
class EncodingKernels(Protocol):
    """What `encode` asks of the kernels of a hash grid on a device: `encoding_cpu` (numba), `encoding_cuda` (Triton).

    Tensors are float32. The Jacobian lies in memory as the kernels please.
    """

    def forward(
        self,
        points: Float[Tensor, "n 3"],
        table: Float[Tensor, "rows f"],
        grid: HashGrid,
        active_levels: int,
        with_jacobian: bool,
    ) -> tuple[Float[Tensor, "n c"], Tensor | None]:
        """Features and, where it is asked for, their Jacobian."""

    def backward(
        self,
        points: Float[Tensor, "n 3"],
        grid: HashGrid,
        active_levels: int,
        grad_features: Float[Tensor, "n c"] | None,
        grad_jacobian: tuple[Float[Tensor, "n 3"], Float[Tensor, "n c"]] | None,
        grad_table: Float[Tensor, "rows f"],
    ) -> None:
        """Add d loss / d table to grad_table, given the gradients of features and of the Jacobian, or one of them.

        The Jacobian's is of rank one and given by its factors g and u.
        """

    def vjp_forward(self, jacobian: Tensor, cotangent: Float[Tensor, "n c"]) -> Float[Tensor, "n 3"]:
        """The Jacobian times cotangent."""

    def vjp_backward(
        self, jacobian: Tensor, grad_gradients: Float[Tensor, "n 3"], channels: int
    ) -> Float[Tensor, "n {channels}"]:
        """The transposed Jacobian times grad_gradients."""


def encode(
    points: Float[Tensor, "n 3"], table: Float[Tensor, "rows f"] | None, encoding: Encoding, active_levels: int
) -> tuple[Float[Tensor, "n c"], Vjp]:
    """Features of points, and their vjp [N, C] -> [N, 3], which may be called once.

    Channels of levels >= active_levels are zero. A hash grid clamps points to [-1, 1]^3.
    """
    if isinstance(encoding, Frequencies):
        return _encode_frequencies(points, encoding, active_levels)
    assert table is not None
    kernels = kernels_for(points, encoding)
    if kernels is None:
        return encode_reference(points, table, encoding, active_levels)
    return encode_with(kernels, points, table, encoding, active_levels)


def encode_features(
    points: Float[Tensor, "n 3"], table: Float[Tensor, "rows f"] | None, encoding: Encoding, active_levels: int
) -> Float[Tensor, "n c"]:
    """Features alone, differentiable with respect to the table: for density without normals."""
    if isinstance(encoding, Frequencies):
        return _encode_frequencies(points, encoding, active_levels)[0]
    assert table is not None
    kernels = kernels_for(points, encoding)
    if kernels is None:
        return features_reference(points, table, encoding, active_levels)
    return _KernelFeatures.apply(points, table, encoding, active_levels, kernels)


def _encode_frequencies(
    points: Float[Tensor, "n 3"], encoding: Frequencies, active_levels: int
) -> tuple[Float[Tensor, "n c"], Vjp]:
    """`encode` by sines and cosines: plain torch, on every device."""
    frequencies = math.pi * 2.0 ** torch.arange(active_levels, device=points.device, dtype=points.dtype)
    angles = points[:, None] * frequencies[:, None]  # [N, levels, 3]
    sines, cosines = torch.sin(angles), torch.cos(angles)
    padding = encoding.channels - 6 * active_levels
    features = torch.nn.functional.pad(torch.cat([sines, cosines], 2).flatten(1), (0, padding))

    def vjp(cotangent: Tensor) -> Tensor:
        of_sines, of_cosines = cotangent[:, : 6 * active_levels].view(-1, active_levels, 6).split(3, 2)
        return torch.einsum("nka,k->na", of_sines * cosines - of_cosines * sines, frequencies)

    return features, vjp


# ---------------------------------------------------------------- which kernels
def kernels_for(points: Float[Tensor, "n 3"], grid: HashGrid) -> EncodingKernels | None:
    """The kernels that take these points, or None where the reference does: float64, no kernels.

    Those of the CPU are written for 4 features a level, those of CUDA for powers of two.
    """
    if grid.features == 4 and takes_kernel(points):
        from stages.neural import encoding_cpu

        return encoding_cpu
    if points.device.type == "cuda" and points.dtype == torch.float32 and grid.features.bit_count() == 1:
        return _cuda_kernels(grid.features, points.device)
    return None


@cache
def _cuda_kernels(features: int, device: torch.device) -> EncodingKernels | None:
    """The Triton kernels, if they are there and do on this device what the reference does; says once if not."""
    try:
        compiler_folder("TRITON_CACHE_DIR", "triton")
        from stages.neural import encoding_cuda

        error = disagreement(encoding_cuda, HashGrid(3, features, 9, 4, 16), device)
    except Exception as exception:  # Triton, its compiler and the driver raise what they like; the reference goes on
        log.warning("no CUDA kernels for the encoding (%s): it goes in plain PyTorch, several times slower", exception)
        return None
    if not error < AGREEMENT:
        log.warning("the CUDA kernels of the encoding are off by %.1e here: it goes in plain PyTorch", error)
        return None
    return encoding_cuda


@torch.enable_grad()
def disagreement(kernels: EncodingKernels, grid: HashGrid, device: torch.device | str, num_points: int = 300) -> float:
    """Largest error of kernels against the reference, relative to the largest value: of features, of a product with the
    Jacobian and of the gradients of both, at random points, some of which lie on the cube's faces and beyond."""
    generator = torch.Generator().manual_seed(0)
    points = (2.4 * torch.rand(num_points, 3, generator=generator) - 1.2).to(device)
    values = torch.randn(grid.num_rows, grid.features, generator=generator).to(device)
    pulls = torch.randn(num_points, grid.channels, generator=generator).to(device)
    results = []
    for encoder in (partial(encode_with, kernels), encode_reference):
        table, cotangent = values.clone().requires_grad_(), pulls.clone().requires_grad_()
        features, vjp = encoder(points, table, grid, grid.levels)
        gradients = vjp(cotangent)
        ((features * pulls).sum() + (gradients * torch.sin(3 * points)).sum()).backward()
        results.append((features, gradients, cotangent.grad, table.grad))
    return max(
        float(((got - expected).abs().max() / expected.abs().max()).detach())
        for got, expected in zip(*results, strict=True)
    )


# ---------------------------------------------------------------- the reference
def encode_reference(
    points: Float[Tensor, "n 3"], table: Float[Tensor, "rows f"], grid: HashGrid, active_levels: int
) -> tuple[Float[Tensor, "n c"], Vjp]:
    """`encode` in plain torch: the reference of the kernels, and what there is without them."""
    features, jacobian = hash_jacobian(points, table, grid, active_levels)
    return features, lambda cotangent: torch.bmm(jacobian, cotangent.unsqueeze(2)).squeeze(2)


def hash_jacobian(
    points: Float[Tensor, "n 3"], table: Float[Tensor, "rows f"], grid: HashGrid, active_levels: int
) -> tuple[Float[Tensor, "n c"], Float[Tensor, "n 3 c"]]:
    """Features and Jacobian (d feature / d coordinate) of a hash grid, in plain torch."""
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


def features_reference(
    points: Float[Tensor, "n 3"], table: Float[Tensor, "rows f"], grid: HashGrid, active_levels: int
) -> Float[Tensor, "n c"]:
    """`encode_features` in plain torch."""
    features = []
    for level in range(active_levels):
        corners, fraction, _ = _corners(points, grid, level)
        x, y, z = (torch.stack([1 - f, f], 1) for f in fraction.unbind(1))
        weights = (x[:, :, None, None] * y[:, None, :, None] * z[:, None, None, :]).flatten(1)
        features.append((table[corners] * weights[:, :, None]).sum(1))
    padding = grid.channels - active_levels * grid.features
    return torch.nn.functional.pad(torch.cat(features, 1), (0, padding))


def _corners(
    points: Float[Tensor, "n 3"], grid: HashGrid, level: int
) -> tuple[Int[Tensor, "n 8"], Float[Tensor, "n 3"], float]:
    """Table rows of the cell's corners, position in the cell, cells per scene unit."""
    resolution = int(grid.resolutions[level])
    scale = resolution / 2
    position = (points.clamp(-1, 1) + 1) * scale
    cell = position.detach().long().clamp(0, resolution - 1)
    fraction = position - cell
    offset = torch.arange(2, device=points.device)
    x, y, z = (cell[:, i, None] + offset for i in range(3))  # [N, 2] each
    if grid.dense[level]:
        side = resolution + 1
        rows = (x[:, :, None, None] * side + y[:, None, :, None]) * side + z[:, None, None, :]
    else:
        hashed = x[:, :, None, None] ^ (y * PRIME_Y)[:, None, :, None] ^ (z * PRIME_Z)[:, None, None, :]
        rows = hashed & (2**grid.log2_rows - 1)
    return rows.flatten(1) + int(grid.offsets[level]), fraction, scale


# ---------------------------------------------------------------- the kernels in autograd
def encode_with(
    kernels: EncodingKernels,
    points: Float[Tensor, "n 3"],
    table: Float[Tensor, "rows f"],
    grid: HashGrid,
    active_levels: int,
) -> tuple[Float[Tensor, "n c"], Vjp]:
    """`encode` by these kernels."""
    features, jacobian, *factors = _KernelEncode.apply(points, table, grid, active_levels, kernels)
    called = False

    def vjp(cotangent: Tensor) -> Tensor:
        nonlocal called
        if called:  # the factors of two products cannot be added
            raise RuntimeError("the vjp of an encoding was called twice, expected once")
        called = True
        return _KernelVjp.apply(cotangent, jacobian, kernels, *factors)

    return features, vjp


class _KernelEncode(torch.autograd.Function):
    """Features, Jacobian and two stand-ins for the Jacobian's gradient; gradients with respect to the table only.

    The Jacobian is used in one product with a cotangent u (`_KernelVjp`), so its gradient is g u^T, g [N, 3] the
    gradient of the product. Autograd would have to write that out as [N, 3, C]. The stand-ins have the shapes of g and
    u, hold nothing, and receive them as their gradients: one pass over the table then takes all gradients.
    """

    @staticmethod
    def forward(ctx, points, table, grid, active_levels, kernels):
        features, jacobian = kernels.forward(points, table, grid, active_levels, with_jacobian=True)
        ctx.save_for_backward(points, table)
        ctx.grid, ctx.active_levels, ctx.kernels = grid, active_levels, kernels
        ctx.mark_non_differentiable(jacobian)
        ctx.set_materialize_grads(False)
        stand_ins = (torch.empty(1, 1, device=points.device).expand(len(points), size) for size in (3, grid.channels))
        return features, jacobian, *stand_ins

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, grad_features, _, grad_gradients, cotangent):
        points, table = ctx.saved_tensors
        grad_jacobian = None if grad_gradients is None else (grad_gradients, cotangent)
        ctx.kernels.backward(points, ctx.grid, ctx.active_levels, grad_features, grad_jacobian, _grad_of(table))
        return None, None, None, None, None


def _grad_of(table: Tensor) -> Tensor:
    """The table's gradient [rows, F], which the kernels add to where it lies.

    Through autograd each query of the encoding would make and add a gradient as large as the table.
    """
    if table.grad is None:
        table.grad = torch.zeros_like(table)
    return table.grad


class _KernelVjp(torch.autograd.Function):
    """Jacobian times cotangent [N, C] -> [N, 3]; hands its factors' gradients on (see `_KernelEncode`)."""

    @staticmethod
    def forward(ctx, cotangent, jacobian, kernels, _grad_gradients, _cotangent):
        ctx.save_for_backward(cotangent, jacobian)
        ctx.kernels = kernels
        return kernels.vjp_forward(jacobian, cotangent)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, grad_gradients):
        cotangent, jacobian = ctx.saved_tensors
        grad_cotangent = ctx.kernels.vjp_backward(jacobian, grad_gradients, cotangent.shape[1])
        return grad_cotangent, None, None, grad_gradients, cotangent


class _KernelFeatures(torch.autograd.Function):
    """Features alone; gradients with respect to the table only."""

    @staticmethod
    def forward(ctx, points, table, grid, active_levels, kernels):
        ctx.save_for_backward(points, table)
        ctx.grid, ctx.active_levels, ctx.kernels = grid, active_levels, kernels
        return kernels.forward(points, table, grid, active_levels, with_jacobian=False)[0]

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, grad_features):
        points, table = ctx.saved_tensors
        ctx.kernels.backward(points, ctx.grid, ctx.active_levels, grad_features, None, _grad_of(table))
        return None, None, None, None, None
