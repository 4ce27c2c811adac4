"""How far depths are to be trusted: the paper's visibility and ambiguity, asked of geometry.

Four neighbours can agree on what is not there: on polished metal they all see the same reflection, at the same depth
behind the surface. Photos from further aside do not. So the judge of a place is the share of all photos which look at
it from within 60 degrees that find it too; and a photo is only asked where nothing that is known stands in between.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from stages.stereo.rectification import View

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Float32

# Depths that differ by less than this part of them agree.
TOLERANCE = 0.008
# The share of photos that must find a place for it to count at all, and to count in full: on polished metal (1 and 3 %
# off) a tenth of the places have more than the middle of the two, on a helmet and a plain plaster part 90 and 65 %.
SUPPORT = (0.15, 0.45)
# Of those that find it or see through it, so many must find it.
UNCONTRADICTED = (0.4, 0.8)
# Trust from which a place hides what is behind it.
KNOWN = 0.5
# Votes are taken at every other pixel, and summed over so many of those to either side: one place has too few.
_STRIDE, _REACH = 2, 4


def trust_of(views: Sequence[View], depths: Sequence[Float32[np.ndarray, "h w"]]) -> list[Float32[np.ndarray, "h w"]]:
    """Trust in [0, 1] of each photo's depths [h, w], 0 where there is none.

    In two rounds: only the first one's trusted places excuse photos from seeing what is behind them in the second.
    """
    nothing = [np.zeros(depth.shape, bool) for depth in depths]
    first = _round(views, depths, nothing)
    return _round(views, depths, [trust > KNOWN for trust in first])


def _round(
    views: Sequence[View], depths: Sequence[np.ndarray], known: Sequence[Bool[np.ndarray, "h w"]]
) -> list[np.ndarray]:
    from stages.stereo import depth_kernels

    matrices = np.stack([v.matrix @ np.c_[v.rotation, -v.rotation @ v.center] for v in views])
    centers = np.stack([view.center for view in views])
    sizes = np.array([view.size for view in views])
    starts = np.concatenate([[0], np.cumsum(sizes.prod(1))])
    all_depths = np.concatenate([depth.ravel() for depth in depths])
    all_known = np.concatenate([each.ravel() for each in known])
    trusts = []
    for owner, (view, depth) in enumerate(zip(views, depths, strict=True)):
        rows, columns = np.nonzero(depth[::_STRIDE, ::_STRIDE] > 0)
        v, u = rows * _STRIDE, columns * _STRIDE
        normals = view_normals(view, depth)[v, u]
        counts = np.zeros((-(-depth.shape[0] // _STRIDE), -(-depth.shape[1] // _STRIDE), 3), np.float32)
        depth_kernels.votes(
            owner, rows, columns, places(view, depth, v, u), normals, matrices, centers, sizes, starts, all_depths,
            all_known, TOLERANCE, counts,
        )  # fmt: skip
        trusts.append(_upsampled(_trust(counts), depth))
    return trusts


def places(view: View, depth: np.ndarray, v: np.ndarray, u: np.ndarray) -> Float[np.ndarray, "n 3"]:
    """Where the pixels of these rows and columns lie, in the frame."""
    pixels = np.stack([u + 0.5, v + 0.5, np.ones(len(u))], 1)
    rays = pixels @ np.linalg.inv(view.matrix).T
    in_frame: np.ndarray = (rays * depth[v, u][:, None]) @ view.rotation + view.center
    return in_frame


def view_normals(view: View, depth: np.ndarray) -> Float[np.ndarray, "h w 3"]:
    """Unit normals of a depth map in the frame, towards the photo; 0 where they are not known."""
    from stages.stereo import depth_kernels

    normals = np.zeros((*depth.shape, 3), np.float32)
    depth_kernels.normals_of(depth, view.matrix[:2], 3, normals)
    in_frame: np.ndarray = normals @ view.rotation.astype(np.float32)
    return in_frame


def _trust(counts: Float[np.ndarray, "a b 3"]) -> np.ndarray:
    """Trust of places from photos that look at them, that agree, that see through, summed over the places around."""
    import cv2

    side = 2 * _REACH + 1
    asked, agree, through = np.moveaxis(cv2.boxFilter(counts, -1, (side, side), normalize=False), -1, 0)
    around = cv2.boxFilter((counts[..., 0] > 0).astype(np.float32), -1, (side, side), normalize=False)
    # one more photo at each place that does not find it: two that agree are not yet a proof
    support = agree / np.maximum(asked + around, 1)
    uncontradicted = agree / np.maximum(agree + through, 1)
    trust: np.ndarray = _ramp(support, *SUPPORT) * _ramp(uncontradicted, *UNCONTRADICTED)
    return trust


def _ramp(value: np.ndarray, low: float, high: float) -> np.ndarray:
    return np.clip((value - low) / (high - low), 0, 1)


def _upsampled(trust: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """To the size of the depth map, 0 where it has none."""
    whole = trust.repeat(_STRIDE, 0).repeat(_STRIDE, 1)[: depth.shape[0], : depth.shape[1]]
    return np.where(depth > 0, whole, 0).astype(np.float32)
