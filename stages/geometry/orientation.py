"""Which way is up: turning the world for file formats and screens that want +Y on top."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from jaxtyping import Float


def y_up_rotation(up: Float[np.ndarray, " 3"]) -> Float[np.ndarray, "3 3"]:
    """The smallest proper rotation that turns the unit vector `up` to +Y (glTF's up)."""
    target = np.array([0.0, 1.0, 0.0])
    up = up / np.linalg.norm(up)
    axis, cos = np.cross(up, target), float(up @ target)
    if cos < -1 + 1e-9:  # upside down: half a turn about X
        return np.diag([1.0, -1.0, -1.0])
    skew = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    return np.eye(3) + skew + skew @ skew / (1 + cos)
