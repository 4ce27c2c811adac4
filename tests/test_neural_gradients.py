"""Gradients of the pure functions against differences, in float64, away from their kinks."""

from __future__ import annotations

import pytest
import torch

from stages.neural.appearance import positional_encoding
from stages.neural.density import (
    laplace_density,
    logistic_section_optical_depth,
    outline_correction,
    section_optical_depth,
)
from stages.neural.fields import contract, smooth_relu_reference
from stages.neural.losses import (
    eikonal_error,
    exposure_error,
    inside_error,
    mask_error,
    outside_error,
    rgb_error,
    sparse_point_error,
)
from stages.neural.mlp import spherical_harmonics
from stages.neural.rendering import composite, sample_optical_depths, weights_from_optical_depth
from stages.neural.sampling import free_outside, invert_cdf
from stages.neural.terms.eikonal import eikonal_relaxation_literal
from stages.neural.terms.planar import bending_error
from stages.neural.terms.reflection import compose, reflect, reflection_probability


def draw(*shape: int, seed: int = 0, low: float = -1.0, high: float = 1.0) -> torch.Tensor:
    """Numbers in [low, high) with a gradient."""
    generator = torch.Generator().manual_seed(seed)
    numbers = torch.rand(*shape, generator=generator, dtype=torch.float64)
    return (low + (high - low) * numbers).requires_grad_()


def sorted_distances(rays: int, samples: int) -> torch.Tensor:
    return (draw(rays, samples, seed=9, low=0.5, high=2.5).detach().sort(1).values).requires_grad_()


LOSSES = {
    "rgb": (rgb_error, draw(5, 3), draw(5, 3, seed=1)),
    "eikonal": (eikonal_error, draw(5, 3)),
    "sparse point": (lambda f: sparse_point_error(f, 0.3), draw(9)),
    "outside": (lambda f: outside_error(f, 0.2), draw(9)),
    "inside": (lambda f: inside_error(f, 0.2), draw(9)),
    "mask": (lambda opacity: mask_error(opacity, draw(6, seed=1, low=0).detach()), draw(6, low=0.05, high=0.95)),
    "exposure": (exposure_error, draw(4, 3)),
    "planar": (bending_error, draw(4, 3), draw(4, 3, seed=1)),
    "eikonal relaxation as written": (eikonal_relaxation_literal, draw(8, low=0.0, high=0.5), draw(8, seed=1, low=0.1)),
}  # fmt: skip

RENDERING = {
    "laplace density": (laplace_density, draw(9), draw(1, low=0.1, high=0.3).squeeze()),
    "section": (
        section_optical_depth, draw(9), draw(9, seed=1), draw(9, seed=2, low=0.1), draw(1, low=0.1, high=0.3).squeeze(),
    ),
    "logistic section": (
        logistic_section_optical_depth, draw(9), draw(9, seed=1), draw(1, low=0.1, high=0.3).squeeze(),
    ),
    "optical depths": (lambda f, at: sample_optical_depths(f, at, 0.2), draw(3, 6), sorted_distances(3, 6)),
    "optical depths of neus": (
        lambda f, at: sample_optical_depths(f, at.detach(), 0.2, density="neus"), draw(3, 6), sorted_distances(3, 6),
    ),
    "optical depths outlined": (
        lambda f, at: sample_optical_depths(f, at, 0.2, torch.full_like(f, 0.6)), draw(3, 6), sorted_distances(3, 6),
    ),
    "section by change": (
        outline_correction, draw(9), draw(9, seed=1), draw(9, seed=2, low=0.1), draw(1, low=0.1, high=0.3).squeeze(),
    ),
    "weights": (weights_from_optical_depth, draw(3, 6, low=0.0)),
    "composite": (composite, draw(3, 6, low=0.0), draw(3, 6, 2, seed=1)),
    "free outside": (free_outside, draw(9), draw(9, seed=1, low=0.5, high=1.5)),
    "inverted cdf": (
        lambda edges, weights: invert_cdf(edges, weights, draw(3, 4, seed=5, low=0.05, high=0.95).detach()),
        sorted_distances(3, 7), draw(3, 6, seed=1, low=0.2),
    ),
}  # fmt: skip

NETWORKS = {
    "smooth relu": (smooth_relu_reference, draw(40, low=-0.2, high=0.2)),
    "contraction": (contract, draw(8, 3, low=-4, high=4)),
    "spherical harmonics": (spherical_harmonics, draw(5, 3)),
    "positional encoding": (lambda x: positional_encoding(x, 3), draw(4, 3)),
    "reflected direction": (reflect, draw(5, 3), draw(5, 3, seed=1)),
    "composed colour": (compose, draw(5, 3), draw(5, 3, seed=1), draw(5, seed=2), draw(5, seed=3)),
    "reflection probability": (
        lambda f: reflection_probability(f, sorted_distances(3, 6).detach(), 0.2), draw(3, 6),
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", [*LOSSES, *RENDERING, *NETWORKS])
def test_gradients_are_those_of_differences(name):
    function, *inputs = {**LOSSES, **RENDERING, **NETWORKS}[name]
    assert torch.autograd.gradcheck(function, inputs)


@pytest.mark.parametrize("name", LOSSES)
def test_every_loss_pulls_at_each_of_its_arguments(name):
    function, *inputs = LOSSES[name]
    for gradient in torch.autograd.grad(function(*inputs).sum(), inputs):
        assert gradient.abs().max() > 0
