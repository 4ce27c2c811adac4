"""Multi-core CPU kernels that draw Gaussians, and that lead a drawing's errors back to them (numba).

`drawing` says what they compute; this file is about speed. A drawing goes through three steps: Gaussians to ellipses in
the image (parallel over Gaussians), ellipses to the 16 x 16 tiles that they reach, nearest first, and tiles to pixels
(parallel over tiles). Backward, each tile writes what it found of each of its ellipses into rows of its own, and each
Gaussian adds up its rows: no atomics, and sums are taken in one order whatever the number of threads.

They live in one file because a compiled function's cache notices changes in its own file only. No `fastmath`, for the
reason that `stages.neural.kernels` gives.

Notation: an ellipse is its mean (pixels), conic (a, b, c), the inverse of its 2D covariance, opacity and colour; at the
offset (dx, dy) from its mean its alpha is opacity exp(-(a dx² + c dy²) / 2 - b dx dy).
"""

from __future__ import annotations

import numpy as np

from stages.compiling import njit, prange

TILE = 16
# Variance in pixels² that is added to each ellipse, for it to be at least about a pixel wide (3DGS).
LOW_PASS = np.float32(0.3)
# Gaussians nearer than this to the camera's plane are not drawn; scene units (gsplat).
NEAR = np.float32(0.01)
# Alphas are cut at these, and a pixel is done when less than this of it would be left open (gsplat).
LEAST_ALPHA, MOST_ALPHA = np.float32(1 / 255), np.float32(0.999)
LEAST_OPEN = np.float32(1e-4)
# Beyond so many halves of the image from its centre, the projection is taken as if the Gaussian lay there (3DGS).
REACH = np.float32(1.3)
# Rows that a tile writes of an ellipse: mean (2), conic (3), opacity, colour (3).
PARTS = 9
# Ellipses after which a tile looks whether any of its pixels is still open.
_LOOK = 16
_OPTIONS = dict(cache=True, nogil=True, error_model="numpy", boundscheck=False)
_0, _1, _2, _HALF = np.float32(0), np.float32(1), np.float32(2), np.float32(0.5)
# Nothing below shows: alpha is under 1 / 255 whatever the opacity.
_LEAST_POWER = np.float32(-5.6)

# ---------------------------------------------------------------- spherical harmonics, signs and order of 3DGS
C0, C1 = np.float32(0.28209479177387814), np.float32(0.4886025119029199)
C20, C21, C22 = np.float32(1.0925484305920792), np.float32(0.31539156525252005), np.float32(0.5462742152960396)
C30, C31, C32 = np.float32(0.5900435899266435), np.float32(2.890611442640554), np.float32(0.4570457994644658)
C33, C34 = np.float32(0.3731763325901154), np.float32(1.445305721320277)
_3, _4, _5, _6, _8, _10 = (np.float32(n) for n in (3, 4, 5, 6, 8, 10))


@njit(**_OPTIONS)
def fill_basis(x, y, z, values):  # pragma: no cover - compiled
    """Fill the K values of the basis at the unit direction (x, y, z); K = 1, 4, 9 or 16."""
    count = values.shape[0]
    values[0] = C0
    if count == 1:
        return
    values[1], values[2], values[3] = -C1 * y, C1 * z, -C1 * x
    if count == 4:
        return
    xx, yy, zz = x * x, y * y, z * z
    values[4], values[5] = C20 * x * y, -C20 * y * z
    values[6] = C21 * (_2 * zz - xx - yy)
    values[7], values[8] = -C20 * x * z, C22 * (xx - yy)
    if count == 9:
        return
    values[9], values[10] = -C30 * y * (_3 * xx - yy), C31 * x * y * z
    values[11] = -C32 * y * (_4 * zz - xx - yy)
    values[12] = C33 * z * (_2 * zz - _3 * xx - _3 * yy)
    values[13], values[14] = -C32 * x * (_4 * zz - xx - yy), C34 * z * (xx - yy)
    values[15] = -C30 * x * (xx - _3 * yy)


@njit(**_OPTIONS)
def _basis_backward(x, y, z, d_values):  # pragma: no cover - compiled
    """Gradient to (x, y, z), taken as three free numbers, from that to the K values."""
    count = d_values.shape[0]
    dx, dy, dz = _0, _0, _0
    if count > 1:
        dx, dy, dz = -C1 * d_values[3], -C1 * d_values[1], C1 * d_values[2]
    if count > 4:
        v4, v5, v6, v7, v8 = d_values[4], d_values[5], d_values[6], d_values[7], d_values[8]
        dx += C20 * (y * v4 - z * v7) + _2 * x * (C22 * v8 - C21 * v6)
        dy += C20 * (x * v4 - z * v5) - _2 * y * (C22 * v8 + C21 * v6)
        dz += _4 * C21 * z * v6 - C20 * (y * v5 + x * v7)
    if count > 9:
        xx, yy, zz, xy, xz, yz = x * x, y * y, z * z, x * y, x * z, y * z
        v9, v10, v11, v12 = d_values[9], d_values[10], d_values[11], d_values[12]
        v13, v14, v15 = d_values[13], d_values[14], d_values[15]
        dx += (
            -_6 * C30 * xy * v9 + C31 * yz * v10 + _2 * C32 * xy * v11 - _6 * C33 * xz * v12
            - C32 * (_4 * zz - _3 * xx - yy) * v13 + _2 * C34 * xz * v14 - _3 * C30 * (xx - yy) * v15
        )  # fmt: skip
        dy += (
            -_3 * C30 * (xx - yy) * v9 + C31 * xz * v10 - C32 * (_4 * zz - xx - _3 * yy) * v11 - _6 * C33 * yz * v12
            + _2 * C32 * xy * v13 - _2 * C34 * yz * v14 + _6 * C30 * xy * v15
        )  # fmt: skip
        dz += (
            C31 * xy * v10 - _8 * C32 * yz * v11 + C33 * (_6 * zz - _3 * xx - _3 * yy) * v12
            - _8 * C32 * xz * v13 + C34 * (xx - yy) * v14
        )  # fmt: skip
    return dx, dy, dz


# ---------------------------------------------------------------- Gaussians to ellipses
@njit(**_OPTIONS)
def _fill_rotation(q, turn):  # pragma: no cover - compiled
    """Fill the matrix of a quaternion (w, x, y, z) of any length; returns one over its length."""
    per_length = _1 / np.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    w, x, y, z = q[0] * per_length, q[1] * per_length, q[2] * per_length, q[3] * per_length
    turn[0, 0], turn[0, 1], turn[0, 2] = _1 - _2 * (y * y + z * z), _2 * (x * y - w * z), _2 * (x * z + w * y)
    turn[1, 0], turn[1, 1], turn[1, 2] = _2 * (x * y + w * z), _1 - _2 * (x * x + z * z), _2 * (y * z - w * x)
    turn[2, 0], turn[2, 1], turn[2, 2] = _2 * (x * z - w * y), _2 * (y * z + w * x), _1 - _2 * (x * x + y * y)
    return per_length


@njit(**_OPTIONS)
def _fill_axes(turn, log_scales, pose, axes):  # pragma: no cover - compiled
    """Fill [3, 3]: the Gaussian's axes at the length of its deviations, in the camera's frame, as columns."""
    for k in range(3):
        scale = np.exp(log_scales[k])
        for i in range(3):
            axes[i, k] = scale * (pose[i, 0] * turn[0, k] + pose[i, 1] * turn[1, k] + pose[i, 2] * turn[2, k])


@njit(**_OPTIONS)
def _slopes(x, y, z, reach):  # pragma: no cover - compiled
    """The direction (x / z, y / z) that the projection is taken at, and whether each is the point's own."""
    u, v = x / z, y / z
    left, right, top, bottom = reach[0], reach[1], reach[2], reach[3]
    return min(max(u, left), right), min(max(v, top), bottom), left < u < right, top < v < bottom


@njit(**_OPTIONS)
def _fill_flat(axes, u, v, z, focal, flat):  # pragma: no cover - compiled
    """Fill [2, 3], the axes in the image: the projection's Jacobian at (u z, v z, z) times axes. focal: (fx, s, fy)."""
    per_z = _1 / z
    for k in range(3):
        flat[0, k] = per_z * (focal[0] * (axes[0, k] - u * axes[2, k]) + focal[1] * (axes[1, k] - v * axes[2, k]))
        flat[1, k] = per_z * focal[2] * (axes[1, k] - v * axes[2, k])


@njit(parallel=True, **_OPTIONS)
def project(
    centers, rotations, log_scales, opacity_logits, harmonics, pose, position, focal, middle, reach, width, height,
    means, depths, conics, opacities, colors, boxes,
):  # fmt: skip # pragma: no cover - compiled
    """Fill the ellipses of N Gaussians, and boxes [N, 4] int32: the first and one past the last column and row of
    pixels that they may show in; none for those that are not drawn.

    pose: [3, 4] camera from scene; position: [3] of the camera; middle: [2] principal point; reach: [4] see `_slopes`.
    """
    count = harmonics.shape[1]
    for n in prange(centers.shape[0]):
        boxes[n, 0] = boxes[n, 1] = boxes[n, 2] = boxes[n, 3] = 0
        at = centers[n]
        z = pose[2, 0] * at[0] + pose[2, 1] * at[1] + pose[2, 2] * at[2] + pose[2, 3]
        opacity = _1 / (_1 + np.exp(-opacity_logits[n]))
        if not (z > NEAR and opacity > LEAST_ALPHA):
            continue
        x = pose[0, 0] * at[0] + pose[0, 1] * at[1] + pose[0, 2] * at[2] + pose[0, 3]
        y = pose[1, 0] * at[0] + pose[1, 1] * at[1] + pose[1, 2] * at[2] + pose[1, 3]
        mean_x = (focal[0] * x + focal[1] * y) / z + middle[0]
        mean_y = focal[2] * y / z + middle[1]
        turn, axes, flat = np.empty((3, 3), np.float32), np.empty((3, 3), np.float32), np.empty((2, 3), np.float32)
        _fill_rotation(rotations[n], turn)
        _fill_axes(turn, log_scales[n], pose, axes)
        u, v, _, _ = _slopes(x, y, z, reach)
        _fill_flat(axes, u, v, z, focal, flat)
        xx, xy, yy = LOW_PASS, _0, LOW_PASS
        for k in range(3):
            xx += flat[0, k] * flat[0, k]
            xy += flat[0, k] * flat[1, k]
            yy += flat[1, k] * flat[1, k]
        determinant = xx * yy - xy * xy
        if not determinant > 0:
            continue
        # Beyond these the alpha is cut: opacity exp(-r² / 2) < 1 / 255.
        radius = np.sqrt(_2 * np.log(opacity / LEAST_ALPHA))
        wide, high = radius * np.sqrt(xx), radius * np.sqrt(yy)
        left, right = max(np.ceil(mean_x - wide - _HALF), _0), min(np.floor(mean_x + wide + _HALF), np.float32(width))
        top, bottom = max(np.ceil(mean_y - high - _HALF), _0), min(np.floor(mean_y + high + _HALF), np.float32(height))
        if not (left < right and top < bottom):
            continue
        boxes[n, 0], boxes[n, 1] = np.int32(left), np.int32(right)
        boxes[n, 2], boxes[n, 3] = np.int32(top), np.int32(bottom)
        means[n, 0], means[n, 1], depths[n], opacities[n] = mean_x, mean_y, z, opacity
        conics[n, 0], conics[n, 1], conics[n, 2] = yy / determinant, -xy / determinant, xx / determinant
        values = np.empty(count, np.float32)
        dx, dy, dz = at[0] - position[0], at[1] - position[1], at[2] - position[2]
        length = np.sqrt(dx * dx + dy * dy + dz * dz)
        fill_basis(dx / length, dy / length, dz / length, values)
        for c in range(3):
            color = _HALF
            for k in range(count):
                color += values[k] * harmonics[n, k, c]
            colors[n, c] = max(color, _0)


# ---------------------------------------------------------------- ellipses to tiles
@njit(**_OPTIONS)
def count_pairs(order, boxes, columns, first, starts):  # pragma: no cover - compiled
    """Count pairs of an ellipse and a tile that it reaches, of ellipses `order` [M].

    Fills first [M + 1], where the pairs of each ellipse begin, and starts [tiles + 1], where those of each tile do.
    """
    starts[:] = 0
    first[0] = 0
    for m in range(order.shape[0]):
        box = boxes[order[m]]
        left, right = box[0] // TILE, (box[1] - 1) // TILE
        top, bottom = box[2] // TILE, (box[3] - 1) // TILE
        first[m + 1] = first[m] + (right - left + 1) * (bottom - top + 1)
        for row in range(top, bottom + 1):
            for column in range(left, right + 1):
                starts[row * columns + column + 1] += 1
    for tile in range(1, starts.shape[0]):
        starts[tile] += starts[tile - 1]


@njit(**_OPTIONS)
def fill_pairs(order, boxes, columns, first, starts, members, places):  # pragma: no cover - compiled
    """Fill members [P], the ellipses (ids) of all tiles one after the other, each tile's in `order`; and places [P],
    where among them the pairs of each ellipse are, one ellipse after the other."""
    filled = starts.copy()
    for m in range(order.shape[0]):
        n = order[m]
        box = boxes[n]
        pair = first[m]
        for row in range(box[2] // TILE, (box[3] - 1) // TILE + 1):
            for column in range(box[0] // TILE, (box[1] - 1) // TILE + 1):
                tile = row * columns + column
                members[filled[tile]] = n
                places[pair] = filled[tile]
                filled[tile] += 1
                pair += 1


# ---------------------------------------------------------------- tiles to pixels
@njit(inline="always")
def _exp(x):  # pragma: no cover - compiled
    """exp(x) for x in [-5.6, 0], to 3e-6 of it: (exp(x / 16))^16, on vectors, which the library's is not."""
    t = x * np.float32(1 / 16)
    value = _1 + t * (_1 + t * (_HALF + t * (
        np.float32(1 / 6) + t * (np.float32(1 / 24) + t * (np.float32(1 / 120) + t * np.float32(1 / 720)))
    )))  # fmt: skip
    value = value * value
    value = value * value
    value = value * value
    return value * value


@njit(inline="always")
def _fill_alphas(dx, dy, count, a, b, c, opacity, open_, base, alphas):  # pragma: no cover - compiled
    """Fill alphas of `count` pixels of a row, the first at (dx, dy) from the mean; 0 where they are cut or the pixel is
    done. open_: transmittance of the tile's pixels, negative where they are done, from `base` on those of the row."""
    across = -_HALF * c * dy * dy
    for i in range(count):
        x = dx + np.float32(i)
        power = max(across - x * (_HALF * a * x + b * dy), _LEAST_POWER)
        alpha = min(opacity * _exp(min(power, _0)), MOST_ALPHA)
        alphas[i] = alpha if (alpha >= LEAST_ALPHA and open_[base + i] > _0) else _0


@njit(inline="always")
def _part(box, x0, y0, x1, y1):  # pragma: no cover - compiled
    """The part of a box in a tile: first and one past the last column and row, and columns."""
    left, right = max(box[0], x0), min(box[1], x1)
    return left, max(box[2], y0), min(box[3], y1), np.uintp(right - left)


@njit(parallel=True, **_OPTIONS)
def blend(
    starts, members, columns, means, conics, opacities, colors, boxes, background, image, transmittance
):  # pragma: no cover - compiled
    """Fill image [H, W, 3] and transmittance [H, W] from the tiles' ellipses, nearest first."""
    height, width = transmittance.shape
    for tile in prange(starts.shape[0] - 1):
        x0, y0 = tile % columns * TILE, tile // columns * TILE
        x1, y1 = min(x0 + TILE, width), min(y0 + TILE, height)
        open_ = np.ones(TILE * TILE, np.float32)
        reds, greens = np.zeros(TILE * TILE, np.float32), np.zeros(TILE * TILE, np.float32)
        blues, alphas = np.zeros(TILE * TILE, np.float32), np.empty(TILE, np.float32)
        for p in range(starts[tile], starts[tile + 1]):
            if (p - starts[tile]) % _LOOK == _LOOK - 1 and open_.max() <= _0:
                break
            n = members[p]
            left, top, bottom, count = _part(boxes[n], x0, y0, x1, y1)
            a, b, c, opacity = conics[n, 0], conics[n, 1], conics[n, 2], opacities[n]
            red, green, blue = colors[n, 0], colors[n, 1], colors[n, 2]
            dx = np.float32(left) + _HALF - means[n, 0]
            for y in range(top, bottom):
                base = np.uintp((y - y0) * TILE + left - x0)
                _fill_alphas(dx, np.float32(y) + _HALF - means[n, 1], count, a, b, c, opacity, open_, base, alphas)
                for k in range(count):
                    was_open = open_[base + k]
                    left_open = was_open * (_1 - alphas[k])
                    done = (alphas[k] > _0) & (left_open < LEAST_OPEN)
                    weight = _0 if done else was_open * alphas[k]
                    reds[base + k] += weight * red
                    greens[base + k] += weight * green
                    blues[base + k] += weight * blue
                    open_[base + k] = -was_open if done else left_open
        for y in range(y0, y1):
            for x in range(x0, x1):
                at = (y - y0) * TILE + x - x0
                rest = abs(open_[at])
                transmittance[y, x] = rest
                image[y, x, 0] = reds[at] + rest * background[0]
                image[y, x, 1] = greens[at] + rest * background[1]
                image[y, x, 2] = blues[at] + rest * background[2]


@njit(parallel=True, **_OPTIONS)
def blend_backward(
    starts, members, columns, means, conics, opacities, colors, boxes, image, transmittance, d_image, d_open, parts
):  # pragma: no cover - compiled
    """Fill parts [P, PARTS], each pair's share of the gradient to its ellipse.

    Front to back, as `blend` goes: with O_i the transmittance before ellipse i, and B_i what of the pixel's colour
    comes from behind it, d pixel / d alpha_i = O_i c_i - B_i / (1 - alpha_i).

    image, transmittance: as `blend` left them. d_image, d_open: [H, W, 3], [H, W] gradients to them.
    """
    height, width = transmittance.shape
    for tile in prange(starts.shape[0] - 1):
        x0, y0 = tile % columns * TILE, tile // columns * TILE
        x1, y1 = min(x0 + TILE, width), min(y0 + TILE, height)
        open_ = np.ones(TILE * TILE, np.float32)
        # What lies behind, times the gradient: all of the pixel's colour at first.
        behind = np.zeros(TILE * TILE, np.float32)
        slopes = np.zeros((TILE * TILE, 3), np.float32)
        for y in range(y0, y1):
            for x in range(x0, x1):
                at = (y - y0) * TILE + x - x0
                total = transmittance[y, x] * d_open[y, x]
                for c in range(3):
                    slopes[at, c] = d_image[y, x, c]
                    total += image[y, x, c] * d_image[y, x, c]
                behind[at] = total
        alphas = np.empty(TILE, np.float32)
        finished = False
        for p in range(starts[tile], starts[tile + 1]):
            for k in range(PARTS):
                parts[p, k] = _0
            if finished:
                continue
            if (p - starts[tile]) % _LOOK == _LOOK - 1 and open_.max() <= _0:
                finished = True
                continue
            n = members[p]
            left, top, bottom, count = _part(boxes[n], x0, y0, x1, y1)
            a, b, c, opacity = conics[n, 0], conics[n, 1], conics[n, 2], opacities[n]
            red, green, blue = colors[n, 0], colors[n, 1], colors[n, 2]
            first_dx = np.float32(left) + _HALF - means[n, 0]
            d_x, d_y, d_a, d_b, d_c, d_opacity, d_red, d_green, d_blue = _0, _0, _0, _0, _0, _0, _0, _0, _0
            for y in range(top, bottom):
                base = np.uintp((y - y0) * TILE + left - x0)
                dy = np.float32(y) + _HALF - means[n, 1]
                _fill_alphas(first_dx, dy, count, a, b, c, opacity, open_, base, alphas)
                for k in range(count):
                    alpha = alphas[k]
                    if alpha <= _0:
                        continue
                    at = base + k
                    was_open = open_[at]
                    left_open = was_open * (_1 - alpha)
                    if left_open < LEAST_OPEN:
                        open_[at] = -was_open
                        continue
                    open_[at] = left_open
                    weight = was_open * alpha
                    g_red, g_green, g_blue = slopes[at, 0], slopes[at, 1], slopes[at, 2]
                    d_red += weight * g_red
                    d_green += weight * g_green
                    d_blue += weight * g_blue
                    own = red * g_red + green * g_green + blue * g_blue
                    rest = behind[at] - weight * own
                    behind[at] = rest
                    if alpha >= MOST_ALPHA:
                        continue
                    d_power = alpha * (was_open * own - rest / (_1 - alpha))
                    dx = first_dx + np.float32(k)
                    d_opacity += d_power
                    x_power, y_power = d_power * dx, d_power * dy
                    d_x += x_power
                    d_y += y_power
                    d_a += x_power * dx
                    d_b += x_power * dy
                    d_c += y_power * dy
            parts[p, 0], parts[p, 1] = a * d_x + b * d_y, b * d_x + c * d_y
            parts[p, 2], parts[p, 3], parts[p, 4] = -_HALF * d_a, -d_b, -_HALF * d_c
            parts[p, 5] = d_opacity / opacity
            parts[p, 6], parts[p, 7], parts[p, 8] = d_red, d_green, d_blue


@njit(parallel=True, **_OPTIONS)
def add_parts(first, places, parts, sums):  # pragma: no cover - compiled
    """Fill sums [M, D]: the parts [P, D] of each ellipse, added up in one order."""
    width = sums.shape[1]
    for m in prange(first.shape[0] - 1):
        for k in range(width):
            sums[m, k] = _0
        for pair in range(first[m], first[m + 1]):
            place = places[pair]
            for k in range(width):
                sums[m, k] += parts[place, k]


@njit(parallel=True, **_OPTIONS)
def weigh(
    starts, members, columns, means, conics, opacities, boxes, residual, trust, parts
):  # pragma: no cover - compiled
    """Fill parts [P, 4]: each pair's sum of weights (alpha times transmittance), and of weights times residual.

    Pixels count as much as `trust` [H, W] says. residual: [H, W, 3].
    """
    height, width = trust.shape
    for tile in prange(starts.shape[0] - 1):
        x0, y0 = tile % columns * TILE, tile // columns * TILE
        x1, y1 = min(x0 + TILE, width), min(y0 + TILE, height)
        open_ = np.ones(TILE * TILE, np.float32)
        alphas = np.empty(TILE, np.float32)
        for p in range(starts[tile], starts[tile + 1]):
            n = members[p]
            left, top, bottom, count = _part(boxes[n], x0, y0, x1, y1)
            dx = np.float32(left) + _HALF - means[n, 0]
            a, b, c, opacity = conics[n, 0], conics[n, 1], conics[n, 2], opacities[n]
            total, red, green, blue = _0, _0, _0, _0
            for y in range(top, bottom):
                base = np.uintp((y - y0) * TILE + left - x0)
                dy = np.float32(y) + _HALF - means[n, 1]
                _fill_alphas(dx, dy, count, a, b, c, opacity, open_, base, alphas)
                for k in range(count):
                    if alphas[k] <= _0:
                        continue
                    was_open = open_[base + k]
                    left_open = was_open * (_1 - alphas[k])
                    if left_open < LEAST_OPEN:
                        open_[base + k] = -was_open
                        continue
                    open_[base + k] = left_open
                    column = left + np.int64(k)
                    weight = was_open * alphas[k] * trust[y, column]
                    total += weight
                    red += weight * residual[y, column, 0]
                    green += weight * residual[y, column, 1]
                    blue += weight * residual[y, column, 2]
            parts[p, 0], parts[p, 1], parts[p, 2], parts[p, 3] = total, red, green, blue


# ---------------------------------------------------------------- back to Gaussians
@njit(parallel=True, **_OPTIONS)
def project_backward(
    ids, sums, centers, rotations, log_scales, opacities, harmonics, conics, colors, pose, position, focal, reach,
    d_centers, d_rotations, d_log_scales, d_opacity_logits, d_harmonics,
):  # fmt: skip # pragma: no cover - compiled
    """Fill gradients [M, ...] to Gaussians `ids` [M] from those to their ellipses, `sums` [M, PARTS]."""
    count = harmonics.shape[1]
    for m in prange(ids.shape[0]):
        n = ids[m]
        at = centers[n]
        # --- colour
        values, d_values = np.empty(count, np.float32), np.zeros(count, np.float32)
        rx, ry, rz = at[0] - position[0], at[1] - position[1], at[2] - position[2]
        per_length = _1 / np.sqrt(rx * rx + ry * ry + rz * rz)
        rx, ry, rz = rx * per_length, ry * per_length, rz * per_length
        fill_basis(rx, ry, rz, values)
        for c in range(3):
            d_color = sums[m, 6 + c] if colors[n, c] > _0 else _0
            for k in range(count):
                d_harmonics[m, k, c] = d_color * values[k]
                d_values[k] += d_color * harmonics[n, k, c]
        gx, gy, gz = _basis_backward(rx, ry, rz, d_values)
        along = gx * rx + gy * ry + gz * rz
        dx, dy, dz = (gx - along * rx) * per_length, (gy - along * ry) * per_length, (gz - along * rz) * per_length
        # --- opacity
        d_opacity_logits[m] = sums[m, 5] * opacities[n] * (_1 - opacities[n])
        # --- covariance in the image: dL/dcov = -conic dL/dconic conic, dL/dflat = 2 dL/dcov flat
        a, b, c_ = conics[n, 0], conics[n, 1], conics[n, 2]
        ga, gb, gc = sums[m, 2], _HALF * sums[m, 3], sums[m, 4]
        pa, pb = a * ga + b * gb, a * gb + b * gc
        qa, qb = b * ga + c_ * gb, b * gb + c_ * gc
        g_xx, g_xy, g_yy = -(pa * a + pb * b), -(pa * b + pb * c_), -(qa * b + qb * c_)
        x = pose[0, 0] * at[0] + pose[0, 1] * at[1] + pose[0, 2] * at[2] + pose[0, 3]
        y = pose[1, 0] * at[0] + pose[1, 1] * at[1] + pose[1, 2] * at[2] + pose[1, 3]
        z = pose[2, 0] * at[0] + pose[2, 1] * at[1] + pose[2, 2] * at[2] + pose[2, 3]
        per_z = _1 / z
        turn, axes, flat = np.empty((3, 3), np.float32), np.empty((3, 3), np.float32), np.empty((2, 3), np.float32)
        d_axes, d_turn = np.empty((3, 3), np.float32), np.empty((3, 3), np.float32)
        per_norm = _fill_rotation(rotations[n], turn)
        _fill_axes(turn, log_scales[n], pose, axes)
        u, v, own_u, own_v = _slopes(x, y, z, reach)
        _fill_flat(axes, u, v, z, focal, flat)
        d_u, d_v, d_z = _0, _0, _0
        for k in range(3):
            d0 = _2 * (g_xx * flat[0, k] + g_xy * flat[1, k])
            d1 = _2 * (g_xy * flat[0, k] + g_yy * flat[1, k])
            d_axes[0, k] = per_z * focal[0] * d0
            d_axes[1, k] = per_z * (focal[1] * d0 + focal[2] * d1)
            d_axes[2, k] = -u * d_axes[0, k] - v * d_axes[1, k]
            d_u -= d_axes[0, k] * axes[2, k]
            d_v -= d_axes[1, k] * axes[2, k]
            d_z -= per_z * (d0 * flat[0, k] + d1 * flat[1, k])
        # --- the mean in the image, and the slopes where they are the point's own
        m0, m1 = sums[m, 0], sums[m, 1]
        m_u, m_v = focal[0] * m0, focal[1] * m0 + focal[2] * m1
        c_x, c_y = per_z * m_u, per_z * m_v
        c_z = d_z - per_z * (m_u * x + m_v * y) * per_z
        if own_u:
            c_x += per_z * d_u
            c_z -= per_z * per_z * x * d_u
        if own_v:
            c_y += per_z * d_v
            c_z -= per_z * per_z * y * d_v
        d_centers[m, 0] = dx + pose[0, 0] * c_x + pose[1, 0] * c_y + pose[2, 0] * c_z
        d_centers[m, 1] = dy + pose[0, 1] * c_x + pose[1, 1] * c_y + pose[2, 1] * c_z
        d_centers[m, 2] = dz + pose[0, 2] * c_x + pose[1, 2] * c_y + pose[2, 2] * c_z
        # --- scales and rotation
        for k in range(3):
            scale = np.exp(log_scales[n, k])
            total = _0
            for i in range(3):
                total += d_axes[i, k] * axes[i, k]
                d_turn[i, k] = scale * (
                    pose[0, i] * d_axes[0, k] + pose[1, i] * d_axes[1, k] + pose[2, i] * d_axes[2, k]
                )
            d_log_scales[m, k] = total
        q = rotations[n]
        qw, qx, qy, qz = q[0] * per_norm, q[1] * per_norm, q[2] * per_norm, q[3] * per_norm
        d = d_turn
        dw = _2 * (qx * (d[2, 1] - d[1, 2]) + qy * (d[0, 2] - d[2, 0]) + qz * (d[1, 0] - d[0, 1]))
        dqx = _2 * (
            qw * (d[2, 1] - d[1, 2])
            + qy * (d[0, 1] + d[1, 0])
            + qz * (d[0, 2] + d[2, 0])
            - _2 * qx * (d[1, 1] + d[2, 2])
        )
        dqy = _2 * (
            qw * (d[0, 2] - d[2, 0])
            + qx * (d[0, 1] + d[1, 0])
            + qz * (d[1, 2] + d[2, 1])
            - _2 * qy * (d[0, 0] + d[2, 2])
        )
        dqz = _2 * (
            qw * (d[1, 0] - d[0, 1])
            + qx * (d[0, 2] + d[2, 0])
            + qy * (d[1, 2] + d[2, 1])
            - _2 * qz * (d[0, 0] + d[1, 1])
        )
        along = dw * qw + dqx * qx + dqy * qy + dqz * qz
        d_rotations[m, 0], d_rotations[m, 1] = (dw - along * qw) * per_norm, (dqx - along * qx) * per_norm
        d_rotations[m, 2], d_rotations[m, 3] = (dqy - along * qy) * per_norm, (dqz - along * qz) * per_norm


@njit(parallel=True, **_OPTIONS)
def adam(values, gradients, ids, means, squares, rates, beta_1, beta_2, unbias_1, unbias_2):  # pragma: no cover
    """A step of Adam (Kingma & Ba 2015) on the rows `ids` [M] of values [N, D]; the others stay, moments and all.

    gradients: [M, D]; means, squares: [N, D] moments; rates: [D]; unbias: 1 - beta^step.
    """
    for m in prange(ids.shape[0]):
        n = ids[m]
        for k in range(values.shape[1]):
            gradient = gradients[m, k]
            means[n, k] += (_1 - beta_1) * (gradient - means[n, k])
            squares[n, k] += (_1 - beta_2) * (gradient * gradient - squares[n, k])
            values[n, k] -= (
                rates[k] * (means[n, k] / unbias_1) / (np.sqrt(squares[n, k] / unbias_2) + np.float32(1e-15))
            )
