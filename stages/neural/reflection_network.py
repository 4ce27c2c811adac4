"""The network behind self-reflection: the colour of what is mirrored, and how much of a mirror the surface is."""

from __future__ import annotations

import torch
from torch import nn

from stages.neural.mlp import mlp, spherical_harmonics

# Reflectivity before training: compensation has to earn its place.
_INITIAL_REFLECTIVITY = 0.02


class ReflectionNetwork(nn.Module):
    """g(x_r, n_r, v_r), the colour that the second surface sends to the first, and the first one's reflectivity rho."""

    def __init__(self, features: int, width: int, generator: torch.Generator, layers: int = 2) -> None:
        super().__init__()
        self.color_layers = mlp([3 + 3 + 15, *[width] * layers, 3], generator)
        self.reflectivity_layer = mlp([features + 1, 1], generator)
        head = self.reflectivity_layer[0]
        assert isinstance(head, nn.Linear)
        head.weight.data *= 0.1
        head.bias.data.fill_(torch.logit(torch.tensor(_INITIAL_REFLECTIVITY)).item())

    def forward(self, points: torch.Tensor, normals: torch.Tensor, directions: torch.Tensor) -> torch.Tensor:
        """sRGB colour g [Q, 3] in [0, 1] of x_r [Q, 3] with unit n_r, seen along the reflected directions v_r."""
        inputs = [points, normals, spherical_harmonics(directions)]
        return torch.sigmoid(self.color_layers(torch.cat(inputs, 1)))

    def reflectivity(self, features: torch.Tensor, facing: torch.Tensor) -> torch.Tensor:
        """rho [Q] in (0, 1) at x_0, from its geometry features [Q, G] and facing ratio n.v [Q]; 0.02 before training.

        Not in the paper, where whatever faces another part of the object is a perfect mirror.
        """
        return torch.sigmoid(self.reflectivity_layer(torch.cat([features, facing[:, None]], 1))).squeeze(1)
