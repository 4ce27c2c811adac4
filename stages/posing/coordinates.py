"""Coordinate systems of surveyors and maps (EPSG codes), by pyproj: to latitude, longitude and altitude, and back.

Heights pass through as they are, but for their unit: which surface they count from (geoid, ellipsoid) moves all points
of a capture alike, and its models need not be installed.
"""

from __future__ import annotations

import re
from textwrap import shorten
from typing import TYPE_CHECKING, Any

import numpy as np

from stages.errors import ConfigError, InputError, SystemRequirementError

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

WGS84 = "EPSG:4326"
MAX_BEYOND_DEG = 3.0  # maps are used beyond their border, but not this far
# PROJ opens what these name, on the disk or in the current folder.
NAMES_A_FILE = re.compile(r"\binit=(?!epsg:)|grids=[^ ]*/", re.IGNORECASE)
EXTRA = "pip install 'hineus[geo]'"


def to_geodetic(xyz: Float[np.ndarray, "n 3"], crs: str, what: str) -> Float[np.ndarray, "n 3"]:
    """Latitude, longitude (degrees, WGS 84) and altitude (metres) of coordinates: east (or longitude), north, up.

    Args:
        crs: "EPSG:32632", a PROJ string or WKT. what: the coordinates' name in an error.

    Raises:
        ConfigError: there is no such coordinate system.
        InputError: the coordinates lie outside the area that it is for.
        SystemRequirementError: pyproj is not installed.
    """
    import_pyproj()
    from pyproj import Transformer

    horizontal, metres = _horizontal(crs)
    across = Transformer.from_crs(horizontal, WGS84, always_xy=True)
    longitude, latitude = (np.asarray(each) for each in across.transform(xyz[:, 0], xyz[:, 1]))
    found = np.stack([latitude, longitude, metres * xyz[:, 2]], 1)
    outside = ~np.isfinite(found).all(1) | _beyond(found, horizontal)
    if outside.any():
        x, y, _ = xyz[int(np.argmax(outside))]
        raise InputError(
            f"{outside.sum()} of {len(xyz)} {what} lie outside the area of {_described(horizontal)}, "
            f"e.g. {x:.2f} {y:.2f}.",
            "x is east or longitude, y is north or latitude: are they swapped? Or name the coordinate system: "
            "`--set place.control_epsg=32632`.",
        )
    return found


def to_grid(positions: Float[np.ndarray, "n 3"], crs: str) -> Float[np.ndarray, "n 3"]:
    """East, north and up in metres, in a projected coordinate system, of latitude, longitude and altitude.

    Raises:
        ConfigError: there is no such system, or it is not one of east and north in metres.
        SystemRequirementError: pyproj is not installed.
    """
    import_pyproj()
    from pyproj import Transformer

    horizontal, _ = _horizontal(crs)
    units = {axis.unit_conversion_factor for axis in horizontal.axis_info}
    if not horizontal.is_projected or units != {1.0}:
        unit = horizontal.axis_info[0].unit_name
        raise ConfigError(
            f"{crs} ({horizontal.name}) counts in {unit}; results are in metres east and north.",
            "Name a projected system in metres, such as that of UTM: `--set place.epsg=32632`.",
        )
    across = Transformer.from_crs(WGS84, horizontal, always_xy=True)
    east, north = across.transform(positions[:, 1], positions[:, 0])
    grid = np.stack([east, north, positions[:, 2]], 1)
    if not np.isfinite(grid).all() or _beyond(positions, horizontal).any():
        raise ConfigError(
            f"{_described(horizontal)} does not reach to latitude {positions[0, 0]:.4f}, longitude "
            f"{positions[0, 1]:.4f}.",
            "Name a system for this place, or leave it out: `--set place.epsg=null`.",
        )
    return grid


def _beyond(positions: Float[np.ndarray, "n 3"], horizontal: Any) -> Bool[np.ndarray, " n"]:
    """Whether latitudes and longitudes lie outside the area that a coordinate system is for, and its margin."""
    latitude, longitude, _ = positions.T
    area = horizontal.area_of_use
    if area is None:
        return np.abs(latitude) > 90
    east = (longitude - area.west + MAX_BEYOND_DEG) % 360  # of the western border; areas may cross the 180th meridian
    width = 360 if area.east - area.west >= 360 else (area.east - area.west) % 360 + 2 * MAX_BEYOND_DEG
    within = (latitude >= area.south - MAX_BEYOND_DEG) & (latitude <= area.north + MAX_BEYOND_DEG) & (east <= width)
    return ~within | (np.abs(latitude) > 90)


def _described(horizontal: Any) -> str:
    area = horizontal.area_of_use
    return str(horizontal.name) if area is None else f"{horizontal.name} ({shorten(area.name, 80, placeholder=' ...')})"


def import_pyproj() -> None:
    """Make sure that it is there.

    Raises:
        SystemRequirementError: it is not.
    """
    try:
        import pyproj  # noqa: F401
    except ImportError as error:
        raise SystemRequirementError(
            f"Coordinates of a named system are converted by pyproj, which cannot be imported: {error}.",
            f"Try `{EXTRA}`.",
        ) from error


def _horizontal(crs: str) -> tuple[Any, float]:
    """The part for east and north of a coordinate system, and the metres in its unit of height."""
    from pyproj import CRS
    from pyproj.exceptions import ProjError

    try:
        if NAMES_A_FILE.search(crs):
            raise ProjError("it names a file")
        named = CRS.from_user_input(crs)
    except ProjError as error:
        raise ConfigError(
            f"There is no coordinate system {crs[:60]}.",
            "Look its code up at https://epsg.io; UTM zone 32 north is 32632.",
        ) from error
    horizontal, *rest = named.sub_crs_list if named.is_compound else [named]
    if not (horizontal.is_projected or horizontal.is_geographic):
        raise ConfigError(
            f"{named.name} has no east and north, or latitude and longitude.",
            "Convert the coordinates to longitude, latitude and height: EPSG:4326.",
        )
    if rest:
        return horizontal, float(rest[0].axis_info[0].unit_conversion_factor)
    if horizontal.is_geographic:
        return horizontal, 1.0
    # heights are measured with the same staff
    return horizontal, float(horizontal.axis_info[0].unit_conversion_factor)
