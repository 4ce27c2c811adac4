"""How far a drawing is from its photo, and the gradient of that: 0.8 L1 + 0.2 (1 - SSIM), as 3DGS has it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from jaxtyping import Float32

SSIM_SHARE = 0.2
# Wang et al. 2004: windows and their standard deviation in pixels, and what keeps quotients from 0 / 0.
WINDOW, SIGMA = 11, 1.5
STABLE_MEAN, STABLE_VARIANCE = 0.01**2, 0.03**2


def photo_error(
    image: Float32[np.ndarray, "h w 3"], photo: Float32[np.ndarray, "h w 3"]
) -> tuple[float, Float32[np.ndarray, "h w 3"]]:
    """Mean error over all pixels and channels, 0 where the two are the same, and its gradient to the image."""
    off = image - photo
    similarity, slope = _ssim(image, photo)
    error = (1 - SSIM_SHARE) * float(np.abs(off).mean()) + SSIM_SHARE * (1 - similarity)
    return error, ((1 - SSIM_SHARE) / off.size) * np.sign(off) - SSIM_SHARE * slope


def _ssim(x: np.ndarray, y: np.ndarray) -> tuple[float, np.ndarray]:
    """Mean structural similarity of two images [H, W, 3], and its gradient to x.

    S = (2 mx my + c) (2 sxy + d) / ((mx² + my² + c) (sx² + sy² + d)), with means, variances and covariance under a
    Gaussian window G; G is symmetric, so that gradients to G(x), G(x²) and G(xy) come back through G itself.
    """
    mean_x, mean_y = _blurred(x), _blurred(y)
    variance_x = _blurred(x * x) - mean_x**2
    variance_y = _blurred(y * y) - mean_y**2
    covariance = _blurred(x * y) - mean_x * mean_y
    above_mean, above_variance = 2 * mean_x * mean_y + STABLE_MEAN, 2 * covariance + STABLE_VARIANCE
    below_mean, below_variance = mean_x**2 + mean_y**2 + STABLE_MEAN, variance_x + variance_y + STABLE_VARIANCE
    similarity = above_mean * above_variance / (below_mean * below_variance)
    to_covariance = 2 * above_mean / (below_mean * below_variance)
    to_variance = -similarity / below_variance
    to_mean = 2 * mean_y * above_variance / (below_mean * below_variance) - 2 * mean_x * similarity / below_mean
    through_mean = to_mean - 2 * mean_x * to_variance - mean_y * to_covariance
    gradient = _blurred(through_mean) + 2 * x * _blurred(to_variance) + y * _blurred(to_covariance)
    return float(similarity.mean()), (gradient / similarity.size).astype(np.float32)


def _blurred(image: np.ndarray) -> np.ndarray:
    """Under a Gaussian window; black around the image, so that blurring is its own transpose."""
    import cv2

    blurred: np.ndarray = cv2.GaussianBlur(image, (WINDOW, WINDOW), SIGMA, borderType=cv2.BORDER_CONSTANT)
    return blurred
