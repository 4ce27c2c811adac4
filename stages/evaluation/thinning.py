"""Fewer points, evenly: none nearer to another than a distance, or one a cube."""

from __future__ import annotations

import numpy as np

from stages.compiling import njit

MOST_CUBES = 1 << 30  # in a row


def thin(points: np.ndarray, distance: float) -> np.ndarray:
    """Points of [P, 3], in their order, that keep more than `distance` from all those kept before them."""
    return points[_kept(np.ascontiguousarray(points, dtype=np.float64), distance)] if len(points) else points


def one_a_cube(points: np.ndarray, side: float) -> np.ndarray:
    """The mean of the points [P, 3] in each cube of this side; the grid starts half a cube below the lowest corner.

    As Open3D's `voxel_down_sample`, which the benchmarks' own programs use.

    Raises:
        ValueError: see `check_cubes`.
    """
    import open3d as o3d

    check_cubes(points, side)
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    return np.asarray(cloud.voxel_down_sample(side).points)


def check_cubes(points: np.ndarray, side: float) -> None:
    """
    Raises:
        ValueError: the points [P, 3] spread over more cubes of this side than whole numbers count.
    """
    extent = float(np.ptp(points, axis=0).max()) if len(points) else 0.0
    if not extent < MOST_CUBES * side:
        raise ValueError(f"points spread over {extent:g} are too wide apart for cubes of {side:g}")


@njit(nogil=True, cache=True)
def _bucket(x, y, z, mask):  # pragma: no cover - compiled
    return (x * 73856093 ^ y * 19349663 ^ z * 83492791) & mask


@njit(nogil=True, cache=True)
def _kept(points, distance):  # pragma: no cover - compiled
    count = len(points)
    size = 1
    while size < 2 * count:
        size *= 2
    # Kept points chained by the hash of their cell. Other cells may share a bucket: the distance tells.
    newest = np.full(size, -1, dtype=np.int64)
    older = np.full(count, -1, dtype=np.int64)
    kept = np.zeros(count, dtype=np.bool_)
    for i in range(count):
        x = int(np.floor(points[i, 0] / distance))
        y = int(np.floor(points[i, 1] / distance))
        z = int(np.floor(points[i, 2] / distance))
        free = True
        for dx in range(-1, 2):
            for dy in range(-1, 2):
                for dz in range(-1, 2):
                    j = newest[_bucket(x + dx, y + dy, z + dz, size - 1)]
                    while j >= 0 and free:
                        squared = 0.0
                        for k in range(3):
                            squared += (points[i, k] - points[j, k]) ** 2
                        free = squared > distance * distance
                        j = older[j]
        if free:
            kept[i] = True
            bucket = _bucket(x, y, z, size - 1)
            older[i] = newest[bucket]
            newest[bucket] = i
    return kept
