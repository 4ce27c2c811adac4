"""Whether photos were taken from one place: a camera that only turns shows no depth, however well its photos match.

Structure from motion may still make a model of them, with a wrong focal length and points at any distance.
"""

from __future__ import annotations

import statistics
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from stages.errors import ReconstructionError
from stages.posing.evidence import MIN_VERIFIED

if TYPE_CHECKING:
    from jaxtyping import Float

# Of a photo's longer side: pairs whose matches a turn explains within this were taken from one place. Of a camera that
# was turned, nine pairs of ten stay within 0.12 %; of six walks around something, nine of ten reach 3.8 to 15 %.
MIN_PARALLAX, PAIRS_SHARE = 0.005, 0.9
# Pairs of photos that are looked at, matches of each, and how many pairs it takes to judge.
MAX_PAIRS, MAX_MATCHES, MIN_PAIRS = 2000, 200, 3
# Focal lengths that are tried, in those of the database: without EXIF nobody knows it.
FOCAL_FACTORS = np.geomspace(0.5, 2.0, 9)
STEPS = 8
LEAST = 1e-5  # of the focal length: closer than features are found

Names = tuple[str, str]


class Pair(NamedTuple):
    """Matches of two photos, in focal lengths from their middles, and their longer side in focal lengths."""

    first: Float[np.ndarray, "m 2"]
    second: Float[np.ndarray, "m 2"]
    side: float


def parallaxes(database: Path) -> dict[Names, float]:
    """What turning does not explain of the matches of pairs of photos: their median, in longer sides of a photo.

    With the focal length that explains most, the same factor for all. Pairs are taken evenly of all that matched.
    """
    pairs = _matched(database)
    if len(pairs) < MIN_PAIRS:
        return {}
    found = [[_unexplained(pair, factor) for pair in pairs.values()] for factor in FOCAL_FACTORS]
    return dict(zip(pairs, min(found, key=statistics.median), strict=True))


def check_parallax(database: Path) -> dict[Names, float]:
    """The `parallaxes`; photos that were all taken from one place are refused.

    Raises:
        ReconstructionError: turning alone explains their matches.
    """
    found = parallaxes(database)
    if not found:
        return found
    names = sorted(set().union(*found))
    most = float(np.quantile(list(found.values()), PAIRS_SHARE))
    if most < MIN_PARALLAX:
        raise ReconstructionError(
            f"The {len(names)} photos that match ({names[0]} to {names[-1]}) were taken from one place: a camera that "
            f"only turns explains the matches of most pairs within {100 * most:.2g} % of a photo's longer side (need "
            f"{100 * MIN_PARALLAX:.2g} %), so nothing tells how far things are.",
            "Walk around the subject, a step to the side for each photo, add these photos to the folder, and try "
            "`hineus run PHOTOS --until sfm`.",
        )
    return found


def from_one_place(found: Mapping[Names, float]) -> list[str]:
    """The most photos that one of them, which is among them, shows no parallax to; none where all do."""
    places: dict[str, set[str]] = {}
    for names, parallax in found.items():
        if parallax < MIN_PARALLAX:
            for name in names:
                places.setdefault(name, set()).update(names)
    return sorted(max(places.values(), key=len, default=()))


def _matched(database: Path) -> dict[Names, Pair]:
    """Pairs of photos, by name."""
    import pycolmap

    pairs = {}
    with pycolmap.Database.open(database) as opened:
        lenses = {camera.camera_id: camera for camera in opened.read_all_cameras()}
        images = {image.image_id: image for image in opened.read_all_images()}
        places = {i: _places(opened.read_keypoints(i), lenses[image.camera_id]) for i, image in images.items()}
        pair_ids, counts = opened.read_two_view_geometry_num_inliers()
        enough = [pair for pair, count in zip(pair_ids, counts, strict=True) if count >= 2 * MIN_VERIFIED]
        for pair_id in enough[:: -(-len(enough) // MAX_PAIRS) or 1]:
            first, second = pycolmap.pair_id_to_image_pair(pair_id)
            matches = opened.read_two_view_geometry(first, second).inlier_matches
            matches = matches[:: -(-len(matches) // MAX_MATCHES)]
            lens = lenses[images[first].camera_id]
            pairs[images[first].name, images[second].name] = Pair(
                places[first][matches[:, 0]],
                places[second][matches[:, 1]],
                max(lens.width, lens.height) / lens.mean_focal_length(),
            )
    return pairs


def _places(keypoints: Float[np.ndarray, "k _"], lens: Any) -> Float[np.ndarray, "k 2"]:
    """Features in focal lengths from the photo's middle."""
    return (keypoints[:, :2].astype(np.float64) - np.array([lens.width, lens.height]) / 2) / lens.mean_focal_length()


def _unexplained(pair: Pair, factor: float) -> float:
    """The median distance that the turn with the least sum of distances leaves (iteratively re-weighted squares)."""
    first, second = (_rays(places / factor) for places in pair[:2])
    weights = np.ones(len(first))
    for _ in range(STEPS):
        left, _, right = np.linalg.svd((second * weights[:, None]).T @ first)
        turn = left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right
        misses = np.linalg.norm(second - first @ turn.T, axis=1)
        weights = 1 / np.maximum(misses, LEAST)
    return float(np.median(misses)) * factor / pair.side


def _rays(places: Float[np.ndarray, "m 2"]) -> Float[np.ndarray, "m 3"]:
    """Unit, through places in the plane at distance 1."""
    rays = np.concatenate([places, np.ones((len(places), 1))], axis=1)
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)
