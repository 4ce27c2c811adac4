"""What outlines of an object say beside whole photos: where it is not, and where something of it must be.

How far an outline may be off is measured: dense points tell which pixels show the object, by what most masks of the
photos that see them say. So masks that are too wide, too narrow, shifted or of something else say less, or nothing.

Shapes: I photos, P points, M lines of sight.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from stages.geometry.cameras import PinholeCameras
from stages.geometry.point_cloud import PointCloud

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Float32, Int, Shaped

# A point is the object's where it is on the masks of at least this part of the photos that see it, and not where on no
# more than that part; masks that are too narrow lack a point in all photos that see it from aside. So many must see it.
OWN, OTHER, MIN_SEEN = 0.5, 0.3, 3
# Part of a photo's points that may contradict its outline; of fewer points than this those of all photos are asked.
CONTRADICTED, MIN_POINTS = 0.02, 100
THICK = 4.0  # pixels: half of the width from which points beside a part of the object are asked
WINDOW = 2.0  # pixels: how far inside an outline is looked for points that are not the object's
ROUNDS = 2  # masks that say nothing in the first have no vote in the second
# Pixels: added to a measured outer error, for pixels have a size; and the error where no points tell of it.
PIXEL, UNKNOWN = 1.0, 6.0
# A place is outside the object where more than this part of the photos that see it show it off their outlines.
OUTSIDE = 0.1
MOST = 24.0  # pixels of an inner error that are tried; masks that are off by more say nothing
# Side of the grid of places, and of the coarse one that it is refined from: 0.8 % of the region's radius, one to two
# pixels of a photo of 640 x 480 that shows it whole.
CELLS, COARSE = 256, 32


@dataclass(frozen=True)
class OutlineErrors:
    """How far the outline of each photo [I] may be off, pixels.

    Attributes:
        outer: what is further off the mask is not the object; infinite: the mask says nothing.
        inner: what is deeper inside the mask is the object.
    """

    outer: Float[np.ndarray, " i"]
    inner: Float[np.ndarray, " i"]


def mask_depth(mask: Shaped[np.ndarray, "h w"]) -> Float32[np.ndarray, "h w"]:
    """Distance to the outline in pixels, positive on the mask, negative off it; the frame is no outline."""
    import cv2

    on = (mask != 0).astype(np.uint8)
    inside, outside = (cv2.distanceTransform(side, cv2.DIST_L2, cv2.DIST_MASK_PRECISE) for side in (on, 1 - on))
    depth: np.ndarray = np.where(on > 0, inside - 0.5, 0.5 - outside).astype(np.float32)
    return depth


def outline_errors(
    cameras: PinholeCameras, depths: Sequence[Float32[np.ndarray, "_ _"] | None], cloud: PointCloud
) -> OutlineErrors:
    """What the outlines of photos contradict each other by, at the points that the photos see.

    Args:
        depths: `mask_depth` of each photo, None where it has no mask.
        cloud: dense points, in the frame of the cameras.

    Returns:
        Infinite for photos without a mask.
    """
    point = np.repeat(np.arange(len(cloud)), np.diff(cloud.starts))
    lines = np.stack([cloud.photos, point], 1)
    deep = _depths_at(cameras, depths, cloud.points, lines)
    wide = _depths_at(cameras, [None if depth is None else _widest(depth) for depth in depths], cloud.points, lines)
    asked = np.isfinite(deep)
    photo, point, deep, wide = cloud.photos[asked], point[asked], deep[asked], wide[asked]
    believed = np.array([depth is not None for depth in depths])
    for _ in range(ROUNDS):
        voting = believed[photo]
        seen = np.bincount(point[voting], minlength=len(cloud))
        on = np.bincount(point[voting], deep[voting] > 0, minlength=len(cloud)) / np.maximum(seen, 1)
        own, other = (which[point] & (seen >= MIN_SEEN)[point] for which in (on >= OWN, on <= OTHER))
        other &= wide > THICK
        together = _errors(deep[own & voting], deep[other & voting])
        errors = OutlineErrors(*np.full((2, len(cameras)), np.inf))
        for i in (i for i, depth in enumerate(depths) if depth is not None):
            here = photo == i
            few = np.count_nonzero(here & (own | other)) < MIN_POINTS
            errors.outer[i], errors.inner[i] = together if few else _errors(deep[here & own], deep[here & other])
        believed = (errors.outer < MOST) & (errors.inner < MOST)
    return errors


def _errors(own: Float[np.ndarray, " a"], other: Float[np.ndarray, " b"]) -> tuple[float, float]:
    """Outer and inner error by how deep in the masks the object's own points lie, and the other ones."""
    if not len(own):
        return UNKNOWN, UNKNOWN
    outer = max(0.0, -float(np.quantile(own, CONTRADICTED)))
    tried = np.arange(0.0, MOST + 1)
    deeper = [len(each) - np.searchsorted(np.sort(each), [tried, tried + WINDOW]) for each in (own, other)]
    # of all that is deeper in the mask, and of what is so just there
    right = [of_other <= CONTRADICTED * (of_own + of_other) for of_own, of_other in zip(*deeper, strict=True)]
    just = [begin - end for begin, end in deeper]
    right = right[0] & (just[1] <= CONTRADICTED * (just[0] + just[1]))
    return outer + PIXEL, float(tried[right.argmax()]) if right.any() else np.inf


def _widest(depth: Float32[np.ndarray, "h w"]) -> Float32[np.ndarray, "h w"]:
    """How deep the mask is nearby: what stereo misses beside thin parts is no error of theirs."""
    import cv2

    reach = 2 * int(THICK) + 1
    widest: np.ndarray = cv2.dilate(depth, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (reach, reach)))
    return widest


def _depths_at(
    cameras: PinholeCameras,
    depths: Sequence[Float32[np.ndarray, "_ _"] | None],
    points: Float[np.ndarray, "p 3"],
    lines: Int[np.ndarray, "m 2"],
) -> Float[np.ndarray, " m"]:
    """How deep in the photo's mask each line of sight (photo, point) ends; not a number where there is none."""
    found = np.full(len(lines), np.nan)
    for i, depth in enumerate(depths):
        rows = np.flatnonzero(lines[:, 0] == i)
        if depth is not None and len(rows):
            found[rows] = _looked_up(cameras, i, points[lines[rows, 1]], depth)[0]
    return found


def _looked_up(
    cameras: PinholeCameras, index: int, points: Float[np.ndarray, "p 3"], depth: Float32[np.ndarray, "h w"]
) -> tuple[Float[np.ndarray, " p"], Float[np.ndarray, " p"]]:
    """How deep in a photo's mask points lie, not a number out of its frame; and pixels to a scene unit there."""
    camera = cameras.extrinsics[index].astype(np.float32)
    local = points.astype(np.float32) @ camera[:, :3].T + camera[:, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = cameras.intrinsics[index, 0, 0].astype(np.float32) / local[:, 2]
        plane = local[:, :2] / local[:, 2:]
    x, y = (np.floor(plane[:, k] * cameras.intrinsics[index, k, k] + cameras.intrinsics[index, k, 2]) for k in (0, 1))
    height, width = depth.shape
    framed = (local[:, 2] > 0) & (x >= 0) & (x < width) & (y >= 0) & (y < height)
    found = np.full(len(points), np.nan, np.float32)
    found[framed] = depth[y[framed].astype(int), x[framed].astype(int)]
    return found, scale


def object_space(
    cameras: PinholeCameras,
    depths: Sequence[Float32[np.ndarray, "_ _"] | None],
    outer: Float[np.ndarray, " i"],
    cells: int = CELLS,
) -> Bool[np.ndarray, "{cells} {cells} {cells}"]:
    """Where the object may be: cells of a grid over [-1, 1]^3 that hardly any photo shows off its outline.

    A cell counts as off where its middle half is, further than `outer` pixels. What no photo shows may be the object.
    None is outside the unit sphere. Axes are x, y, z.
    """
    ratio = cells // COARSE
    diagonal = np.sqrt(3.0) / cells  # half of it
    coarse = _centers(np.indices([COARSE] * 3).reshape(3, -1).T, COARSE)
    space = _carved(cameras, depths, outer, coarse, np.sqrt(3.0) / COARSE)
    rough = np.argwhere(space.reshape([COARSE] * 3))
    fine = (rough[:, None] * ratio + np.indices([ratio] * 3).reshape(3, -1).T).reshape(-1, 3)
    kept = fine[_carved(cameras, depths, outer, _centers(fine, cells), 0.5 * diagonal)]
    found = np.zeros([cells] * 3, bool)
    found[tuple(kept.T)] = True
    return found


def _centers(indices: Int[np.ndarray, "c 3"], cells: int) -> Float32[np.ndarray, "c 3"]:
    return ((indices + 0.5) * (2.0 / cells) - 1).astype(np.float32)


def _carved(
    cameras: PinholeCameras,
    depths: Sequence[Float32[np.ndarray, "_ _"] | None],
    outer: Float[np.ndarray, " i"],
    centers: Float32[np.ndarray, "c 3"],
    reach: float,
) -> Bool[np.ndarray, " c"]:
    """Which places may be of the object, by what is off all around them, this far (scene units)."""
    kept = np.flatnonzero(np.linalg.norm(centers, axis=1) < 1 + reach)
    seen, off = np.zeros((2, len(centers)), np.int16)
    saying = [i for i, depth in enumerate(depths) if depth is not None and np.isfinite(outer[i])]
    for done, i in enumerate(saying, 1):
        depth = depths[i]
        assert depth is not None
        deep, scale = _looked_up(cameras, i, centers[kept], depth)
        seen[kept] += np.isfinite(deep)
        off[kept] += deep < -outer[i] - reach * scale
        most = seen[kept] + len(saying) - done  # photos that show it, if all that are left do
        kept = kept[off[kept] <= OUTSIDE * most]
    inside = np.zeros(len(centers), bool)
    inside[kept] = True
    return inside
