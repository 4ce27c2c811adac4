"""The world of the results on the Earth: coordinates of a map with a name, and metres from the Earth's centre."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from stages.geometry.earth import earth_centred, earth_centred_from_local, east_north_up, from_east_north_up
from stages.geometry.place import Place
from stages.geometry.point_cloud import PointCloud
from stages.geometry.similarity import Similarity, align_points
from stages.posing.coordinates import to_geodetic, to_grid

if TYPE_CHECKING:
    from jaxtyping import Float

ZONE_DEG = 6.0  # a zone of UTM, from the 180th meridian eastwards
# Axes of a map and lengths on it are told from a cube of this half a side, metres: they change by parts in ten thousand
# over kilometres.
NEARBY_M = 100.0
# What lies further than this from most points is wrong, and may be where the map has no coordinates.
REACH_M = 20e3


def utm_of(latitude: float, longitude: float) -> str:
    """The zone of UTM (WGS 84) at a place in degrees, as "EPSG:32632"."""
    zone = int((longitude + 180) % 360 // ZONE_DEG) + 1
    return f"EPSG:{(32600 if latitude >= 0 else 32700) + zone}"


def map_of(place: Place) -> str:
    """The coordinate system of `on_map`: that of the place, its zone of UTM, or "" where none has a name."""
    if place.origin is not None:
        return utm_of(*place.origin[:2])
    return place.crs


def on_map(place: Place, world: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """East, north and up in `map_of(place)` of points of the world; their own coordinates where no map is known.

    Raises:
        ConfigError: the map does not reach so far, as at the poles.
        SystemRequirementError: it takes pyproj, which is not installed.
    """
    if place.origin is None:
        return world if place.offset is None else world + np.array(place.offset)
    middle = np.median(world, axis=0)
    near = np.linalg.norm(world - middle, axis=1) < REACH_M
    found = world.copy() if near.all() else map_from_world(place, middle).apply(world)
    found[near] = to_grid(from_east_north_up(world[near], place.origin), map_of(place))
    return found


def in_world(place: Place, positions: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"] | None:
    """Latitude, longitude (degrees) and altitude as points of the world; None where its place on Earth is not known.

    Raises:
        ConfigError, SystemRequirementError: see `to_grid`.
    """
    if place.origin is not None:
        return east_north_up(positions, place.origin)
    return to_grid(positions, place.crs) - np.array(place.offset) if place.crs and place.offset else None


def map_from_world(place: Place, center: Float[np.ndarray, " 3"]) -> Similarity:
    """`on_map` about a point of the world, as one similarity: what turns directions."""
    cube = _about(center)
    return align_points(cube, on_map(place, cube))


def cloud_on_map(place: Place, cloud: PointCloud) -> tuple[PointCloud, tuple[float, float, float], str]:
    """Points of the world less an offset, that offset, and `map_of(place)`, in which they are together.

    Raises:
        ConfigError, SystemRequirementError: see `on_map`.
    """
    if place.origin is None:
        return cloud, place.offset or (0.0, 0.0, 0.0), place.crs
    coordinates = on_map(place, cloud.points)
    offset = np.round(np.median(coordinates, axis=0))
    turn = map_from_world(place, np.median(cloud.points, axis=0)).rotation
    x, y, z = offset.tolist()
    return replace(cloud, points=coordinates - offset, normals=cloud.normals @ turn.T), (x, y, z), map_of(place)


def latitude_and_longitude(place: Place) -> tuple[float, float] | None:
    """Degrees of the world's origin; None where it is not known where on Earth that is.

    Raises:
        ConfigError, SystemRequirementError: see `to_geodetic`.
    """
    if place.origin is not None:
        return place.origin[:2]
    if not place.crs or place.offset is None:
        return None
    latitude, longitude, _ = to_geodetic(np.array([place.offset]), place.crs, "the origin")[0].tolist()
    return latitude, longitude


def earth_centred_from_world(
    place: Place, center: Float[np.ndarray, " 3"], geoid: float
) -> Float[np.ndarray, "4 4"] | None:
    """To metres from the Earth's centre (EPSG:4978); None where the place is not known.

    Args:
        center: where a map's coordinates, which are no straight lines, are met best.
        geoid: metres above the ellipsoid of what altitudes count from.
    """
    if place.origin is not None:
        return earth_centred_from_local(place.origin, geoid)
    if not place.crs:
        return None
    cube = _about(center)
    positions = to_geodetic(on_map(place, cube), place.crs, "points about the model")
    positions[:, 2] += geoid
    return align_points(cube, earth_centred(positions)).matrix()


def _about(center: Float[np.ndarray, " 3"]) -> Float[np.ndarray, "8 3"]:
    """Corners of a cube about a point."""
    return center + NEARBY_M * np.array([[i, j, k] for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)])
