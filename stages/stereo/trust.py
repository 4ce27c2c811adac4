"""How far depths are to be trusted: the paper's visibility and ambiguity, asked of geometry.

Four neighbours can agree on what is not there: on polished metal they all see the same reflection, at the same depth
behind the surface. Photos from further aside do not. So the judge of a place is the share of all photos which look at
it from within 60 degrees that find it too; and a photo is only asked where nothing that is known stands in between.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from stages.stereo.rectification import View, tolerance_of

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Float32, Int, UInt8

# Depths of two photos agree within this many times what those of one photo's pairs agree within.
TOLERANCES = 2.0
# The share of photos that must find a place for it to count at all, and to count in full: on polished metal (1 and 3 %
# off) a tenth of the places have more than the middle of the two, on a helmet and a plain plaster part 90 and 65 %.
SUPPORT = (0.15, 0.45)
# Of those that find it or see through it, so many must find it.
UNCONTRADICTED = (0.4, 0.8)
# How many times as far apart as usual what photos find may lie for a place to count in full, and not at all: on a small
# polished cap 2.0 times, and less than 1.3 at one place in twenty; on a helmet and a plain plaster part one in twenty
# has more than 1.5 and 1.7.
SCATTER = (1.6, 1.8)
# What is usual is at least this part of the tolerance: with perfect poses and pixels, a little more is no sign.
LEAST_SCATTER = 0.15
# Of the photos that agree on a place, the share whose own depths there scatter too much: up to the first it counts in
# full, from the second on not at all. It is a half on what is left of the cap; one in twenty places of the plaster part
# has more than 0.15, of the helmet 0.06.
DOUBTED = (0.3, 0.5)
# Both are believed as far as n^2 / (n^2 + FEW), of n photos that are asked: of one or two, many are off by chance. By
# those asked, not by those that agree: where few of many agree, that these scatter is no chance. Squared, for with n
# the suite's mirror would get back a third of the trust that it loses.
FEW = 2
# Trust from which a place hides what is behind it.
KNOWN = 0.5
# So many photos are asked at most of what one shows, and so many of its places choose them: the cost is to grow with
# the photos, not with their square.
MOST_ASKED, SAMPLE = 64, 200
# Votes are taken at every other pixel, and summed over so many of those to either side: one place has too few.
_STRIDE, _REACH = 2, 4
# Pixels to either side that a normal is fitted to.
_REACH_NORMAL = 3


@dataclass(frozen=True)
class _Photos:
    """All photos as the compiled loop reads them, see `depth_kernels.votes`; and which have any depth."""

    matrices: Float[np.ndarray, "i 3 4"]
    centers: Float[np.ndarray, "i 3"]
    sizes: Int[np.ndarray, "i 2"]
    starts: Int[np.ndarray, " i+1"]
    depths: Float32[np.ndarray, " all"]
    tolerances: Float[np.ndarray, " i"]
    find: Bool[np.ndarray, " i"]


def trust_of(views: Sequence[View], depths: list[Float32[np.ndarray, "h w"]]) -> list[Float32[np.ndarray, "h w"]]:
    """Trust in [0, 1] of each photo's depths [h, w], 0 where there is none.

    In two rounds: only the first one's trusted places excuse photos from seeing what is behind them in the second.

    Args:
        depths: they become views of one array: all of them would be a large part of the memory to hold twice.
    """
    sizes = np.array([view.size for view in views]).reshape(-1, 2)
    photos = _Photos(
        matrices=np.stack([v.matrix @ np.c_[v.rotation, -v.rotation @ v.center] for v in views]),
        centers=np.stack([view.center for view in views]),
        sizes=sizes,
        starts=np.concatenate([[0], np.cumsum(sizes.prod(1))]),
        depths=_in_one(depths),
        tolerances=np.array([TOLERANCES * tolerance_of(view) for view in views]),
        find=np.array([(depth > 0).any() for depth in depths]),
    )
    owned = list(enumerate(zip(views, depths, strict=True)))
    nothing = np.zeros(len(photos.depths), np.uint8)
    first = []
    for k, each in owned:
        trust, scatter, asked = _judged(k, *each, photos, nothing, np.inf)
        first.append((scatter.astype(np.float16), np.where(trust > KNOWN, asked, 0).astype(np.float16)))
    usual = _usual([scatter[asked > 0] for scatter, asked in first])
    known = np.concatenate([_known(*each, usual, depth).ravel() for each, depth in zip(first, depths, strict=True)])
    return [_upsampled(_judged(k, *each, photos, known, usual)[0], depths[k]) for k, each in owned]


def _usual(scatters: Sequence[Float[np.ndarray, " n"]]) -> float:
    """Scatter of the set's trusted places, the median of the photos' medians; infinite where nothing is trusted."""
    medians = [np.median(known) for known in scatters if len(known)]
    return max(LEAST_SCATTER, float(np.median(medians))) if medians else np.inf


def _known(
    scatter: Float[np.ndarray, "a b"],
    asked: Float[np.ndarray, "a b"],
    usual: float,
    depth: Float32[np.ndarray, "h w"],
) -> UInt8[np.ndarray, "h w"]:
    """1 where a place is known to be there, INEXACT where its scatter is more than is usual, 0 elsewhere.

    Args:
        scatter, asked: see `_trust`; none asked where it is not known.
    """
    from stages.stereo.depth_kernels import INEXACT

    inexact = _times_usual(scatter, asked, usual) > SCATTER[0]
    return _upsampled(np.where(inexact, INEXACT, 1) * (asked > 0), depth).astype(np.uint8)


def _times_usual(
    scatter: Float[np.ndarray, "a b"], asked: Float[np.ndarray, "a b"], usual: float
) -> Float[np.ndarray, "a b"]:
    """Scatter as a multiple of what is usual, the nearer to 1 the fewer photos are asked."""
    believed = _believed(asked)
    squares: np.ndarray = believed * (scatter / usual) ** 2 + 1 - believed
    return np.sqrt(squares)


def _believed(asked: Float[np.ndarray, "a b"]) -> Float[np.ndarray, "a b"]:
    return asked**2 / (asked**2 + FEW)


def _in_one(maps: list[Float32[np.ndarray, "h w"]]) -> Float32[np.ndarray, " all"]:
    """All maps one after the other, and each of the list a view of its part."""
    whole, start = np.empty(sum(each.size for each in maps), np.float32), 0
    for k, each in enumerate(maps):
        part = whole[start : start + each.size].reshape(each.shape)
        part[:] = each
        maps[k] = part
        start += each.size
    return whole


def _judged(
    owner: int,
    view: View,
    depth: Float32[np.ndarray, "h w"],
    photos: _Photos,
    known: UInt8[np.ndarray, " all"],
    usual: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Trust, scatter and photos asked [a, b] of every other of one photo's pixels, where places `known` to be there
    hide what is behind them; see `_known` and `_trust`."""
    from stages.stereo import depth_kernels

    rows, columns = np.nonzero(depth[::_STRIDE, ::_STRIDE] > 0)
    v, u = rows * _STRIDE, columns * _STRIDE
    at = places(view, depth, v, u)
    found = np.zeros((len(at), 5), np.float32)
    depth_kernels.votes(
        view.center, _asked(owner, at, photos), at, normals_at(view, depth, v, u), photos.matrices, photos.centers,
        photos.sizes, photos.starts, photos.depths, known, photos.tolerances, found,
    )  # fmt: skip
    counts = np.zeros((-(-depth.shape[0] // _STRIDE), -(-depth.shape[1] // _STRIDE), 5), np.float32)
    counts[rows, columns] = found
    return _trust(counts, usual)


def _asked(owner: int, at: Float[np.ndarray, "n 3"], photos: _Photos) -> Int[np.ndarray, " j"]:
    """The photos to ask of a photo's places: those that have some of them before them and found anything at all."""
    some = at[:: max(1, len(at) // SAMPLE)]
    pixels = some @ photos.matrices[:, :, :3].transpose(0, 2, 1) + photos.matrices[:, None, :, 3]
    depth = np.maximum(pixels[..., 2:], 1e-12)
    inside = (pixels[..., 2] > 0) & ((pixels[..., :2] >= 0) & (pixels[..., :2] < depth * photos.sizes[:, None])).all(-1)
    asked = np.flatnonzero(inside.any(1) & photos.find & (np.arange(len(inside)) != owner))
    few = np.linspace(0, len(asked) - 1, min(len(asked), MOST_ASKED)).astype(np.int64)
    return asked[few]


def places(
    view: View, depth: Float32[np.ndarray, "h w"], v: Int[np.ndarray, " n"], u: Int[np.ndarray, " n"]
) -> Float[np.ndarray, "n 3"]:
    """Where the pixels of these rows and columns lie, in the frame."""
    pixels = np.stack([u + 0.5, v + 0.5, np.ones(len(u))], 1)
    rays = pixels @ np.linalg.inv(view.matrix).T
    in_frame: np.ndarray = (rays * depth[v, u][:, None]) @ view.rotation + view.center
    return in_frame


def normals_at(
    view: View, depth: Float32[np.ndarray, "h w"], v: Int[np.ndarray, " n"], u: Int[np.ndarray, " n"]
) -> Float32[np.ndarray, "n 3"]:
    """Unit normals in the frame of the pixels of these rows and columns, towards the photo; 0 where not known."""
    from stages.stereo import depth_kernels

    normals = np.empty((len(v), 3), np.float32)
    depth_kernels.normals_at(depth, v, u, view.matrix, _REACH_NORMAL, normals)
    in_frame: np.ndarray = normals @ view.rotation.astype(np.float32)
    return in_frame


def _trust(counts: Float32[np.ndarray, "a b 5"], usual: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Trust, scatter and photos asked [a, b] of places, from the votes on them and on the places around.

    The scatter is how far photos that agree are from the place, a root mean square in parts of the tolerance. What is
    seen in a small convex mirror lies at almost the same place for all of them, but only almost.

    Args:
        counts: see `depth_kernels.votes`.
        usual: scatter of the set's trusted places.
    """
    import cv2

    side = 2 * _REACH + 1
    votes = np.dstack([counts, np.float32(counts[..., 0] > 0)])
    asked, agree, through, apart, doubted, around = np.moveaxis(
        cv2.boxFilter(votes, -1, (side, side), normalize=False), -1, 0
    )
    # one more photo at each place that does not find it: two that agree are not yet a proof
    support = agree / np.maximum(asked + around, 1)
    uncontradicted = agree / np.maximum(agree + through, 1)
    scatter = np.sqrt(np.maximum(apart, 0) / np.maximum(agree, 1))  # sums over moving windows end a little below 0
    trust = _ramp(support, *SUPPORT) * _ramp(uncontradicted, *UNCONTRADICTED)
    asked = asked / np.maximum(around, 1)
    trust *= 1 - _ramp(_times_usual(scatter, asked, usual), *SCATTER)
    trust *= 1 - _ramp(_believed(asked) * doubted / np.maximum(agree, 1), *DOUBTED)
    alone = (counts[..., 1] == 0) | (counts[..., 2] > counts[..., 1])
    trust[alone] = 0  # at an outline, what is around does not speak for it
    return trust, scatter, asked


def _ramp(value: np.ndarray, low: float, high: float) -> np.ndarray:
    return np.clip((value - low) / (high - low), 0, 1)


def _upsampled(trust: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """To the size of the depth map, 0 where it has none."""
    whole = trust.repeat(_STRIDE, 0).repeat(_STRIDE, 1)[: depth.shape[0], : depth.shape[1]]
    return np.where(depth > 0, whole, 0).astype(np.float32)
