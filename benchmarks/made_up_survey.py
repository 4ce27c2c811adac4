"""A made-up survey: a city of boxes, photos of a drone's double grid with true poses, and features without pictures.

No picture is drawn. A feature is a point of the city where a photo sees it, displaced by noise; its descriptor is the
point's own, which drifts with the direction it is seen from (as SIFT's does), and noise. Some are no points at all, and
some facades have windows that look the same everywhere. World axes: x east, y north, z up, metres.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from stages.geometry.earth import from_east_north_up

if TYPE_CHECKING:
    from jaxtyping import Float, Int

ORIGIN = (47.37, 8.54, 400.0)  # latitude, longitude (degrees) and altitude (m) of the world's origin
# The city: distance of streets, what houses leave free beside them, heights of houses; metres.
STREETS_M, FREE_M, HEIGHTS_M = 70.0, (9.0, 16.0), (6.0, 35.0)
DENSITY = 0.42  # points a square metre of ground, roof and facade
WINDOWS, WINDOW_SHARE = 400, 0.3  # looks that windows have, and part of the points of facades that are windows
# The flights: altitude in metres above ground and tilt from straight down in degrees, of the first and of the second,
# which crosses it; distance of photos along and of lines, as parts of the footprint.
FLIGHTS = ((85.0, 0.0), (100.0, 35.0))
ALONG, ACROSS = 0.25, 0.35
SHAKE_DEG = 3.0
GPS_NOISE_M = (1.5, 1.5, 4.0)
# The camera: pixels, focal length and radial distortion, and what EXIF's focal length is off by.
SIZE, FOCAL_PX, RADIAL, EXIF_ERROR = (1600, 1200), 1250.0, -0.03, 1.02
# Features: least and largest size in pixels, noise of places in pixels, part of the points seen that is found, part of
# all that is no point.
SIZES_PX, NOISE_PX, FOUND, DISTRACTORS = (1.2, 80.0), 0.6, 0.75, 0.2
MIN_COSINE = 0.2  # of the angle between a surface's normal and the line of sight
# Of unit descriptors: what they drift by over 57 degrees, noise in the median, and the spread of its logarithm. Of what
# two photos both have, 75 % match seen from one direction, and a third from 40 degrees apart.
DRIFT, DESCRIPTOR_NOISE, NOISE_SPREAD = 1.8, 1.1, 0.4
DRIFTS = 4096  # directions that descriptors drift in


@dataclass(frozen=True)
class City:
    """Boxes on flat ground, and points on all of it.

    Attributes:
        boxes: [B, 2, 3] lowest and highest corner.
        points, normals: [P, 3]. sizes: [P] metres.
        looks: [P] whose descriptor a point has: its own number, or that of a window.
    """

    boxes: Float[np.ndarray, "b 2 3"]
    points: Float[np.ndarray, "p 3"]
    normals: Float[np.ndarray, "p 3"]
    sizes: Float[np.ndarray, " p"]
    looks: Int[np.ndarray, " p"]


@dataclass(frozen=True)
class Survey:
    """Photos with true poses.

    Attributes:
        names: in the order of the flight.
        world_from_cam: [N, 3, 3] rotations; x right, y down, z ahead in the camera.
        centers: [N, 3].
        points: [N] arrays of the points of the city that a photo has features of (-1: of none).
    """

    names: tuple[str, ...]
    world_from_cam: Float[np.ndarray, "n 3 3"]
    centers: Float[np.ndarray, "n 3"]
    points: tuple[Int[np.ndarray, " k"], ...]


# ---------------------------------------------------------------- poses
def fly(photos: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Rotations world_from_cam [N, 3, 3] and centres [N, 3] of two flights over a square as large as they need."""
    rotations, centers = [], []
    for number, (altitude, tilt) in enumerate(FLIGHTS):
        count = photos // 2 if number else photos - photos // 2
        along, across = (altitude * side / FOCAL_PX for side in (ALONG * SIZE[1], ACROSS * SIZE[0]))
        lines = max(1, round(np.sqrt(count * along / across)))
        a_line = -(-count // lines)
        for k in range(count):
            line, step = divmod(k, a_line)
            forth = 1 - 2 * (line % 2)
            place = np.array([(step - (a_line - 1) / 2) * along * forth, (line - (lines - 1) / 2) * across, altitude])
            heading = 0.0 if forth > 0 else 180.0
            if number:
                place[:2] = place[1], place[0]
                heading = 90.0 - heading
            shake = rng.normal(0, SHAKE_DEG, 3)
            rotations.append(looking(heading + shake[0], tilt + shake[1], shake[2]))
            centers.append(place + rng.normal(0, 0.05, 3) * altitude)
    return np.stack(rotations), np.stack(centers)


def looking(heading_deg: float, tilt_deg: float, roll_deg: float) -> np.ndarray:
    """[3, 3] world_from_cam: the picture's top to the heading (0: east, 90: north), tilted up from straight down."""
    heading, tilt, roll = np.radians([heading_deg, tilt_deg, roll_deg])
    forward = np.array([np.cos(heading), np.sin(heading), 0.0])
    ahead = np.sin(tilt) * forward - np.cos(tilt) * np.array([0.0, 0.0, 1.0])
    right = np.array([np.sin(heading), -np.cos(heading), 0.0])
    down = np.cross(ahead, right)
    turned = np.cos(roll) * right + np.sin(roll) * down
    return np.stack([turned, np.cross(ahead, turned), ahead], axis=1)


# ---------------------------------------------------------------- the city
def build(half_m: float, rng: np.random.Generator) -> City:
    """A city from -half to half in x and y."""
    corners = np.arange(-half_m, half_m, STREETS_M)
    boxes = []
    for x in corners:
        for y in corners:
            free = rng.uniform(*FREE_M, 4)
            height = rng.uniform(*HEIGHTS_M)
            boxes.append([[x + free[0], y + free[1], 0], [x + STREETS_M - free[2], y + STREETS_M - free[3], height]])
    stacked = np.array(boxes)
    places, normals, facade = [], [], []
    count = round(DENSITY * (2 * half_m) ** 2)
    ground = np.column_stack([rng.uniform(-half_m, half_m, (count, 2)), np.zeros(count)])
    under = np.zeros(count, bool)
    cell = np.clip(((ground[:, :2] - corners[0]) // STREETS_M).astype(int), 0, len(corners) - 1)
    own = stacked[cell[:, 0] * len(corners) + cell[:, 1]]
    under = ((ground[:, :2] > own[:, 0, :2]) & (ground[:, :2] < own[:, 1, :2])).all(1)
    ground[:, 2] = np.where(under, own[:, 1, 2], 0)  # on the roof instead
    places.append(ground)
    normals.append(np.tile([0.0, 0.0, 1.0], (count, 1)))
    facade.append(np.zeros(count, bool))
    for low, high in stacked:
        for axis in (0, 1):
            for side, corner in ((-1.0, low), (1.0, high)):
                number = rng.poisson(DENSITY * (high[1 - axis] - low[1 - axis]) * high[2])
                wall = rng.uniform(low, high, (number, 3))
                wall[:, axis] = corner[axis]
                normal = np.zeros(3)
                normal[axis] = side
                places.append(wall)
                normals.append(np.tile(normal, (number, 1)))
                facade.append(np.ones(number, bool))
    points, is_facade = np.concatenate(places), np.concatenate(facade)
    looks = np.arange(len(points)) + WINDOWS
    window = is_facade & (rng.random(len(points)) < WINDOW_SHARE)
    looks[window] = rng.integers(0, WINDOWS, window.sum())
    sizes = np.exp(rng.normal(np.log(0.25), 0.8, len(points)))
    return City(stacked, points, np.concatenate(normals), sizes, looks)


def hidden(
    center: Float[np.ndarray, " 3"], points: Float[np.ndarray, "p 3"], boxes: Float[np.ndarray, "b 2 3"]
) -> np.ndarray:
    """[P] whether a box is between a place and each point (slab test), a little before the point's own surface."""
    rays = points - center
    rays = np.where(np.abs(rays) < 1e-9, 1e-9, rays)
    blocked = np.zeros(len(points), bool)
    for low, high in boxes:
        first, second = (low - center) / rays, (high - center) / rays
        enters, leaves = np.minimum(first, second).max(1), np.maximum(first, second).min(1)
        blocked |= (enters < leaves) & (enters < 0.999) & (leaves > 0)
    return blocked


# ---------------------------------------------------------------- what photos show
class Looks:
    """Descriptors of points, as SIFT's: 128 whole numbers up to 255, about 512 long."""

    def __init__(self, count: int, rng: np.random.Generator) -> None:
        own = rng.standard_gamma(0.5, (count, 128)).astype(np.float32)
        own /= np.linalg.norm(own, axis=1, keepdims=True)
        self.own = (own * 512).clip(0, 255).astype(np.uint8)
        drifts = rng.normal(size=(DRIFTS, 128)).astype(np.float32)
        self.drifts = drifts / np.linalg.norm(drifts, axis=1, keepdims=True)

    def seen(self, looks: np.ndarray, directions: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """[K, 128] descriptors of points seen in these directions [K, 3]."""
        found = self.own[looks].astype(np.float32) / 512
        for axis in range(3):
            found += DRIFT * directions[:, axis, None].astype(np.float32) * self.drifts[(3 * looks + axis) % DRIFTS]
        noise = DESCRIPTOR_NOISE * np.exp(NOISE_SPREAD * rng.standard_normal((len(looks), 1)))
        found += noise * rng.standard_normal(found.shape) / np.sqrt(128)
        return quantised(found)


def quantised(found: np.ndarray) -> np.ndarray:
    found = found.clip(0)
    return np.rint(512 * found / np.linalg.norm(found, axis=1, keepdims=True)).clip(0, 255).astype(np.uint8)


def project(
    rotation: np.ndarray, center: np.ndarray, points: np.ndarray
) -> tuple[Float[np.ndarray, "p 2"], Float[np.ndarray, " p"]]:
    """Pixels and depths of points; COLMAP's SIMPLE_RADIAL."""
    seen = (points - center) @ rotation
    depth = np.maximum(seen[:, 2], 1e-3)
    plane = seen[:, :2] / depth[:, None]
    plane = plane * (1 + RADIAL * (plane**2).sum(1, keepdims=True))
    return FOCAL_PX * plane + np.array(SIZE) / 2, seen[:, 2]


def visible(
    city: City, tree: Any, rotation: np.ndarray, center: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points [K] that a photo sees, their pixels [K, 2] and sizes [K] in pixels."""
    reach = 2.2 * center[2]
    middle = center + rotation[:, 2] * center[2]
    near = np.array(tree.query_ball_point(middle[:2], reach), dtype=int)
    pixels, depth = project(rotation, center, city.points[near])
    inside = (depth > 1) & (pixels > 0).all(1) & (pixels < SIZE).all(1)
    sight = city.points[near] - center
    sight /= np.linalg.norm(sight, axis=1, keepdims=True)
    sizes = FOCAL_PX * city.sizes[near] / np.maximum(depth, 1)
    inside &= (-(sight * city.normals[near]).sum(1) > MIN_COSINE) & (sizes > SIZES_PX[0]) & (sizes < SIZES_PX[1])
    near, pixels, sizes = near[inside], pixels[inside], sizes[inside]
    boxes = city.boxes[(np.abs(city.boxes.mean(1)[:, :2] - middle[:2]) < reach + STREETS_M).all(1)]
    seen = ~hidden(center, city.points[near], boxes)
    return near[seen], pixels[seen], sizes[seen]


def write_survey(path: Path, photos: int, features: int, seed: int = 0) -> Survey:
    """Make up a survey and write its photos, features and GPS positions into a new COLMAP database."""
    import pycolmap
    from scipy.spatial import cKDTree

    rng = np.random.default_rng(seed)
    rotations, centers = fly(photos, rng)
    city = build(np.abs(centers[:, :2]).max() + 150, rng)
    tree, looks = cKDTree(city.points[:, :2]), Looks(len(city.points) + WINDOWS, rng)
    positions = from_east_north_up(centers + rng.normal(size=centers.shape) * GPS_NOISE_M, ORIGIN)
    names, kept = tuple(f"{i:05d}.jpg" for i in range(photos)), []
    with pycolmap.Database.open(path) as database, pycolmap.DatabaseTransaction(database):
        camera = pycolmap.Camera.create_from_model_name(0, "SIMPLE_RADIAL", FOCAL_PX * EXIF_ERROR, *SIZE)
        camera.has_prior_focal_length = True
        camera_id = database.write_camera(camera)
        rig = pycolmap.Rig()
        rig.add_ref_sensor(pycolmap.sensor_t(pycolmap.SensorType.CAMERA, camera_id))
        rig_id = database.write_rig(rig)
        for i, name in enumerate(names):
            found, pixels, sizes = visible(city, tree, rotations[i], centers[i])
            chosen = np.flatnonzero(rng.random(len(found)) < FOUND)
            sizes *= np.exp(rng.normal(0, 0.1, len(sizes)))
            chosen = chosen[np.argsort(-sizes[chosen])][: round(features * (1 - DISTRACTORS))]
            extra = round(len(chosen) * DISTRACTORS / (1 - DISTRACTORS))
            sight = city.points[found[chosen]] - centers[i]
            sight /= np.linalg.norm(sight, axis=1, keepdims=True)
            drawn = rng.standard_gamma(0.5, (extra, 128)).astype(np.float32)
            descriptors = np.concatenate([looks.seen(city.looks[found[chosen]], sight, rng), quantised(drawn)])
            places = np.concatenate([pixels[chosen] + rng.normal(0, NOISE_PX, (len(chosen), 2)),
                                     rng.random((extra, 2)) * SIZE])  # fmt: skip
            all_sizes = np.concatenate([sizes[chosen], rng.choice(sizes[chosen], extra)])
            write_photo(database, name, camera_id, rig_id, positions[i], places, all_sizes, descriptors)
            kept.append(np.concatenate([found[chosen], np.full(extra, -1)]))
    return Survey(names, rotations, centers, tuple(kept))


def write_photo(
    database: Any, name: str, camera_id: int, rig_id: int, position: np.ndarray, places: np.ndarray, sizes: np.ndarray,
    descriptors: np.ndarray,
) -> None:  # fmt: skip
    """One photo with its features: places [K, 2], sizes [K] in pixels and descriptors [K, 128]."""
    import pycolmap

    image_id = database.write_image(pycolmap.Image(name=name, camera_id=camera_id))
    frame = pycolmap.Frame()
    frame.rig_id = rig_id
    data = pycolmap.data_t(pycolmap.sensor_t(pycolmap.SensorType.CAMERA, camera_id), image_id)
    frame.add_data_id(data)
    database.write_frame(frame)
    zeros = np.zeros(len(sizes))
    database.write_keypoints(image_id, np.column_stack([places, sizes, zeros, zeros, sizes]).astype(np.float32))
    database.write_descriptors(image_id, pycolmap.FeatureDescriptors(pycolmap.FeatureExtractorType.SIFT, descriptors))
    database.write_pose_prior(
        pycolmap.PosePrior(
            corr_data_id=data,
            position=position.reshape(3, 1),
            coordinate_system=pycolmap.PosePriorCoordinateSystem.WGS84,
        )
    )


def overlaps(survey: Survey) -> Int[np.ndarray, "n n"]:
    """How many points two photos both have features of."""
    from scipy.sparse import csr_array

    number = max(int(points.max(initial=0)) for points in survey.points) + 1
    rows = np.repeat(np.arange(len(survey.points)), [int((points >= 0).sum()) for points in survey.points])
    columns = np.concatenate([points[points >= 0] for points in survey.points])
    seen = csr_array((np.ones(len(rows), np.int32), (rows, columns)), shape=(len(survey.points), number))
    common = (seen @ seen.T).toarray()
    np.fill_diagonal(common, 0)
    return common
