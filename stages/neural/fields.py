"""The networks: signed distance, radiance, background, per-photo exposure.

Shapes: N points. All live in the scene frame; the region of interest is the unit sphere.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

from stages.neural.acceleration import short_products, takes_kernel
from stages.neural.appearance import FeatureMlp
from stages.neural.encoding_shapes import Encoding, Frequencies, HashGrid
from stages.neural.encodings import encode, encode_features
from stages.neural.mlp import Mlp, kaiming_uniform, mlp
from stages.neural.proposal import ProposalNetwork
from stages.neural.radiance import Radiance
from stages.neural.reflection_network import ReflectionNetwork

if TYPE_CHECKING:
    from jaxtyping import Float

# Half width of the smooth ReLU's bend: about the blur of the softplus(beta = 100) that IDR and NeuS use.
BEND = 0.05


def smooth_relu(z: Float[Tensor, "*any"]) -> tuple[Float[Tensor, "*any"], Float[Tensor, "*any"]]:
    """A ReLU with a parabola of half width `BEND` for a kink, and its derivative, a ramp from 0 to 1.

    The second derivative exists almost everywhere, so normals get gradients; no exponential is needed.
    """
    if takes_kernel(z):
        return _KernelSmoothRelu.apply(z)
    return smooth_relu_reference(z)


def smooth_relu_reference(z: Float[Tensor, "*any"]) -> tuple[Float[Tensor, "*any"], Float[Tensor, "*any"]]:
    """`smooth_relu` in plain torch: the reference of the kernel, and the path on CUDA."""
    slope = (z * (0.5 / BEND) + 0.5).clamp(0, 1)
    return BEND * slope * slope + torch.relu(z - BEND), slope


class _KernelSmoothRelu(torch.autograd.Function):
    """`smooth_relu` in one pass each way."""

    @staticmethod
    def forward(ctx, z):
        from stages.neural import kernels

        activation, slope = torch.empty(z.shape), torch.empty(z.shape)
        kernels.smooth_relu_forward(
            z.detach().reshape(-1).numpy(), BEND, activation.view(-1).numpy(), slope.view(-1).numpy()
        )
        ctx.save_for_backward(slope)
        return activation, slope

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, grad_activation, grad_slope):
        from stages.neural import kernels

        (slope,) = ctx.saved_tensors
        grad_z = torch.empty(slope.shape)
        kernels.smooth_relu_backward(
            slope.view(-1).numpy(), BEND, grad_activation.reshape(-1).numpy(), grad_slope.reshape(-1).numpy(),
            grad_z.view(-1).numpy(),
        )  # fmt: skip
        return grad_z


@dataclass(frozen=True)
class FieldShape:
    """Everything needed to build the networks again.

    Attributes:
        sdf_grid: encoding of the SDF: a hash grid, or frequencies.
        sdf_layers, sdf_width: hidden layers of the SDF's MLP.
        radiance_layers, radiance_width: hidden layers of the radiance MLP; the other networks are as wide.
        reflected: whether the radiance MLP gets the reflected direction and n.v beside the view.
        shaded: whether colours are albedo times irradiance where the radiance MLP is not needed.
        features: geometry features handed from the SDF network to the radiance network.
        sphere_radius: radius of the sphere that the SDF is before training.
        background_grid: hash encoding of the background, or None without one.
        num_images: photos with an exposure of their own.
        numerical: whether the SDF's gradient is taken by central differences instead of by differentiation.
        learned_scale: initial scale of the density where it is learned, scene units, or None.
        reflection, appearance, proposal: whether there is a reflection network, a feature MLP, a proposal network.
    """

    sdf_grid: Encoding
    sdf_layers: int
    sdf_width: int
    radiance_layers: int
    radiance_width: int
    reflected: bool
    features: int
    sphere_radius: float
    background_grid: HashGrid | None
    num_images: int
    numerical: bool = False
    learned_scale: float | None = None
    reflection: bool = False
    appearance: bool = False
    proposal: bool = False
    shaded: bool = False


class SdfNetwork(nn.Module):
    """f(x) = |x| - r + MLP(encoding(x)): an encoding and hidden layers on top of a sphere.

    The analytic sphere is the geometric initialisation: f is that sphere at step 0, whatever the width and depth. A
    hash encoding is silent then. Frequencies are not, so that their columns of the first layer start at zero.

    Attributes:
        short: whether products are TF32 on CUDA where f and its gradient are asked for together.
    """

    short = False

    def __init__(self, shape: FieldShape, generator: torch.Generator) -> None:
        super().__init__()
        self.grid, self.radius, self.numerical = shape.sdf_grid, shape.sphere_radius, shape.numerical
        self.table = None if isinstance(self.grid, Frequencies) else nn.Parameter(self.grid.initial_table(generator))
        widths = [self.grid.channels, *[shape.sdf_width] * shape.sdf_layers, 1 + shape.features]
        weights = [kaiming_uniform(rows, columns, generator) for columns, rows in itertools.pairwise(widths)]
        weights[-1][0] *= 0.1
        if isinstance(self.grid, Frequencies):
            weights[0].zero_()
        # Where the first layer hears nothing, each hidden unit answers smooth_relu(0) = BEND / 4. The next layer's
        # bias takes it off, so that the same holds there, and at last f is the sphere.
        biases = [torch.zeros(shape.sdf_width), *(-0.25 * BEND * weight.sum(1) for weight in weights[1:])]
        self.weights, self.biases = nn.ParameterList(weights), nn.ParameterList(biases)

    def forward(
        self, points: Float[Tensor, "n 3"], active_levels: int
    ) -> tuple[Float[Tensor, " n"], Float[Tensor, "n g"], Float[Tensor, "n 3"]]:
        """f, geometry features and grad f at points, all differentiable once.

        The gradient is a reverse sweep through the layers, written out, or central differences over one active voxel
        to either side (Neuralangelo).
        """
        radius = torch.linalg.vector_norm(points, dim=1, keepdim=True)
        if self.numerical:
            encoded = encode_features(points, self.table, self.grid, active_levels)
            values, features, _ = self._mlp(encoded)
            return (values + radius).squeeze(1) - self.radius, features, self._differences(points, active_levels)
        encoded, vjp = encode(points, self.table, self.grid, active_levels)
        with short_products(self.short, points.device):
            values, features, slopes = self._mlp(encoded)
            *hidden, last = self.weights
            cotangent = last[0]  # d MLP / d activation, pulled back to d MLP / d encoding, [N, C]
            for weight, slope in zip(reversed(hidden), reversed(slopes), strict=True):
                cotangent = (slope * cotangent) @ weight
        gradients = vjp(cotangent) + points / radius.clamp(min=1e-6)
        return (values + radius).squeeze(1) - self.radius, features, gradients

    def sdf(self, points: Float[Tensor, "n 3"], active_levels: int) -> Float[Tensor, " n"]:
        """f alone."""
        activation, _ = self._hidden(encode_features(points, self.table, self.grid, active_levels))
        values = activation @ self.weights[-1][0] + self.biases[-1][0]
        return values + torch.linalg.vector_norm(points, dim=1) - self.radius

    def _mlp(
        self, encoded: Float[Tensor, "n c"]
    ) -> tuple[Float[Tensor, "n 1"], Float[Tensor, "n g"], list[Float[Tensor, "n w"]]]:
        """f but for the sphere, geometry features and the slopes of the hidden layers."""
        activation, slopes = self._hidden(encoded)
        outputs = torch.addmm(self.biases[-1], activation, self.weights[-1].T)
        values, features = outputs.split([1, outputs.shape[1] - 1], 1)  # unlike slices, one copy in the backward pass
        return values, features, slopes

    def _hidden(self, encoded: Float[Tensor, "n c"]) -> tuple[Float[Tensor, "n w"], list[Float[Tensor, "n w"]]]:
        """The last hidden layer's activation and the slopes of all."""
        activation, slopes = encoded, []
        *hidden, _ = zip(self.weights, self.biases, strict=True)
        for weight, bias in hidden:
            activation, slope = smooth_relu(torch.addmm(bias, activation, weight.T))
            slopes.append(slope)
        return activation, slopes

    def _differences(self, points: Float[Tensor, "n 3"], active_levels: int) -> Float[Tensor, "n 3"]:
        """grad f as (f(x + h e_i) - f(x - h e_i)) / (2 h), h the finest active voxel."""
        step = self.grid.voxel_size(active_levels)
        offsets = step * torch.eye(3, device=points.device, dtype=points.dtype)
        places = points + torch.stack([offsets, -offsets])[:, :, None]  # [2, 3, N, 3]
        high, low = self.sdf(places.view(-1, 3), active_levels).view(2, 3, -1)
        return ((high - low) / (2 * step)).T


class BackgroundNetwork(nn.Module):
    """Density and colour outside the unit sphere, in contracted space (Mip-NeRF 360, eq. 10)."""

    def __init__(self, shape: FieldShape, generator: torch.Generator) -> None:
        super().__init__()
        assert shape.background_grid is not None
        self.grid = shape.background_grid
        self.table = nn.Parameter(self.grid.initial_table(generator))
        self.layers = mlp([self.grid.channels + 3, shape.radiance_width, 4], generator)

    def forward(
        self, points: Float[Tensor, "n 3"], view_dirs: Float[Tensor, "n 3"]
    ) -> tuple[Float[Tensor, " n"], Float[Tensor, "n 3"]]:
        """Density per unit of CONTRACTED length and colour at points outside the unit sphere."""
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
        self.radiance = Radiance(
            shape.features, shape.radiance_layers, shape.radiance_width, shape.reflected, shape.shaded, generator
        )
        self.background = BackgroundNetwork(shape, generator) if shape.background_grid else None
        self.log_gains = nn.Parameter(torch.zeros(shape.num_images, 3))
        self.reflection = (
            ReflectionNetwork(shape.features, shape.radiance_width, generator) if shape.reflection else None
        )
        self.appearance = FeatureMlp(generator) if shape.appearance else None
        self.proposal = ProposalNetwork(generator) if shape.proposal else None
        self.log_scale = None if shape.learned_scale is None else nn.Parameter(torch.tensor(shape.learned_scale).log())

    def use_mixed_precision(self) -> None:
        """From now on short products: bfloat16 for colours, TF32 for the distance (`docs/adr/0009`)."""
        self.sdf.short = True
        for module in self.modules():
            if isinstance(module, Mlp):
                module.mixed = True

    def tables(self) -> list[nn.Parameter]:
        """The hash tables, which learn at a rate of their own."""
        tables = [self.sdf.table, self.background.table if self.background else None]
        return [table for table in tables if table is not None]


def contract(points: Float[Tensor, "*any 3"]) -> Float[Tensor, "*any 3"]:
    """Map all of space into the ball of radius 2, the unit ball onto itself (Mip-NeRF 360, eq. 10)."""
    radius = torch.linalg.vector_norm(points, dim=-1, keepdim=True).clamp(min=1e-6)
    return torch.where(radius <= 1, points, (2 - 1 / radius) * points / radius)
