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
# What photos count in the mean of either band is a power of their weight. Low: many photos, for sheen moves from one
# to the next and none of them is right. High: rather those that resolve the most. See docs/benchmarks/textures.md.
LOW_POWER, HIGH_POWER = 0.5, 1.0


@njit(nogil=True, cache=True)
def observe(px, py, pz, nx, ny, nz, matrix, center, focal, inverse_depth, confidence):  # pragma: no cover - compiled
    """Weight with which a photo sees a point, and the pixel; weight 0: it does not.

    weight = confidence · (focal cos θ / depth)² cos θ: pixels on a unit of surface, times a further fall-off
    with the angle θ between normal and line of sight, because slanted views blur and mirror.
    """
    dx, dy, dz = center[0] - px, center[1] - py, center[2] - pz
    distance = np.sqrt(dx * dx + dy * dy + dz * dz)
    cos = (nx * dx + ny * dy + nz * dz) / max(distance, 1e-12)
    if cos < MIN_COS:
        return 0.0, 0.0, 0.0
    z = matrix[2, 0] * px + matrix[2, 1] * py + matrix[2, 2] * pz + matrix[2, 3]
    if z <= 0:
        return 0.0, 0.0, 0.0
    u = (matrix[0, 0] * px + matrix[0, 1] * py + matrix[0, 2] * pz + matrix[0, 3]) / z - 0.5
    v = (matrix[1, 0] * px + matrix[1, 1] * py + matrix[1, 2] * pz + matrix[1, 3]) / z - 0.5
    height, width = inverse_depth.shape
    if not (u >= 0 and v >= 0 and u < width - 1 and v < height - 1):
        return 0.0, 0.0, 0.0
    x, y = int(u), int(v)
    fx, fy = u - x, v - y
    trust = min(confidence[y, x], confidence[y, x + 1], confidence[y + 1, x], confidence[y + 1, x + 1])
    if trust <= 0:
        return 0.0, 0.0, 0.0
    w = (inverse_depth[y, x] * (1 - fx) + inverse_depth[y, x + 1] * fx) * (1 - fy) + (
        inverse_depth[y + 1, x] * (1 - fx) + inverse_depth[y + 1, x + 1] * fx
    ) * fy
    # Within two pixel sizes of the depth map, stretched along the line of sight on slanted surfaces.
    if abs(z * w - 1.0) * focal * cos > DEPTH_PIXELS * w * z:
        return 0.0, 0.0, 0.0
    detail = focal * cos / z
    return trust * detail * detail * cos, u, v


@njit(nogil=True, cache=True)
def _bilinear(image, u, v, c):  # pragma: no cover - compiled
    x, y = int(u), int(v)
    fx, fy = u - x, v - y
    top = image[y, x, c] * (1 - fx) + image[y, x + 1, c] * fx
    bottom = image[y + 1, x, c] * (1 - fx) + image[y + 1, x + 1, c] * fx
    return top * (1 - fy) + bottom * fy


@njit(nogil=True, cache=True)
def sample_points(
    points, normals, matrix, center, focal, inverse_depth, confidence, image, weights, colors
):  # pragma: no cover - compiled
    """Fill weights [P] and bilinear colours [P, 3] of one photo (or a band of it) at points [P, 3]."""
    for i in range(points.shape[0]):
        weight, u, v = observe(
            points[i, 0], points[i, 1], points[i, 2], normals[i, 0], normals[i, 1], normals[i, 2],
            matrix, center, focal, inverse_depth, confidence,
        )  # fmt: skip
        weights[i] = weight
        if weight > 0:
            for c in range(3):
                colors[i, c] = _bilinear(image, u, v, c)


@njit(nogil=True, cache=True)
def gather_texels(
    points, normals, matrix, center, focal, inverse_depth, confidence, low, photo, gain, sharpness,
    best_weights, best_lows, best_highs, seen_by,
):  # fmt: skip # pragma: no cover - compiled
    """Offer one photo to texels [T].

    Keeps each texel's best K views in best_weights [T, K] (descending), their low bands in best_lows [T, K, 3] uint16
    and high bands in best_highs [T, K, 3] int16, and counts views in seen_by [T].
    """
    keep = best_weights.shape[1]
    for i in range(points.shape[0]):
        weight, u, v = observe(
            points[i, 0], points[i, 1], points[i, 2], normals[i, 0], normals[i, 1], normals[i, 2],
            matrix, center, focal, inverse_depth, confidence,
        )  # fmt: skip
        weight *= sharpness
        if weight <= 0:
            continue
        seen_by[i] += 1
        if weight <= best_weights[i, keep - 1]:
            continue
        slot = keep - 1
        while slot > 0 and best_weights[i, slot - 1] < weight:
            best_weights[i, slot] = best_weights[i, slot - 1]
            for c in range(3):
                best_lows[i, slot, c] = best_lows[i, slot - 1, c]
                best_highs[i, slot, c] = best_highs[i, slot - 1, c]
            slot -= 1
        best_weights[i, slot] = weight
        for c in range(3):
            low_value = _bilinear(low, u, v, c)
            high = (_bilinear(photo, u, v, c) - low_value) * gain[c]
            best_lows[i, slot, c] = np.uint16(min(low_value * gain[c], 1020.0) * STEPS_UNSIGNED + 0.5)
            best_highs[i, slot, c] = np.int16(np.floor(min(max(high, -1020.0), 1020.0) * STEPS_SIGNED + 0.5))


@njit(nogil=True, cache=True)
def blend_texels(
    best_weights, best_lows, best_highs, detail, robust_sigma, diffuse, colors
):  # pragma: no cover - compiled
    """Fill colors [T, 3] uint8 from the buffers of `gather_texels`.

    A view's distance d from the others is that of its low band from their weighted median. Views at d = robust_sigma *
    1.4826 * MAD and beyond count nothing, nearer ones (1 - (./d)^2)^2 (Tukey's biweight). With `diffuse`, a view
    that is brighter than the median is twice as far from it: a highlight adds light, and moves from photo to photo.

    Low band: mean of the views with weight^LOW_POWER, high band: with weight^HIGH_POWER. The last of the kept views
    counts nothing and its weight is taken off the others', so that a view fades out before it leaves the set and no
    seam shows where it does.
    """
    keep = best_weights.shape[1] - 1
    values = np.empty((keep, 3))
    weights = np.empty(keep)
    deviations = np.empty(keep)
    order = np.empty(keep, dtype=np.int64)
    median = np.empty(3)
    low = np.empty(3)
    high = np.empty(3)
    for i in range(best_weights.shape[0]):
        count = 0
        while count < keep and best_weights[i, count] > 0:
            # A little of each weight stays: with equal ones, nothing would be left.
            weights[count] = (1.001 * best_weights[i, count] - best_weights[i, keep]) / best_weights[i, 0]
            for c in range(3):
                values[count, c] = best_lows[i, count, c] / STEPS_UNSIGNED
            count += 1
        if count == 0:
            continue
        half = 0.5 * weights[:count].sum()
        for c in range(3):
            median[c] = _weighted_middle(values[:count, c], weights[:count], half, order)
        for k in range(count):
            deviations[k] = 0.0
            for c in range(3):
                off = values[k, c] - median[c]
                if off < 0:
                    off = -off
                elif diffuse:
                    off *= 2.0
                deviations[k] = max(deviations[k], off)
        spread = max(1.4826 * _weighted_middle(deviations[:count], weights[:count], half, order), NOISE_FLOOR)
        low[:] = 0.0
        high[:] = 0.0
        low_total = high_total = 0.0
        for k in range(count):
            near = 1.0 - (deviations[k] / (robust_sigma * spread)) ** 2
            if near <= 0:
                continue
            low_weight = near * near * weights[k] ** LOW_POWER
            high_weight = near * near * weights[k] ** HIGH_POWER
            low_total += low_weight
            high_total += high_weight
            for c in range(3):
                low[c] += low_weight * values[k, c]
                high[c] += high_weight * best_highs[i, k, c] / STEPS_SIGNED
        for c in range(3):
            color = low[c] / low_total if low_total > 0 else median[c]
            if detail and high_total > 0:
                color += high[c] / high_total
            colors[i, c] = np.uint8(min(max(color, 0.0), 255.0) + 0.5)


@njit(nogil=True, cache=True)
def _weighted_middle(values, weights, half, order):  # pragma: no cover - compiled
    """Weighted median of a few values, `half` being half of the weights' sum. `order` is scratch of their number."""
    count = values.shape[0]
    # By insertion: numpy's argsort takes several times as long for so few.
    for i in range(count):
        k = i
        while k > 0 and values[order[k - 1]] > values[i]:
            order[k] = order[k - 1]
            k -= 1
        order[k] = i
    cumulative = 0.0
    for k in range(count):
        cumulative += weights[order[k]]
        if cumulative >= half:
            return values[order[k]]
    return values[order[count - 1]]
