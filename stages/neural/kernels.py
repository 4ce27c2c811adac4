"""Multi-core CPU kernels of the hash encoding (numba). `encodings.py` says what they compute; this file is about speed.

Every kernel works on one level for one chunk of points at a time. The forward pass runs chunks in parallel; the
backward pass runs LEVELS in parallel, each thread owning its level's rows: no atomics, and the order of additions
never depends on the thread count, so gradients are deterministic.

A row is 4 floats wide and read whole. Corner index = 4 x + 2 y + z.
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange, uint32

PRIME_Y, PRIME_Z = np.uint32(2654435761), np.uint32(805459861)
CHUNK = 512  # points whose features and Jacobian stay in a core's L2 cache
_OPTIONS = dict(cache=True, fastmath=True, nogil=True, error_model="numpy", boundscheck=False)


@njit(inline="always")
def _cell(coordinate, resolution):
    """Cell index and position in the cell of one coordinate in [-1, 1]."""
    position = (min(max(coordinate, np.float32(-1)), np.float32(1)) + np.float32(1)) * np.float32(0.5 * resolution)
    cell = min(np.int32(position), np.int32(resolution - 1))
    return cell, position - np.float32(cell)


@njit(inline="always")
def _rows(x, y, z, resolution, dense, mask, offset):
    """The eight table rows of a cell's corners."""
    if dense:
        side = resolution + 1
        base = (x * side + y) * side + z + offset
        return (
            base, base + 1, base + side, base + side + 1,
            base + side * side, base + side * side + 1,
            base + side * side + side, base + side * side + side + 1,
        )  # fmt: skip
    x0, x1 = uint32(x), uint32(x + 1)
    y0 = uint32(uint32(y) * PRIME_Y)
    y1 = uint32(y0 + PRIME_Y)
    z0 = uint32(uint32(z) * PRIME_Z)
    z1 = uint32(z0 + PRIME_Z)
    return (
        offset + np.int64((x0 ^ y0 ^ z0) & mask), offset + np.int64((x0 ^ y0 ^ z1) & mask),
        offset + np.int64((x0 ^ y1 ^ z0) & mask), offset + np.int64((x0 ^ y1 ^ z1) & mask),
        offset + np.int64((x1 ^ y0 ^ z0) & mask), offset + np.int64((x1 ^ y0 ^ z1) & mask),
        offset + np.int64((x1 ^ y1 ^ z0) & mask), offset + np.int64((x1 ^ y1 ^ z1) & mask),
    )  # fmt: skip


@njit(**_OPTIONS)
def _interleaved(index, levels):
    """The level a backward pass takes at `index`: first the even ones, then the odd ones.

    Threads take contiguous runs of indices. Coarse levels stay in cache and fine ones do not, so a run of neighbours
    would leave one thread with all the slow ones.
    """
    half = (levels + 1) // 2
    return 2 * index if index < half else 2 * (index - half) + 1


@njit(parallel=True, **_OPTIONS)
def encode_forward(points, table, resolutions, offsets, dense, active_levels, features, jacobian):
    """Fill features [N, C] and jacobian [N, 3, C]."""
    num_points, channels = features.shape
    num_chunks = (num_points + CHUNK - 1) // CHUNK
    for chunk in prange(num_chunks):
        first, last = chunk * CHUNK, min((chunk + 1) * CHUNK, num_points)
        for level in range(active_levels):
            resolution, offset, is_dense = resolutions[level], offsets[level], dense[level]
            mask = uint32(offsets[level + 1] - offset - 1)
            scale = np.float32(0.5 * resolution)
            column = level * 4
            for p in range(first, last):
                ix, fx = _cell(points[p, 0], resolution)
                iy, fy = _cell(points[p, 1], resolution)
                iz, fz = _cell(points[p, 2], resolution)
                r0, r1, r2, r3, r4, r5, r6, r7 = _rows(ix, iy, iz, resolution, is_dense, mask, offset)
                for f in range(4):
                    v0, v1, v2, v3 = table[r0, f], table[r1, f], table[r2, f], table[r3, f]
                    v4, v5, v6, v7 = table[r4, f], table[r5, f], table[r6, f], table[r7, f]
                    d00, d01, d10, d11 = v1 - v0, v3 - v2, v5 - v4, v7 - v6
                    c00, c01, c10, c11 = v0 + fz * d00, v2 + fz * d01, v4 + fz * d10, v6 + fz * d11
                    dy0, dy1 = c01 - c00, c11 - c10
                    c0, c1 = c00 + fy * dy0, c10 + fy * dy1
                    dz0, dz1 = d00 + fy * (d01 - d00), d10 + fy * (d11 - d10)
                    features[p, column + f] = c0 + fx * (c1 - c0)
                    jacobian[p, 0, column + f] = scale * (c1 - c0)
                    jacobian[p, 1, column + f] = scale * (dy0 + fx * (dy1 - dy0))
                    jacobian[p, 2, column + f] = scale * (dz0 + fx * (dz1 - dz0))
        for p in range(first, last):
            for c in range(active_levels * 4, channels):
                features[p, c] = np.float32(0)
                jacobian[p, 0, c] = np.float32(0)
                jacobian[p, 1, c] = np.float32(0)
                jacobian[p, 2, c] = np.float32(0)


@njit(parallel=True, **_OPTIONS)
def encode_backward(points, resolutions, offsets, dense, active_levels, grad_features, grad_jacobian, grad_table):
    """Add d loss / d table [rows, 4] given the gradients of features [N, C] and jacobian [N, 3, C]."""
    num_points = len(points)
    for index in prange(active_levels):
        level = _interleaved(index, active_levels)
        resolution, offset, is_dense = resolutions[level], offsets[level], dense[level]
        mask = uint32(offsets[level + 1] - offset - 1)
        scale = np.float32(0.5 * resolution)
        one = np.float32(1)
        column = level * 4
        for p in range(num_points):
            ix, fx = _cell(points[p, 0], resolution)
            iy, fy = _cell(points[p, 1], resolution)
            iz, fz = _cell(points[p, 2], resolution)
            r0, r1, r2, r3, r4, r5, r6, r7 = _rows(ix, iy, iz, resolution, is_dense, mask, offset)
            gx, gy, gz = one - fx, one - fy, one - fz
            for f in range(4):
                a = grad_features[p, column + f]
                jx = scale * grad_jacobian[p, 0, column + f]
                jy = scale * grad_jacobian[p, 1, column + f]
                jz = scale * grad_jacobian[p, 2, column + f]
                # Each corner's share: w a + dw/dx jx + dw/dy jy + dw/dz jz with w = wx wy wz, factored over x.
                low, high = gx * a - jx, fx * a + jx
                q00 = gy * low - gx * jy
                q01 = fy * low + gx * jy
                q10 = gy * high - fx * jy
                q11 = fy * high + fx * jy
                z00, z01, z10, z11 = gx * gy * jz, gx * fy * jz, fx * gy * jz, fx * fy * jz
                grad_table[r0, f] += gz * q00 - z00
                grad_table[r1, f] += fz * q00 + z00
                grad_table[r2, f] += gz * q01 - z01
                grad_table[r3, f] += fz * q01 + z01
                grad_table[r4, f] += gz * q10 - z10
                grad_table[r5, f] += fz * q10 + z10
                grad_table[r6, f] += gz * q11 - z11
                grad_table[r7, f] += fz * q11 + z11


@njit(parallel=True, **_OPTIONS)
def features_forward(points, table, resolutions, offsets, dense, active_levels, features):
    """Fill features [N, C] alone."""
    num_points, channels = features.shape
    num_chunks = (num_points + CHUNK - 1) // CHUNK
    for chunk in prange(num_chunks):
        first, last = chunk * CHUNK, min((chunk + 1) * CHUNK, num_points)
        for level in range(active_levels):
            resolution, offset, is_dense = resolutions[level], offsets[level], dense[level]
            mask = uint32(offsets[level + 1] - offset - 1)
            column = level * 4
            for p in range(first, last):
                ix, fx = _cell(points[p, 0], resolution)
                iy, fy = _cell(points[p, 1], resolution)
                iz, fz = _cell(points[p, 2], resolution)
                r0, r1, r2, r3, r4, r5, r6, r7 = _rows(ix, iy, iz, resolution, is_dense, mask, offset)
                for f in range(4):
                    c00 = table[r0, f] + fz * (table[r1, f] - table[r0, f])
                    c01 = table[r2, f] + fz * (table[r3, f] - table[r2, f])
                    c10 = table[r4, f] + fz * (table[r5, f] - table[r4, f])
                    c11 = table[r6, f] + fz * (table[r7, f] - table[r6, f])
                    c0, c1 = c00 + fy * (c01 - c00), c10 + fy * (c11 - c10)
                    features[p, column + f] = c0 + fx * (c1 - c0)
        for p in range(first, last):
            for c in range(active_levels * 4, channels):
                features[p, c] = np.float32(0)


@njit(parallel=True, **_OPTIONS)
def features_backward(points, resolutions, offsets, dense, active_levels, grad_features, grad_table):
    """Add d loss / d table [rows, 4] given the gradient of features [N, C]."""
    num_points = len(points)
    for index in prange(active_levels):
        level = _interleaved(index, active_levels)
        resolution, offset, is_dense = resolutions[level], offsets[level], dense[level]
        mask = uint32(offsets[level + 1] - offset - 1)
        one = np.float32(1)
        column = level * 4
        for p in range(num_points):
            ix, fx = _cell(points[p, 0], resolution)
            iy, fy = _cell(points[p, 1], resolution)
            iz, fz = _cell(points[p, 2], resolution)
            r0, r1, r2, r3, r4, r5, r6, r7 = _rows(ix, iy, iz, resolution, is_dense, mask, offset)
            gx, gy, gz = one - fx, one - fy, one - fz
            for f in range(4):
                a = grad_features[p, column + f]
                q00, q01, q10, q11 = gx * gy * a, gx * fy * a, fx * gy * a, fx * fy * a
                grad_table[r0, f] += gz * q00
                grad_table[r1, f] += fz * q00
                grad_table[r2, f] += gz * q01
                grad_table[r3, f] += fz * q01
                grad_table[r4, f] += gz * q10
                grad_table[r5, f] += fz * q10
                grad_table[r6, f] += gz * q11
                grad_table[r7, f] += fz * q11


@njit(**_OPTIONS)
def _trilinear(values, x, y, z):
    """Cached f at a position in [-1, 1]^3; values [G, G, G] are indexed z, y, x."""
    last = values.shape[0] - 1
    ix, fx = _cell(x, last)
    iy, fy = _cell(y, last)
    iz, fz = _cell(z, last)
    one = np.float32(1)
    low = (one - fy) * ((one - fx) * values[iz, iy, ix] + fx * values[iz, iy, ix + 1]) + fy * (
        (one - fx) * values[iz, iy + 1, ix] + fx * values[iz, iy + 1, ix + 1]
    )
    high = (one - fy) * ((one - fx) * values[iz + 1, iy, ix] + fx * values[iz + 1, iy, ix + 1]) + fy * (
        (one - fx) * values[iz + 1, iy + 1, ix] + fx * values[iz + 1, iy + 1, ix + 1]
    )
    return (one - fz) * low + fz * high


# A path is solid, and its walk over, once f falls below this: a visibility of 0 to the last digit (100 f + 3 < -7).
_SOLID = np.float32(-0.1)


@njit(parallel=True, **_OPTIONS)
def smallest_on_paths(values, points, targets, start, smallest):
    """Fill smallest [P] with the least cached f met by sphere tracing from points [P, 3] towards targets [P, 3].

    A step is f long, or half a cell where f is smaller; the walk ends at the target, at the unit sphere, or inside.
    """
    num_points = len(points)
    half_cell = np.float32(1.0 / (values.shape[0] - 1))
    num_chunks = (num_points + CHUNK - 1) // CHUNK
    for chunk in prange(num_chunks):
        for p in range(chunk * CHUNK, min((chunk + 1) * CHUNK, num_points)):
            x, y, z = points[p, 0], points[p, 1], points[p, 2]
            dx, dy, dz = targets[p, 0] - x, targets[p, 1] - y, targets[p, 2] - z
            length = np.sqrt(dx * dx + dy * dy + dz * dz)
            dx, dy, dz = dx / length, dy / length, dz / length
            t, least = start[p], np.float32(2)
            while t < length:
                px, py, pz = x + t * dx, y + t * dy, z + t * dz
                if px * px + py * py + pz * pz > np.float32(1):
                    break
                f = _trilinear(values, px, py, pz)
                least = min(least, f)
                if f < _SOLID:
                    break
                t += max(f, half_cell)
            smallest[p] = least
