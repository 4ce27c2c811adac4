"""BlendedMVS (Yao et al. 2020): its makers published no program to score surfaces.

Plain distances and F-scores, at thresholds of our own; they are parts of the true mesh's extent, as its scenes have no
unit.
"""

from __future__ import annotations

from stages.evaluation.surfaces import Sampling, Surface, SurfaceScores, measure

BLENDED_THRESHOLDS = (0.005, 0.01, 0.02)  # of the truth's extent


def blended_score(predicted: Surface, truth: Surface, sampling: Sampling | None = None) -> SurfaceScores:
    """Hold a surface against a scene of BlendedMVS, in its frame. Raises ValueError as `measure` does."""
    return measure(predicted, truth, [part * truth.extent for part in BLENDED_THRESHOLDS], sampling)
