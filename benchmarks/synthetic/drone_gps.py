"""Where a drone's GPS has its camera, for the EXIF of photos from the air."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from stages.geometry.earth import from_east_north_up

if TYPE_CHECKING:
    from jaxtyping import Float

ORIGIN = (47.37, 8.54, 400.0)  # of the scene: latitude, longitude (degrees, WGS 84) and altitude (m)
NOISE_M = (2.0, 2.0, 4.0)  # standard deviations east, north and up


def drone_positions(
    cam_from_world: Float[np.ndarray, "n 4 4"], metres: float, rng: np.random.Generator
) -> Float[np.ndarray, "n 3"]:
    """Latitude, longitude (degrees) and altitude (m) of cameras in a scene whose unit is so many metres, with noise."""
    centers = -np.einsum("nji,nj->ni", cam_from_world[:, :3, :3], cam_from_world[:, :3, 3])
    return from_east_north_up(metres * centers + rng.normal(size=centers.shape) * NOISE_M, ORIGIN)


def stated(metres: float) -> dict[str, Any]:
    """For what a set was made with."""
    return {"metres": metres, "origin": list(ORIGIN), "noise_m": list(NOISE_M)}
