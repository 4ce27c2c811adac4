"""Gains of photos, planted and found."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from stages.shading.exposures import balanced, exposures
from stages.shading.fitting import coded, decoded

PLANTED = torch.tensor([0.8, 1.0, 1.1, 1.3])


def dimmed(count: int = 3000) -> tuple[torch.Tensor, ...]:
    """What photos should show and do show [S, K, 3], weights and photos [S, K]."""
    random = torch.Generator().manual_seed(0)
    photos = torch.randint(4, (count, 3), generator=random)
    radiance = 0.1 + 0.4 * torch.rand(count, 3, 3, generator=random)
    return radiance, coded(radiance / PLANTED[photos][..., None]), torch.ones(count, 3), photos


def test_planted_gains_come_back_with_a_mean_of_one():
    radiance, observed, weights, photos = dimmed()
    gains = torch.ones(4)
    for _ in range(4):
        gains = gains * exposures(radiance, balanced(observed, gains, photos), weights, photos, 4)
    assert float(gains.log().mean()) == pytest.approx(0, abs=1e-6)
    np.testing.assert_allclose(gains, PLANTED / PLANTED.log().mean().exp(), rtol=0.02)


def test_reflections_that_the_model_lacks_are_no_exposure():
    radiance, observed, weights, photos = dimmed()
    shiny = (torch.arange(len(photos)) % 5 == 0)[:, None] & (photos == 1)
    observed = torch.where(shiny[..., None], 0.94, observed)
    with_sheen = exposures(radiance, observed, weights, photos, 4)
    without = exposures(radiance, dimmed()[1], weights, photos, 4)
    np.testing.assert_allclose(with_sheen, without, rtol=0.05)


def test_photos_of_few_points_are_as_the_others():
    radiance, observed, weights, photos = dimmed(30)
    assert (exposures(radiance, observed, weights, photos, 4).log().abs() < 0.08).all()
    assert (exposures(radiance, observed, 0 * weights, photos, 4) == 1).all()


def test_a_gain_is_on_linear_values_and_clipped_stays_clipped():
    observed, photos = torch.tensor([[[0.5, 1.0, 0.2]]]), torch.tensor([[1]])
    after = balanced(observed, torch.tensor([1.0, 0.5]), photos)[0, 0]
    assert float(after[1]) == 1
    torch.testing.assert_close(decoded(after[[0, 2]]), 0.5 * decoded(observed[0, 0, [0, 2]]), rtol=1e-4, atol=1e-5)
