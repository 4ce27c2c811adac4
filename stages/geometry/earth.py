"""Places on the Earth (WGS 84): latitude and longitude in degrees and altitude in metres, to and from metres.

All goes by way of positions from the Earth's centre, where neither the 180th meridian nor the poles are special.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from jaxtyping import Float

# Semi-major axis in metres and flattening.
EARTH_RADIUS, FLATTENING = 6378137.0, 1 / 298.257223563
SQUARED_ECCENTRICITY = FLATTENING * (2 - FLATTENING)
LATITUDE_STEPS = 10  # each step brings two more digits and a half: it is exact after six


def earth_centred(positions: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Metres from the Earth's centre of positions: latitude, longitude (degrees), altitude (m)."""
    latitude, longitude = np.radians(positions[:, :2]).T
    altitude = positions[:, 2]
    normal_radius = EARTH_RADIUS / np.sqrt(1 - SQUARED_ECCENTRICITY * np.sin(latitude) ** 2)
    across = (normal_radius + altitude) * np.cos(latitude)
    along_axis = (normal_radius * (1 - SQUARED_ECCENTRICITY) + altitude) * np.sin(latitude)
    return np.stack([across * np.cos(longitude), across * np.sin(longitude), along_axis], 1)


def geodetic(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """The inverse of `earth_centred`, for points near the Earth's surface."""
    x, y, z = points.T
    across = np.hypot(x, y)
    latitude = np.arctan2(z, across * (1 - SQUARED_ECCENTRICITY))
    for _ in range(LATITUDE_STEPS):
        normal_radius = EARTH_RADIUS / np.sqrt(1 - SQUARED_ECCENTRICITY * np.sin(latitude) ** 2)
        latitude = np.arctan2(z + SQUARED_ECCENTRICITY * normal_radius * np.sin(latitude), across)
    sine, cosine = np.sin(latitude), np.cos(latitude)
    # holds at the poles, too, where across / cosine does not
    altitude = across * cosine + z * sine - EARTH_RADIUS * np.sqrt(1 - SQUARED_ECCENTRICITY * sine**2)
    return np.stack([np.degrees(latitude), np.degrees(np.arctan2(y, x)), altitude], 1)


def middle_position(positions: Float[np.ndarray, "n 3"]) -> tuple[float, float, float]:
    """Latitude, longitude and altitude in the middle of positions, of which less than half may be anywhere."""
    latitude, longitude, _ = geodetic(np.median(earth_centred(positions), axis=0)[None])[0]
    return float(latitude), float(longitude), float(np.median(positions[:, 2]))


def east_north_up_axes(origin: tuple[float, float, float]) -> Float[np.ndarray, "3 3"]:
    """Rows: unit east, north and up at a place, in the axes of `earth_centred`."""
    latitude, longitude = np.radians(origin[:2])
    east = np.array([-np.sin(longitude), np.cos(longitude), 0.0])
    up = np.array([np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude), np.sin(latitude)])
    return np.stack([east, np.cross(up, east), up])


def east_north_up(positions: Float[np.ndarray, "n 3"], origin: tuple[float, float, float]) -> Float[np.ndarray, "n 3"]:
    """Metres east, north and up of `origin` of positions: latitude, longitude (degrees), altitude (m)."""
    return (earth_centred(positions) - earth_centred(np.array([origin]))) @ east_north_up_axes(origin).T


def from_east_north_up(
    metres: Float[np.ndarray, "n 3"], origin: tuple[float, float, float]
) -> Float[np.ndarray, "n 3"]:
    """The inverse of `east_north_up`."""
    return geodetic(metres @ east_north_up_axes(origin) + earth_centred(np.array([origin])))


def earth_centred_from_local(origin: tuple[float, float, float], raised: float) -> Float[np.ndarray, "4 4"]:
    """From metres east, north and up of `origin`, which lies `raised` metres over its altitude, to `earth_centred`."""
    latitude, longitude, altitude = origin
    matrix = np.eye(4)
    matrix[:3, :3] = east_north_up_axes(origin).T
    matrix[:3, 3] = earth_centred(np.array([[latitude, longitude, altitude + raised]]))[0]
    return matrix
