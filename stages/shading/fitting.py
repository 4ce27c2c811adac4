"""Materials and light from what photos say of points: each from the other, in turn.

A point's radiance towards an observation is linear in its base colour ρ once roughness, metalness and light are known
(glTF 2.0, appendix B.3.5, with the split sum of `stages.light.ggx` for each of its two parts), and linear in the light
once the materials are:

    no metal:  ρ (1 - F) E + F s,                     F = 0.04 scale + bias
    metal:     (ρ scale + bias) s

E: what a white matte point shows, s: what the lobe sees. So roughness and metalness are tried out on a grid, with the
best ρ for each in closed form; the light is found by steps that multiply it (ISRA), with ρ following in closed form as
in variable projection. Colours are compared as the eye does, coded as sRGB; what a photo shows clipped agrees with all
that is brighter.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from stages.light.ggx import DIELECTRIC, ROUGHNESSES, blur, blur_back
from stages.neural.radiance import encoded_srgb
from stages.shading.reflection import Reflection

LEVELS = len(ROUGHNESSES)
# Coded colours differ by so much for reasons of their own: noise, poses, normals.
SPREAD = 0.04
# Part of a pixel's tint that each step takes from the whole light's: what is matte shows no tint of the light apart
# from its own, so nothing else would hold it.
GREY = 0.03
# From here on (coded) a photo is clipped.
CLIPPED = 0.98
# A point's base colour is not its own while the light is searched, or it would explain all shading.
PULL = 2.0
# What agrees with a clipped photo says nothing of a base colour but where there is no other.
FAINT = 1e-4
# Base colours of real things end here: fresh snow, silver.
BRIGHTEST = 0.95


@dataclass(frozen=True)
class Materials:
    """Of S points.

    Attributes:
        color: [S, 3] linear base colour.
        roughness: [S] in [0.1, 1].
        metallic: [S] in [0, 1].
    """

    color: Tensor
    roughness: Tensor
    metallic: Tensor


def coded(linear: Tensor) -> Tensor:
    """sRGB code of linear values, cut at 0 and 1."""
    return encoded_srgb(linear.clamp(0, 1))


def decoded(code: Tensor) -> Tensor:
    """Linear values of sRGB codes."""
    return torch.where(code <= 0.04045, code / 12.92, ((code.clamp_min(0) + 0.055) / 1.055) ** 2.4)


def _code_slope(code: Tensor) -> Tensor:
    """d code / d linear at a code."""
    linear = decoded(code).clamp_min(1e-3)
    return torch.where(linear <= 0.0031308, 12.92, 1.055 / 2.4 * linear ** (1 / 2.4 - 1))


def residuals(predicted: Tensor, observed: Tensor) -> Tensor:
    """Differences of coded colours; none where a clipped photo shows what is brighter."""
    off = coded(predicted) - observed
    return torch.where((observed >= CLIPPED) & (off >= CLIPPED - observed), 0.0, off)


def robust(off: Tensor) -> Tensor:
    """Pseudo-Huber: half the square of small differences (in SPREADs), large ones as they are."""
    return (1 + (off / SPREAD) ** 2).sqrt() - 1


def robust_weight(off: Tensor) -> Tensor:
    """What makes weighted squares of `robust`: its derivative over the difference."""
    return (1 + (off / SPREAD) ** 2).rsqrt()


def best_color(
    slope: Tensor,
    offset: Tensor,
    observed: Tensor,
    weights: Tensor,
    rounds: int = 3,
    paint: Tensor | None = None,
    brightest: float = BRIGHTEST,
) -> Tensor:
    """Base colours [S, 3] that make slope · ρ + offset [S, K, 3] fit coded colours best.

    By iteratively reweighted least squares, a linear difference counting by the slope of the code; a clipped photo
    counts where it shows more than the model, not where it agrees. Where a `paint` [S, 3] is given its
    brightness counts PULL times as much as theirs, for shading leaves the ratio of the channels.
    """
    wanted = decoded(observed)
    base = weights[..., None] * _code_slope(observed) ** 2
    clipped = observed >= CLIPPED
    trust = torch.where(clipped, FAINT, 1.0)
    color = torch.zeros_like(slope[:, 0])
    for _ in range(rounds):
        each = base * trust
        color = (each * slope * (wanted - offset)).sum(1) / (each * slope**2).sum(1).clamp_min(1e-9)
        if paint is not None:
            own = color.mean(1, keepdim=True).clamp_min(1e-6)
            color = color * (own + PULL * paint.mean(1, keepdim=True)) / ((1 + PULL) * own)
        color = color.clamp(0, brightest)
        predicted = slope * color[:, None] + offset
        off = residuals(predicted, observed)
        agrees = clipped & (off == 0)
        wanted = torch.where(agrees, predicted, decoded(observed))
        trust = torch.where(agrees, FAINT, robust_weight(off))
    return color


def slopes(scale: Tensor, bias: Tensor, mirrored: Tensor, diffuse: Tensor, metallic: Tensor | float) -> tuple[
    Tensor, Tensor
]:  # fmt: skip
    """Radiance = slope · ρ + offset of materials: [S, K, 3] each.

    Args:
        scale, bias: [S, K, 1] of the split sum.
        mirrored: [S, K, 3] what the lobe sees.
        diffuse: [S, 1, 3] what a white matte point shows.
        metallic: broadcasts against these.
    """
    fresnel = DIELECTRIC * scale + bias
    slope = (1 - metallic) * (1 - fresnel) * diffuse + metallic * scale * mirrored
    offset = ((1 - metallic) * fresnel + metallic * bias) * mirrored
    return slope, offset


# ---------------------------------------------------------------- materials from light
def try_out(
    reflection: Reflection,
    observed: Tensor,
    weights: Tensor,
    light: Tensor,
    kinds: Sequence[int] = (0, 1),
    brightest: float = BRIGHTEST,
) -> tuple[Tensor, Tensor]:
    """How well each roughness fits, as no metal (0) and as metal (1).

    Args:
        brightest: base colour of no metal.

    Returns:
        costs [S, 2, R], infinite for a kind that is not asked for, and the best base colours [S, 2, R, 3].
    """
    count = len(observed)
    costs, colors = torch.full((count, 2, LEVELS), torch.inf), torch.zeros(count, 2, LEVELS, 3)
    total = weights.sum(1).clamp_min(1e-9)
    for part in torch.arange(count).split(1024):
        here = reflection.select(part)
        diffuse, mirrored = here.diffuse(light)[:, None], here.mirrored(light)
        for metallic in kinds:
            for level in range(LEVELS):
                slope, offset = slopes(
                    here.scale[..., level, None], here.bias[..., level, None], mirrored[:, :, level], diffuse, metallic
                )
                most = BRIGHTEST if metallic else brightest
                color = best_color(slope, offset, observed[part], weights[part], brightest=most)
                off = residuals(slope * color[:, None] + offset, observed[part])
                colors[part, metallic, level] = color
                costs[part, metallic, level] = (weights[part] * robust(off).mean(2)).sum(1) / total[part]
    return costs, colors


# ---------------------------------------------------------------- light from materials
def levels_of(roughness: Tensor) -> Tensor:
    """The nearest of ROUGHNESSES for each."""
    return (roughness[:, None] - torch.tensor(ROUGHNESSES)).abs().argmin(1)


def find_light(
    reflection: Reflection,
    observed: Tensor,
    weights: Tensor,
    materials: Materials,
    light: Tensor,
    rounds: int = 4,
    subsets: int = 6,
    smoothness: float = 0.02,
    grey: float = GREY,
) -> Tensor:
    """The light [P, 3] that fits best, from a start that is nowhere 0.

    The radiance of the observations is A L + b with A >= 0, and base colours follow in closed form. L takes steps

        L <- L (A' W y) / (A' W (A L + b)),

    which keep it above 0 and lower the weighted squares (ISRA, Daube-Witherspoon & Muehllehner 1986), each from another
    part of the points (ordered subsets, Hudson & Larkin 1994).
    """
    chosen = torch.from_numpy(np.random.default_rng(0).permutation(len(observed)))
    parts = [Part(reflection, observed, weights, materials, rows) for rows in chosen.chunk(subsets)]
    for _ in range(rounds):
        for part in parts:
            light = greyed(smoothed(light * part.update(light), smoothness), grey)
    return light


class Part:
    """Some of the points, with what does not change while the light does.

    `free`: their base colours are whatever fits, as where the light's shape is known; else they stay near
    `materials.color`.
    """

    def __init__(
        self,
        reflection: Reflection,
        observed: Tensor,
        weights: Tensor,
        materials: Materials,
        rows: Tensor,
        free: bool = False,
    ) -> None:
        from scipy.sparse import csr_matrix

        self.here, self.observed, self.weights = reflection.select(rows), observed[rows], weights[rows]
        level = levels_of(materials.roughness[rows])
        used, place = level.unique(return_inverse=True)
        self.lobes = self.here.lobes[used.numpy()]
        count, views = self.weights.shape

        def of_level(values: Tensor) -> Tensor:
            index = level[:, None, None].expand(count, views, 1)
            return values.gather(2, index if values.ndim == 3 else index[..., None].expand(-1, -1, -1, 3)).squeeze(2)

        pixels = len(self.here.lobes[0])
        columns = (place[:, None, None] * pixels + self.here.pixels).reshape(-1)
        entries = (self.here.shares * of_level(self.here.open)[..., None]).reshape(-1)
        starts = np.arange(0, 4 * count * views + 1, 4)
        shape = (count * views, len(used) * pixels)
        self.lobe = csr_matrix((entries.numpy(), columns.numpy(), starts), shape=shape)
        self.back = self.lobe.T.tocsr()
        self.bounced = of_level(self.here.bounced)
        scale, bias = of_level(self.here.scale)[..., None], of_level(self.here.bias)[..., None]
        metallic = materials.metallic[rows][:, None, None]
        self.paint = None if free else materials.color[rows]
        fresnel = DIELECTRIC * scale + bias
        self.of_diffuse = (1 - metallic) * (1 - fresnel)
        self.of_mirrored, self.of_tinted = (1 - metallic) * fresnel + metallic * bias, metallic * scale

    def radiance(self, light: Tensor) -> tuple[Tensor, Tensor]:
        """That of the observations [S, K, 3], and the base colours [S, 3] that fit best."""
        blurred = blur(self.lobes, light.numpy()).reshape(-1, 3)
        mirrored = torch.from_numpy(self.lobe @ blurred).reshape(self.observed.shape) + self.bounced
        diffuse = self.of_diffuse * self.here.diffuse(light)[:, None]
        slope, offset = diffuse + self.of_tinted * mirrored, self.of_mirrored * mirrored
        color = best_color(slope, offset, self.observed, self.weights, rounds=2, paint=self.paint)
        return slope * color[:, None] + offset, color

    def update(self, light: Tensor) -> Tensor:
        """The factor [P, 3] of a step."""
        radiance, color = self.radiance(light)
        off = residuals(radiance, self.observed)
        trust = self.weights[..., None] * _code_slope(self.observed) ** 2 * robust_weight(off)
        wanted = torch.where(off == 0, radiance, decoded(self.observed))
        return self.seen_back(trust * wanted, color) / self.seen_back(trust * radiance, color).clamp_min(1e-12)

    def seen_back(self, values: Tensor, color: Tensor) -> Tensor:
        """A' of values [S, K, 3] of the observations: [P, 3]."""
        color = color[:, None]
        matte = torch.from_numpy(self.here.cosine.numpy().T @ (values * self.of_diffuse * color).sum(1).numpy())
        glossy = (values * (self.of_mirrored + self.of_tinted * color)).reshape(-1, 3).numpy()
        blurred = (self.back @ glossy).reshape(len(self.lobes), -1, 3)
        # a floor: directions that hardly anything shows stay as they are
        return matte + torch.from_numpy(blur_back(self.lobes, blurred)) + 1e-6

    def cost(self, light: Tensor) -> float:
        radiance, _ = self.radiance(light)
        each = self.weights[..., None] * robust(residuals(radiance, self.observed))
        return float(each.sum() / (3 * self.weights.sum()))


def radiance_of(
    reflection: Reflection, observed: Tensor, weights: Tensor, materials: Materials, light: Tensor
) -> Tensor:
    """Radiance [S, K, 3] of the observations, with base colours that fit and are near `materials.color`."""
    return Part(reflection, observed, weights, materials, torch.arange(len(observed))).radiance(light)[0]


def smoothed(light: Tensor, share: float) -> Tensor:
    """A light [P, 3] of any size with a share of each pixel's logarithm taken from its four neighbours'."""
    rows = math.isqrt(len(light) // 2)
    grid = light.clamp_min(1e-6).log().reshape(rows, 2 * rows, 3)
    above, below = torch.cat([grid[:1], grid[:-1]]), torch.cat([grid[1:], grid[-1:]])
    mean = (grid.roll(1, 1) + grid.roll(-1, 1) + above + below) / 4
    return ((1 - share) * grid + share * mean).exp().reshape(-1, 3)


def greyed(light: Tensor, share: float) -> Tensor:
    """A light [P, 3] with a share of each pixel's tint (the ratios of its channels) taken from that of the whole."""
    grid, whole = light.clamp_min(1e-6).log(), light.mean(0).clamp_min(1e-6).log()
    tint, of_whole = grid - grid.mean(1, keepdim=True), whole - whole.mean()
    return (grid + share * (of_whole - tint)).exp()


def grey_world(light: Tensor, color: Tensor, solid_angles: Tensor) -> tuple[Tensor, Tensor]:
    """The same pictures with a light that is white on average: what light and base colours share is a convention."""
    mean = (light * solid_angles[:, None]).sum(0) / solid_angles.sum()
    tint = mean / mean.mean()
    return light / tint, color * tint
