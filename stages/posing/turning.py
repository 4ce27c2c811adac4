"""Whether photos tell of depth: a camera that only turns shows none, however well its photos match, nor does a plane.

Structure from motion may still make a model of them, with a wrong focal length and points at any distance.
"""

from __future__ import annotations

import statistics
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from stages.errors import ReconstructionError
from stages.geometry.plane import fit_plane
from stages.posing.evidence import MIN_VERIFIED
from stages.posing.joining import view_distance

if TYPE_CHECKING:
    from jaxtyping import Float

# Of a photo's longer side: pairs whose matches a turn explains within this were taken from one place. Of a camera that
# was turned, nine pairs of ten stay within 0.12 %; of six walks around something, nine of ten reach 3.8 to 15 %.
MIN_PARALLAX, PAIRS_SHARE = 0.005, 0.9
# Pairs of photos that are looked at, matches of each, and how many pairs it takes to judge.
MAX_PAIRS, MAX_MATCHES, MIN_PAIRS = 1000, 200, 3
# Focal lengths that are tried, in those of the database: without EXIF nobody knows it, and EXIF may be wrong.
FOCAL_FACTORS = np.geomspace(0.5, 2.0, 9)
FINER_FACTORS = np.geomspace(0.87, 1.15, 6)  # then, of the best one
# Seen straight on through a long lens, a step along something flat looks like a turn. Where the focal length that makes
# it one is so many longer sides of a photo, and a homography still explains the matches so much better, it was a step.
LONG_FOCAL, FLAT_GAIN = 1.2, 1.5
# Of the longer side: a homography explains four of five matches of nine pairs of ten within this where all is flat, or
# where a camera turned or zoomed. Of flat things 0.08 to 0.16 %, of five captures of objects 3.6 % and more.
FLAT, FLAT_MATCHES = 0.003, 0.8
HOMOGRAPHY_ERROR, HOMOGRAPHY_PAIRS = 0.004, 200  # of the longer side; pairs that are looked at
SAME_PLACE = 0.02  # of the distance to what is seen: steps shorter than this tell next to nothing of it
PLANE_FITS, POINTS_SHARE = 3, 0.9
STEPS, ZOOM_STEPS, MAX_ZOOM = 8, 12, 8.0
LEAST = 1e-5  # of the focal length: closer than features are found

Names = tuple[str, str]


class Pair(NamedTuple):
    """Matches of two photos, in focal lengths from their middles, and their longer side in focal lengths."""

    first: Float[np.ndarray, "m 2"]
    second: Float[np.ndarray, "m 2"]
    side: float


@dataclass(frozen=True)
class Depth:
    """What the matches of pairs of photos tell of depth.

    Attributes:
        parallaxes: what turning does not explain of their matches: the median, in longer sides of a photo, with the
            focal length that explains most, the same factor for all. None where pairs are too few, or where a step
            along something flat cannot be told from a turn.
        zoomed: the same where a camera may have zoomed, too; None where that was not asked.
        is_flat: whether homographies explain nearly all matches.
    """

    parallaxes: Mapping[Names, float]
    zoomed: Mapping[Names, float] = field(default_factory=dict)
    is_flat: bool = False

    @property
    def from_one_place(self) -> bool:
        """Whether turning alone, or turning and zooming, explains the matches."""
        return any(map(_shows_none, (self.parallaxes, self.zoomed)))


def judge_depth(database: Path) -> Depth:
    """Look at pairs of photos, taken evenly of all that matched."""
    pairs, focal_known = _matched(database)
    if len(pairs) < MIN_PAIRS:
        return Depth({})
    factor, turned = _by_turning(pairs)
    few = dict(list(pairs.items())[:: -(-len(pairs) // HOMOGRAPHY_PAIRS)])
    by_homography = np.array([_by_homography(pair) for pair in few.values()])
    middle, most = np.quantile(by_homography, PAIRS_SHARE, axis=0)
    is_flat = bool(most < FLAT)

    def is_a_step(factor: float, found: Mapping[Names, float]) -> bool:
        """Where a turn would explain it, too."""
        focal = statistics.median(factor / pair.side for pair in few.values())
        return is_flat and focal > LONG_FOCAL and _most(found) > FLAT_GAIN * middle

    zoomed: Mapping[Names, float] = {}
    if is_flat and not focal_known and _most(turned) >= MIN_PARALLAX:
        zoom_factor, zoomed = _by_zooming(few)
        zoomed = {} if is_a_step(zoom_factor, zoomed) else zoomed
    return Depth({} if is_a_step(factor, turned) else turned, zoomed, is_flat)


def refuse_one_place(depth: Depth) -> None:
    """Refuse photos that were all taken from one place.

    Raises:
        ReconstructionError: turning alone, or turning and zooming, explains their matches.
    """
    for found, did in ((depth.parallaxes, "turns"), (depth.zoomed, "turns and zooms")):
        if not _shows_none(found):
            continue
        names = sorted(set().union(*found))
        flat = " (or something flat was photographed from straight ahead, nearer and nearer)" if "zooms" in did else ""
        raise ReconstructionError(
            f"The {len(names)} photos that match ({names[0]} to {names[-1]}) were taken from one place: a camera that "
            f"only {did} explains the matches of most pairs within {100 * _most(found):.2g} % of a photo's longer side "
            f"(need {100 * MIN_PARALLAX:.2g} %), so nothing tells how far things are{flat}.",
            "Walk around the subject, a step to the side for each photo, add these photos to the folder, and try "
            "`hineus run PHOTOS --until sfm`.",
        )


def _shows_none(found: Mapping[Names, float]) -> bool:
    return bool(found) and _most(found) < MIN_PARALLAX


def _most(found: Mapping[Names, float]) -> float:
    return float(np.quantile(list(found.values()), PAIRS_SHARE))


def _by_turning(pairs: Mapping[Names, Pair]) -> tuple[float, dict[Names, float]]:
    """The factor of the focal lengths with which turning explains most, and what it leaves of each pair."""
    tried: dict[float, list[float]] = {}
    for factors in (FOCAL_FACTORS, FINER_FACTORS):
        best = min(tried, key=lambda factor: statistics.median(tried[factor]), default=1.0)
        for factor in (best * factors).tolist():
            tried[factor] = [_unexplained(pair, factor) for pair in pairs.values()]
    best = min(tried, key=lambda factor: statistics.median(tried[factor]))
    return best, dict(zip(pairs, tried[best], strict=True))


def _by_zooming(pairs: Mapping[Names, Pair]) -> tuple[float, dict[Names, float]]:
    """The same where each photo may have a focal length of its own; the factor is the middle one."""
    found = [
        min((_unexplained(pair, factor, zoom=True), factor) for factor in FOCAL_FACTORS) for pair in pairs.values()
    ]
    return statistics.median(f for _, f in found), {names: left for names, (left, _) in zip(pairs, found, strict=True)}


def from_one_place(found: Mapping[Names, float]) -> list[str]:
    """The most photos that one of them, which is among them, shows no parallax to, and those that belong to them.

    Not every pair was matched. A photo belongs to others where at least `MIN_PAIRS` pairs with them were, and nearly
    all of these show no parallax: on a dense walk pairs of neighbours show none, and others do.

    Returns:
        Names, sorted; none where all pairs show parallax.
    """
    partners: dict[str, dict[str, bool]] = {}  # photo -> partner -> whether they show no parallax
    for (first, second), parallax in found.items():
        partners.setdefault(first, {})[second] = parallax < MIN_PARALLAX
        partners.setdefault(second, {})[first] = parallax < MIN_PARALLAX
    stars = ({name, *still} for name, of in sorted(partners.items()) if (still := [k for k in of if of[k]]))
    place = max(stars, key=len, default=set[str]())
    grown = {""}
    while grown:
        seen = {name: [still for k, still in of.items() if k in place] for name, of in partners.items()}
        grown = {
            name
            for name, pairs in seen.items()
            if name not in place and len(pairs) >= MIN_PAIRS and sum(pairs) >= PAIRS_SHARE * len(pairs)
        }
        place |= grown
    return sorted(place)


def two_places(model: Any) -> tuple[list[str], list[str]]:
    """Names of the photos of a pycolmap model at the two places where most were taken."""
    photos = sorted((model.images[i] for i in model.reg_image_ids()), key=lambda image: image.name)
    centers = np.array([photo.projection_center() for photo in photos])
    near = np.linalg.norm(centers[:, None] - centers, axis=-1) < SAME_PLACE * view_distance(model)
    found = []
    for _ in range(2):
        place = near[near.sum(1).argmax()].copy()
        found.append([photo.name for photo, taken in zip(photos, place, strict=True) if taken])
        near[place], near[:, place] = False, False
    return found[0], found[1]


def relief(model: Any) -> float:
    """How far a pycolmap model's points lie off one plane, in the distance from which they are seen.

    That of nine of ten of those that are seen in three photos and more; the rest may be wrong. 0 without such points.
    """
    points = np.array([point.xyz for point in model.points3D.values() if point.track.length() > 2]).reshape(-1, 3)
    if len(points) < 3:
        return 0.0
    heights = np.zeros(len(points))
    for _ in range(PLANE_FITS):
        normal, offset = fit_plane(points[heights <= np.quantile(heights, POINTS_SHARE)], np.array([0.0, 0.0, 1.0]))
        heights = np.abs(points @ normal - offset)
    return float(np.quantile(heights, POINTS_SHARE)) / view_distance(model)


def _matched(database: Path) -> tuple[dict[Names, Pair], bool]:
    """Pairs of photos, by name; and whether the focal lengths of most are known, as from EXIF."""
    import pycolmap

    pairs = {}
    with pycolmap.Database.open(database) as opened:
        lenses = {camera.camera_id: camera for camera in opened.read_all_cameras()}
        images = {image.image_id: image for image in opened.read_all_images()}
        known = [lenses[image.camera_id].has_prior_focal_length for image in images.values()]
        pair_ids, counts = opened.read_two_view_geometry_num_inliers()
        enough = [pair for pair, count in zip(pair_ids, counts, strict=True) if count >= 2 * MIN_VERIFIED]
        for pair_id in enough[:: -(-len(enough) // MAX_PAIRS) or 1]:
            first, second = pycolmap.pair_id_to_image_pair(pair_id)
            matches = opened.read_two_view_geometry(first, second).inlier_matches
            matches = matches[:: -(-len(matches) // MAX_MATCHES)]
            lens, other = (lenses[images[i].camera_id] for i in (first, second))
            pairs[images[first].name, images[second].name] = Pair(
                _places(opened.read_keypoints(first)[matches[:, 0]], lens),
                _places(opened.read_keypoints(second)[matches[:, 1]], other),
                max(lens.width, lens.height) / lens.mean_focal_length(),
            )
    return pairs, 2 * sum(known) > len(known)


def _places(keypoints: Float[np.ndarray, "k _"], lens: Any) -> Float[np.ndarray, "k 2"]:
    """Features in focal lengths from the photo's middle."""
    return (keypoints[:, :2].astype(np.float64) - np.array([lens.width, lens.height]) / 2) / lens.mean_focal_length()


def _unexplained(pair: Pair, factor: float, zoom: bool = False) -> float:
    """The median distance that the turn with the least sum of distances leaves (iteratively re-weighted squares).

    Args:
        factor: of the focal lengths of both photos. zoom: the second one's may be any.
    """
    first, ratio = _rays(pair.first / factor), _spread(pair.second) / _spread(pair.first) if zoom else 1.0
    weights = np.ones(len(first))
    for _ in range(ZOOM_STEPS if zoom else STEPS):
        second = _rays(pair.second / (factor * ratio))
        left, _, right = np.linalg.svd((second * weights[:, None]).T @ first)
        turn = left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right
        turned = first @ turn.T
        weights = 1 / np.maximum(np.linalg.norm(second - turned, axis=1), LEAST)
        if zoom:
            seen = turned[:, :2] / np.maximum(turned[:, 2:], LEAST) * factor
            ratio = float((weights[:, None] * seen * pair.second).sum() / (weights[:, None] * seen**2).sum())
            ratio = min(max(ratio, 1 / MAX_ZOOM), MAX_ZOOM)
    return float(np.median(1 / weights)) * factor * ratio / pair.side


def _spread(places: Float[np.ndarray, "m 2"]) -> float:
    return float(np.median(np.linalg.norm(places - np.median(places, axis=0), axis=1))) + LEAST


def _by_homography(pair: Pair) -> tuple[float, float]:
    """The median distance that the best homography leaves, and that of `FLAT_MATCHES` of the matches."""
    import cv2

    cv2.setRNGSeed(0)
    found, _ = cv2.findHomography(pair.first, pair.second, cv2.RANSAC, HOMOGRAPHY_ERROR * pair.side)
    if found is None:
        return np.inf, np.inf
    there = cv2.perspectiveTransform(pair.first[None], found)[0]
    median, most = np.quantile(np.linalg.norm(there - pair.second, axis=1), (0.5, FLAT_MATCHES))
    return float(median) / pair.side, float(most) / pair.side


def _rays(places: Float[np.ndarray, "m 2"]) -> Float[np.ndarray, "m 3"]:
    """Unit, through places in the plane at distance 1."""
    rays = np.concatenate([places, np.ones((len(places), 1))], axis=1)
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)
