"""What photos say of points on the surface, from each side."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from stages.geometry.vectors import unit
from stages.texture.observing import sample_points
from stages.texture.photo_views import View

# Of each point at most so many photos count, a random choice: from each side some.
MOST_VIEWS = 40


@dataclass(frozen=True)
class Observations:
    """Colours of S points in up to K photos each.

    Attributes:
        colors: [S, K, 3] float32, sRGB-coded, 1 for full scale.
        weights: [S, K] float32 in [0, 1] trust in each; 0 where there are fewer photos.
        towards: [S, K, 3] float32 unit directions to the cameras.
        photos: [S, K] int64 which photo each is of.
    """

    colors: np.ndarray
    weights: np.ndarray
    towards: np.ndarray
    photos: np.ndarray

    def select(self, rows: np.ndarray) -> Observations:
        """Those of some points."""
        return Observations(self.colors[rows], self.weights[rows], self.towards[rows], self.photos[rows])


def observe(positions: np.ndarray, normals: np.ndarray, views: Iterable[View], most: int = MOST_VIEWS) -> Observations:
    """Look at points [S, 3] with unit normals [S, 3] in all photos."""
    all_weights, all_colors, centers = [], [], []
    for view in views:
        weights, colors = np.zeros(len(positions), np.float32), np.zeros((len(positions), 3), np.float32)
        sample_points(
            positions, normals, view.matrix, view.center, view.focal, view.inverse_depth, view.confidence, view.photo,
            weights, colors,
        )  # fmt: skip
        all_weights.append(weights)
        all_colors.append(colors)
        centers.append(view.center)
    weights, colors = np.stack(all_weights, axis=1), np.stack(all_colors, axis=1)
    # The root: what resolves a point four times as well is not four times as right about its colour.
    weights = np.sqrt(weights / np.maximum(weights.max(1, keepdims=True), 1e-20))
    keys = np.where(weights > 0, np.random.default_rng(0).random(weights.shape), -1)
    kept = np.argsort(-keys, axis=1, kind="stable")[:, :most]
    return Observations(
        colors=(np.take_along_axis(colors, kept[..., None], 1) / 255).astype(np.float32),
        weights=np.take_along_axis(weights, kept, 1),
        towards=unit(np.stack(centers)[kept] - positions[:, None]).astype(np.float32),
        photos=kept,
    )
