"""Shapes to start from: the visual hull, which is the largest that silhouettes allow, and a room."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from stages.geometry.cameras import PinholeCameras

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Float32, Shaped

# A voxel belongs to the hull when it is inside the silhouette in this part of the views it projects into;
# less than 1, because a mask or a pose may be wrong.
HULL_AGREEMENT = 0.9
HULL_CELLS = 48
DISTANCE_CELLS = 64
# A room's walls before training, in radii of the region: most of it is free, and the sphere lies behind them.
ROOM_RADIUS = 0.9


def visual_hull_sphere(
    cameras: PinholeCameras,
    masks: Sequence[Shaped[np.ndarray, "_ _"] | None],
    center: Float[np.ndarray, " 3"],
    radius: float,
) -> tuple[Float[np.ndarray, " 3"], float] | None:
    """Sphere about the visual hull of silhouettes, looked for in the cube `center` +- `radius`.

    The cube is carved on a coarse grid, then once more on the hull's own box; without margin.

    Args:
        masks: one array (not zero on the object) per camera, of the camera's size, or None where there is none.

    Returns:
        Centre and radius, or None where nothing is left after carving.
    """
    hull = carve(cameras, masks, center, radius)
    if hull is None:
        return None
    kept = hull.centers[hull.inside.ravel()]
    hull_center = (kept.min(0) + kept.max(0)) / 2
    # a cell's own half diagonal, because the grid holds centres of cells
    hull_radius = np.linalg.norm(kept - hull_center, axis=1).max() + np.linalg.norm(hull.cell) / 2
    return hull_center, float(hull_radius)


@dataclass(frozen=True)
class Hull:
    """A visual hull on a grid over its own box, a cell wider on each side.

    Attributes:
        low, high: corners of the grid.
        inside: cells of the hull, axes x, y, z.
    """

    low: Float[np.ndarray, " 3"]
    high: Float[np.ndarray, " 3"]
    inside: Bool[np.ndarray, "c c c"]

    @property
    def cell(self) -> Float[np.ndarray, " 3"]:
        """Sides of a cell."""
        return (self.high - self.low) / self.inside.shape

    @property
    def centers(self) -> Float[np.ndarray, "c3 3"]:
        """Of all cells, in the order of `inside.ravel()`."""
        axes = [self.low[k] + (np.arange(self.inside.shape[k]) + 0.5) * self.cell[k] for k in range(3)]
        return np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)


def carve(
    cameras: PinholeCameras,
    masks: Sequence[Shaped[np.ndarray, "_ _"] | None],
    center: Float[np.ndarray, " 3"],
    radius: float,
    agreement: float = HULL_AGREEMENT,
) -> Hull | None:
    """Visual hull in the cube `center` +- `radius`: on a coarse grid, then once more on the hull's own box.

    Args:
        masks: as for `visual_hull_sphere`.
        agreement: a cell is inside if it is on the silhouettes of this part of the views it projects into.

    Returns:
        None where nothing is left after carving.
    """
    low, high = center - radius, center + radius
    for _ in range(2):
        hull = Hull(low, high, np.zeros([HULL_CELLS] * 3, bool))
        grid = hull.centers
        inside = _inside_silhouettes(cameras, masks, grid, agreement)
        if not inside.any():
            return None
        hull = replace(hull, inside=inside.reshape(hull.inside.shape))
        low, high = grid[inside].min(0) - hull.cell, grid[inside].max(0) + hull.cell
    return hull


def _inside_silhouettes(
    cameras: PinholeCameras,
    masks: Sequence[Shaped[np.ndarray, "_ _"] | None],
    points: Float[np.ndarray, "p 3"],
    agreement: float = HULL_AGREEMENT,
) -> Bool[np.ndarray, " p"]:
    """Whether points lie inside the silhouettes of this part of the views they project into."""
    seen, inside = np.zeros(len(points)), np.zeros(len(points))
    masked = [(i, mask) for i, mask in enumerate(masks) if mask is not None]
    for i, mask in masked:
        visible, on_object = cameras.on_mask(i, points, mask)
        seen += visible
        inside += on_object
    # a voxel most views do not see is no part of what they were pointed at
    return (seen >= max(1.0, 0.5 * len(masked))) & (inside >= agreement * seen)


def hull_distances(
    cameras: PinholeCameras, masks: Sequence[Shaped[np.ndarray, "_ _"] | None], cells: int = DISTANCE_CELLS
) -> Float32[np.ndarray, "{cells} {cells} {cells}"] | None:
    """Signed distance to the hull, negative inside, at the centres of a grid over the cube [-1, 1]^3.

    Args:
        masks: one array per camera, not zero on the object, or None where there is none.

    Returns:
        Axes x, y, z; or None where nothing, or all, is inside.
    """
    from scipy.ndimage import distance_transform_edt

    cell = 2.0 / cells
    grid = cube(cells).reshape(-1, 3)
    inside = (_inside_silhouettes(cameras, masks, grid) & (np.linalg.norm(grid, axis=1) < 1)).reshape([cells] * 3)
    if not inside.any() or inside.all():
        return None
    # The transforms count to the nearest centre on the other side; the surface is half a cell before it.
    outside_by = np.maximum(distance_transform_edt(~inside) - 0.5, 0)
    inside_by = np.maximum(distance_transform_edt(inside) - 0.5, 0)
    return (cell * (outside_by - inside_by)).astype(np.float32)


def room_distances(cells: int = DISTANCE_CELLS) -> Float32[np.ndarray, "{cells} {cells} {cells}"]:
    """Signed distance to a round room's wall, positive within, at the centres of a grid as of `hull_distances`."""
    return (ROOM_RADIUS - np.linalg.norm(cube(cells), axis=-1)).astype(np.float32)


def cube(cells: int = DISTANCE_CELLS) -> Float[np.ndarray, "{cells} {cells} {cells} 3"]:
    """Centres of a grid over the cube [-1, 1]^3."""
    axis = (np.arange(cells) + 0.5) * 2.0 / cells - 1
    return np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1)
