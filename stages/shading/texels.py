"""The base colour of each texel, once light and materials are known: every photo's own answer, averaged."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from stages.compiling import njit
from stages.light import ggx
from stages.light.environment import look_up
from stages.light.levels import matte
from stages.light.srgb import decoded
from stages.shading.few_materials import looks
from stages.shading.fitting import CLIPPED
from stages.shading.learning import Learned
from stages.shading.reflection import matte_weights
from stages.shading.surroundings import ROWS as NEAR_ROWS
from stages.shading.surroundings import Surroundings
from stages.texture.observing import sample_points
from stages.texture.photo_views import View

# Points that a texel takes its irradiance from, the nearest ones.
NEAREST = 4
# The first round takes all photos, the second those that agree with its answer.
ROUNDS = 2
SPREAD = 0.06
# Clipped photos say little about a base colour: nothing, but where there are no others.
FAINT = 0.02


class Told(IntEnum):
    """What the photos tell of a texel; the values make a readable grey image."""

    OUTSIDE = 0
    NOTHING = 64
    COLOR = 160
    ALL = 255


@dataclass(frozen=True)
class Points:
    """The points that materials were learned at.

    Attributes:
        positions, normals: [S, 3].
        colors: [S, 3] the baked texture's there, coded, 0..1.
        around: of each.
    """

    positions: np.ndarray
    normals: np.ndarray
    colors: np.ndarray
    around: Surroundings


@dataclass(frozen=True)
class TexelMaterials:
    """Of T texels.

    Attributes:
        color: [T, 3] float32 linear base colour.
        which: [T] of the few materials.
        told: [T] uint8 of `Told`.
    """

    color: np.ndarray
    which: np.ndarray
    told: np.ndarray


def base_colors(
    positions: np.ndarray,
    normals: np.ndarray,
    baked: np.ndarray,
    points: Points,
    learned: Learned,
    light_from_scene: np.ndarray,
    views: Callable[[], Iterator[View]],
    workers: int = 1,
) -> TexelMaterials:
    """Base colours of texels [T, 3] with unit normals.

    Args:
        baked: [T, 3] uint8, the texture with light in it.
        points: S of them; `learned` says what they are made of.
        light_from_scene: rotation [3, 3].
        views: gives all photos, once a round.
        workers: threads.
    """
    from scipy.spatial import cKDTree

    coded = baked.astype(np.float32) / 255
    extent = float(np.ptp(points.positions, axis=0).max())

    of_points, of_texels = looks(points.positions, points.colors, extent), looks(positions, coded, extent)
    alike = cKDTree(of_points).query(of_texels, workers=workers)[1]
    which = learned.which[alike].astype(np.int32)
    distance, near = cKDTree(points.positions).query(positions, k=NEAREST, workers=workers)
    facing = np.clip(np.einsum("tc,tkc->tk", normals, points.normals[near]), 0, 1)
    share = (0.05 + facing) / (distance + 1e-3 * extent) ** 2
    share = (share / share.sum(1, keepdims=True)).astype(np.float32)
    matte_light = matte(learned.light)
    turned = (normals @ light_from_scene.T).astype(np.float32)
    # How much of what it would receive in the open a point receives, and so the texels around it.
    openness = _received(points, learned.light, light_from_scene) / look_up(
        matte_light, (points.normals @ light_from_scene.T).astype(np.float32)
    ).clip(1e-6)
    received = look_up(matte_light, turned) * np.einsum("tk,tkc->tc", share, openness[near])

    roughness = np.array([material.roughness for material in learned.materials])
    mirrored = np.stack([ggx.blurred(learned.light, each) for each in roughness])
    around = np.empty((len(points.positions), 2 * NEAR_ROWS**2, 4), np.float32)
    for k, each in enumerate(roughness):
        rows, lobe = learned.which == k, ggx.lobe_matrix(each, NEAR_ROWS, NEAR_ROWS)
        around[rows, :, 3] = points.around.open[rows] @ lobe.T
        for c in range(3):
            around[rows, :, c] = points.around.bounced[rows, :, c] @ lobe.T
    metallic = np.array([float(material.metallic) for material in learned.materials], np.float32)
    columns = (np.arange(ggx.TABLE_SIDE) + 0.5) / ggx.TABLE_SIDE
    of_material = np.stack(ggx.split_sum(columns, roughness[:, None]), axis=2)  # [M, side, 2]

    count = len(positions)
    color = np.zeros((count, 3), np.float32)
    for turn in range(ROUNDS):
        top, bottom = np.zeros((count, 3), np.float32), np.zeros((count, 3), np.float32)
        for index, view in enumerate(views()):
            weights, seen = np.zeros(count, np.float32), np.zeros((count, 3), np.float32)
            sample_points(
                positions, normals, view.matrix, view.center, view.focal, view.inverse_depth, view.confidence,
                view.photo, weights, seen,
            )  # fmt: skip
            _answer(
                weights, seen, positions, turned, np.asarray(view.center), light_from_scene, received, which,
                near[:, 0], around, mirrored, of_material, metallic, float(learned.gains[index]), turn > 0, color,
                top, bottom,
            )  # fmt: skip
        color = np.clip(top / np.maximum(bottom, 1e-12), 0, 1)
    known = bottom.min(1) > 0
    # What no photo shows: the texture's own colour, with the light taken off that lies on the points around.
    ratio = (learned.color / decoded(points.colors).clip(0.01)).clip(0.2, 5)
    color[~known] = (decoded(coded[~known]) * ratio[alike[~known]]).clip(0, 1)
    told = np.array([Told.ALL if material.told else Told.COLOR for material in learned.materials], np.uint8)[which]
    told[~known] = Told.NOTHING
    return TexelMaterials(color.astype(np.float32), which, told)


def _received(points: Points, light: np.ndarray, light_from_scene: np.ndarray) -> np.ndarray:
    """What white matte points [S, 3] show where they are."""
    cosine, bounced = matte_weights(points.normals, points.around, light_from_scene)
    received: np.ndarray = cosine @ light.reshape(-1, 3) + bounced
    return received


@njit(nogil=True, cache=True)
def _look(image, x, y, z, out):  # pragma: no cover - compiled
    """Bilinear look-up in an equirectangular map [H, 2 H, C]; as `stages.light.environment.look_up`."""
    height = image.shape[0]
    width = image.shape[1]
    v = np.arccos(min(max(y, -1.0), 1.0)) * (height / np.pi) - 0.5
    u = (np.arctan2(z, x) / np.pi + 1.0) * height - 0.5
    y0, x0 = int(np.floor(v)), int(np.floor(u))
    fv, fu = v - y0, u - x0
    y1 = min(y0 + 1, height - 1)
    y0 = max(y0, 0)
    x1 = (x0 + 1) % width
    x0 = x0 % width
    for c in range(image.shape[2]):
        out[c] = (image[y0, x0, c] * (1 - fu) + image[y0, x1, c] * fu) * (1 - fv) + (
            image[y1, x0, c] * (1 - fu) + image[y1, x1, c] * fu
        ) * fv


@njit(nogil=True, cache=True)
def _code(value):  # pragma: no cover - compiled
    value = min(max(value, 0.0), 1.0)
    return 12.92 * value if value <= 0.0031308 else 1.055 * value ** (1 / 2.4) - 0.055


@njit(nogil=True, cache=True)
def _answer(
    weights, seen, positions, normals, center, turn, received, which, nearest, around, mirrored, of_material,
    metallic, gain, judged, color, top, bottom,
):  # fmt: skip # pragma: no cover - compiled
    """Add one photo's answers to top and bottom [T, 3] of the weighted mean; see `fitting` for the equation.

    `normals` are in the light's frame already; around [S, 2 ROWS^2, 4] is what lobes see near the points; `judged`:
    answers count by their distance from `color`.
    """
    glow, local = np.empty(3), np.empty(4)
    rows = int(np.sqrt(around.shape[1] // 2))
    side = of_material.shape[1]
    for i in range(weights.shape[0]):
        if weights[i] <= 0:
            continue
        d0, d1, d2 = center[0] - positions[i, 0], center[1] - positions[i, 1], center[2] - positions[i, 2]
        length = np.sqrt(d0 * d0 + d1 * d1 + d2 * d2)
        vx = (turn[0, 0] * d0 + turn[0, 1] * d1 + turn[0, 2] * d2) / length
        vy = (turn[1, 0] * d0 + turn[1, 1] * d1 + turn[1, 2] * d2) / length
        vz = (turn[2, 0] * d0 + turn[2, 1] * d1 + turn[2, 2] * d2) / length
        nx, ny, nz = normals[i, 0], normals[i, 1], normals[i, 2]
        facing = min(max(vx * nx + vy * ny + vz * nz, 1e-3), 1.0)
        rx, ry, rz = 2 * facing * nx - vx, 2 * facing * ny - vy, 2 * facing * nz - vz
        material = which[i]
        _look(mirrored[material], rx, ry, rz, glow)
        _look(around[nearest[i]].reshape(rows, 2 * rows, 4), rx, ry, rz, local)
        column = min(int(facing * side), side - 1)
        scale, bias = of_material[material, column, 0], of_material[material, column, 1]
        fresnel = 0.04 * scale + bias
        metal = metallic[material]
        for c in range(3):
            code = seen[i, c] / 255.0
            lobe = glow[c] * local[3] + local[c]
            slope = (1 - metal) * (1 - fresnel) * received[i, c] + metal * scale * lobe
            offset = ((1 - metal) * fresnel + metal * bias) * lobe
            linear = code / 12.92 if code <= 0.04045 else ((code + 0.055) / 1.055) ** 2.4
            linear *= gain
            weight = weights[i] * (FAINT if code >= CLIPPED else 1.0)
            if judged:
                off = (_code(slope * color[i, c] + offset) - _code(linear)) / SPREAD
                weight /= (1 + off * off) ** 2
            # a difference counts by the slope of the code there
            tone = max(linear, 1e-3)
            weight *= tone ** (2 / 2.4 - 2)
            top[i, c] += weight * slope * (linear - offset)
            bottom[i, c] += weight * slope * slope
