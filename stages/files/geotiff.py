"""Pictures of the ground as GeoTIFF: colours, heights, and where each pixel lies."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from jaxtyping import Shaped

# What other programs write for a height that is not known.
NO_HEIGHT = -9999.0
BLOCK = 256  # pixels along a side, as GDAL has them
# The system of coordinates in metres that no map knows.
LOCAL_METRES = 'LOCAL_CS["metres in a frame of their own",UNIT["metre",1],AXIS["x",EAST],AXIS["y",NORTH]]'


def orthophoto_bytes(
    picture: Shaped[np.ndarray, "4 h w"], west: float, north: float, resolution: float, crs: str, note: str = ""
) -> bytes:
    """Red, green, blue and alpha, 8 bits each, see `_geotiff`."""
    from rasterio.enums import ColorInterp

    kinds = (ColorInterp.red, ColorInterp.green, ColorInterp.blue, ColorInterp.alpha)
    return _geotiff(picture, west, north, resolution, crs, note, colorinterp=kinds)


def heights_bytes(
    heights: Shaped[np.ndarray, "h w"],
    west: float,
    north: float,
    resolution: float,
    crs: str,
    note: str = "",
    unit: str = "metre",
) -> bytes:
    """Heights in 32-bit floats, NaN written as `NO_HEIGHT`, see `_geotiff`."""
    known = np.where(np.isfinite(heights), heights, NO_HEIGHT).astype(np.float32)
    about = {"descriptions": ("height",), "units": (unit,)}
    return _geotiff(known[None], west, north, resolution, crs, note, nodata=NO_HEIGHT, **about)


def _geotiff(
    bands: Shaped[np.ndarray, "c h w"],
    west: float,
    north: float,
    resolution: float,
    crs: str,
    note: str,
    nodata: float | None = None,
    **about: tuple[object, ...],
) -> bytes:
    """A GeoTIFF in blocks, compressed without loss, with smaller versions of itself (overviews).

    Args:
        bands: rows go south.
        west, north: of the first pixel's outer corner. resolution: side of a pixel.
        crs: "EPSG:32632", a text of WKT, or "" for none.
        note: what the file says of itself.
        about: attributes of the data set, of rasterio.

    Raises:
        ImportError: rasterio is missing.
    """
    import rasterio
    from rasterio.crs import CRS
    from rasterio.enums import Resampling
    from rasterio.io import MemoryFile

    count, height, width = bands.shape
    profile = {
        "driver": "GTiff", "count": count, "height": height, "width": width, "dtype": bands.dtype, "nodata": nodata,
        "transform": rasterio.Affine(resolution, 0, west, 0, -resolution, north),
        "crs": CRS.from_string(crs) if crs else None,
        "tiled": True, "compress": "deflate", "predictor": 3 if bands.dtype.kind == "f" else 2, "bigtiff": "if_safer",
    }  # fmt: skip
    with MemoryFile() as memory:
        with memory.open(**profile) as out:
            out.write(bands)
            for name, value in about.items():
                setattr(out, name, value)
            out.update_tags(TIFFTAG_IMAGEDESCRIPTION=note)
            # each half as wide as the one before, down to one block
            halves = [2**k for k in range(1, 16) if max(width, height) / 2 ** (k - 1) > BLOCK]
            if halves:
                out.build_overviews(halves, Resampling.average if nodata is None else Resampling.nearest)
        return bytes(memory.getbuffer())
