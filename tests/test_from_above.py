"""Orthophoto and surface model of a box on a plane whose corners are known, read back by rasterio."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rigs import capture, look_at, scene_without_points
from tetrahedron import UP, rotation_about, workspace

from configs.params import ExportParams
from stages import artifacts
from stages.artifacts import AtlasMesh, write_png
from stages.drawing import from_above
from stages.drawing.from_above import ground_grid, seen_from_above, two_digits
from stages.errors import ConfigError, SystemRequirementError
from stages.export import EXPORT
from stages.geometry.earth import from_east_north_up
from stages.geometry.place import Place
from stages.geometry.similarity import Similarity
from stages.posing.map_coordinates import utm_of
from stages.texture.baking import Provenance
from stages.texture.footprint import ground_sampling

GREEN, RED, UNSEEN = (40, 160, 60), (210, 40, 30), (90, 90, 200)
ORIGIN = (47.0, 8.5, 400.0)
# The box's lowest and highest corner, metres; the plane is 12 x 10 m about the origin, at height 0.
BOX = np.array([[-1.03, 0.52, 0.0], [2.41, 3.17, 2.5]])
PLANE = np.array([[-6.0, -5], [6, 5]])
# West of this, no photo saw the plane.
SEEN_FROM = -4.0
SIZE = 64


def on_ground(corners: np.ndarray, height: float, chart: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A rectangle, its UVs in one of four columns of the texture, and its faces."""
    (x0, y0), (x1, y1) = corners
    vertices = np.array([[x0, y0, height], [x1, y0, height], [x1, y1, height], [x0, y1, height]])
    uvs = np.array([[chart + u, v] for u, v in ((0.1, 0.1), (0.9, 0.1), (0.9, 0.9), (0.1, 0.9))]) * [0.25, 1]
    return vertices, uvs, np.array([[0, 1, 2], [0, 2, 3]])


def scene() -> tuple[AtlasMesh, np.ndarray, np.ndarray]:
    """Mesh, texture and provenance: the plane in two parts, the box's lid, and a wall below it."""
    wall = np.array([BOX[0] * [1, 1, 0], BOX[0] * [1, 1, 0], BOX[1], BOX[1]])
    wall[[1, 2], 1], wall[[0, 3], 1] = BOX[1, 1], BOX[0, 1]
    wall[:, 0] = BOX[0, 0]
    parts = [
        on_ground(np.array([PLANE[0], [SEEN_FROM, 5]]), 0.0, 2),
        on_ground(np.array([[SEEN_FROM, -5], PLANE[1]]), 0.0, 0),
        on_ground(BOX[:, :2], BOX[1, 2], 1),
        (wall, on_ground(BOX[:, :2], 0, 3)[1], np.array([[0, 1, 2], [0, 2, 3]])),
    ]
    starts = np.cumsum([0, *(len(part[0]) for part in parts)])
    vertices = np.concatenate([part[0] for part in parts])
    mesh = AtlasMesh(
        vertices.astype(np.float32),
        np.tile(UP, (len(vertices), 1)).astype(np.float32),
        np.concatenate([part[1] for part in parts]).astype(np.float32),
        np.concatenate([part[2] + start for part, start in zip(parts, starts, strict=False)]).astype(np.int32),
        SIZE,
    )
    texture = np.repeat(np.repeat([[GREEN, RED, UNSEEN, (0, 0, 0)]], SIZE, 0), SIZE // 4, 1).astype(np.uint8)
    provenance = np.full((SIZE, SIZE), Provenance.PHOTO, np.uint8)
    provenance[:, SIZE // 2 : SIZE * 3 // 4] = Provenance.FIELD
    return mesh, texture, provenance


def exported(tmp_path: Path, place: Place, **changes) -> tuple[Path, dict]:
    """The scene in a world that is turned and scaled against that of the workspace."""
    context = workspace(tmp_path, ExportParams(formats=("orthophoto",), **changes))
    mesh, texture, provenance = scene()
    scene_from_world = Similarity(0.1, rotation_about(np.array([1.0, 2, -1]), 0.8), np.array([0.3, -0.1, 0.2]))
    mesh = replace(
        mesh,
        vertices=scene_from_world.apply(mesh.vertices).astype(np.float32),
        normals=(mesh.normals @ scene_from_world.rotation.T).astype(np.float32),
    )
    # four photos from 30 m above, whose pixels cover 30 / 600 = 0.05 m
    cameras = capture(
        [look_at(np.array([x, y, 30.0]), np.array([x, y, 0.0]), np.eye(3)[1]) for x in (-2, 2) for y in (-1, 1)]
    )
    turned = np.einsum("nij,jk->nik", cameras.extrinsics[:, :, :3], scene_from_world.rotation.T)
    centers = scene_from_world.apply(cameras.centers)
    extrinsics = np.concatenate([turned, -np.einsum("nij,nj->ni", turned, centers)[..., None]], 2)
    posed = scene_without_points(replace(cameras, extrinsics=extrinsics), scene_from_world.inverse())
    artifacts.SCENE.save(context.inputs["train"], replace(posed, up=scene_from_world.rotation @ UP))
    artifacts.ATLAS_MESH.save(context.inputs["atlas"], mesh)
    artifacts.WORLD_PLACE.save(context.inputs["place"], place)
    write_png(artifacts.BASE_COLOR.load(context.inputs["bake"]), texture)
    write_png(artifacts.PROVENANCE.load(context.inputs["bake"]), provenance)
    return context.out, EXPORT.run(context)


def edges(row: np.ndarray) -> np.ndarray:
    """Where a row of pixels changes, in pixels from its first one's outer edge."""
    return np.flatnonzero(np.diff(row.astype(float)) != 0) + 1


def expect_box(folder: Path, corner_at: np.ndarray, far_at: np.ndarray, base: float) -> None:
    """The lid lies between two places of the map, to half a pixel, 2.5 m over the plane at height `base`."""
    import rasterio

    with rasterio.open(folder / artifacts.SURFACE_MODEL) as file:
        heights, to_map = file.read(1, masked=True), file.transform
    with rasterio.open(folder / artifacts.ORTHOPHOTO) as file:
        assert file.transform == to_map
        picture = file.read()
    pixel = to_map.a
    column, row = (int(value) for value in ~to_map @ ((corner_at + far_at) / 2)[:2])
    assert heights[row, column] == pytest.approx(base + 2.5, abs=1e-3)
    lid = (picture[0] > 150).astype(int)
    for steps in (edges(heights[row].filled(-1) > base + 1), edges(lid[row])):
        np.testing.assert_allclose(to_map.c + pixel * steps, [corner_at[0], far_at[0]], atol=pixel / 2 + 1e-6)
    for steps in (edges(heights[:, column].filled(-1) > base + 1), edges(lid[:, column])):
        np.testing.assert_allclose(to_map.f - pixel * steps, [far_at[1], corner_at[1]], atol=pixel / 2 + 1e-6)
    assert tuple(picture[:3, row, column]) == RED


def test_the_box_lies_on_the_map_of_the_place(tmp_path):
    import rasterio

    offset = (465000.0, 5247000.0, 400.0)
    place = Place(Similarity.identity(), True, "GPS", 0.01, crs="EPSG:32632", offset=offset, up=UP)
    folder, numbers = exported(tmp_path, place)
    assert (
        0.05 <= numbers["ground_resolution"] <= 0.052
    )  # what the photos' pixels cover of the plane; most see it aslant
    assert numbers["ground_crs"] == "EPSG:32632"
    expect_box(folder, BOX[0] + offset, BOX[1] + offset, base=400.0)
    with rasterio.open(folder / artifacts.SURFACE_MODEL) as file:
        assert file.crs.to_epsg() == 32632
        assert file.dtypes == ("float32",)
        heights = file.read(1, masked=True)
        assert file.units == ("metre",)
        west = np.array([file.xy(*place) for place in np.argwhere(~np.ma.getmaskarray(heights))]).min(0)[0]
        assert f"{numbers['ground_resolution']} metres wide" in file.tags()["TIFFTAG_IMAGEDESCRIPTION"]
    assert west == pytest.approx(465000 + SEEN_FROM, abs=0.05)  # nothing where no photo saw anything
    with rasterio.open(folder / artifacts.ORTHOPHOTO) as file:
        alpha = file.read(4)
        assert file.crs.to_epsg() == 32632
        assert [kind.name for kind in file.colorinterp] == ["red", "green", "blue", "alpha"]
    np.testing.assert_array_equal(alpha > 0, ~np.ma.getmaskarray(heights))
    assert set(np.unique(alpha)) == {0, 255}
    assert sorted(numbers["bytes"]) == ["dsm", "orthophoto"]


def test_gps_alone_gives_the_zone_of_utm(tmp_path):
    """Corners by PROJ's own way: topocentric east, north, up to the Earth's centre to the zone."""
    pyproj = pytest.importorskip("pyproj")
    import rasterio

    latitude, longitude, altitude = ORIGIN
    there = pyproj.Transformer.from_pipeline(
        f"+proj=pipeline +step +inv +proj=topocentric +ellps=WGS84 +lat_0={latitude} +lon_0={longitude} "
        f"+h_0={altitude} +step +inv +proj=cart +ellps=WGS84 +step +proj=utm +zone=32 +ellps=WGS84"
    )
    folder, numbers = exported(tmp_path, Place(Similarity.identity(), True, "GPS", 0.01, ORIGIN, 1.2, up=UP))
    assert numbers["ground_crs"] == "EPSG:32632"
    with rasterio.open(folder / artifacts.SURFACE_MODEL) as file:
        assert file.crs.to_epsg() == 32632
        # north of the grid is not north: the lid's middle, and the height of the plane
        middle = there.transform(*BOX.mean(0) * [1, 1, 2])
        row, column = file.index(*middle[:2])
        heights = file.read(1, masked=True)
        assert heights[row, column] == pytest.approx(middle[2], abs=1e-3)
        lid = np.argwhere(heights.filled(0) > altitude + 1)
        found = np.array(file.xy(*lid.mean(0)))
        np.testing.assert_allclose(found, middle[:2], atol=0.5 * file.res[0])
        corners = [there.transform(x, y, BOX[1, 2]) for x in BOX[:, 0] for y in BOX[:, 1]]
        for x, y, _ in corners:  # just inside and just outside of each corner
            inward = np.sign(np.array(middle[:2]) - [x, y]) * file.res[0]
            assert heights[file.index(*(np.array([x, y]) + inward))] > altitude + 1
            assert heights[file.index(*(np.array([x, y]) - inward))] < altitude + 1


@pytest.mark.parametrize(
    ("place", "named"),
    [
        (Place(Similarity.identity()), None),
        (Place(Similarity.identity(), True, "a known distance"), "metre"),
        (Place(Similarity.identity(), True, "4 control points", offset=(100.0, 200.0, 0.0)), "metre"),
    ],
)
def test_without_a_map_the_frame_is_the_models_own(tmp_path, place, named):
    import rasterio

    folder, numbers = exported(tmp_path, place)
    assert "ground_crs" not in numbers
    with rasterio.open(folder / artifacts.ORTHOPHOTO) as file:
        assert (file.crs is None) if named is None else (file.crs.units_factor == (named, 1.0))
        assert file.crs is None or file.crs.to_epsg() is None
    added = np.array(place.offset or (0.0, 0, 0))
    expect_box(folder, BOX[0] + added, BOX[1] + added, base=added[2])


def test_the_resolution_that_is_asked_for(tmp_path):
    import rasterio

    folder, numbers = exported(tmp_path, Place(Similarity.identity(), True, "GPS"), ground_resolution=0.2)
    assert numbers["ground_resolution"] == 0.2
    assert numbers["ground_pixels"] in ([w, h] for w in (60, 61, 62) for h in (50, 51, 52))  # by rounding
    with rasterio.open(folder / artifacts.ORTHOPHOTO) as file:
        assert file.res == (0.2, 0.2)
        assert np.allclose(np.array(file.bounds) / 0.2, np.round(np.array(file.bounds) / 0.2), atol=1e-6)
    (tmp_path / "b").mkdir()
    with pytest.raises(ConfigError, match="more than 134 million pixels") as caught:
        exported(tmp_path / "b", Place(Similarity.identity()), ground_resolution=1e-5)
    assert "export.ground_resolution=0.00095" in caught.value.hint


def test_without_rasterio_the_command_to_get_it_is_named(tmp_path, monkeypatch):
    import sys

    monkeypatch.setitem(sys.modules, "rasterio", None)
    with pytest.raises(SystemRequirementError) as caught:
        exported(tmp_path, Place(Similarity.identity()))
    assert "hineus[survey]" in caught.value.hint


def test_a_picture_in_bands_is_the_same(monkeypatch):
    mesh, texture, provenance = scene()
    grid = ground_grid(mesh.vertices[:, :2], 0.11)
    known = provenance == Provenance.PHOTO
    whole = seen_from_above(mesh, texture, known, grid)
    monkeypatch.setattr(from_above, "MOST_SAMPLES", 7 * 9 * grid.width)
    for one, other in zip(whole, seen_from_above(mesh, texture, known, grid), strict=True):
        np.testing.assert_array_equal(one, other)


def test_neighbours_at_the_same_resolution_share_their_lines():
    west = ground_grid(np.array([[0.13, 7.02], [4.44, 9.25]]), 0.1)
    east = ground_grid(np.array([[4.44, 7.3], [6.0, 9.9]]), 0.1)
    assert (west.west, east.west) == (pytest.approx(0.1), pytest.approx(4.4))
    assert (west.north, west.width, west.height) == (pytest.approx(9.3), 44, 23)


def test_ground_sampling_is_the_median_over_the_ground():
    density = np.array([400.0, 100.0, 25.0, 0.0])
    assert ground_sampling(density, np.array([1.0, 3, 1, 9])) == pytest.approx(0.1)
    assert ground_sampling(np.zeros(2), np.ones(2)) == 0
    assert [two_digits(length) for length in (0.05, 0.0501, 0.0137, 3.0, 123.0)] == [0.05, 0.051, 0.014, 3.0, 130.0]


@pytest.mark.parametrize(
    ("latitude", "longitude", "zone"),
    [(47.0, 8.5, 32632), (-33.9, 151.2, 32756), (0.0, -180.0, 32601), (10.0, 179.99, 32660), (10.0, 180.0, 32601)],
)
def test_zones_of_utm(latitude, longitude, zone):
    assert utm_of(latitude, longitude) == f"EPSG:{zone}"


def test_points_of_a_place_known_by_gps_are_in_its_zone(tmp_path, monkeypatch):
    import sys

    import laspy
    from rigs import shell

    from stages.posing.coordinates import to_grid

    context = workspace(tmp_path, ExportParams(formats=("points",), points_trust=0.0, points_from="everywhere"))
    cloud = shell()
    far = cloud.points.copy()
    far[0] = (3e6, 0, 0)  # one of the wrong ones, where the zone has no coordinates
    artifacts.POINT_CLOUD.save(context.inputs["densify"], replace(cloud, points=far))
    place = Place(Similarity.identity(), True, "GPS", 0.01, ORIGIN, 1.2, up=UP)
    artifacts.WORLD_PLACE.save(context.inputs["place"], place)
    numbers = EXPORT.run(context)
    assert numbers["points_crs"] == "EPSG:32632"
    found = laspy.read(context.out / "points.laz")
    assert found.header.parse_crs().to_epsg() == 32632
    expected = to_grid(from_east_north_up(cloud.points[1:].astype(float), ORIGIN), "EPSG:32632")
    np.testing.assert_allclose(found.xyz, expected, rtol=0, atol=1e-4)
    normals = np.stack([found.NormalX, found.NormalY, found.NormalZ], 1)
    # west of the middle meridian, towards which all meridians lean: north is east of the grid's
    convergence = np.radians((ORIGIN[1] - 9) * np.sin(np.radians(ORIGIN[0])))
    turned = cloud.normals[1:] @ rotation_about(UP, convergence).T
    np.testing.assert_allclose(normals, turned, atol=2e-4)
    monkeypatch.setitem(sys.modules, "pyproj", None)
    warnings = EXPORT.run(context)["warnings"]
    assert any("names no map" in warning["sentence"] and "hineus[geo]" in warning["sentence"] for warning in warnings)
    np.testing.assert_allclose(laspy.read(context.out / "points.laz").xyz, cloud.points[1:], atol=1e-4)
