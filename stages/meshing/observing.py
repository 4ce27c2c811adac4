"""What photos say about surface points: the compiled loops of baking.

They live in one file because a compiled function's cache notices changes in its own file only.
"""

from __future__ import annotations

import numpy as np
from numba import njit

# Beyond this angle from the normal (cosine) a photo says nothing about a point.
MIN_COS = 0.17
# How far the depth map and the point may differ, in pixel sizes across the line of sight.
DEPTH_PIXELS = 2.0
# Fixed-point steps per colour level in the texel buffers: they hold 0..1020 and ±1020.
STEPS_UNSIGNED = 64.0
STEPS_SIGNED = 32.0
# Robust spread (colour levels) never counts as less than this: photo noise.
NOISE_FLOOR = 3.0


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
    points, normals, matrix, center, focal, inverse_depth, confidence, low, weights, colors
):  # pragma: no cover - compiled
    """Fill weights [P] and low-band colours [P, 3] of one photo at points [P, 3]."""
    for i in range(points.shape[0]):
        weight, u, v = observe(
            points[i, 0], points[i, 1], points[i, 2], normals[i, 0], normals[i, 1], normals[i, 2],
            matrix, center, focal, inverse_depth, confidence,
        )  # fmt: skip
        weights[i] = weight
        if weight > 0:
            for c in range(3):
                colors[i, c] = _bilinear(low, u, v, c)


@njit(nogil=True, cache=True)
def gather_texels(
    points, normals, preferred, matrix, center, focal, inverse_depth, confidence, low, photo, gain,
    best_weights, best_lows, seen_by, detail_rank, details, detail_lows,
):  # fmt: skip # pragma: no cover - compiled
    """Offer one photo to texels [T].

    Keeps each texel's best K views in best_weights [T, K] (descending) and best_lows [T, K, 3] uint16,
    counts views in seen_by [T], and keeps the high band of the preferred view (preferred [T] bool), else of
    the best one, in details [T, 3] int16 with that view's low band in detail_lows [T, 3] uint16.
    """
    keep = best_weights.shape[1]
    for i in range(points.shape[0]):
        weight, u, v = observe(
            points[i, 0], points[i, 1], points[i, 2], normals[i, 0], normals[i, 1], normals[i, 2],
            matrix, center, focal, inverse_depth, confidence,
        )  # fmt: skip
        if weight <= 0:
            continue
        seen_by[i] += 1
        rank = np.inf if preferred[i] else weight
        takes_detail = rank > detail_rank[i]
        takes_low = weight > best_weights[i, keep - 1]
        if not (takes_detail or takes_low):
            continue
        slot = keep - 1
        if takes_low:
            while slot > 0 and best_weights[i, slot - 1] < weight:
                best_weights[i, slot] = best_weights[i, slot - 1]
                for c in range(3):
                    best_lows[i, slot, c] = best_lows[i, slot - 1, c]
                slot -= 1
            best_weights[i, slot] = weight
        if takes_detail:
            detail_rank[i] = rank
        for c in range(3):
            low_value = _bilinear(low, u, v, c)
            fixed = np.uint16(min(low_value * gain[c], 1020.0) * STEPS_UNSIGNED + 0.5)
            if takes_low:
                best_lows[i, slot, c] = fixed
            if takes_detail:
                high = (_bilinear(photo, u, v, c) - low_value) * gain[c]
                details[i, c] = np.int16(min(max(high, -1020.0), 1020.0) * STEPS_SIGNED)
                detail_lows[i, c] = fixed


@njit(nogil=True, cache=True)
def blend_texels(
    best_weights, best_lows, details, detail_lows, robust_sigma, ghost_levels, colors
):  # pragma: no cover - compiled
    """Fill colors [T, 3] (0..255 float32) from the buffers of `gather_texels`.

    Low band: mean of all kept views but the last, whose weight is taken off the others', so that a view fades out
    before it leaves the set and no seam shows where it does. Views at d = robust_sigma · 1.4826 · MAD from the
    weighted median and beyond count nothing, nearer ones (1 - (·/d)²)² (Tukey's biweight).

    The high band is added, faded by exp(-(d / ghost_levels)²) where its view's low band lies d off the robust
    mean: a highlight or a misplaced surface there, whose detail belongs elsewhere.
    """
    keep = best_weights.shape[1] - 1
    values = np.empty((keep, 3))
    weights = np.empty(keep)
    deviations = np.empty(keep)
    median = np.empty(3)
    for i in range(best_weights.shape[0]):
        count = 0
        while count < keep and best_weights[i, count] > 0:
            weights[count] = best_weights[i, count]
            for c in range(3):
                values[count, c] = best_lows[i, count, c] / STEPS_UNSIGNED
            count += 1
        if count == 0:
            continue
        half = 0.5 * weights[:count].sum()
        for c in range(3):
            median[c] = _weighted_middle(values[:count, c], weights[:count], half)
        for k in range(count):
            deviations[k] = max(
                abs(values[k, 0] - median[0]), abs(values[k, 1] - median[1]), abs(values[k, 2] - median[2])
            )
        spread = max(1.4826 * _weighted_middle(deviations[:count], weights[:count], half), NOISE_FLOOR)
        total = 0.0
        mean0, mean1, mean2 = 0.0, 0.0, 0.0
        for k in range(count):
            near = 1.0 - (deviations[k] / (robust_sigma * spread)) ** 2
            if near > 0:
                # A little of each weight stays: with equal ones, nothing would be left.
                weight = (1.001 * weights[k] - best_weights[i, keep]) * near * near
                total += weight
                mean0 += weight * values[k, 0]
                mean1 += weight * values[k, 1]
                mean2 += weight * values[k, 2]
        if total > 0:
            median[0], median[1], median[2] = mean0 / total, mean1 / total, mean2 / total
        off = 0.0
        for c in range(3):
            off = max(off, abs(detail_lows[i, c] / STEPS_UNSIGNED - median[c]))
        share = np.exp(-((off / ghost_levels) ** 2)) / STEPS_SIGNED
        for c in range(3):
            colors[i, c] = min(max(median[c] + share * details[i, c], 0.0), 255.0)


@njit(nogil=True, cache=True)
def _weighted_middle(values, weights, half):  # pragma: no cover - compiled
    """Weighted median of a few values, `half` being half of the weights' sum."""
    order = np.argsort(values)
    cumulative = 0.0
    for k in order:
        cumulative += weights[k]
        if cumulative >= half:
            return values[k]
    return values[order[-1]]
