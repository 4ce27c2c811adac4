"""The sparse points that SfM would find in a capture, simulated from its true cameras and surfaces.

Features lie where photos show texture. A feature of one photo is found again in another where it is in the frame, not
hidden, not seen at a grazing angle, and looks alike: from a similar direction at a similar scale, with luck (Lowe 2004,
figures 8 and 12: SIFT under change of viewpoint). Tracks are triangulated from pixels with noise, and judged as COLMAP
judges them. Some tracks are false, short ones.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from benchmarks.captures.model import Capture, Posed, joined
from stages.geometry.cameras import PinholeCameras
from stages.surface.triangle_mesh import raycaster

FEATURES = 500  # a photo, before its texture has a say
KEPT = (0.4, 0.7)  # of what could be found again in a photo, photo by photo
ALIKE_DEG, ALIKE_OCTAVES = 30.0, 0.8  # standard deviations of what still looks alike
GRAZING_DEG, GRAZING_KEPT = 60.0, 0.3
NOISE_PX = 0.6
MIN_TRACK, SHORT_KEPT = 3, 0.3  # part that is kept of the tracks of two
MIN_ANGLE_DEG, MAX_ERROR_PX = 1.5, 4.0
FALSE_SHARE, FALSE_DEPTHS = 0.015, (0.3, 4.0)
HIDDEN = 2e-3  # of the distance, before a point: something else is there


@dataclass(frozen=True)
class Sight:
    """How N photos see P points.

    Attributes:
        seen: [N, P] bool: in the frame and not hidden.
        distances: [N, P].
        directions: [N, P, 3] unit, from the camera.
    """

    seen: np.ndarray
    distances: np.ndarray
    directions: np.ndarray


def sight(cameras: PinholeCameras, points: np.ndarray, scene: object) -> Sight:
    """Which photos see which points [P, 3] among the surfaces of `scene` (an Open3D RaycastingScene)."""
    import open3d as o3d

    offsets = points[None] - cameras.centers[:, None]
    distances = np.linalg.norm(offsets, axis=2)
    directions = offsets / np.maximum(distances, 1e-9)[..., None]
    rays = np.concatenate([np.broadcast_to(cameras.centers[:, None], offsets.shape), directions], axis=2)
    hits = scene.cast_rays(o3d.core.Tensor(rays.astype(np.float32)))["t_hit"].numpy()  # type: ignore[attr-defined]
    framed = np.stack([cameras.in_frame(i, points) for i in range(len(cameras))])
    return Sight(framed & (hits > (1 - HIDDEN) * distances), distances, directions)


def simulate(capture: Capture, rng: np.random.Generator, features: int = FEATURES) -> Posed:
    """The posed photos of a capture; the same for the same random numbers."""
    mesh = joined(capture.subject + capture.surroundings)
    scene, cameras = raycaster(mesh.vertices, mesh.faces), capture.cameras
    places, normals, photo = _features(cameras, mesh.texture, scene, features, rng)
    tracks = _tracks(sight(cameras, places, scene), normals, photo, rng)
    lengths = tracks.sum(0)
    kept = (lengths >= MIN_TRACK) | ((lengths == 2) & (rng.random(len(places)) < SHORT_KEPT))
    return _triangulated(cameras, places[kept], tracks[:, kept], rng)


def _features(
    cameras: PinholeCameras, texture: np.ndarray, scene: object, count: int, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Places [P, 3] on the surfaces where photos show texture, normals [P, 3] and the photo [P] that shows each."""
    import open3d as o3d

    rays = []
    for i in range(len(cameras)):
        origins, directions = cameras.rays(i, rng.random((count, 2)) * cameras.sizes[i])
        rays.append(np.concatenate([origins, directions], axis=1))
    cast = np.concatenate(rays)
    hit = scene.cast_rays(o3d.core.Tensor(cast.astype(np.float32)))  # type: ignore[attr-defined]
    far, face = hit["t_hit"].numpy().astype(np.float64), hit["primitive_ids"].numpy()
    met = np.isfinite(far)
    found = met & (rng.random(len(cast)) < texture[np.where(met, face, 0)])
    places = cast[found, :3] + far[found, None] * cast[found, 3:]
    return places, hit["primitive_normals"].numpy()[found], np.repeat(np.arange(len(cameras)), count)[found]


def _tracks(seen: Sight, normals: np.ndarray, photo: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """[N, P] bool: which photo's features make up the track of which place."""
    columns = np.arange(len(photo))
    cosines = np.einsum("npi,pi->np", seen.directions, seen.directions[photo, columns])
    turned_deg = np.degrees(np.arccos(np.clip(cosines, -1, 1)))
    octaves = np.log2(seen.distances / seen.distances[photo, columns])
    luck = rng.uniform(*KEPT, len(seen.seen))[:, None]
    chance = luck * np.exp(-0.5 * (turned_deg / ALIKE_DEG) ** 2 - 0.5 * (octaves / ALIKE_OCTAVES) ** 2)
    steep = np.abs(np.einsum("npi,pi->np", seen.directions, normals)) < np.cos(np.radians(GRAZING_DEG))
    chance = np.where(steep, GRAZING_KEPT * chance, chance)
    tracks = seen.seen & (rng.random(chance.shape) < chance)
    tracks[photo, columns] = True
    return tracks


def _triangulated(cameras: PinholeCameras, places: np.ndarray, tracks: np.ndarray, rng: np.random.Generator) -> Posed:
    """Points from noisy rays (the least sum of squared distances, far ones counting less), false ones among them."""
    image, point = np.nonzero(tracks)
    pixels = np.empty((len(image), 2))
    directions = np.empty((len(image), 3))
    for i in range(len(cameras)):
        rows = image == i
        pixels[rows] = cameras.project(i, places[point[rows]])[0] + NOISE_PX * rng.normal(size=(rows.sum(), 2))
        directions[rows] = cameras.rays(i, pixels[rows])[1]
    found = _nearest(cameras.centers[image], directions, point, places)
    wrong = rng.random(len(places)) < FALSE_SHARE
    found[wrong] = _false(cameras, places[wrong], image, point, np.flatnonzero(wrong), rng)

    errors = np.zeros(len(places))
    for i in range(len(cameras)):
        rows = image == i
        misses = np.linalg.norm(cameras.project(i, found[point[rows]])[0] - pixels[rows], axis=1)
        np.add.at(errors, point[rows], misses)
    errors /= tracks.sum(0)
    errors[wrong] = rng.uniform(0.5, MAX_ERROR_PX, wrong.sum())  # a false match fits, or it would have been thrown out
    good = (errors < MAX_ERROR_PX) & (_widest_deg(directions, point, len(places)) > MIN_ANGLE_DEG)
    # False tracks are of two photos, as nearly all are.
    first, second = _first_two(point, len(places))
    short = np.isin(np.arange(len(point)), np.concatenate([first, second])) | ~wrong[point]
    rows = good[point] & short
    index = np.cumsum(good) - 1
    observations = np.stack([image[rows], index[point[rows]]], 1).astype(np.int32)
    order = np.lexsort(observations.T[::-1])
    return Posed(cameras, found[good], errors[good].astype(np.float32), observations[order])


def _nearest(
    origins: np.ndarray, directions: np.ndarray, point: np.ndarray, places: np.ndarray
) -> np.ndarray:  # fmt: skip
    """[P, 3] nearest to the rays (origins, directions [M, 3]) of each point [M]; weights from true distances."""
    weights = 1 / np.sum((places[point] - origins) ** 2, axis=1)
    projectors = (np.eye(3) - directions[:, :, None] * directions[:, None, :]) * weights[:, None, None]
    normal, right = np.zeros((len(places), 3, 3)), np.zeros((len(places), 3))
    np.add.at(normal, point, projectors)
    np.add.at(right, point, np.einsum("mij,mj->mi", projectors, origins))
    return np.linalg.solve(normal + 1e-12 * np.eye(3), right[..., None])[..., 0]


def _false(
    cameras: PinholeCameras, places: np.ndarray, image: np.ndarray, point: np.ndarray, which: np.ndarray,
    rng: np.random.Generator,
) -> np.ndarray:  # fmt: skip
    """Points at wrong distances along the rays of the first photo of each track."""
    first, _ = _first_two(point, int(point.max()) + 1 if len(point) else 0)
    origins = cameras.centers[image[first[which]]]
    low, high = np.log(FALSE_DEPTHS)
    return origins + (places - origins) * np.exp(rng.uniform(low, high, (len(places), 1)))


def _first_two(point: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """The first and the second observation (rows of `point` [M]) of each of `count` points."""
    order = np.argsort(point, kind="stable")
    starts = np.searchsorted(point[order], np.arange(count))
    return order[starts], order[starts + 1]


def _widest_deg(directions: np.ndarray, point: np.ndarray, count: int) -> np.ndarray:
    """About the widest angle [count] between the rays of each point: twice that to their mean."""
    mean = np.zeros((count, 3))
    np.add.at(mean, point, directions)
    mean /= np.linalg.norm(mean, axis=1, keepdims=True)
    least = np.ones(count)
    np.minimum.at(least, point, np.einsum("mi,mi->m", directions, mean[point]))
    return 2 * np.degrees(np.arccos(np.clip(least, -1, 1)))
