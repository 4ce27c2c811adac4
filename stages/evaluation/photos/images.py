"""A drawing against its photo: PSNR, SSIM, and LPIPS where its weights are at hand.

H x W pixels.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path

import numpy as np

from stages.drawing.view_scores import psnr, ssim

Lpips = Callable[[np.ndarray, np.ndarray], float]


@dataclass(frozen=True)
class ImageScore:
    """A drawing against its photo.

    Attributes:
        psnr: dB.
        ssim: mean structural similarity.
        lpips: learned distance (Zhang et al. 2018, AlexNet), or None where its weights are not at hand.
        pixels: how many counted.
    """

    psnr: float
    ssim: float
    lpips: float | None
    pixels: int


def score_image(
    image: np.ndarray, truth: np.ndarray, mask: np.ndarray | None = None, lpips: Lpips | None = None
) -> ImageScore:
    """Scores of [H, W, 3] uint8 images, over the pixels of `mask` [H, W] bool or over all.

    LPIPS sees both images black outside the mask.

    Raises:
        ValueError: the mask is empty, or the images are smaller than a window of SSIM.
    """
    counted = np.ones(image.shape[:2], bool) if mask is None else mask
    distance = None if lpips is None else lpips(image * counted[..., None], truth * counted[..., None])
    return ImageScore(psnr(image, truth, counted), ssim(image, truth, counted), distance, int(counted.sum()))


def find_lpips() -> tuple[Lpips | None, str]:
    """The function, or None, and where it comes from or why there is none. Nothing is ever downloaded."""
    if importlib.util.find_spec("lpips") is None:
        return None, "left out: the package lpips is not installed (`pip install lpips torchvision`)"
    import lpips
    import torch
    import torchvision

    # The backbone's file as torchvision names it; lpips brings its own few weights along.
    url = torchvision.models.AlexNet_Weights.IMAGENET1K_V1.url
    weights = Path(torch.hub.get_dir()) / "checkpoints" / Path(url).name
    if not weights.exists():
        return None, f"left out: {weights} is not there, and nothing is downloaded; put {url} there"
    network = lpips.LPIPS(net="alex", verbose=False).eval()

    @torch.no_grad()
    def distance(image: np.ndarray, truth: np.ndarray) -> float:
        both = [torch.from_numpy(each).permute(2, 0, 1)[None].float() / 127.5 - 1 for each in (image, truth)]
        return float(network(*both))

    return distance, f"lpips {metadata.version('lpips')}, AlexNet of {weights}"
