"""Colours of the surface: shaded by the light around it, or painted by a network, as the photos ask for.

A network that sees place and geometry features can paint any shading onto any shape, so that nothing holds the shape of
plain things. Shading is a product of the surface's own colour and of the light that reaches it, which only the normal,
the surroundings and the coarse place tell: to be darker a place must be turned, or lie deeper.

Shapes: N points.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor, nn

from stages.neural.evidence import SIDE, at_places
from stages.neural.mlp import mlp, spherical_harmonics

if TYPE_CHECKING:
    from jaxtyping import Float

# Distances along the normal at which the surroundings are asked for, scene units.
REACHES = (0.02, 0.05, 0.1, 0.2, 0.4)
# Width of the hidden layers of albedo and irradiance: they are smooth.
_WIDTH = 32
# Part of the colour that is the network's at the start: a polished thing takes harm from less, as its shape begins.
_GLOSS_LOGIT = 2.0
# Linear values up to here are straight in sRGB (IEC 61966-2-1).
_STRAIGHT = 0.0031308


class Colored(NamedTuple):
    """What a surface looks like.

    Attributes:
        colors: sRGB in [0, 1]; more where the light is glaring.
        gloss: part of the colour that is not shaded, in [0, 1].
    """

    colors: Float[Tensor, "n 3"]
    gloss: Float[Tensor, " n"]


def openness(
    sdf: Callable[[Tensor], Tensor],
    points: Float[Tensor, "n 3"],
    normals: Float[Tensor, "n 3"],
    reaches: Float[Tensor, " t"],
) -> Float[Tensor, "n t"]:
    """How far what is around leaves a place open: f(x + t n) / t at some distances t along its normal, in [0, 1].

    1 above a plane and anything convex; less in corners, gaps and bores [Evans, Fast approximations for global
    illumination on dynamic scenes, 2006]. Without gradient.
    """
    with torch.no_grad():
        places = points[:, None] + reaches[:, None] * normals[:, None]
        return (sdf(places.view(-1, 3)).view(-1, len(reaches)) / reaches).clamp(0, 1)


def encoded_srgb(linear: Float[Tensor, "*any"]) -> Float[Tensor, "*any"]:
    """sRGB of linear values that are not negative, with a finite slope everywhere (IEC 61966-2-1)."""
    curved = 1.055 * linear.clamp(min=_STRAIGHT) ** (1 / 2.4) - 0.055
    return torch.where(linear > _STRAIGHT, curved, 12.92 * linear)


class RadianceNetwork(nn.Module):
    """Colour from position, normal, view direction and geometry features; and reflected direction and facing ratio.

    The reflected direction lets a mirror-like surface be explained by its surroundings instead of by dents
    (Ref-NeRF); n.v carries the Fresnel-like brightening towards grazing angles. The paper's network has neither.
    """

    def __init__(self, features: int, layers: int, width: int, reflected: bool, generator: torch.Generator) -> None:
        super().__init__()
        self.reflected = reflected
        inputs = features + 3 + 3 + 3 + (1 + 15 if reflected else 0)
        self.layers = mlp([inputs, *[width] * layers, 3], generator)

    def forward(
        self,
        points: Float[Tensor, "n 3"],
        normals: Float[Tensor, "n 3"],
        view_dirs: Float[Tensor, "n 3"],
        features: Float[Tensor, "n g"],
    ) -> Float[Tensor, "n 3"]:
        """sRGB colour in [0, 1]; normals are unit, view_dirs unit from camera to point."""
        inputs = [features, points, normals, view_dirs]
        if self.reflected:
            facing = (normals * view_dirs).sum(1, keepdim=True)
            inputs += [facing, spherical_harmonics(view_dirs - 2 * facing * normals)]
        return torch.sigmoid(self.layers(torch.cat(inputs, 1)))


class Shading(nn.Module):
    """The colour of a matte surface: its albedo times the irradiance, which knows nothing of the albedo's features.

    Attributes:
        surface: MLP from geometry features to albedo and gloss, before their sigmoids.
        reaches: `REACHES`, on the device: a graph cannot bring them there.
        light: MLP from spherical harmonics of the normal up to degree 2, openness and place to irradiance, before its
            softplus.
    """

    reaches: Tensor

    def __init__(self, features: int, generator: torch.Generator) -> None:
        super().__init__()
        self.register_buffer("reaches", torch.tensor(REACHES), persistent=False)
        self.surface = mlp([features, _WIDTH, 4], generator)
        self.light = mlp([8 + len(REACHES) + 3, _WIDTH, _WIDTH, 3], generator)

    def albedo_and_gloss(self, features: Float[Tensor, "n g"]) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 1"]]:
        """Linear RGB in [0, 1], up to a factor that the light takes up; and gloss in [0, 1]."""
        outputs = self.surface(features)
        return torch.sigmoid(outputs[:, :3]), torch.sigmoid(outputs[:, 3:] + _GLOSS_LOGIT)

    def irradiance(
        self, points: Float[Tensor, "n 3"], normals: Float[Tensor, "n 3"], open_parts: Float[Tensor, "n t"]
    ) -> Float[Tensor, "n 3"]:
        """Light that reaches a surface point with this unit normal, linear RGB, not negative."""
        inputs = torch.cat([spherical_harmonics(normals)[:, :8], open_parts, points], 1)
        return nn.functional.softplus(self.light(inputs))


class Radiance(nn.Module):
    """(1 - g) sRGB(albedo x irradiance) + g c, with gloss g and the colour c of a `RadianceNetwork`.

    Without `shaded` the network's colour alone, as in the paper: gloss is 1 everywhere. So it is where something is
    known to be shiny: to explain reflections by shading would dent it.

    Attributes:
        shiny: `stages.neural.evidence.Evidence.shiny`; nothing at first.
    """

    shiny: Tensor

    def __init__(
        self, features: int, layers: int, width: int, reflected: bool, shaded: bool, generator: torch.Generator
    ) -> None:
        super().__init__()
        self.network = RadianceNetwork(features, layers, width, reflected, generator)
        self.shading = Shading(features, generator) if shaded else None
        self.register_buffer("shiny", torch.zeros(1, 1, *3 * [SIDE]))

    def forward(
        self,
        points: Float[Tensor, "n 3"],
        normals: Float[Tensor, "n 3"],
        view_dirs: Float[Tensor, "n 3"],
        features: Float[Tensor, "n g"],
        sdf: Callable[[Tensor], Tensor],
    ) -> Colored:
        """What surface points look like; sdf([M, 3]) -> [M] tells of their surroundings, coarsely."""
        colors = self.network(points, normals, view_dirs, features)
        if self.shading is None:
            return Colored(colors, torch.ones(len(points), device=points.device))
        albedo, gloss = self.shading.albedo_and_gloss(features)
        light = self.shading.irradiance(points, normals, openness(sdf, points, normals, self.shading.reaches))
        gloss = torch.maximum(gloss, at_places(self.shiny, points).unsqueeze(1))
        matte = encoded_srgb(albedo * light)
        return Colored(torch.lerp(matte, colors, gloss), gloss.squeeze(1))
