"""The error between drawing and photo, against torch and another program's SSIM."""

import numpy as np
import pytest

from stages.gaussians.photo_error import SSIM_SHARE, photo_error


def some_images(side: int = 24) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    photo = rng.random((side, side, 3)).astype(np.float32)
    return np.clip(photo + rng.normal(0, 0.2, photo.shape), 0, 1).astype(np.float32), photo


def test_nothing_is_lost_on_the_photo_itself():
    _, photo = some_images()
    error, gradient = photo_error(photo, photo)
    assert error == pytest.approx(0, abs=1e-6)
    assert np.abs(gradient).max() < 1e-6


def test_similarity_is_that_of_scikit_image_away_from_the_border():
    from skimage.metrics import structural_similarity

    image, photo = some_images(64)
    image[:16], image[-16:], image[:, :16], image[:, -16:] = (photo[:16], photo[-16:], photo[:, :16], photo[:, -16:])
    truth = structural_similarity(
        image, photo, channel_axis=2, gaussian_weights=True, sigma=1.5, use_sample_covariance=False, data_range=1
    )
    without = (1 - SSIM_SHARE) * np.abs(image - photo).mean()
    # scikit-image leaves a border of five pixels out of its mean; here both are the same there.
    inner = 54**2 / 64**2
    assert (photo_error(image, photo)[0] - without) / SSIM_SHARE == pytest.approx((1 - truth) * inner, rel=2e-3)


def test_gradient_is_that_of_differences():
    image, photo = some_images()
    _, gradient = photo_error(image, photo)
    rng = np.random.default_rng(1)
    for _ in range(5):
        way = rng.normal(0, 1, image.shape).astype(np.float32)
        way[np.abs(image - photo) < 0.02] = 0  # across the kink of |x|
        step = np.float32(2e-3)
        rise = (photo_error(image + step * way, photo)[0] - photo_error(image - step * way, photo)[0]) / (2 * step)
        assert (gradient * way).sum() == pytest.approx(rise, rel=0.02, abs=2e-4)
