"""Bringing a surface into the truth's frame: by a given matrix, by camera centres, by ICP."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from stages.evaluation.surfaces import Surface
from stages.geometry.similarity import Similarity


def by_cameras(centers: Mapping[str, np.ndarray], true_centers: Mapping[str, np.ndarray]) -> tuple[Similarity, int]:
    """The similarity that takes camera centres [3] to the true ones of the same names, and how many were paired.

    Raises:
        ValueError: fewer than 3 names are shared, or the centres lie on one line.
    """
    raise NotImplementedError


def by_icp(predicted: Surface, truth: Surface, scaled: bool = False) -> Similarity:
    """The rigid motion (`scaled`: similarity) that takes a surface nearest to the truth, from where it is.

    Trimmed point-to-plane ICP (Chen and Medioni 1992), see `stages.meshing.comparing`. A cloud without normals gets
    those of planes through 20 neighbours.
    """
    raise NotImplementedError
