"""What a capture is laid out around: the region of interest, the ground under it, and up."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from stages.geometry.attention import attended
from stages.geometry.cameras import PinholeCameras
from stages.geometry.plane import Plane, find_ground
from stages.geometry.region import RegionOfInterest, find_region, grown_over
from stages.geometry.subjects import seen_by
from stages.geometry.up import Up, choose_up, estimate_up

if TYPE_CHECKING:
    from jaxtyping import Float, Int, Integer, Shaped


class Layout(NamedTuple):
    """Region, ground (None where there is none) and up in the frame of the poses."""

    region: RegionOfInterest
    ground: Plane | None
    up: Up


def find_layout(
    cameras: PinholeCameras,
    points: Float[np.ndarray, "p 3"],
    observations: Integer[np.ndarray, "m 2"],
    masks: Sequence[Shaped[np.ndarray, "_ _"] | None] | None = None,
    stated: RegionOfInterest | None = None,
    photos: Int[np.ndarray, " k"] | None = None,
) -> Layout:
    """The layout of the photos of one subject.

    Args:
        cameras, points: in the frame of the poses.
        observations: rows (image index, point index).
        masks, stated: see `find_region`.
        photos: indices of those of the subject, see `find_subjects`; None: all are.

    Raises:
        ValueError: no region can be found.
    """
    held = estimate_up(cameras)
    if photos is not None:
        cameras, masks = cameras.select(photos), None if masks is None else [masks[i] for i in photos]
        points, observations = seen_by(photos, points, observations)
    about = attended(cameras, points, observations)
    region = find_region(cameras, points, about, masks, stated)
    ground = find_ground(points, cameras.centers, held.direction, region.center, region.radius)
    region = grown_over(region, points[about], ground)
    return Layout(region, ground, choose_up(held, None if ground is None else ground.normal))
