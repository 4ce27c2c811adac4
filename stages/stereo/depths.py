"""Photos to depth maps: each pair compared once, for both of its photos; kept is what several pairs agree on."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from stages.geometry.cameras import PinholeCameras
from stages.stereo.matching import disparities, evened, in_pixels, warped
from stages.stereo.rectification import Rectified, View, rectify, tolerance_of

if TYPE_CHECKING:
    from jaxtyping import Float, Float32, Int, Int16, UInt8

# Of the pairs that know a depth, so many must agree; and never fewer than two.
MAJORITY = 0.6


@dataclass(frozen=True)
class _Compared:
    """What a pair was found to be: its plane, and OpenCV's disparities of the left photo."""

    left: int
    right: int
    plane: Rectified
    disparities: Int16[np.ndarray, "a b"]


def views_of(cameras: PinholeCameras, side: int) -> list[View]:
    """The cameras at the size at which they are compared: no longer than `side`, and never enlarged."""
    views = []
    for k, (width, height) in enumerate(cameras.sizes.tolist()):
        scale = min(1.0, side / max(width, height))
        size = (round(width * scale), round(height * scale))
        matrix = np.diag([size[0] / width, size[1] / height, 1]) @ cameras.intrinsics[k]
        views.append(View(matrix, cameras.extrinsics[k, :, :3], cameras.centers[k], size))
    return views


def depth_maps(
    views: Sequence[View],
    greys: Sequence[UInt8[np.ndarray, "h w"]],
    pairs: Sequence[tuple[int, int]],
    points_seen: Sequence[Float[np.ndarray, "p 3"]],
    workers: int,
    progress: Callable[[int], None],
) -> list[Float32[np.ndarray, "h w"]]:
    """Depth along the optical axis of each photo's pixels, in units of the frame; 0 where no two pairs agree on one.

    Args:
        points_seen: the known points that each photo sees; they tell between which depths to search.
        progress: called with the number of photos that are done.
    """
    maps: dict[int, np.ndarray] = {}
    with ThreadPoolExecutor(max_workers=max(1, workers)) as pool:
        for k, compared in _by_photo(_along(pairs, len(views)), greys, views, pairs, points_seen, pool):
            maps[k] = _agreed(views[k], list(pool.map(partial(_depth, k, views[k]), compared)))
            progress(len(maps))
    return [maps[k] for k in range(len(views))]


def _along(pairs: Sequence[tuple[int, int]], count: int) -> Int[np.ndarray, " n"]:
    """An order of the photos in which those of a pair come soon after each other: few pairs are held at a time."""
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import reverse_cuthill_mckee

    left, right = np.array(pairs, np.int64).reshape(-1, 2).T
    graph = csr_array((np.ones(len(left)), (left, right)), shape=(count, count))
    return reverse_cuthill_mckee((graph + graph.T).tocsr(), symmetric_mode=True)


def _by_photo(
    order: Int[np.ndarray, " n"],
    greys: Sequence[UInt8[np.ndarray, "h w"]],
    views: Sequence[View],
    pairs: Sequence[tuple[int, int]],
    points_seen: Sequence[Float[np.ndarray, "p 3"]],
    pool: ThreadPoolExecutor,
) -> Iterator[tuple[int, list[_Compared]]]:
    """Each photo in this order, with its pairs; one is compared for its first photo, forgotten after the second."""
    of_photo = defaultdict(list)
    for pair in pairs:
        for k in pair:
            of_photo[k].append(pair)
    known: dict[tuple[int, int], _Compared | None] = {}

    def compare(pair: tuple[int, int]) -> _Compared | None:
        left, right = pair
        plane = rectify(views[left], views[right], np.concatenate([points_seen[left], points_seen[right]]))
        if plane is None:
            return None
        turned = [warped(greys[k], views[k], plane, k == right) for k in pair]
        return _Compared(left, right, plane, disparities(*evened(*turned), plane))

    turn = np.argsort(order)
    for k in order.tolist():
        new = [pair for pair in of_photo[k] if pair not in known]
        known.update(zip(new, pool.map(compare, new), strict=True))
        yield k, [compared for pair in of_photo[k] if (compared := known[pair]) is not None]
        for pair in of_photo[k]:
            if turn[list(pair)].max() == turn[k]:
                del known[pair]


def _depth(photo: int, view: View, pair: _Compared) -> Float32[np.ndarray, "h w"]:
    """What a pair says of the depth of one of its photos' pixels, [h, w]; 0 where nothing."""
    from stages.stereo import depth_kernels

    plane, right = pair.plane, pair.right == photo
    found = in_pixels(pair.disparities, plane)
    depth = np.empty(view.size[::-1], np.float32)
    depth_kernels.depths_of(
        depth_kernels.seen_from_right(found) if right else found,
        plane.turn @ view.rotation.T @ np.linalg.inv(view.matrix),
        plane.focal,
        plane.left_x - (plane.shift if right else 0.0),
        plane.top,
        plane.focal * plane.base,
        plane.shift,
        depth,
    )
    return depth


def _agreed(view: View, known: Sequence[Float32[np.ndarray, "h w"]]) -> Float32[np.ndarray, "h w"]:
    """The depth [h, w] on which most of some maps agree; 0 where too few do."""
    from stages.stereo import depth_kernels

    depth = np.zeros(view.size[::-1], np.float32)
    if len(known) >= 2:
        needed = np.array([max(2, int(np.ceil(MAJORITY * count))) for count in range(len(known) + 1)])
        depth_kernels.agreed(np.stack(known), tolerance_of(view), needed, depth)
    return depth
