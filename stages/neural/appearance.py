"""The paper's feature MLP: what a place looks like, for the planar weight lambda_pla (paper eq. radiance_feat).

Shapes: N points, L frequencies. All live in the scene frame.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

if TYPE_CHECKING:
    from jaxtyping import Float

# Paper: gamma(x, 10) and gamma(v, 4).
POSITION_FREQUENCIES = 10
DIRECTION_FREQUENCIES = 4
# Paper: "a skip connection at layer 4": the inputs join the activation of the fourth layer.
_SKIP_AFTER = 4


def positional_encoding(x: Float[Tensor, "*any c"], frequencies: int) -> Float[Tensor, "*any c*(1+2*{frequencies})"]:
    """gamma(x, L) of x in [-1, 1] (NeRF, eq. 4, the input itself in front).

    x, then sin(2^l pi x) and cos(2^l pi x) for l = 0 .. L - 1.
    """
    octaves = math.pi * 2.0 ** torch.arange(frequencies, dtype=x.dtype, device=x.device)
    angles = x[..., None, :] * octaves[:, None]
    return torch.cat([x, torch.stack([angles.sin(), angles.cos()], -2).flatten(-3)], -1)


class FeatureMlp(nn.Module):
    """c_feat(x, v) = MLP(gamma(x, 10), gamma(v, 4)), ReLU, the inputs joined in again after the fourth layer.

    The paper names no loss that trains it: only its own weight lambda_pla does, which pulls features apart. `color`, a
    linear head on the features, gives it one: features that explain the photos' colours tell an edge from an even
    place.
    """

    def __init__(self, generator: torch.Generator, layers: int = 8, width: int = 256) -> None:
        super().__init__()
        inputs = 3 * (1 + 2 * POSITION_FREQUENCIES) + 3 * (1 + 2 * DIRECTION_FREQUENCIES)
        columns = [inputs] + [width] * (layers - 1)
        if layers > _SKIP_AFTER:
            columns[_SKIP_AFTER] += inputs
        hidden = [nn.Linear(count, width) for count in columns]
        self.layers, self.head = nn.ModuleList(hidden), nn.Linear(width, 3)
        for layer in hidden:
            nn.init.kaiming_uniform_(layer.weight, nonlinearity="relu", generator=generator)
            nn.init.zeros_(layer.bias)
        nn.init.kaiming_uniform_(self.head.weight, nonlinearity="linear", generator=generator)
        nn.init.zeros_(self.head.bias)

    def forward(self, points: Float[Tensor, "*n 3"], view_dirs: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n width"]:
        """Features, not negative, of points seen along unit view_dirs (camera to point).

        The paper's v_k points from x_k to the surface point on its ray: the ray's own direction, which is also the one
        to give for x_0, where the paper's quotient is 0 / 0.
        """
        inputs = torch.cat(
            [positional_encoding(points, POSITION_FREQUENCIES), positional_encoding(view_dirs, DIRECTION_FREQUENCIES)],
            -1,
        )
        activation = inputs
        for i, layer in enumerate(self.layers):
            if i == _SKIP_AFTER:
                activation = torch.cat([activation, inputs], -1)
            activation = torch.relu(layer(activation))
        return activation

    def color(self, features: Float[Tensor, "*n width"]) -> Float[Tensor, "*n 3"]:
        """sRGB colour in [0, 1] of features."""
        return torch.sigmoid(self.head(features))
