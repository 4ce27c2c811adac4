"""How well photos that were left out of the training are met."""

from __future__ import annotations

from collections.abc import Callable
from math import ceil, sqrt
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from stages.blocks import in_blocks
from stages.errors import ConfigError
from stages.neural.acceleration import RAYS_AT_ONCE, RENDERED
from stages.neural.training_photos import Photos, RayBatch

if TYPE_CHECKING:
    from jaxtyping import Bool

MIN_TRAINING = 3  # photos
PIXELS = 20_000  # of a photo at most; its PSNR barely moves with more
_SMALLEST_ERROR = 1e-10  # a photo met exactly has 100 dB


def left_out(num_photos: int, every: int) -> Bool[Tensor, " {num_photos}"]:
    """Which photos are left out: i % every == every // 2, none where `every` is 0.

    Raises ConfigError where too few photos are left to train on, or none is left out though some should be.
    """
    if every == 0:
        return torch.zeros(num_photos, dtype=torch.bool)
    out = torch.arange(num_photos) % every == every // 2
    left = num_photos - int(out.sum())
    if not MIN_TRAINING <= left < num_photos:
        found = f"leaves {left} of {num_photos} photos to train on (needed: {MIN_TRAINING} to {num_photos - 1})"
        raise ConfigError(f"`train.hold_out` = {every} {found}.", "Try `--hold-out 8`, or 0 for none.")
    return out


@torch.no_grad()
def photo_psnr(photos: Photos, image: int, render: Callable[[RayBatch], Tensor]) -> float | None:
    """PSNR in dB of one photo: -10 log10 of the mean squared error over pixels and channels.

    Counted are pixels on a regular grid whose rays cross the region of interest, on the mask where there is one.

    Args:
        render: gives the colours [R, 3] of rays.

    Returns:
        None where no pixel counts.
    """
    width, height = photos.sizes[image].tolist()
    stride = max(1, ceil(sqrt(width * height / PIXELS)))
    y, x = torch.meshgrid(
        torch.arange(stride // 2, height, stride), torch.arange(stride // 2, width, stride), indexing="ij"
    )
    grid = torch.stack([x, y], 2).view(-1, 2).to(photos.device)
    if photos.masks is not None:
        grid = grid[photos.masks[photos.first[image] + grid[:, 1] * width + grid[:, 0]] > 127]

    def squares(rows: slice) -> tuple[float, int]:
        pixels = grid[rows].float()
        batch = photos.rays(torch.full((len(pixels),), image, device=photos.device), pixels)
        error = ((render(batch).clamp(0, 1) - batch.colors) ** 2).mean(1)
        return float(error.sum()), len(error)

    parts = in_blocks(squares, len(grid), RAYS_AT_ONCE, RENDERED)
    total, count = sum(part for part, _ in parts), sum(number for _, number in parts)
    return -10 * float(torch.tensor(max(total / count, _SMALLEST_ERROR)).log10()) if count else None


def held_out_psnr(photos: Photos, render: Callable[[RayBatch], Tensor]) -> float | None:
    """Mean PSNR in dB of the photos that are not for training, None where there are none. See `photo_psnr`."""
    held_out = torch.nonzero(~photos.training).squeeze(1).tolist()
    values = [value for image in held_out if (value := photo_psnr(photos, image, render)) is not None]
    return sum(values) / len(values) if values else None
