"""Scenes whose makers published no program to score surfaces: plain distances and F-scores at thresholds of our own.

BlendedMVS (Yao et al. 2020): thresholds are parts of the true mesh's extent, as its scenes have no unit.
UrbanScene3D (Lin et al. 2022): thresholds are metres.
"""

from __future__ import annotations

from stages.evaluation.surfaces import Sampling, Surface, SurfaceScores, measure

BLENDED_THRESHOLDS = (0.005, 0.01, 0.02)  # of the truth's extent
URBAN_THRESHOLDS = (0.05, 0.1, 0.2, 0.5)  # metres


def blended_score(predicted: Surface, truth: Surface, sampling: Sampling | None = None) -> SurfaceScores:
    """Hold a surface against a scene of BlendedMVS, in its frame. Raises ValueError as `measure` does."""
    return measure(predicted, truth, [part * truth.extent for part in BLENDED_THRESHOLDS], sampling)


def urban_score(predicted: Surface, truth: Surface, sampling: Sampling | None = None) -> SurfaceScores:
    """Hold a surface against a scan of UrbanScene3D, in its frame, metres. Raises ValueError as `measure` does."""
    return measure(predicted, truth, URBAN_THRESHOLDS, sampling)
