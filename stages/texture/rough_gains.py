"""How bright each of many photos is, roughly, by the colours of sparse points: what ties the parts of a large scene.

Each part finds its photos' gains for itself, much better (`gains`), but all of them up to one factor.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from stages.artifacts import Pictures
from stages.posing.undistortion import registered_photos, seen_places
from stages.texture.gains import BRIGHTEST, DARKEST, ROBUST_SCALE

# Colours are looked up in photos of no more than so many pixels along a side: a corner's own pixels tell less than
# what lies around it.
SMALL = 800
# Pull of each gain to 1, as a part of the mean weight of a photo. So weak that exposures that drift over hundreds of
# photos, each of which is compared with its neighbours alone, are believed.
REGULARISATION = 1e-6
_ITERATIONS = 8
_PRECISION = 1e-6


def rough_gains(model: Any, taken: Pictures) -> dict[str, np.ndarray]:
    """Name of each photo of a pycolmap model -> gains [3], see `solve_rough_gains`; none of those not known."""
    photos = registered_photos(model)
    numbers, colors = [], []
    for photo in photos:
        points, pixels = seen_places(photo)
        image, lens = taken.image(photo.name), model.cameras[photo.camera_id]
        stretch = np.array(image.shape[1::-1]) / (lens.width, lens.height)
        numbers.append(points)
        colors.append(colors_at(image, pixels * stretch))
    photo_of = np.repeat(np.arange(len(photos)), [len(points) for points in numbers])
    _, point_of = np.unique(np.concatenate(numbers), return_inverse=True)
    gains = solve_rough_gains(np.column_stack([photo_of, point_of]), np.concatenate(colors), len(photos))
    return {photo.name: found for photo, found in zip(photos, gains, strict=True) if np.isfinite(found).all()}


def colors_at(photo: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Colours [K, 3] float32 of a photo [H, W, 3] uint8 at places [K, 2], pixel centres at .5."""
    import cv2

    height, width = photo.shape[:2]
    scale = min(1.0, SMALL / max(height, width))
    if scale < 1:
        photo = cv2.resize(photo, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    shrunk = np.array(photo.shape[1::-1]) / (width, height)
    at = np.ascontiguousarray(pixels * shrunk - 0.5, dtype=np.float32)
    # one row of places would be wider than what OpenCV takes
    found = np.empty((len(at), 3), np.float32)
    for start in range(0, len(at), 1 << 14):
        rows = slice(start, start + (1 << 14))
        found[rows] = cv2.remap(
            photo.astype(np.float32), at[rows, :1], at[rows, 1:], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )[:, 0]
    return found


def solve_rough_gains(observations: np.ndarray, colors: np.ndarray, num_photos: int) -> np.ndarray:
    """Gains g that make photos agree: minimise sum_ip w_ip rho(log(g_i c_ip) - m_p) over g and the points' colours m.

    The equations of `gains.solve_gains` (Brown and Lowe 2007, eq. 29, on logarithms and robust), of which only photos
    that share points are held, and solved by conjugate gradients. Per channel; each point counts once.

    Args:
        observations: [M, 2] photo and point.
        colors: [M, 3] what the photo shows there, 0..255.

    Returns:
        [N, 3] float64 with a geometric mean of 1 a channel; NaN for photos that share no point with another.
    """
    gains = np.full((num_photos, 3), np.nan)
    for channel in range(3):
        values = colors[:, channel].astype(np.float64)
        told = (values >= DARKEST) & (values <= BRIGHTEST)
        photo, point = observations[told].T.astype(np.int64)
        shared = np.bincount(point)[point] >= 2 if len(point) else told[told]
        if shared.any():
            photo, point = photo[shared], np.unique(point[shared], return_inverse=True)[1]
            logs = _log_gains(photo, point, np.log(values[told][shared]), num_photos)
            known = np.isin(np.arange(num_photos), photo)
            gains[known, channel] = np.exp(logs - logs[known].mean())[known]
    return gains


def _log_gains(photo: np.ndarray, point: np.ndarray, logs: np.ndarray, num_photos: int) -> np.ndarray:
    """[N] of one channel: iteratively reweighted least squares (rho: Geman-McClure) with m eliminated."""
    base = 1.0 / np.bincount(point)[point]
    pull = REGULARISATION * base.sum() / num_photos
    solution, weights, scale = np.zeros(num_photos), base, 4 * ROBUST_SCALE  # wide at first, as in `solve_gains`
    for _ in range(_ITERATIONS):
        solution = _least_squares(photo, point, logs, weights, pull, solution)
        adjusted = logs + solution[photo]
        center = np.bincount(point, weights * adjusted) / np.bincount(point, weights)
        weights = base / (1 + ((adjusted - center[point]) / scale) ** 2) ** 2
        scale = max(ROBUST_SCALE, 0.6 * scale)
    return solution


def _least_squares(
    photo: np.ndarray, point: np.ndarray, logs: np.ndarray, weights: np.ndarray, pull: float, start: np.ndarray
) -> np.ndarray:
    """[N] log gains with the least sum of weights (log gain + logs - mean of its point)^2 + pull (log gain)^2."""
    from scipy.sparse import csr_array
    from scipy.sparse.linalg import LinearOperator, cg

    shape = (len(start), len(start))
    of_photo, of_point = np.bincount(photo, weights, len(start)), np.bincount(point, weights)
    seen = csr_array((weights, (photo, point)))
    seen.resize(len(start), len(of_point))
    diagonal = of_photo + pull
    normal = LinearOperator(
        shape, lambda gains: diagonal * gains - seen @ ((seen.T @ gains) / of_point), dtype=np.float64
    )
    mean = np.bincount(point, weights * logs) / of_point
    wanted = -np.bincount(photo, weights * (logs - mean[point]), len(start))
    found, _ = cg(
        normal,
        wanted,
        start,
        rtol=_PRECISION,
        M=LinearOperator(shape, lambda gains: gains / diagonal, dtype=np.float64),
    )
    solution: np.ndarray = found
    return solution
