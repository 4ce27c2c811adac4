"""Brightness differences between photos: one gain per photo and channel."""

from __future__ import annotations

import numpy as np

# Coded values outside this range are clipped or drowned in noise: they say nothing about a gain.
DARKEST, BRIGHTEST = 8.0, 247.0
# Residuals (natural log) larger than this are highlights and shadows, not gains.
ROBUST_SCALE = 0.08
# Pull of each gain to 1, as a part of the mean weight of a photo; it decides only for photos that share
# nothing.
REGULARISATION = 1e-3
LIMIT = 3.0
# Photos further than this many robust standard deviations from the others say nothing about the gauge.
GAUGE_SIGMAS = 3.0
_ITERATIONS = 8


def solve_gains(colors: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Gains g that make photos agree: minimise Σ_pi w_pi ρ(log(g_i c_pi) - m_p) over g and the points' own
    colours m.

    Per channel, by iteratively reweighted least squares (ρ: Geman-McClure) on the normal equations with m
    eliminated, regularised to g = 1 and fixed to a geometric mean of 1; then shrunk to 1 by `trust`.

    Args:
        colors: [P, N, 3] colour of point p in photo i, 0..255.
        weights: [P, N] trust in it, 0 where the photo does not see the point.

    Returns:
        [N, 3] float64 gains within [1 / LIMIT, LIMIT]; all 1 when no two photos share a point.
    """
    if colors.shape != (*weights.shape, 3):
        raise ValueError(f"expected colors of shape {(*weights.shape, 3)}, got {colors.shape}")
    num_photos = weights.shape[1]
    gains = np.ones((num_photos, 3))
    for channel in range(3):
        values = colors[:, :, channel]
        base = np.where((values >= DARKEST) & (values <= BRIGHTEST), weights, 0.0).astype(np.float64)
        # Each point counts once however large its weights, and only where photos can disagree.
        shared = (base > 0).sum(1) >= 2
        base = base[shared] / base[shared].sum(1, keepdims=True)
        if not len(base):
            continue
        logs = np.log(np.maximum(values[shared], 1.0)).astype(np.float64)
        log_gains = np.zeros(num_photos)
        robust = base
        scale = 4 * ROBUST_SCALE  # wide at first: gains not yet known look like outliers
        for _ in range(_ITERATIONS):
            total = np.maximum(robust.sum(1, keepdims=True), 1e-12)
            mean = (robust * logs).sum(1, keepdims=True) / total
            normal = np.diag(robust.sum(0)) - robust.T @ (robust / total)
            normal += REGULARISATION * base.sum() / num_photos * np.eye(num_photos)
            log_gains = np.linalg.solve(normal, -(robust * (logs - mean)).sum(0))
            adjusted = logs + log_gains
            center = _weighted_median(adjusted, base)
            robust = base / (1 + ((adjusted - center) / scale) ** 2) ** 2
            scale = max(ROBUST_SCALE, 0.6 * scale)
        seen = robust.sum(0) > 0
        log_gains -= np.median(log_gains[seen])  # most photos share one exposure: judge the others against it
        log_gains[~seen] = 0
        log_gains *= trust(log_gains, _spreads(logs + log_gains, base))
        log_gains[seen] -= log_gains[seen].mean()
        gains[:, channel] = np.exp(np.clip(log_gains, -np.log(LIMIT), np.log(LIMIT)))
    return gains


def in_gauge_of(gains: np.ndarray, rough: np.ndarray) -> np.ndarray:
    """Gains [N, 3] times the factor a channel that photos leave free, as a larger scene's rough gains have it.

    The factor c makes the robust mean over photos of log(c gain) - log(rough gain) zero: what is within `GAUGE_SIGMAS`
    of the median counts. Photos whose rough gain is not known (NaN) do not; with none that is, c is 1.
    """
    if gains.shape != rough.shape:
        raise ValueError(f"expected rough gains of shape {gains.shape}, got {rough.shape}")
    factors = np.ones(3)
    for channel in range(3):
        known = np.isfinite(rough[:, channel])
        if known.any():
            away = np.log(rough[known, channel] / gains[known, channel])
            off = np.abs(away - np.median(away))
            factors[channel] = np.exp(away[off <= GAUGE_SIGMAS * 1.4826 * np.median(off)].mean())
    return gains * factors


def trust(log_gains: np.ndarray, spreads: np.ndarray) -> np.ndarray:
    """Part of each log gain to keep: g² / (g² + s²), s being the photo's residual spread once gains are
    applied.

    A change of exposure moves all of a photo's points alike: g stands out from s. Sheen moves them
    differently,
    by no more than their spread: it is not a gain and must not be "corrected".
    """
    return log_gains**2 / np.maximum(log_gains**2 + spreads**2, 1e-20)


def _spreads(values: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """[N] robust standard deviation of each column's distance from its row's median."""
    off = np.abs(values - _weighted_median(values, weights))
    return np.array(
        [
            1.4826 * np.median(column[seen]) if seen.any() else 0.0
            for column, seen in zip(off.T, weights.T > 0, strict=True)
        ]
    )


def _weighted_median(values: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """[P, 1] weighted median of each row of values [P, N]."""
    order = np.argsort(values, axis=1)
    cumulative = np.cumsum(np.take_along_axis(weights, order, 1), axis=1)
    middle = (cumulative >= 0.5 * cumulative[:, -1:]).argmax(1)[:, None]
    return np.take_along_axis(values, np.take_along_axis(order, middle, 1), 1)
