"""Which part of the world is reconstructed: a sphere, found from cameras, sparse points and masks.

Cameras and points are given in the frame of the poses.

Two kinds of capture:
- "object": the cameras look at one place. The sphere is centred where their optical axes meet and a little
  larger than what the views show whole; where silhouettes are known, it encloses their visual hull instead.
- "forward": the optical axes are nearly parallel (a facade, a survey flight), meet behind the cameras (a room), meet in
  empty space (a room from its walls), or only come near each other (a survey flight with oblique photos).

Either holds the sparse points that the photos are about (`attention`): what is larger than the frame, off its middle,
or seen from one side only. Rather too large than too small: what lies outside is lost.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from stages.geometry.cameras import PinholeCameras
from stages.geometry.hull import visual_hull_sphere
from stages.geometry.plane import Plane

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Shaped

# Axes that spread less than this (root mean square angle to their mean) are "nearly parallel".
MIN_AXIS_SPREAD_DEG = 8.0
# The meeting point must lie in front of this part of the cameras ...
MIN_IN_FRONT = 0.8
# ... and the axes must pass it within this part of its distance (median): else they do not meet.
MAX_MISS_RATIO = 0.5
# They meet in an object only if they also pass through what the photos show of it whole: the median miss is at most
# this part of the seen-whole radius. On six captures of objects it was 0.004 to 0.18, on an oblique flight 1.1.
MAX_MISS_OF_SEEN = 0.5
# There is something where they meet: of the points in the middle of the photos (half the width and height), this part
# at least lies at that distance (give or take half of it). Fewer points than this say nothing of the whole.
MIN_PRESENT, PRESENT_DEPTHS, MIN_JUDGED = 0.03, (0.5, 1.5), 100
MAX_JUDGED = 4000
# The sphere of an object capture comes from the median of the largest spheres each camera sees whole, but is
# no smaller than this part of the distance to the cameras (close-ups see little whole).
MIN_RADIUS_RATIO = 0.05
# People fill the frame with the object, and its far ends stick out of the largest sphere the short side shows:
# on three captures with known geometry they reached 0.95, 1.04 and 1.14 of its radius. Enlarged by this.
SEEN_WHOLE_MARGIN = 1.2
# What stands on the ground rises above it by this part of the region's radius: three times what is taken for ground.
STANDING = 0.03
# What stands on the same ground beyond a gap wider than this, in radii of the region, is something else.
MAX_GAP = 0.4
# The ends of a subject, which fewer photos see, reach beyond the points on it: those of an object, which photos leave
# above and below, and those of a forward capture, which goes on at its sides.
ATTENDED_MARGIN, FORWARD_MARGIN = 1.25, 1.12
# Free space around silhouettes' visual hull: 10 % of the radius.
HULL_MARGIN = 1.1
# In a room points lie all around the cameras: their directions from the cameras' middle cancel to less than this.
MAX_ONE_SIDED = 0.5
# All of it was photographed, but for what is farther from the nearest camera than this many times the median.
FORWARD_DEPTHS = 4.0
# Points with fewer neighbours than this within this part of their median distance from the middle are wrong.
MIN_NEIGHBOURS, MAX_ISOLATION = 2, 0.7
ENCLOSING_STEPS, MAX_OUTER = 1000, 5000
FROM_FRUSTA, FROM_ATTENTION, FROM_POINTS = "the frusta of the cameras", "what the photos look at", "the sparse points"
IRLS_STEPS = 30
TINY = 1e-12  # keeps divisions finite; far below any length that occurs


@dataclass(frozen=True)
class RegionOfInterest:
    """The sphere that becomes the unit sphere.

    Attributes:
        center: in the frame of the poses.
        radius: in its units.
        kind: "object" or "forward".
        source: what the sphere was found from, in words.
    """

    center: Float[np.ndarray, " 3"]
    radius: float
    kind: str
    source: str


def meeting_point(
    origins: Float[np.ndarray, "n 3"], directions: Float[np.ndarray, "n 3"]
) -> tuple[Float[np.ndarray, " 3"], Float[np.ndarray, " n"]]:
    """Point with the least summed distance to lines (L1, by iteratively re-weighted squares).

    Minimises sum_i |(I - d_i d_i^T)(p - o_i)|; L1 so that a few photos taken of something else do not count.

    Args:
        origins: a point of each line.
        directions: unit.

    Returns:
        The point and each line's distance to it.

    Raises:
        ValueError: fewer than two lines, or all of them parallel.
    """
    if len(origins) < 2:
        raise ValueError(f"got {len(origins)} lines, expected at least 2")
    projectors = np.eye(3) - directions[:, :, None] * directions[:, None, :]
    if np.linalg.eigvalsh(projectors.mean(0))[0] < TINY:
        raise ValueError("got parallel lines, expected lines that meet")
    weights = np.ones(len(origins))
    scale = np.linalg.norm(origins - origins.mean(0), axis=1).max() + TINY
    for _ in range(IRLS_STEPS):
        normal = np.einsum("n,nij->ij", weights, projectors)
        point = np.linalg.solve(normal, np.einsum("n,nij,nj->i", weights, projectors, origins))
        misses = np.linalg.norm(np.einsum("nij,nj->ni", projectors, point - origins), axis=1)
        weights = 1.0 / np.maximum(misses, 1e-4 * scale)
    return point, misses


def axis_spread_deg(directions: Float[np.ndarray, "n 3"]) -> float:
    """Root mean square angle in degrees of unit directions to their principal axis (sign ignored)."""
    largest = np.linalg.eigvalsh(directions.T @ directions / len(directions))[-1]
    return float(np.degrees(np.arcsin(np.sqrt(np.clip(1.0 - largest, 0.0, 1.0)))))


def seen_whole_radii(cameras: PinholeCameras, center: Float[np.ndarray, " 3"]) -> Float[np.ndarray, " n"]:
    """Radius of the largest sphere about `center` that each camera sees whole.

    The least distance from the centre to the four side planes of the frustum; <= 0 where the centre itself is
    out of view.
    """
    radii = np.empty(len(cameras))
    for i in range(len(cameras)):
        in_cam = cameras.extrinsics[i, :, :3] @ center + cameras.extrinsics[i, :, 3]
        K, (width, height) = cameras.intrinsics[i], cameras.sizes[i]
        left, right = -K[0, 2] / K[0, 0], (width - K[0, 2]) / K[0, 0]
        top, bottom = -K[1, 2] / K[1, 1], (height - K[1, 2]) / K[1, 1]
        # inward normals of the planes x = left * z and so on
        planes = np.array([[1, 0, -left], [-1, 0, right], [0, 1, -top], [0, -1, bottom]])
        radii[i] = (planes @ in_cam / np.linalg.norm(planes, axis=1)).min()
        if in_cam[2] <= 0:
            radii[i] = min(radii[i], 0.0)
    return radii


def present_share(cameras: PinholeCameras, points: Float[np.ndarray, "p 3"], place: Float[np.ndarray, " 3"]) -> float:
    """Part of the points in the middle of the photos that lie about as far away as `place`; median photo."""
    thinned = points[:: -(-len(points) // MAX_JUDGED)]
    shares = []
    for i, distance in enumerate(np.linalg.norm(cameras.centers - place, axis=1)):
        pixels, depth = cameras.project(i, thinned)
        central = (depth > 0) & (np.abs(pixels / cameras.sizes[i] - 0.5) < 0.25).all(1)
        low, high = PRESENT_DEPTHS
        if central.any():
            shares.append(np.mean((depth[central] > low * distance) & (depth[central] < high * distance)))
    return float(np.median(shares)) if shares else 0.0


def find_region(
    cameras: PinholeCameras,
    points: Float[np.ndarray, "p 3"],
    about: Bool[np.ndarray, " p"] | None = None,
    masks: Sequence[Shaped[np.ndarray, "_ _"] | None] | None = None,
    stated: RegionOfInterest | None = None,
) -> RegionOfInterest:
    """The sphere the capture is about; of an object, see `grown_over`, too.

    Args:
        cameras: at least two, in the frame of the poses.
        points: sparse points, likewise.
        about: which of them the photos are about, see `attention.attended`; None: nobody knows.
        masks: one silhouette per camera (or None for it), or None without masks.
        stated: what the poses' file says; taken unless the silhouettes' hull is smaller, for both hold the object.

    Raises:
        ValueError: fewer than two cameras, or no sphere of positive size can be found.
    """
    if len(cameras) < 2:
        raise ValueError(f"got {len(cameras)} cameras, expected at least 2")
    found = _where_axes_meet(cameras)
    enough = len(points) >= MIN_JUDGED
    if found is not None and enough and present_share(cameras, points, found.point) < MIN_PRESENT:
        found = None
    if found is not None and masks is not None and any(mask is not None for mask in masks):
        # The silhouettes may be larger than what every view shows whole: look in a cube twice as wide.
        hull = visual_hull_sphere(cameras, masks, found.point, 2.0 * SEEN_WHOLE_MARGIN * found.radius)
        if hull is not None and (stated is None or hull[1] * HULL_MARGIN < stated.radius):
            return RegionOfInterest(hull[0], hull[1] * HULL_MARGIN, "object", "the visual hull of the masks")
    if stated is not None:
        return stated
    if found is not None and enough and found.miss > MAX_MISS_OF_SEEN * found.radius:
        found = None
    if found is not None:
        return RegionOfInterest(found.point, SEEN_WHOLE_MARGIN * found.radius, "object", FROM_FRUSTA)
    return _around_points(cameras, points, about)


def _around_points(
    cameras: PinholeCameras, points: Float[np.ndarray, "p 3"], about: Bool[np.ndarray, " p"] | None
) -> RegionOfInterest:
    """The region of a forward capture: what its photos are about, or all that surrounds the cameras."""
    if len(points) == 0:
        raise ValueError("got 0 sparse points and optical axes that do not meet, expected either")
    chosen, source = points[[] if about is None else about], FROM_ATTENTION
    if not len(chosen) or _one_sidedness(cameras, chosen) < MAX_ONE_SIDED:
        chosen, source = points[surround_cameras(points, cameras.centers)], FROM_POINTS
    chosen = without_strays(chosen)
    center, radius = enclosing_sphere(chosen)
    if radius <= 0:
        raise ValueError(f"got sparse points within a radius of {radius}, expected a positive one")
    return RegionOfInterest(center, FORWARD_MARGIN * radius, "forward", source)


def _one_sidedness(cameras: PinholeCameras, points: Float[np.ndarray, "p 3"]) -> float:
    """Length of the mean direction of points as seen from the middle of the cameras: 0 all around, 1 one way."""
    away = points - cameras.centers.mean(0)
    directions = away / np.maximum(np.linalg.norm(away, axis=1, keepdims=True), TINY)
    return float(np.linalg.norm(directions.mean(0)))


def grown_over(region: RegionOfInterest, points: Float[np.ndarray, "p 3"], ground: Plane | None) -> RegionOfInterest:
    """The region of an object with all in it that the photos are about; as it was where that is so.

    What stands on a ground is a thing of its own, and the ground does not count. Where there is none, the object may
    hang on a wall or be larger than the frame, and all counts.

    Args:
        points: those that `attention.attended` names.
    """
    if region.source != FROM_FRUSTA:
        return region
    if ground is not None:
        points = _connected(points[ground.heights(points) > STANDING * region.radius], region)
    points = without_strays(points)
    if not (np.linalg.norm(points - region.center, axis=1) > region.radius / ATTENDED_MARGIN).any():
        return region
    center, radius = enclosing_sphere(points)
    center, radius = merged_spheres((region.center, region.radius), (center, ATTENDED_MARGIN * radius))
    return RegionOfInterest(center, radius, region.kind, FROM_ATTENTION)


def without_strays(points: Float[np.ndarray, "p 3"]) -> Float[np.ndarray, "k 3"]:
    """The points that have others near."""
    return points[have_neighbours(points)]


def have_neighbours(points: Float[np.ndarray, "p 3"]) -> Bool[np.ndarray, " p"]:
    """Which points have others near."""
    from scipy.spatial import cKDTree

    if len(points) <= MIN_NEIGHBOURS:
        return np.ones(len(points), dtype=bool)
    typical = np.median(np.linalg.norm(points - np.median(points, axis=0), axis=1))
    isolation = cKDTree(points).query(points, k=MIN_NEIGHBOURS + 1)[0][:, -1]
    near: np.ndarray = isolation <= MAX_ISOLATION * typical
    return near


def surround_cameras(points: Float[np.ndarray, "p 3"], centers: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, " p"]:
    """Which points, some at least, are what lies around the cameras and not far behind it."""
    from scipy.spatial import cKDTree

    distances, _ = cKDTree(centers).query(points)
    near: np.ndarray = distances <= FORWARD_DEPTHS * np.median(distances)
    return near


def _connected(points: Float[np.ndarray, "p 3"], region: RegionOfInterest) -> Float[np.ndarray, "k 3"]:
    """Points that lie in the region or hang together with some that do; all of them where none does."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    gap = MAX_GAP * region.radius
    # one point a cell is enough to tell what hangs together
    _, first, cell_of = np.unique(np.floor(points / (gap / 4)), axis=0, return_index=True, return_inverse=True)
    cells = points[first]
    pairs = cKDTree(cells).query_pairs(gap, output_type="ndarray")
    links = coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(cells), len(cells)))
    group = connected_components(links, directed=False)[1][cell_of.reshape(-1)]
    core = group[np.linalg.norm(points - region.center, axis=1) < region.radius]
    return points[np.isin(group, core)] if len(core) else points


def enclosing_sphere(points: Float[np.ndarray, "p 3"]) -> tuple[Float[np.ndarray, " 3"], float]:
    """Nearly the smallest sphere about points (a thousandth too large).

    Steps of shrinking length towards the farthest point (Badoiu and Clarkson, "Smaller core-sets for balls", 2003).
    """
    center = (points.min(0) + points.max(0)) / 2
    outer = points[np.argsort(((points - center) ** 2).sum(1))[-MAX_OUTER:]]  # of a million, the others touch nothing
    for step in range(1, ENCLOSING_STEPS):
        farthest = outer[np.argmax(((outer - center) ** 2).sum(1))]
        center = center + (farthest - center) / (step + 1)
    return center, float(np.linalg.norm(points - center, axis=1).max())


Sphere = tuple["Float[np.ndarray, ' 3']", float]


def merged_spheres(one: Sphere, other: Sphere) -> Sphere:
    """The smallest sphere that holds two spheres, each given by its centre and radius."""
    (center, radius), (other_center, other_radius) = (one, other) if one[1] >= other[1] else (other, one)
    away = other_center - center
    distance = float(np.linalg.norm(away))
    if distance + other_radius <= radius:
        return center, radius
    merged = (distance + radius + other_radius) / 2
    return center + away / distance * (merged - radius), merged


class _Meeting(NamedTuple):
    """Where optical axes meet: the point, the radius about it that the views show whole, the axes' median miss."""

    point: Float[np.ndarray, " 3"]
    radius: float
    miss: float


def _where_axes_meet(cameras: PinholeCameras) -> _Meeting | None:
    """None where they do not."""
    centers, forward = cameras.centers, cameras.forward
    if axis_spread_deg(forward) < MIN_AXIS_SPREAD_DEG:
        return None
    point, misses = meeting_point(centers, forward)
    depths = np.einsum("ni,ni->n", point - centers, forward)
    in_front = depths > 0
    if in_front.mean() < MIN_IN_FRONT or np.median(misses[in_front] / depths[in_front]) > MAX_MISS_RATIO:
        return None
    seen_whole = float(np.median(seen_whole_radii(cameras, point)))
    radius = max(seen_whole, MIN_RADIUS_RATIO * float(np.median(depths[in_front])))
    return _Meeting(point, radius, float(np.median(misses)))
