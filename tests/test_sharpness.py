"""Blurred photos count less."""

from __future__ import annotations

import numpy as np
import pytest

from stages.texture.sharpness import LEAST, sharpness_of_photos


def _highs(points: int = 400, photos: int = 5) -> np.ndarray:
    """The same detail in every photo, with noise."""
    rng = np.random.default_rng(0)
    return rng.normal(0, 10, (points, 1)) + rng.normal(0, 1, (points, photos))


def test_a_photo_with_half_the_detail_counts_a_sixteenth():
    highs = _highs()
    highs[:, 2] *= 0.5
    factor = sharpness_of_photos(highs, np.ones_like(highs))
    assert factor[2] == pytest.approx(1 / 16, rel=0.1)
    assert factor[[0, 1, 3, 4]].min() > 0.9


def test_what_a_photo_does_not_see_says_nothing_about_it():
    highs, weights = _highs(), np.ones((400, 5))
    highs[:200, 1], weights[:200, 1] = 0, 0
    assert sharpness_of_photos(highs, weights).min() > 0.9


def test_nothing_is_known_of_photos_without_shared_points_or_detail():
    assert (sharpness_of_photos(_highs(), np.eye(5).repeat(80, axis=0)) == 1).all()
    assert (sharpness_of_photos(0.01 * _highs(), np.ones((400, 5))) == 1).all()


def test_no_photo_is_left_without_any_weight():
    highs = _highs()
    highs[:, 0] = 0
    assert sharpness_of_photos(highs, np.ones_like(highs))[0] == LEAST
