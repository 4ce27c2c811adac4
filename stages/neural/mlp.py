"""Multi-layer perceptrons from a seeded generator, and the encoding of directions that they take."""

from __future__ import annotations

import itertools
import math
from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

if TYPE_CHECKING:
    from jaxtyping import Float


class Mlp(nn.Sequential):
    """Layers one after the other.

    Attributes:
        mixed: whether products and activations are bfloat16; inputs, outputs, weights and their gradients are float32
            all the same. For colours: outputs are off by about 1/256 of themselves, half a grey level after a sigmoid.
            Distances need more.
    """

    mixed = False

    def forward(self, inputs: Float[Tensor, "n i"]) -> Float[Tensor, "n o"]:
        if not self.mixed:
            return super().forward(inputs)
        with torch.autocast(inputs.device.type, torch.bfloat16):
            outputs = super().forward(inputs)
        return outputs.float()


def mlp(widths: list[int], generator: torch.Generator) -> Mlp:
    """Linear layers from widths[0] inputs to widths[-1] outputs with ReLUs between; small last weights, no biases."""
    layers: list[nn.Module] = []
    for i, (columns, rows) in enumerate(itertools.pairwise(widths)):
        layer = nn.Linear(columns, rows)
        last = i == len(widths) - 2
        layer.weight.data = kaiming_uniform(rows, columns, generator) * (0.3 if last else 1.0)
        layer.bias.data.zero_()
        layers += [layer] if last else [layer, nn.ReLU()]
    return Mlp(*layers)


def kaiming_uniform(rows: int, columns: int, generator: torch.Generator) -> Float[Tensor, "{rows} {columns}"]:
    """Kaiming-uniform weights for a ReLU layer."""
    return (torch.rand(rows, columns, generator=generator) * 2 - 1) * math.sqrt(6 / columns)


def spherical_harmonics(directions: Float[Tensor, "n 3"]) -> Float[Tensor, "n 15"]:
    """Real spherical harmonics of degree 1 to 3 of unit directions, without their constants."""
    x, y, z = directions.unbind(1)
    xx, yy, zz = x * x, y * y, z * z
    return torch.stack(
        [
            x, y, z,
            x * y, y * z, z * x, xx - yy, 3 * zz - 1,
            y * (3 * xx - yy), x * y * z, y * (5 * zz - 1), z * (5 * zz - 3), x * (5 * zz - 1),
            z * (xx - yy), x * (xx - 3 * yy),
        ],
        1,
    )  # fmt: skip
