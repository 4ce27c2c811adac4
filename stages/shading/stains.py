"""What base colours still show of light and shade, told from paint and taken out.

Where the shape or the light that was found is a little off, the error ends in the base colours: shade on one side of a
thing that has one paint, a reflection on metal. Two things tell it from paint. A thing has few paints, each in many
places (`few_materials.few_colors`). And shading is smooth over normals: what a matte surface receives is nearly of
degree 2 on their sphere (Ramamoorthi & Hanrahan, "An Efficient Representation for Irradiance Environment Maps", 2001).

Differences are of natural logarithms of linear base colours throughout.
"""

from __future__ import annotations

import numpy as np

from stages.light.harmonics import basis
from stages.shading.few_materials import SAME, few_colors, heard, hues, looks, neighbors

# Differences beyond this (length over the channels) are rather of paint than of shading.
SPREAD = 0.25
# Holds shading down where normals tell little of it, in parts of what they tell where they face all sides.
RIDGE = 0.03
# A stain is not stronger than this.
STRONGEST = 1.0
# Part of the fine differences that metal loses, too: its colours are what it mirrors more than its own.
FINE_OF_METAL = 0.5
# A difference in brightness counts by this part of one in colour, once shading is out: more than
# `few_materials.BRIGHTNESS`, for light and dark grey are two paints.
BRIGHTNESS = 0.7
# Width of the Gaussian that shares a colour among paints, in parts of `few_materials.SAME`.
BETWEEN = 0.6
# Points that a texel hears of its stain from.
_HEARD = 4
_DARKEST = 0.02
_ROUNDS, _REWEIGHTS = 4, 8


def without_stains(
    colors: np.ndarray,
    positions: np.ndarray,
    normals: np.ndarray,
    shown: np.ndarray,
    metallic: np.ndarray,
    points: np.ndarray,
    workers: int = 1,
) -> np.ndarray:
    """Base colours [T, 3] of texels without stains.

    A stain is what a point and those around it that look alike have in common of the difference from their paint. What
    is finer is the texel's own and stays; of metal a part of it does.

    Args:
        colors: [T, 3] linear, as photos, shape and light say.
        positions, normals: [T, 3].
        shown: [T, 3] coded colours 0..1 with light in them: what looks alike.
        metallic: [T] in [0, 1].
        points: [S] rows of some texels, at which paints are found.
        workers: threads.
    """
    from scipy.spatial import cKDTree

    paint = paints(colors[points], normals[points])
    stain = heard(_difference(colors[points], paint), neighbors(positions[points], shown[points]))
    extent = float(np.ptp(positions[points], axis=0).max())
    tree = cKDTree(looks(positions[points], shown[points], extent))
    near = tree.query(looks(positions, shown, extent), k=min(_HEARD, len(points)), workers=workers)[1]
    near = near.reshape(len(colors), -1)
    taken = stain[near].mean(1)
    metal = metallic > 0
    own = _difference(colors[metal], paint[near[metal, 0]])
    taken[metal] += FINE_OF_METAL * metallic[metal, None] * (own - taken[metal])
    return np.clip(colors * np.exp(-taken), 0, 1).astype(np.float32)


def paints(colors: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """The paint [S, 3] of each point: the few of base colours without their shading, both found in turn.

    The first turn takes the whole thing to be of one paint, so that one paint in light and shade is not taken for two.
    What really is of another is an outlier to `shading`. What lies between two paints in the end is of both, or a slow
    change would become steps.
    """
    logs = np.log(np.maximum(colors.astype(np.float64), _DARKEST))
    flat = _flattened(logs, np.tile(np.median(colors, axis=0), (len(colors), 1)), normals)
    for _ in range(_ROUNDS - 1):
        flat = _flattened(logs, few_colors(flat), normals)
    return _blended(flat, np.unique(few_colors(flat, BRIGHTNESS), axis=0))


def _flattened(logs: np.ndarray, found: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Base colours [S, 3] of these logarithms without their shading, by the paints [S, 3] found so far."""
    flat: np.ndarray = np.exp(logs - shading(logs - np.log(np.maximum(found, _DARKEST)), normals))
    return flat


def _blended(colors: np.ndarray, few: np.ndarray) -> np.ndarray:
    """For colours [S, 3] the mean [S, 3] of logarithms of a few [C, 3], by a Gaussian of how far off each is.

    What is far off all of them, a small decal, is a paint of its own.
    """
    apart = ((hues(colors, BRIGHTNESS)[:, None] - hues(few, BRIGHTNESS)) ** 2).sum(2)
    nearest = apart.min(1, keepdims=True)
    shares = np.exp(-(apart - nearest) / (2 * (BETWEEN * SAME) ** 2))
    logs, of_few = (np.log(np.maximum(each, _DARKEST)) for each in (colors, few))
    of_them = np.exp(-nearest / (2 * SAME**2))
    blended: np.ndarray = np.exp(logs + of_them * (shares / shares.sum(1, keepdims=True) @ of_few - logs))
    return blended


def shading(logs: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """The part of logs [S, 3] that is of degree 1 and 2 in the normals [S, 3]; its mean over points is 0.

    Robust least squares (Cauchy's weights) with a ridge.
    """
    functions = np.sqrt(4 * np.pi) * basis(normals, 2)[:, 1:]  # of mean square 1 over all sides
    functions = functions - functions.mean(0)
    held = RIDGE * len(logs) * np.eye(functions.shape[1])
    smooth = np.zeros_like(logs)
    for _ in range(_REWEIGHTS):
        weighted = functions / (1 + ((logs - smooth) ** 2).sum(1, keepdims=True) / SPREAD**2)
        smooth = functions @ np.linalg.solve(weighted.T @ functions + held, weighted.T @ logs)
    return smooth


def _difference(colors: np.ndarray, paint: np.ndarray) -> np.ndarray:
    """[S, 3] of colours from their paint, no stronger than a stain can be."""
    logs, of_paint = (np.log(np.maximum(each.astype(np.float64), _DARKEST)) for each in (colors, paint))
    difference: np.ndarray = np.clip(logs - of_paint, -STRONGEST, STRONGEST)
    return difference
