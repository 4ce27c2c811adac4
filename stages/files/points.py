"""A point cloud as PLY and as LAZ: positions, normals, colours, trust, and how many photos see each point."""

from __future__ import annotations

import io
from collections.abc import Sequence
from datetime import date

import numpy as np

from stages.geometry.point_cloud import PointCloud

# LAZ holds whole numbers: they count this part of the points' median distance from their middle, or less, a power of
# ten. Stereo is a hundred times as coarse, and finer numbers compress badly.
STEP = 1e-5
# The most steps from the middle, just less than 32 bits hold: two thousand to twenty thousand times the points' median
# distance. What lies beyond is wrong, and steps that reached it would be coarse for all the others.
MOST_STEPS = 2e9
# Files say when they were made; the same points give the same bytes on any day.
MADE = date(2000, 1, 1)
# LAS has colours of 16 bits: 255 becomes 65535.
FULL_RANGE = 257


def points_ply_bytes(cloud: PointCloud, comment: str = "") -> bytes:
    """A binary PLY of vertices alone, with `photos` (how many see a point) and its trust beside what all readers know.

    The trust is called `quality`: by this name MeshLab knows it, and colours by it.

    Args:
        comment: one line of ASCII for the header.
    """
    columns: dict[str, np.ndarray] = dict(zip("xyz", cloud.points.T.astype("<f4"), strict=True))
    columns |= dict(zip(("nx", "ny", "nz"), cloud.normals.T.astype("<f4"), strict=True))
    columns |= dict(zip(("red", "green", "blue"), cloud.colors.T, strict=True))
    columns |= {"quality": cloud.trust.astype("<f4"), "photos": _counts(cloud)}
    names = {"f4": "float", "u1": "uchar"}
    lines = ["ply", "format binary_little_endian 1.0", *([f"comment {comment}"] if comment else [])]
    lines.append(f"element vertex {len(cloud)}")
    lines += [f"property {names[column.dtype.str[1:]]} {name}" for name, column in columns.items()]
    table = np.empty(len(cloud), [(name, column.dtype) for name, column in columns.items()])
    for name, column in columns.items():
        table[name] = column
    return "\n".join([*lines, "end_header", ""]).encode("ascii", "replace") + table.tobytes()


def laz_bytes(
    cloud: PointCloud, offset: Sequence[float] = (0.0, 0.0, 0.0), crs: str = "", program: str = ""
) -> tuple[bytes, int]:
    """LAZ: LAS 1.4, compressed, points of format 7 with normals, trust and number of photos as extra dimensions.

    Args:
        cloud: one point or more.
        offset: added to its coordinates, in float64, it gives those of the file.
        crs: the coordinate system of these, projected, as "EPSG:32632".
        program: what wrote it.

    Returns:
        The file, and how many points it lacks: those more than `MOST_STEPS` steps from the points' middle.

    Raises:
        ImportError: laspy or lazrs is missing, or pyproj where there is a `crs`.
        ValueError: there is no point, or one is not finite.
    """
    import laspy

    if not len(cloud) or not np.isfinite(cloud.points).all():
        raise ValueError(f"expected finite points, one or more, got {len(cloud)}")
    points = cloud.points.astype(np.float64)
    middle = np.round(np.median(points, axis=0))
    header = laspy.LasHeader(version="1.4", point_format=7)
    header.generating_software = program.encode("ascii", "replace").decode()[:32]
    header.creation_date = MADE
    step = _step(points - middle)
    within = np.abs(points - middle).max(1) <= MOST_STEPS * step
    points, cloud = points[within], cloud.chosen(within)
    header.scales = np.full(3, step)
    header.offsets = middle + offset
    # names of PDAL for normals, as CloudCompare knows them
    extra = {f"Normal{axis}": column.astype(np.float32) for axis, column in zip("XYZ", cloud.normals.T, strict=True)}
    extra |= {"trust": cloud.trust.astype(np.float32), "photos": _counts(cloud)}
    header.add_extra_dims([laspy.ExtraBytesParams(name, column.dtype) for name, column in extra.items()])
    if crs:
        import pyproj

        # the first form of WKT, as LAS wants it: it also says x east, y north of grids that are defined otherwise
        wkt = pyproj.CRS.from_user_input(crs).to_wkt("WKT1_GDAL")
        header.vlrs.append(laspy.vlrs.known.WktCoordinateSystemVlr(wkt))
        header.global_encoding.wkt = True
    las = laspy.LasData(header)
    las.x, las.y, las.z = (points + offset).T
    las.red, las.green, las.blue = cloud.colors.T.astype(np.uint16) * FULL_RANGE
    las.return_number[:] = las.number_of_returns[:] = 1
    for name, column in extra.items():
        las[name] = column
    data = io.BytesIO()
    las.write(data, do_compress=True, laz_backend=laspy.LazBackend.Lazrs)
    return data.getvalue(), int((~within).sum())


def _counts(cloud: PointCloud) -> np.ndarray:
    """How many photos see each point [n], to 255: Open3D reads no longer numbers."""
    return np.minimum(np.diff(cloud.starts), 255).astype(np.uint8)


def _step(offsets: np.ndarray) -> float:
    """The length that whole numbers count, for points [n, 3] as seen from their middle: a power of ten."""
    usual = float(np.median(np.linalg.norm(offsets, axis=1)))
    return float(10.0 ** np.floor(np.log10(STEP * usual if usual > 0 else 1e-3)))
