"""The compiled loops of dense stereo: disparities to depths, depths that agree, photos that see a point.

They live in one file because a compiled function's cache notices changes in its own file only.
"""

from __future__ import annotations

import numpy as np

from stages.compiling import njit, prange

# Neighbouring disparities further apart than this, in pixels, are two surfaces: nothing is between them.
_SAME_SURFACE = 1.0
# Cosines: photos whose lines of sight to a point differ by more than 60 degrees say nothing of each other; nor does one
# that sees the surface from behind, or almost from the side.
_WIDE, _FACING = 0.5, 0.2
# Neighbouring depths that differ by more than this part of them are two surfaces: no normal spans both.
_NEAR = 0.05
# In `known` of `votes`: found less exactly than is usual.
INEXACT = 2


@njit(nogil=True, cache=True)
def seen_from_right(disparity):  # pragma: no cover - compiled
    """Disparity [a, b] of the right photo's pixels, from that of the left's; NaN where nothing lands."""
    rows, columns = disparity.shape
    found = np.full((rows, columns), np.nan, np.float32)
    for y in range(rows):
        last_x, last_d = np.float32(-1e9), np.float32(np.nan)
        for x in range(columns):
            d = disparity[y, x]
            if np.isnan(d):
                continue
            at = np.float32(x) - d
            if abs(d - last_d) <= _SAME_SURFACE and at > last_x and at - last_x < 2.5:
                first = int(np.ceil(last_x))
                for k in range(max(first, 0), min(int(np.floor(at)), columns - 1) + 1):
                    t = (np.float32(k) - last_x) / (at - last_x)
                    value = last_d + t * (d - last_d)
                    if not found[y, k] > value:  # what is nearer hides what is behind it
                        found[y, k] = value
            last_x, last_d = at, d
    return found


@njit(nogil=True, cache=True)
def depths_of(disparity, rays_from_pixels, focal, x0, y0, focal_base, shift, depth):  # pragma: no cover
    """Depth [h, w] along the optical axis of a photo's pixels, from disparities [a, b] of its rectified picture.

    Args:
        rays_from_pixels: [3, 3], turned frame from pixels; their third is z for a unit of depth.
        x0, y0: principal point in the rectified picture.
        depth: written; 0 where nothing is known.
    """
    height, width = depth.shape
    rows, columns = disparity.shape
    m = rays_from_pixels
    for v in range(height):
        for u in range(width):
            px, py = u + 0.5, v + 0.5
            rz = m[2, 0] * px + m[2, 1] * py + m[2, 2]
            depth[v, u] = 0
            if rz <= 1e-9:
                continue
            x = focal * (m[0, 0] * px + m[0, 1] * py + m[0, 2]) / rz + x0 - 0.5
            y = focal * (m[1, 0] * px + m[1, 1] * py + m[1, 2]) / rz + y0 - 0.5
            if not (x >= 0 and y >= 0 and x < columns - 1 and y < rows - 1):
                continue
            i, j = int(x), int(y)
            a, b, c, d = disparity[j, i], disparity[j, i + 1], disparity[j + 1, i], disparity[j + 1, i + 1]
            fx, fy = x - i, y - j
            low, high = min(min(a, b), min(c, d)), max(max(a, b), max(c, d))
            if high - low <= _SAME_SURFACE:  # false for NaN
                found = (1 - fy) * ((1 - fx) * a + fx * b) + fy * ((1 - fx) * c + fx * d)
            else:
                found = disparity[int(y + 0.5), int(x + 0.5)]
            if np.isnan(found) or found - shift <= 1e-6:
                continue
            depth[v, u] = focal_base / (found - shift) / rz


@njit(nogil=True, parallel=True, cache=True)
def agreed(depths, tolerance, needed, depth):  # pragma: no cover - compiled
    """The depth on which most of K maps [K, h, w] agree within a part `tolerance` of it, as their mean.

    Args:
        needed: [K + 1] how many must agree where so many know one.
        depth: written, [h, w]: 0 where too few agree.
    """
    maps, height, width = depths.shape
    for v in prange(height):
        known = np.empty(maps)
        for u in range(width):
            total = 0
            for k in range(maps):
                if depths[k, v, u] > 0:
                    known[total] = depths[k, v, u]
                    total += 1
            best, best_sum = 0, 0.0
            for a in range(total):
                here, here_sum = 0, 0.0
                for b in range(total):
                    if abs(known[b] - known[a]) <= tolerance * known[a]:
                        here += 1
                        here_sum += known[b]
                if here > best:
                    best, best_sum = here, here_sum
            good = total > 0 and best >= needed[total]
            depth[v, u] = best_sum / best if good else 0.0


@njit(nogil=True, inline="always")
def _known(depth, v, u, dv, du, reach, near):  # pragma: no cover - compiled
    """How many pixels away, at most `reach`, the furthest known depth lies that is near this one; 0: none."""
    height, width = depth.shape
    for k in range(reach, 0, -1):
        y, x = v + dv * k, u + du * k
        if 0 <= y < height and 0 <= x < width and depth[y, x] > 0 and abs(depth[y, x] - depth[v, u]) < near:
            return k
    return 0


@njit(nogil=True, parallel=True, cache=True)
def normals_at(depth, rows, columns, pixels_from_rays, reach, normals):  # pragma: no cover - compiled
    """Unit normals [n, 3] of a depth map in the frame of its camera, towards it; 0 where they are not known.

    The plane through the places `reach` pixels to either side, or nearer, where they are known and near in depth.

    Args:
        rows, columns: [n], pixels.
        pixels_from_rays: [3, 3], intrinsics without skew.
        normals: written.
    """
    m = pixels_from_rays
    for k in prange(len(rows)):
        v, u = rows[k], columns[k]
        normals[k] = 0
        near = depth[v, u] * _NEAR
        left, right = _known(depth, v, u, 0, -1, reach, near), _known(depth, v, u, 0, 1, reach, near)
        up, down = _known(depth, v, u, -1, 0, reach, near), _known(depth, v, u, 1, 0, reach, near)
        if left + right == 0 or up + down == 0:
            continue
        x0, y0 = (u + 0.5 - m[0, 2]) / m[0, 0], (v + 0.5 - m[1, 2]) / m[1, 1]
        a, b, c, e = depth[v, u - left], depth[v, u + right], depth[v - up, u], depth[v + down, u]
        xa, xb = x0 - left / m[0, 0], x0 + right / m[0, 0]
        yc, ye = y0 - up / m[1, 1], y0 + down / m[1, 1]
        px, py, pz = xb * b - xa * a, y0 * (b - a), b - a
        qx, qy, qz = x0 * (e - c), ye * e - yc * c, e - c
        nx, ny, nz = qy * pz - qz * py, qz * px - qx * pz, qx * py - qy * px
        length = np.sqrt(nx * nx + ny * ny + nz * nz)
        if length > 0:
            normals[k, 0], normals[k, 1], normals[k, 2] = nx / length, ny / length, nz / length


@njit(nogil=True, parallel=True, cache=True)
def votes(
    center, others, points, normals, matrices, centers, sizes, starts, depths, known, tolerances, counts
):  # pragma: no cover - compiled
    """What other photos say of a photo's points.

    Args:
        center, others: of the photo whose points these are; the photos that are asked.
        points, normals: [n, 3]; a normal of zero is unknown.
        matrices, centers, sizes: [i, 3, 4] pixels from the frame, [i, 3], [i, 2] width and height.
        starts, depths, known: photo k's depths, row by row, begin at `starts[k]`; where known is not 0, what is there
            excuses photos that do not see what is behind it; 2 where it is found less exactly than is usual.
        tolerances: [i], depths in these photos that differ by less than this part agree.
        counts: [n, 5], written: photos that look at the place, that agree, that see through it; the sum of squares of
            how far those that agree are from it, in parts of the tolerance; and those that agree by a depth of known 2.
    """
    for k in prange(len(points)):
        px, py, pz = points[k, 0], points[k, 1], points[k, 2]
        nx, ny, nz = normals[k, 0], normals[k, 1], normals[k, 2]
        ox, oy, oz = center[0] - px, center[1] - py, center[2] - pz
        own = np.sqrt(ox * ox + oy * oy + oz * oz)
        asked, agree, through, apart, doubted = 0, 0, 0, 0.0, 0
        for j in others:
            cx, cy, cz = centers[j, 0] - px, centers[j, 1] - py, centers[j, 2] - pz
            length = np.sqrt(cx * cx + cy * cy + cz * cz)
            if ox * cx + oy * cy + oz * cz < _WIDE * own * length:
                continue
            if (nx != 0 or ny != 0 or nz != 0) and nx * cx + ny * cy + nz * cz < _FACING * length:
                continue
            m = matrices[j]
            z = m[2, 0] * px + m[2, 1] * py + m[2, 2] * pz + m[2, 3]
            if z <= 0:
                continue
            u = (m[0, 0] * px + m[0, 1] * py + m[0, 2] * pz + m[0, 3]) / z
            v = (m[1, 0] * px + m[1, 1] * py + m[1, 2] * pz + m[1, 3]) / z
            if not (u >= 0 and v >= 0 and u < sizes[j, 0] and v < sizes[j, 1]):
                continue
            at = starts[j] + int(v) * sizes[j, 0] + int(u)
            found, margin = depths[at], tolerances[j] * z
            if found > 0 and found < z - margin and known[at]:
                continue
            asked += 1
            if found > z + margin:
                through += 1
            elif found >= z - margin:
                agree += 1
                apart += ((found - z) / margin) ** 2
                doubted += known[at] == INEXACT
        counts[k, 0], counts[k, 1], counts[k, 2], counts[k, 3], counts[k, 4] = asked, agree, through, apart, doubted
