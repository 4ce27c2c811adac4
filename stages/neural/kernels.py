"""Multi-core CPU kernels of the networks and the sampler (numba).

The modules that call them say what they compute; this file is about speed.

Hash encoding: every kernel works on one level for one chunk of points at a time, in two passes: first the rows and
positions of the whole chunk, which vectorises, then the table, whose reads then wait for nothing but memory. The
forward pass runs chunks in parallel; the backward pass runs LEVELS in parallel, each thread owning its level's rows:
no atomics, and the order of additions never depends on the thread count, so gradients are deterministic.

A row is 4 floats wide and read whole. Corner index = 4 x + 2 y + z. Indices are unsigned where it is hot: numba tests
signed ones for counting from the end, which costs as much as the read.

The table is larger than a core's caches, and a point's rows lie anywhere in it: rows are asked for some points ahead.
"""

from __future__ import annotations

import numpy as np

from stages.compiling import njit, prange, prefetch_row, uint32

PRIME_Y, PRIME_Z = np.uint32(2654435761), np.uint32(805459861)
CHUNK = 512  # points whose rows, features and Jacobian stay in a core's L2 cache
AHEAD = 32  # points whose rows are on their way: 16 to 128 do, and 0 takes 2.7 times as long
# No `fastmath`. The process that compiles a kernel runs another copy of it than those that find it in the cache, and
# with leave to reorder sums LLVM rounds in the two differently: the first training would not be the second. It would
# save one or two parts in a hundred of a step.
_OPTIONS = dict(cache=True, nogil=True, error_model="numpy", boundscheck=False)


@njit(inline="always")
def _cell(coordinate, resolution):
    """Cell index and position in the cell of one coordinate in [-1, 1]."""
    position = (min(max(coordinate, np.float32(-1)), np.float32(1)) + np.float32(1)) * np.float32(0.5 * resolution)
    cell = min(np.int32(position), np.int32(resolution - 1))
    return cell, position - np.float32(cell)


@njit(inline="always")
def _rows(x, y, z, resolution, dense, mask, offset):
    """The eight table rows of a cell's corners."""
    one = uint32(1)
    if dense:
        side = uint32(resolution + 1)
        slab = side * side
        base = (uint32(x) * side + uint32(y)) * side + uint32(z) + offset
        return (
            base, base + one, base + side, base + side + one,
            base + slab, base + slab + one, base + slab + side, base + slab + side + one,
        )  # fmt: skip
    x0, x1 = uint32(x), uint32(x + 1)
    y0 = uint32(uint32(y) * PRIME_Y)
    y1 = uint32(y0 + PRIME_Y)
    z0 = uint32(uint32(z) * PRIME_Z)
    z1 = uint32(z0 + PRIME_Z)
    return (
        offset + ((x0 ^ y0 ^ z0) & mask), offset + ((x0 ^ y0 ^ z1) & mask),
        offset + ((x0 ^ y1 ^ z0) & mask), offset + ((x0 ^ y1 ^ z1) & mask),
        offset + ((x1 ^ y0 ^ z0) & mask), offset + ((x1 ^ y0 ^ z1) & mask),
        offset + ((x1 ^ y1 ^ z0) & mask), offset + ((x1 ^ y1 ^ z1) & mask),
    )  # fmt: skip


@njit(inline="always")
def _locate_one(points, p, q, resolution, dense, mask, offset, rows, fractions):
    ix, fx = _cell(points[p, 0], resolution)
    iy, fy = _cell(points[p, 1], resolution)
    iz, fz = _cell(points[p, 2], resolution)
    (
        rows[0, q], rows[1, q], rows[2, q], rows[3, q], rows[4, q], rows[5, q], rows[6, q], rows[7, q],
    ) = _rows(ix, iy, iz, resolution, dense, mask, offset)  # fmt: skip
    fractions[0, q], fractions[1, q], fractions[2, q] = fx, fy, fz


@njit(**_OPTIONS)
def _locate(points, first, count, resolution, offset, end, dense, rows, fractions):
    """Fill rows [8, CHUNK] and positions in the cell, fractions [3, CHUNK], of `count` points from `first` on."""
    start, mask = uint32(offset), uint32(end - offset - 1)
    if dense:  # two loops, so that the compiler sees each without a branch
        for q in range(count):
            _locate_one(points, uint32(first + q), q, resolution, True, mask, start, rows, fractions)
    else:
        for q in range(count):
            _locate_one(points, uint32(first + q), q, resolution, False, mask, start, rows, fractions)


@njit(inline="always")
def _ask_for(table, rows, first, last):
    """Rows of the table at rows[:, first:last] will be wanted."""
    for q in range(first, last):
        for corner in range(uint32(8)):
            prefetch_row(table, rows[corner, q])


@njit(**_OPTIONS)
def _interleaved(index, levels):
    """The level a backward pass takes at `index`: first the even ones, then the odd ones.

    Threads take contiguous runs of indices. Coarse levels stay in cache and fine ones do not, so a run of neighbours
    would leave one thread with all the slow ones.
    """
    half = (levels + 1) // 2
    return 2 * index if index < half else 2 * (index - half) + 1


@njit(**_OPTIONS)
def _encode_chunk(table, first, count, column, scale, rows, fractions, features, jacobian):
    """One level's columns of features, and of jacobian unless it is None, for the located points."""
    _ask_for(table, rows, 0, min(AHEAD, count))
    for q in range(count):
        _ask_for(table, rows, q + AHEAD, min(q + AHEAD + 1, count))
        p = uint32(first + q)
        fx, fy, fz = fractions[0, q], fractions[1, q], fractions[2, q]
        r0, r1, r2, r3 = rows[0, q], rows[1, q], rows[2, q], rows[3, q]
        r4, r5, r6, r7 = rows[4, q], rows[5, q], rows[6, q], rows[7, q]
        for f in range(uint32(4)):
            c = uint32(column + f)
            v0, v1, v2, v3 = table[r0, f], table[r1, f], table[r2, f], table[r3, f]
            v4, v5, v6, v7 = table[r4, f], table[r5, f], table[r6, f], table[r7, f]
            d00, d01, d10, d11 = v1 - v0, v3 - v2, v5 - v4, v7 - v6
            c00, c01, c10, c11 = v0 + fz * d00, v2 + fz * d01, v4 + fz * d10, v6 + fz * d11
            dy0, dy1 = c01 - c00, c11 - c10
            c0, c1 = c00 + fy * dy0, c10 + fy * dy1
            dz0, dz1 = d00 + fy * (d01 - d00), d10 + fy * (d11 - d10)
            features[p, c] = c0 + fx * (c1 - c0)
            if jacobian is not None:
                jacobian[p, uint32(0), c] = scale * (c1 - c0)
                jacobian[p, uint32(1), c] = scale * (dy0 + fx * (dy1 - dy0))
                jacobian[p, uint32(2), c] = scale * (dz0 + fx * (dz1 - dz0))


@njit(parallel=True, **_OPTIONS)
def encode_forward(points, table, resolutions, offsets, dense, active_levels, features, jacobian):
    """Fill features [N, C], and jacobian [N, 3, C] unless it is None."""
    num_points, channels = features.shape
    num_chunks = (num_points + CHUNK - 1) // CHUNK
    for chunk in prange(num_chunks):
        first, last = chunk * CHUNK, min((chunk + 1) * CHUNK, num_points)
        count = uint32(last - first)
        rows, fractions = np.empty((8, CHUNK), np.uint32), np.empty((3, CHUNK), np.float32)
        for level in range(active_levels):
            resolution = resolutions[level]
            _locate(points, first, count, resolution, offsets[level], offsets[level + 1], dense[level], rows, fractions)
            scale = np.float32(0.5 * resolution)
            _encode_chunk(table, first, count, uint32(level * 4), scale, rows, fractions, features, jacobian)
        for p in range(first, last):
            for c in range(active_levels * 4, channels):
                features[p, c] = np.float32(0)
                if jacobian is not None:
                    jacobian[p, 0, c] = np.float32(0)
                    jacobian[p, 1, c] = np.float32(0)
                    jacobian[p, 2, c] = np.float32(0)


@njit(**_OPTIONS)
def _encode_chunk_backward(
    first, count, column, scale, rows, fractions, grad_features, grad_gradients, cotangent, grad_table
):
    """One level's additions to grad_table for the located points."""
    one = np.float32(1)
    _ask_for(grad_table, rows, 0, min(AHEAD, count))
    for q in range(count):
        _ask_for(grad_table, rows, q + AHEAD, min(q + AHEAD + 1, count))
        p = uint32(first + q)
        fx, fy, fz = fractions[0, q], fractions[1, q], fractions[2, q]
        r0, r1, r2, r3 = rows[0, q], rows[1, q], rows[2, q], rows[3, q]
        r4, r5, r6, r7 = rows[4, q], rows[5, q], rows[6, q], rows[7, q]
        sx = sy = sz = np.float32(0)
        if grad_gradients is not None:
            sx = scale * grad_gradients[p, uint32(0)]
            sy = scale * grad_gradients[p, uint32(1)]
            sz = scale * grad_gradients[p, uint32(2)]
        gx, gy, gz = one - fx, one - fy, one - fz
        # Each corner's share is w a + (dw . s) u, w = wx wy wz its weight, a and u the incoming features and cotangent.
        w00, w01, w10, w11 = gx * gy, gx * fy, fx * gy, fx * fy
        e00, e01, e10, e11 = -sx * gy - sy * gx, -sx * fy + sy * gx, sx * gy - sy * fx, sx * fy + sy * fx
        z00, z01, z10, z11 = w00 * sz, w01 * sz, w10 * sz, w11 * sz
        for f in range(uint32(4)):
            c = uint32(column + f)
            a = np.float32(0) if grad_features is None else grad_features[p, c]
            u = np.float32(0) if cotangent is None else cotangent[p, c]
            grad_table[r0, f] += gz * (w00 * a + e00 * u) - z00 * u
            grad_table[r1, f] += fz * (w00 * a + e00 * u) + z00 * u
            grad_table[r2, f] += gz * (w01 * a + e01 * u) - z01 * u
            grad_table[r3, f] += fz * (w01 * a + e01 * u) + z01 * u
            grad_table[r4, f] += gz * (w10 * a + e10 * u) - z10 * u
            grad_table[r5, f] += fz * (w10 * a + e10 * u) + z10 * u
            grad_table[r6, f] += gz * (w11 * a + e11 * u) - z11 * u
            grad_table[r7, f] += fz * (w11 * a + e11 * u) + z11 * u


@njit(parallel=True, **_OPTIONS)
def encode_backward(
    points, resolutions, offsets, dense, active_levels, grad_features, grad_gradients, cotangent, grad_table
):
    """Add d loss / d table [rows, 4], given the gradients of features [N, C] and of jacobian [N, 3, C].

    The latter is of rank one and given by its factors: grad_gradients [N, 3] times cotangent [N, C]. One of the two may
    be None: numba then compiles a kernel without its arithmetic.
    """
    num_points = len(points)
    for index in prange(active_levels):
        level = _interleaved(index, active_levels)
        resolution = resolutions[level]
        scale = np.float32(0.5 * resolution)
        rows, fractions = np.empty((8, CHUNK), np.uint32), np.empty((3, CHUNK), np.float32)
        for first in range(0, num_points, CHUNK):
            count = uint32(min(CHUNK, num_points - first))
            _locate(points, first, count, resolution, offsets[level], offsets[level + 1], dense[level], rows, fractions)
            _encode_chunk_backward(
                first, count, uint32(level * 4), scale, rows, fractions,
                grad_features, grad_gradients, cotangent, grad_table,
            )  # fmt: skip


@njit(parallel=True, **_OPTIONS)
def vjp_forward(jacobian, cotangent, gradients):
    """Fill gradients [N, 3] with jacobian [N, 3, C] times cotangent [N, C]."""
    num_points, _, channels = jacobian.shape
    for p in prange(num_points):
        x = y = z = np.float32(0)
        for c in range(channels):
            u = cotangent[p, c]
            x += jacobian[p, 0, c] * u
            y += jacobian[p, 1, c] * u
            z += jacobian[p, 2, c] * u
        gradients[p, 0], gradients[p, 1], gradients[p, 2] = x, y, z


@njit(parallel=True, **_OPTIONS)
def vjp_backward(jacobian, grad_gradients, grad_cotangent):
    """Fill grad_cotangent [N, C] with jacobian^T [N, C, 3] times grad_gradients [N, 3]."""
    num_points, _, channels = jacobian.shape
    for p in prange(num_points):
        x, y, z = grad_gradients[p, 0], grad_gradients[p, 1], grad_gradients[p, 2]
        for c in range(channels):
            grad_cotangent[p, c] = x * jacobian[p, 0, c] + y * jacobian[p, 1, c] + z * jacobian[p, 2, c]


@njit(parallel=True, **_OPTIONS)
def smooth_relu_forward(z, bend, activation, slope):
    """Fill activation and slope [M] at z [M]: `stages.neural.fields.smooth_relu`."""
    zero, half, one = np.float32(0), np.float32(0.5), np.float32(1)
    inverse = np.float32(0.5 / bend)
    width = np.float32(bend)
    for i in prange(len(z)):
        s = min(max(z[i] * inverse + half, zero), one)
        slope[i] = s
        activation[i] = width * s * s + max(z[i] - width, zero)


@njit(parallel=True, **_OPTIONS)
def smooth_relu_backward(slope, bend, grad_activation, grad_slope, grad_z):
    """Fill grad_z [M] given the gradients of activation and slope [M]."""
    inverse = np.float32(0.5 / bend)
    for i in prange(len(slope)):
        s = slope[i]
        curvature = inverse if (s > np.float32(0)) and (s < np.float32(1)) else np.float32(0)
        grad_z[i] = s * grad_activation[i] + curvature * grad_slope[i]


@njit(**_OPTIONS)
def _trilinear(values, x, y, z):
    """Cached f at a position in [-1, 1]^3; values [G, G, G] are indexed z, y, x."""
    last = values.shape[0] - 1
    cx, fx = _cell(x, last)
    cy, fy = _cell(y, last)
    cz, fz = _cell(z, last)
    one = np.float32(1)
    x0, x1, y0, y1 = uint32(cx), uint32(cx + 1), uint32(cy), uint32(cy + 1)
    z0, z1 = uint32(cz), uint32(cz + 1)
    low = (one - fy) * ((one - fx) * values[z0, y0, x0] + fx * values[z0, y0, x1]) + fy * (
        (one - fx) * values[z0, y1, x0] + fx * values[z0, y1, x1]
    )
    high = (one - fy) * ((one - fx) * values[z1, y0, x0] + fx * values[z1, y0, x1]) + fy * (
        (one - fx) * values[z1, y1, x0] + fx * values[z1, y1, x1]
    )
    return (one - fz) * low + fz * high


@njit(parallel=True, **_OPTIONS)
def lookup(values, points, found):
    """Fill found [P] with the cached f at points [P, 3]; places outside the cube read its border."""
    for p in prange(len(points)):
        found[p] = _trilinear(values, points[p, 0], points[p, 1], points[p, 2])


@njit(parallel=True, **_OPTIONS)
def smallest_on_paths(values, points, targets, start, solid, smallest):
    """Fill smallest [P] with the least cached f met by sphere tracing from points [P, 3] towards targets [P, 3].

    A step is f long, or half a cell where f is smaller; the walk ends at the target, at the unit sphere, or where f
    falls below `solid`.
    """
    half_cell = np.float32(1.0 / (values.shape[0] - 1))
    for p in prange(len(points)):
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
            if f < solid:
                break
            t += max(f, half_cell)
        smallest[p] = least


@njit(inline="always")
def _density_integral(sdf, scale):
    """`stages.neural.density._density_integral`; its exponential is nothing beyond 25 scales, and dear."""
    tail = np.float32(0.5) * scale * np.exp(-abs(sdf) / scale) if abs(sdf) < np.float32(25) * scale else np.float32(0)
    return max(-sdf, np.float32(0)) + tail


@njit(parallel=True, **_OPTIONS)
def importance_distances(
    values, origins, directions, entry, leave, places, scale, flat, even_share, floor, num_bins, distances
):
    """Fill distances [R, K]: the inverse CDF, at ascending places [R, K] in [0, 1), of the rendering weights that the
    cached f gives to even bins of the rays; `stages.neural.sampling.importance_distances_reference` in one pass.
    """
    num_rays, num_samples = distances.shape
    b, half, zero, one = np.float32(scale), np.float32(0.5), np.float32(0), np.float32(1)
    flat_change = np.float32(flat * scale)
    num_chunks = (num_rays + 15) // 16
    for chunk in prange(num_chunks):
        cdf = np.empty(num_bins + 1, np.float32)
        for r in range(chunk * 16, min((chunk + 1) * 16, num_rays)):
            x, y, z = origins[r, 0], origins[r, 1], origins[r, 2]
            dx, dy, dz = directions[r, 0], directions[r, 1], directions[r, 2]
            start, length = entry[r], leave[r] - entry[r]
            step = length / np.float32(num_bins)
            before = _trilinear(values, x + start * dx, y + start * dy, z + start * dz)
            integral_before = _density_integral(before, b)
            transmittance = one
            for k in range(num_bins):
                t = start + length * (np.float32(k + 1) / np.float32(num_bins))
                after = _trilinear(values, x + t * dx, y + t * dy, z + t * dz)
                integral_after = _density_integral(after, b)
                change = after - before
                if abs(change) < flat_change:
                    middle = half * (before + after)
                    decay = half * np.exp(-abs(middle) / b)
                    tau = (decay if middle >= zero else one - decay) * step / b
                else:
                    tau = (integral_before - integral_after) / change * step / b
                weight = -transmittance * np.expm1(-tau) if tau > zero else zero
                cdf[k + 1] = weight
                before, integral_before, transmittance = after, integral_after, transmittance - weight
            even = (np.float32(even_share) * (one - transmittance) + np.float32(floor)) / np.float32(num_bins)
            cdf[0] = zero
            for k in range(num_bins):
                cdf[k + 1] += cdf[k] + even
            total = cdf[num_bins]
            k = 0
            for i in range(num_samples):
                place = places[r, i] * total
                while k < num_bins - 1 and cdf[k + 1] <= place:
                    k += 1
                inside = min(max((place - cdf[k]) / (cdf[k + 1] - cdf[k]), zero), one)
                distances[r, i] = start + length * (np.float32(k) + inside) / np.float32(num_bins)


@njit(inline="always")
def _laplace_cdf(sdf, scale):
    """Psi_b(-f): b times `stages.neural.density.laplace_density`."""
    decay = np.float32(0.5) * np.exp(-abs(sdf) / scale) if abs(sdf) < np.float32(25) * scale else np.float32(0)
    return decay if sdf >= np.float32(0) else np.float32(1) - decay


@njit(inline="always")
def _outside_cdf(sdf, scale):
    """Psi_b(-f) outside, 0 inside."""
    return _laplace_cdf(sdf, scale) if sdf >= np.float32(0) else np.float32(0)


@njit(inline="always")
def _outside_integral(sdf, scale):
    """`stages.neural.density._outside_integral`."""
    return scale * _laplace_cdf(max(sdf, np.float32(0)), scale)


@njit(inline="always")
def _section(start, end, length, outlined, scale, flat):
    """Optical depth of a section of this length (in b) on which f runs linearly from start to end.

    `stages.neural.density.section_optical_depth`, and the part `outlined` of its `outline_correction`.
    """
    change = end - start
    if abs(change) < flat:
        middle = np.float32(0.5) * (start + end)
        mean, outside = _laplace_cdf(middle, scale), _outside_cdf(middle, scale)
    else:
        mean = (_density_integral(start, scale) - _density_integral(end, scale)) / change
        outside = (_outside_integral(start, scale) - _outside_integral(end, scale)) / change
    return length * mean + outlined * outside * (abs(change) / scale - length)


@njit(inline="always")
def _section_slopes(start, end, length, outlined, scale, flat):
    """The derivatives of `_section` with respect to start and end."""
    change = end - start
    if abs(change) < flat:
        middle = np.float32(0.5) * (start + end)
        cdf, outside = _laplace_cdf(middle, scale), _outside_cdf(middle, scale)
        to_start = to_end = np.float32(-0.5) * min(cdf, np.float32(1) - cdf) / scale
        outside_to_start = outside_to_end = np.float32(-0.5) * outside / scale
    else:
        mean = (_density_integral(start, scale) - _density_integral(end, scale)) / change
        to_start, to_end = (mean - _laplace_cdf(start, scale)) / change, (_laplace_cdf(end, scale) - mean) / change
        outside = (_outside_integral(start, scale) - _outside_integral(end, scale)) / change
        outside_to_start = (outside - _outside_cdf(start, scale)) / change
        outside_to_end = (_outside_cdf(end, scale) - outside) / change
    rest, turn = abs(change) / scale - length, outside * np.sign(change) / scale
    return (
        length * to_start + outlined * (outside_to_start * rest - turn),
        length * to_end + outlined * (outside_to_end * rest + turn),
    )


@njit(parallel=True, **_OPTIONS)
def ray_weights_forward(sdf, distances, outlined, scale, flat, weights, transmittance):
    """Fill weights [R, K] and transmittance [R]: `stages.neural.rendering.rendering_weights`."""
    num_rays, num_samples = sdf.shape
    b, half, flat_change = np.float32(scale), np.float32(0.5), np.float32(flat * scale)
    for r in prange(num_rays):
        left, far = np.float32(1), np.float32(0)  # far: optical depth of the half section before sample k
        for k in range(num_samples):
            depth = far
            if k + 1 < num_samples:
                stretch = half * (distances[r, k + 1] - distances[r, k]) / b
                middle = half * (sdf[r, k] + sdf[r, k + 1])
                depth += _section(sdf[r, k], middle, stretch, outlined[r, k], b, flat_change)
                far = _section(middle, sdf[r, k + 1], stretch, outlined[r, k + 1], b, flat_change)
            weight = -left * np.expm1(-depth)
            weights[r, k] = weight
            left -= weight
        transmittance[r] = left


@njit(parallel=True, **_OPTIONS)
def ray_weights_backward(
    sdf, distances, outlined, scale, flat, weights, transmittance, grad_weights, grad_transmittance, grad_sdf
):
    """Fill grad_sdf [R, K] given the gradients of weights [R, K] and transmittance [R].

    The transmittance T_m before sample m falls with every optical depth before it, so that a depth's gradient sums over
    all T_m behind it: rays are walked from their ends.
    """
    num_rays, num_samples = sdf.shape
    b, half, flat_change = np.float32(scale), np.float32(0.5), np.float32(flat * scale)
    for r in prange(num_rays):
        left = transmittance[r]
        grad_far = -left * (grad_transmittance[r] - grad_weights[r, num_samples - 1])  # of sample k + 1's depth
        grad_sdf[r, num_samples - 1] = np.float32(0)
        for k in range(num_samples - 2, -1, -1):
            left += weights[r, k + 1]
            grad_near = grad_far - left * (grad_weights[r, k + 1] - grad_weights[r, k])  # of sample k's
            stretch = half * (distances[r, k + 1] - distances[r, k]) / b
            middle = half * (sdf[r, k] + sdf[r, k + 1])
            near_start, near_end = _section_slopes(sdf[r, k], middle, stretch, outlined[r, k], b, flat_change)
            far_start, far_end = _section_slopes(middle, sdf[r, k + 1], stretch, outlined[r, k + 1], b, flat_change)
            of_middle = half * (grad_near * near_end + grad_far * far_start)
            grad_sdf[r, k] = grad_near * near_start + of_middle
            grad_sdf[r, k + 1] += grad_far * far_end + of_middle
            grad_far = grad_near
