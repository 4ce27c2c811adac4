"""Points on a sphere of known materials under a known light, as photos would show them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
import torch
from torch import Tensor

from stages.geometry.vectors import unit
from stages.light.environment import directions
from stages.light.ggx import ROUGHNESSES
from stages.shading import fitting, learning
from stages.shading import reflection as reflecting
from stages.shading.observations import Observations
from stages.shading.reflection import Reflection, reflection
from stages.shading.surroundings import ROWS as NEAR_ROWS
from stages.shading.surroundings import Surroundings

# As many as around points, in place of 32: lobes of all pixels around all take seconds then.
ROWS = NEAR_ROWS
PLASTIC, METAL = ((0.7, 0.2, 0.1), 0.2, 0.0), ((0.9, 0.6, 0.3), 0.3, 1.0)
# base colour, roughness, metalness
Kind = tuple[tuple[float, float, float], float, float]


def use_small_maps(monkeypatch: pytest.MonkeyPatch) -> None:
    """Lights of `ROWS` rows throughout."""
    for module in (reflecting, learning):
        monkeypatch.setattr(module, "LIGHT_ROWS", ROWS)


@dataclass(frozen=True)
class LitSphere:
    """S points in K photos.

    Attributes:
        light: [P, 3].
        observed, weights: [S, K, 3] coded, [S, K].
        normals: [S, 3], also the positions.
    """

    light: Tensor
    reflection: Reflection
    observations: Observations
    normals: np.ndarray
    color: Tensor
    roughness: Tensor
    metallic: Tensor

    @property
    def observed(self) -> Tensor:
        return torch.from_numpy(self.observations.colors)

    @property
    def weights(self) -> Tensor:
        return torch.from_numpy(self.observations.weights)

    @property
    def materials(self) -> fitting.Materials:
        return fitting.Materials(self.color, self.roughness, self.metallic)


def lamps() -> np.ndarray:
    """[ROWS, 2 ROWS, 3]: a sky that is brighter above, with two lamps."""
    towards = directions(ROWS)
    light = 0.2 + 0.2 * np.clip(towards[..., 1:2], 0, 1) * np.array([0.6, 0.8, 1.2])
    for place, power, color in (((0.5, 0.7, 0.3), 6.0, (1, 0.95, 0.8)), ((-0.6, 0.3, -0.7), 3.0, (0.8, 0.9, 1))):
        lamp = np.exp((towards @ unit(np.array(place)) - 1) / 0.03)
        light = light + power * lamp[..., None] * np.array(color)
    return (0.7 * light).astype(np.float32)


def nothing_around(count: int) -> Surroundings:
    sides = 2 * NEAR_ROWS**2
    return Surroundings(np.ones((count, sides), np.float32), np.zeros((count, sides, 3), np.float32))


def lit_sphere(kinds: tuple[Kind, ...], count: int = 200, views: int = 24, noise: float = 0.0) -> LitSphere:
    """A sphere whose points along x are of each kind in turn. Call `use_small_maps` first."""
    rng = np.random.default_rng(0)
    normals = unit(rng.normal(size=(count, 3))).astype(np.float32)
    cameras = 4 * unit(rng.normal(size=(views, 3)))
    towards = unit(cameras[None] - normals[:, None]).astype(np.float32)
    weights = (np.einsum("skc,sc->sk", towards, normals) > 0.2).astype(np.float32)
    photos = np.broadcast_to(np.arange(views), weights.shape).copy()
    seen = Observations(np.zeros((*weights.shape, 3), np.float32), weights, towards, photos)
    reflected = reflection(seen, normals, nothing_around(count), np.eye(3))
    which = np.minimum((len(kinds) * (normals[:, 0] + 1) / 2).astype(int), len(kinds) - 1)
    color, roughness, metallic = (
        torch.tensor(np.array([kind[part] for kind in kinds], np.float32)[which]) for part in range(3)
    )
    light = torch.from_numpy(lamps().reshape(-1, 3))
    radiance = shown(reflected, light, color, roughness, metallic)
    observed = fitting.coded(radiance) + noise * torch.from_numpy(rng.normal(size=radiance.shape).astype(np.float32))
    seen = Observations(observed.clamp(0, 1).numpy(), weights, towards, photos)
    return LitSphere(light, reflected, seen, normals, color, roughness, metallic)


def shown(reflected: Reflection, light: Tensor, color: Tensor, roughness: Tensor, metallic: Tensor) -> Tensor:
    """Radiance [S, K, 3] by the sum of the two parts of glTF's model, written out for itself."""
    level = [int(np.argmin(np.abs(np.array(ROUGHNESSES) - float(each)))) for each in roughness]
    rows = torch.arange(len(level))
    lobe = reflected.mirrored(light)[rows, :, level]
    scale, bias = reflected.scale[rows, :, level, None], reflected.bias[rows, :, level, None]
    metal, color = metallic[:, None, None], color[:, None]
    plastic = (1 - 0.04 * scale - bias) * color * reflected.diffuse(light)[:, None] + (0.04 * scale + bias) * lobe
    return (1 - metal) * plastic + metal * (color * scale + bias) * lobe
