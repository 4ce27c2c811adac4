"""Each photo's exposure."""

from __future__ import annotations

import torch
from torch import Tensor

from stages.shading.fitting import CLIPPED, coded, decoded

# Coded colours outside of this are clipped or drowned in noise.
DARKEST, BRIGHTEST = 0.05, 0.95
# Differences (natural log) beyond this are the model's, not the exposure's.
SPREAD = 0.15
# A photo of fewer points is as the others are.
FEW = 100.0
_ROUNDS = 6


def balanced(observed: Tensor, gains: Tensor, photos: Tensor) -> Tensor:
    """Coded colours [S, K, 3] with the gains [N] of photos [S, K] (int) on linear values; clipped ones as they are."""
    return torch.where(observed >= CLIPPED, observed, coded(decoded(observed) * gains[photos][..., None]))


def exposures(radiance: Tensor, observed: Tensor, weights: Tensor, photos: Tensor, num_photos: int) -> Tensor:
    """Gains [N] that bring photos to what they should show [S, K, 3]; their geometric mean is 1.

    A robust mean of log(radiance / observed), over the three channels alike: white balance is the light's matter.
    """
    ratio = (radiance.clamp_min(1e-4) / decoded(observed).clamp_min(1e-4)).log()
    usable = ((observed > DARKEST) & (observed < BRIGHTEST)).all(2)
    base, ratio = (weights * usable).reshape(-1), ratio.mean(2).reshape(-1)
    index = photos.reshape(-1)
    logs = torch.zeros(num_photos)
    for _ in range(_ROUNDS):
        trust = base / (1 + ((ratio - logs[index]) / SPREAD) ** 2)
        total = torch.zeros(num_photos).index_add_(0, index, trust)
        logs = torch.zeros(num_photos).index_add_(0, index, trust * ratio) / (total + FEW)
    return (logs - logs.mean()).exp()
