"""The networks: signed distance, radiance, background, per-photo exposure.

Shapes: N points. All live in the scene frame; the region of interest is the unit sphere.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import torch
from torch import nn

from stages.neural.encodings import HashGrid, encode, encode_features

# Half width of the smooth ReLU's bend: about the blur of the softplus(beta = 100) that IDR and NeuS use.
BEND = 0.05


def smooth_relu(z: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """A ReLU with a parabola of half width `BEND` for a kink, and its derivative, a ramp from 0 to 1.

    The second derivative exists almost everywhere, so normals get gradients; no exponential is needed.
    """
    slope = (z * (0.5 / BEND) + 0.5).clamp(0, 1)
    return BEND * slope * slope + torch.relu(z - BEND), slope


@dataclass(frozen=True)
class FieldShape:
    """Everything needed to build the networks again.

    Attributes:
        sdf_grid: encoding of the SDF.
        sdf_layers, sdf_width: hidden layers of the SDF's MLP.
        radiance_layers, radiance_width: hidden layers of the radiance MLP; the other networks are as wide.
        features: geometry features handed from the SDF network to the radiance network.
        sphere_radius: radius of the sphere that the SDF is before training.
        background_grid: hash encoding of the background, or None without one.
        num_images: photos with an exposure of their own.
    """

    sdf_grid: HashGrid
    sdf_layers: int
    sdf_width: int
    radiance_layers: int
    radiance_width: int
    features: int
    sphere_radius: float
    background_grid: HashGrid | None
    num_images: int


class SdfNetwork(nn.Module):
    """f(x) = |x| - r + MLP(hash(x)): a hash encoding and one hidden layer on top of a sphere.

    The analytic sphere is the geometric initialisation: exact at step 0 whatever the width.
    """

    def __init__(self, shape: FieldShape, generator: torch.Generator) -> None:
        super().__init__()
        self.grid, self.radius = shape.sdf_grid, shape.sphere_radius
        channels, hidden, outputs = self.grid.channels, shape.sdf_width, 1 + shape.features
        self.table = nn.Parameter(self.grid.initial_table(generator))
        self.weight_in = nn.Parameter(_uniform(hidden, channels, generator))
        self.bias_in = nn.Parameter(torch.zeros(hidden))
        weight_out = _uniform(outputs, hidden, generator)
        weight_out[0] *= 0.1
        self.weight_out = nn.Parameter(weight_out)
        # With silent encodings each hidden unit answers smooth_relu(0) = BEND / 4: taken off, so that f is the sphere.
        self.bias_out = nn.Parameter(-0.25 * BEND * weight_out.sum(1))

    def forward(self, points: torch.Tensor, active_levels: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """f [N], geometry features [N, G] and grad f [N, 3] at points [N, 3], all differentiable once."""
        encoded, jacobian = encode(points, self.table, self.grid, active_levels)
        activation, slope = smooth_relu(torch.addmm(self.bias_in, encoded, self.weight_in.T))
        outputs = torch.addmm(self.bias_out, activation, self.weight_out.T)
        from_encoding = (slope * self.weight_out[0]) @ self.weight_in  # d MLP / d encoding, [N, C]
        radius = torch.linalg.vector_norm(points, dim=1, keepdim=True).clamp(min=1e-6)
        gradients = torch.bmm(jacobian, from_encoding.unsqueeze(2)).squeeze(2) + points / radius
        return outputs[:, 0] + radius.squeeze(1) - self.radius, outputs[:, 1:], gradients

    def sdf(self, points: torch.Tensor, active_levels: int) -> torch.Tensor:
        """f [N] alone."""
        encoded = encode_features(points, self.table, self.grid, active_levels)
        activation, _ = smooth_relu(torch.addmm(self.bias_in, encoded, self.weight_in.T))
        value = activation @ self.weight_out[0] + self.bias_out[0]
        return value + torch.linalg.vector_norm(points, dim=1) - self.radius


class RadianceNetwork(nn.Module):
    """Colour from position, normal, view and reflected direction, facing ratio and geometry features.

    The reflected direction lets a mirror-like surface be explained by its surroundings instead of by dents
    (Ref-NeRF); n.v carries the Fresnel-like brightening towards grazing angles.
    """

    def __init__(self, shape: FieldShape, generator: torch.Generator) -> None:
        super().__init__()
        inputs = shape.features + 3 + 3 + 3 + 1 + 15
        self.layers = _mlp([inputs, *[shape.radiance_width] * shape.radiance_layers, 3], generator)

    def forward(
        self,
        points: torch.Tensor,
        normals: torch.Tensor,
        view_dirs: torch.Tensor,
        features: torch.Tensor,
    ) -> torch.Tensor:
        """sRGB colour [N, 3] in [0, 1]; normals are unit, view_dirs [N, 3] unit from camera to point."""
        facing = (normals * view_dirs).sum(1, keepdim=True)
        reflected = view_dirs - 2 * facing * normals
        inputs = [features, points, normals, view_dirs, facing, spherical_harmonics(reflected)]
        return torch.sigmoid(self.layers(torch.cat(inputs, 1)))


class BackgroundNetwork(nn.Module):
    """Density and colour outside the unit sphere, in contracted space (Mip-NeRF 360, eq. 10)."""

    def __init__(self, shape: FieldShape, generator: torch.Generator) -> None:
        super().__init__()
        assert shape.background_grid is not None
        self.grid = shape.background_grid
        self.table = nn.Parameter(self.grid.initial_table(generator))
        self.layers = _mlp([self.grid.channels + 3, shape.radiance_width, 4], generator)

    def forward(self, points: torch.Tensor, view_dirs: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Density [N] per unit of CONTRACTED length and colour [N, 3] at points [N, 3] outside the unit sphere."""
        encoded = encode_features(contract(points) * 0.5, self.table, self.grid, self.grid.levels)
        outputs = self.layers(torch.cat([encoded, view_dirs], 1))
        return nn.functional.softplus(outputs[:, 0]) * 10, torch.sigmoid(outputs[:, 1:])


class Fields(nn.Module):
    """All that is trained."""

    def __init__(self, shape: FieldShape, seed: int = 0) -> None:
        super().__init__()
        generator = torch.Generator().manual_seed(seed)
        self.shape = shape
        self.sdf = SdfNetwork(shape, generator)
        self.radiance = RadianceNetwork(shape, generator)
        self.background = BackgroundNetwork(shape, generator) if shape.background_grid else None
        self.log_gains = nn.Parameter(torch.zeros(shape.num_images, 3))

    def tables(self) -> list[nn.Parameter]:
        """The hash tables, which learn at a rate of their own."""
        return [self.sdf.table] + ([self.background.table] if self.background else [])


def contract(points: torch.Tensor) -> torch.Tensor:
    """Map all of space into the ball of radius 2, the unit ball onto itself (Mip-NeRF 360, eq. 10)."""
    radius = torch.linalg.vector_norm(points, dim=-1, keepdim=True).clamp(min=1e-6)
    return torch.where(radius <= 1, points, (2 - 1 / radius) * points / radius)


def spherical_harmonics(directions: torch.Tensor) -> torch.Tensor:
    """Real spherical harmonics of degree 1 to 3 [N, 15] of unit directions [N, 3], without their constants."""
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


def _uniform(rows: int, columns: int, generator: torch.Generator) -> torch.Tensor:
    """Kaiming-uniform weights for a ReLU layer."""
    return (torch.rand(rows, columns, generator=generator) * 2 - 1) * math.sqrt(6 / columns)


def _mlp(widths: list[int], generator: torch.Generator) -> nn.Sequential:
    layers: list[nn.Module] = []
    for i, (columns, rows) in enumerate(itertools.pairwise(widths)):
        layer = nn.Linear(columns, rows)
        last = i == len(widths) - 2
        layer.weight.data = _uniform(rows, columns, generator) * (0.3 if last else 1.0)
        layer.bias.data.zero_()
        layers += [layer] if last else [layer, nn.ReLU()]
    return nn.Sequential(*layers)
