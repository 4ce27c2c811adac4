"""What photos say about surface points: the compiled loops of baking.

They live in one file because a compiled function's cache notices changes in its own file only.
"""

from __future__ import annotations

import numpy as np

from stages.compiling import njit

# Beyond this angle from the normal (cosine) a photo says nothing about a point.
MIN_COS = 0.17
# How far the depth map and the point may differ, in pixel sizes across the line of sight.
DEPTH_PIXELS = 2.0
# Fixed-point steps per colour level in the texel buffers: they hold 0..1020 and ±1020.
STEPS_UNSIGNED = 64.0
STEPS_SIGNED = 32.0
# Robust spread (colour levels) never counts as less than this: photo noise.
NOISE_FLOOR = 3.0
# Points projected at a time, by the two loops over points themselves: with a function for it that both call, inlined or
# not, they took three to six times as long.
_BLOCK = 512
# Unsigned, or numba would look at each index whether it counts from the end, at a fifth of the time.
_ONE = np.uintp(1)


@njit(nogil=True, cache=True)
def _project(points, normals, matrix, center, u, v, depth, cos):  # pragma: no cover - compiled
    """Fill pixel, depth and cosine to the normal, [_BLOCK] each, of as many points or fewer.

    Apart from `view_weight`, into arrays of their own and without a branch, so that it runs on vectors.
    """
    for k in range(points.shape[0]):
        px, py, pz = points[k, 0], points[k, 1], points[k, 2]
        dx, dy, dz = center[0] - px, center[1] - py, center[2] - pz
        distance = np.sqrt(dx * dx + dy * dy + dz * dz)
        z = matrix[2, 0] * px + matrix[2, 1] * py + matrix[2, 2] * pz + matrix[2, 3]
        per_depth = 1.0 / z
        u[k] = (matrix[0, 0] * px + matrix[0, 1] * py + matrix[0, 2] * pz + matrix[0, 3]) * per_depth - 0.5
        v[k] = (matrix[1, 0] * px + matrix[1, 1] * py + matrix[1, 2] * pz + matrix[1, 3]) * per_depth - 0.5
        depth[k] = z
        facing = normals[k, 0] * dx + normals[k, 1] * dy + normals[k, 2] * dz
        cos[k] = facing / max(distance, 1e-12)


@njit(nogil=True, cache=True)
def view_weight(u, v, z, cos, focal, inverse_depth, confidence):  # pragma: no cover - compiled
    """Weight with which a photo sees a point at depth z on pixel (u, v); 0: it does not.

    weight = confidence · (focal cos θ / depth)² cos θ: pixels on a unit of surface, times a further fall-off
    with the angle θ between normal and line of sight, because slanted views blur and mirror.
    """
    height, width = inverse_depth.shape
    if not (cos >= MIN_COS and z > 0 and u >= 0 and v >= 0 and u < width - 1 and v < height - 1):
        return 0.0
    x, y = np.uintp(u), np.uintp(v)
    right, below = x + _ONE, y + _ONE
    fx, fy = u - x, v - y
    trust = min(confidence[y, x], confidence[y, right], confidence[below, x], confidence[below, right])
    w = (inverse_depth[y, x] * (1 - fx) + inverse_depth[y, right] * fx) * (1 - fy) + (
        inverse_depth[below, x] * (1 - fx) + inverse_depth[below, right] * fx
    ) * fy
    # Beyond two pixel sizes of the depth map, stretched along the line of sight on slanted surfaces. Trust and this are
    # no ways out of their own: where they change, the processor guesses wrong, which takes longer than all the rest.
    hidden = abs(z * w - 1.0) * focal * cos > DEPTH_PIXELS * w * z
    detail = focal * cos / z
    return 0.0 if hidden else trust / 255.0 * detail * detail * cos


@njit(nogil=True, cache=True)
def _bilinear(image, u, v):  # pragma: no cover - compiled
    """The three channels of an image between four pixels."""
    x, y = np.uintp(u), np.uintp(v)
    right, below = x + _ONE, y + _ONE
    fx, fy = u - x, v - y
    w00, w01, w10, w11 = (1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy
    red = w00 * image[y, x, 0] + w01 * image[y, right, 0] + w10 * image[below, x, 0] + w11 * image[below, right, 0]
    green = w00 * image[y, x, 1] + w01 * image[y, right, 1] + w10 * image[below, x, 1] + w11 * image[below, right, 1]
    blue = w00 * image[y, x, 2] + w01 * image[y, right, 2] + w10 * image[below, x, 2] + w11 * image[below, right, 2]
    return red, green, blue


@njit(nogil=True, cache=True)
def sample_points(
    points, normals, matrix, center, focal, inverse_depth, confidence, image, weights, colors
):  # pragma: no cover - compiled
    """Fill weights [P] and bilinear colours [P, 3] of one photo (or a band of it) at points [P, 3]."""
    us, vs, depths, cosines = np.empty(_BLOCK), np.empty(_BLOCK), np.empty(_BLOCK), np.empty(_BLOCK)
    for i in range(points.shape[0]):
        k = i % _BLOCK
        if k == 0:
            block = slice(i, i + _BLOCK)
            _project(points[block], normals[block], matrix, center, us, vs, depths, cosines)
        u, v = us[k], vs[k]
        weights[i] = view_weight(u, v, depths[k], cosines[k], focal, inverse_depth, confidence)
        if weights[i] > 0:
            colors[i, 0], colors[i, 1], colors[i, 2] = _bilinear(image, u, v)


@njit(nogil=True, cache=True)
def _least(values):  # pragma: no cover - compiled
    least = 0
    for k in range(1, values.shape[0]):
        if values[k] <= values[least]:
            least = k
    return least


@njit(nogil=True, cache=True)
def gather_texels(
    points, normals, matrix, center, focal, inverse_depth, confidence, low, photo, gain, sharpness,
    best_weights, best_lows, best_highs, seen_by,
):  # fmt: skip # pragma: no cover - compiled
    """Offer one photo, with its low band in `STEPS_UNSIGNED` a level, to texels [T].

    Keeps each texel's best K views in best_weights [T, K] (in no order, 0 where there are fewer), their low bands in
    best_lows [T, K, 3] uint16 and high bands in best_highs [T, K, 3] int16, and counts views in seen_by [T].
    """
    keep = best_weights.shape[1]
    us, vs, depths, cosines = np.empty(_BLOCK), np.empty(_BLOCK), np.empty(_BLOCK), np.empty(_BLOCK)
    for i in range(points.shape[0]):
        k = i % _BLOCK
        if k == 0:
            block = slice(i, i + _BLOCK)
            _project(points[block], normals[block], matrix, center, us, vs, depths, cosines)
        u, v = us[k], vs[k]
        weight = sharpness * view_weight(u, v, depths[k], cosines[k], focal, inverse_depth, confidence)
        if weight <= 0:
            continue
        slot = seen_by[i]
        seen_by[i] += 1
        if slot >= keep:
            slot = _least(best_weights[i])
            if weight <= best_weights[i, slot]:
                continue
        best_weights[i, slot] = weight
        low_values, values = _bilinear(low, u, v), _bilinear(photo, u, v)
        for c in range(3):
            low_value = low_values[c] / STEPS_UNSIGNED
            high = (values[c] - low_value) * gain[c]
            best_lows[i, slot, c] = np.uint16(min(low_value * gain[c], 1020.0) * STEPS_UNSIGNED + 0.5)
            best_highs[i, slot, c] = np.int16(np.floor(min(max(high, -1020.0), 1020.0) * STEPS_SIGNED + 0.5))


@njit(nogil=True, cache=True)
def blend_texels(
    best_weights, best_lows, best_highs, detail, robust_sigma, diffuse, colors
):  # pragma: no cover - compiled
    """Fill colors [T, 3] uint8 from the buffers of `gather_texels`.

    A view's distance d from the others is that of its low band from their weighted median. Views at d = robust_sigma *
    1.4826 * MAD and beyond count nothing, nearer ones (1 - (./d)^2)^2 (Tukey's biweight). Both medians go by the root
    of the weights: what passes below the photographer is in the photos that weigh most. With `diffuse`, a view that is
    brighter than the median is twice as far from it: a highlight adds light, and moves from photo to photo.

    Low band: mean of the views with the root of their weight, for sheen moves from one photo to the next and none of
    them is right. High band: with the weight, rather those that resolve the most (docs/benchmarks/textures.md). Where
    all places for views are taken, the least one counts nothing and its weight is taken off the others', so that a view
    fades out before it leaves the set and no seam shows where it does.
    """
    places = best_weights.shape[1]
    values, highs = np.empty((3, places), dtype=np.float32), np.empty((3, places), dtype=np.float32)
    weights, deviations = np.empty(places, dtype=np.float32), np.empty(places, dtype=np.float32)
    up_to, votes = np.empty(places, dtype=np.float32), np.empty(places, dtype=np.float32)
    median = np.empty(3)
    low = np.empty(3)
    high = np.empty(3)
    for i in range(best_weights.shape[0]):
        last, faded = -1, 0.0
        if best_weights[i, places - 1] > 0:
            last = _least(best_weights[i])
            faded = best_weights[i, last]
        most = best_weights[i].max()
        count = 0
        for slot in range(places):
            if best_weights[i, slot] <= 0:
                break
            if slot == last:
                continue
            # A little of each weight stays: with equal ones, nothing would be left.
            weights[count] = (1.001 * best_weights[i, slot] - faded) / most
            for c in range(3):
                values[c, count] = best_lows[i, slot, c] / STEPS_UNSIGNED
                highs[c, count] = best_highs[i, slot, c] / STEPS_SIGNED
            count += 1
        if count == 0:
            continue
        total = np.float32(0.0)
        for k in range(count):
            votes[k] = np.sqrt(weights[k])
            total += votes[k]
        half = np.float32(0.5) * total
        for c in range(3):
            median[c] = _weighted_middle(values[c, :count], votes[:count], half, up_to)
        for k in range(count):
            deviations[k] = 0.0
            for c in range(3):
                off = values[c, k] - median[c]
                if off < 0:
                    off = -off
                elif diffuse:
                    off *= 2.0
                deviations[k] = max(deviations[k], off)
        spread = max(1.4826 * _weighted_middle(deviations[:count], votes[:count], half, up_to), NOISE_FLOOR)
        low[:] = 0.0
        high[:] = 0.0
        low_total = high_total = 0.0
        for k in range(count):
            near = 1.0 - (deviations[k] / (robust_sigma * spread)) ** 2
            if near <= 0:
                continue
            low_weight = near * near * votes[k]
            high_weight = near * near * weights[k]
            low_total += low_weight
            high_total += high_weight
            for c in range(3):
                low[c] += low_weight * values[c, k]
                high[c] += high_weight * highs[c, k]
        for c in range(3):
            color = low[c] / low_total if low_total > 0 else median[c]
            if detail and high_total > 0:
                color += high[c] / high_total
            colors[i, c] = np.uint8(min(max(color, 0.0), 255.0) + 0.5)


@njit(nogil=True, cache=True)
def _weighted_middle(values, weights, half, up_to):  # pragma: no cover - compiled
    """Weighted median of P values, `half` being half of the weights' sum. `up_to` [P] is scratch.

    By comparing all pairs, which runs on vectors: sorting so few takes several times as long.
    """
    count, none, middle = values.shape[0], np.float32(0.0), np.float32(np.inf)
    for k in range(count):
        up_to[k] = none
    for j in range(count):
        value, weight = values[j], weights[j]
        for k in range(count):
            up_to[k] += weight if value <= values[k] else none
    for k in range(count):
        if up_to[k] >= half and values[k] < middle:
            middle = values[k]
    return middle
