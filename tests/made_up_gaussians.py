"""Gaussians for tests: some in a ball, of all shapes and colours."""

from __future__ import annotations

import numpy as np

from stages.gaussians.gaussians import Gaussians


def some_gaussians(count: int = 200, degree: int = 3, seed: int = 0) -> Gaussians:
    """In a ball around the origin, with harmonics that fade with their degree."""
    random = np.random.default_rng(seed)
    quaternions = random.normal(size=(count, 4))
    terms = np.concatenate([np.full(2 * l + 1, 0.4 / (l + 1) ** 2) for l in range(degree + 1)])
    arrays = {
        "centers": random.normal(size=(count, 3)) * 0.4,
        "rotations": quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True),
        "log_scales": np.log(random.uniform([0.02, 0.02, 0.002], [0.2, 0.2, 0.02], (count, 3))),
        "opacity_logits": random.normal(size=count) * 2,
        "harmonics": random.normal(size=(count, (degree + 1) ** 2, 3)) * terms[:, None],
    }
    kept = {name: array.astype(np.float32) for name, array in arrays.items()}
    return Gaussians(**kept, anchored=random.random(count) < 0.8)
