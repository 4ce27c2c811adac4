"""Ground control points: files as people write them, points placed from marks, and the world they make."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from rigs import ring

from stages.artifacts import ImageRecord
from stages.errors import ConfigError, InputError
from stages.geometry.earth import east_north_up
from stages.geometry.place import Place
from stages.geometry.similarity import Similarity
from stages.posing.control import fit_control, place_point
from stages.posing.control_files import GroundControl, KnownPoint, Sighting, coordinate_system, read_control
from stages.posing.coordinates import to_geodetic, to_grid
from stages.posing.marks import match_sightings
from stages.posing.survey import survey

UTM = np.array([465123.25, 5247811.5, 410.0])  # EPSG:32632, in Zurich
# metres from the frame of the poses
TRUE = Similarity(7.3, np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), UTM)
POINTS = np.array([[1.0, 0, 0], [0, 1, 0], [-1, 0, 0.1], [0, -1, 0.3], [0.5, 0.5, 0.4], [-0.6, 0.4, 0]])
LENS = pycolmap.Camera(model="SIMPLE_RADIAL", width=640, height=480, params=[600, 320, 240, 0.08], camera_id=1)


class Photo:
    """As much of a pycolmap image as is asked of one."""

    camera_id = 1

    def __init__(self, name: str, pose: np.ndarray) -> None:
        self.name = name
        self._pose = pycolmap.Rigid3d(pycolmap.Rotation3d(pose[:, :3]), pose[:, 3])

    def cam_from_world(self) -> pycolmap.Rigid3d:
        return self._pose


PHOTOS = [Photo(f"{i:03d}.jpg", pose) for i, pose in enumerate(ring(np.zeros(3), count=8))]
RECORDS = [
    ImageRecord(p.name, f"dir/{p.name}", 640, 480, 600.0, "c", 1.0, False, "", taken=(1280, 960)) for p in PHOTOS
]


def pixel(photo: Photo, point: np.ndarray) -> np.ndarray:
    return LENS.img_from_cam((photo.cam_from_world() * point)[None])[0]


def control(noise: float = 0.0, points: np.ndarray = POINTS, checks: int = 0) -> GroundControl:
    """Marks in the photos as they were taken, twice as large as they were read; the last points only check."""
    random = np.random.default_rng(0)
    known = TRUE.apply(points)
    return GroundControl(
        Path("gcp.csv"),
        tuple(KnownPoint(f"P{i}", tuple(xyz), i >= len(points) - checks) for i, xyz in enumerate(known)),
        tuple(
            Sighting(f"P{i}", photo.name, tuple(2 * pixel(photo, point) + noise * random.normal(size=2)))
            for i, point in enumerate(points)
            for photo in PHOTOS
        ),
    )


def surveyed(given: GroundControl, crs: str = ""):
    return survey(given, crs, PHOTOS, {1: LENS}, RECORDS)


# ---------------------------------------------------------------- files
TABLE = """name,x,y,z,photo,px,py
A,1,2,3,a.jpg,10,20
A,1,2,3,b.jpg,11.5,21
check1,4,5,6,a.jpg,30,40
"""
SAME = {
    "plain": TABLE,
    "byte-order mark": "\ufeff" + TABLE,
    "semicolons": TABLE.replace(",", ";"),
    "tabs": TABLE.replace(",", "\t"),
    "no names": TABLE.split("\n", 1)[1],
    "names of Metashape": TABLE.replace("name,x,y,z,photo,px,py", "#Label,X/Easting,Y/Northing,Z/Altitude,Image,u,v"),
    "units": TABLE.replace("name,x,y,z,photo,px,py", 'Point ID,"X [m]",Y (m),Z [m],Image Name,px,py'),
    "OpenDroneMap": "1 2 3 10 20 a.jpg A\n1 2 3 11.5 21 b.jpg A\n4\t5\t6\t30\t40\ta.jpg\tcheck1\n",
    "x and y are pixels": TABLE.replace("name,x,y,z,photo,px,py", "Marker,East,North,Up,Picture,x,y"),
    "coordinates once": TABLE.replace("A,1,2,3,b", "A,,,,b"),
    "comments": "# taken by hand\n" + TABLE,
    "Windows": TABLE.replace("\n", "\r\n\r\n"),
}


@pytest.mark.parametrize("kind", SAME)
def test_a_table_however_it_is_written(kind: str, tmp_path: Path):
    (tmp_path / "gcp.csv").write_text(SAME[kind], encoding="utf-8", newline="")
    found = read_control(tmp_path / "gcp.csv")
    assert found.points == (KnownPoint("A", (1, 2, 3), False), KnownPoint("check1", (4, 5, 6), True))
    assert found.sightings == (
        Sighting("A", "a.jpg", (10, 20)),
        Sighting("A", "b.jpg", (11.5, 21)),
        Sighting("check1", "a.jpg", (30, 40)),
    )
    assert found.crs == ""


def test_utf_16_and_latin_names(tmp_path: Path):
    for encoding in ("utf-16", "cp1252"):
        (tmp_path / "gcp.txt").write_bytes(TABLE.replace("A,", "Größe,").encode(encoding))
        assert read_control(tmp_path / "gcp.txt").points[0].name == "Größe"


@pytest.mark.parametrize(
    "parts",
    [
        ("name,x,y,z,role\nA,1,2,3,control\nB,4,5,6,check\n", "name,photo,px,py\nA,a.jpg,10,20\nB,b.jpg,1,2\n"),
        ("A,1,2,3\ncheckB,4,5,6\n", "a.jpg,A,10,20\nb.jpg,checkB,1,2\n"),
        ("A 1 2 3\ncheckB 4 5 6\n", "#image,name,x,y\na.jpg,A,10,20\nb.jpg,checkB,1,2\n"),
    ],
)
def test_a_table_of_points_and_one_of_marks(parts: tuple[str, str], tmp_path: Path):
    for name, text in zip(("points.csv", "marks.csv"), parts, strict=True):
        (tmp_path / name).write_text(text)
    found = read_control(tmp_path)
    assert [(point.xyz, point.check) for point in found.points] == [((1, 2, 3), False), ((4, 5, 6), True)]
    assert [(each.photo, each.pixel) for each in found.sightings] == [("a.jpg", (10, 20)), ("b.jpg", (1, 2))]


@pytest.mark.parametrize(
    ("line", "crs"),
    [
        ("EPSG:32632", "EPSG:32632"),
        ("epsg 2056", "EPSG:2056"),
        ("# CRS: EPSG:25832", "EPSG:25832"),
        ("WGS84 UTM 16N", "EPSG:32616"),
        ("WGS 84 / UTM zone 7S", "EPSG:32707"),
        ("+proj=utm +zone=10 +ellps=WGS84 +units=m +no_defs", "+proj=utm +zone=10 +ellps=WGS84 +units=m +no_defs"),
        ("LOCAL", ""),
    ],
)
def test_the_coordinate_system_on_top(line: str, crs: str, tmp_path: Path):
    (tmp_path / "gcp_list.txt").write_text(f"{line}\n1 2 3 10 20 a.jpg A\n")
    assert read_control(tmp_path / "gcp_list.txt").crs == crs


def test_columns_called_longitude_and_latitude_are_degrees(tmp_path: Path):
    (tmp_path / "gcp.csv").write_text(TABLE.replace("name,x,y,z", "name,lat,lon,alt"))
    found = read_control(tmp_path / "gcp.csv")
    assert found.crs == "EPSG:4326"
    assert found.points[0].xyz == (2, 1, 3)
    assert coordinate_system("A,1,2,3") == ""


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (TABLE.replace(",", ";").replace("11.5", "11,5"), r"line 3: 11,5 has a decimal comma"),
        ("1,5 2,5 3,5 10 20 a.jpg A\n", "1,5 has a decimal comma"),
        (TABLE.replace("A,1,2,3,b", "A,1,2,9,b"), "line 3: A is at 1 2 9, before it was at 1 2 3"),
        (TABLE.replace("b.jpg", "a.jpg"), "A is marked twice in a.jpg"),
        (TABLE.replace("10,20", "ten,20"), "px is 'ten', a number is needed"),
        (TABLE.replace("A,1,", "A,nan,", 1), "x is 'nan', a number is needed"),
        ("name,photo,px,py\nA,a.jpg,1,2\n", "names 0 points with coordinates and 1 pixel"),
        ("name,x,y,z\nA,1,2,3\n", "names 1 points with coordinates and 0 pixel"),
        ("hello world\n", "line 1 is not understood"),
        ("", "names 0 points"),
        ("PK\x03\x04", "is no text"),
        (TABLE.replace("A,1,", "A,1e300,", 1), "x is '1e300', a number is needed"),
        (TABLE.replace("10,20", "9" * 400 + ",20"), "px is '9{40}', a number is needed"),
        (TABLE + "a" * 200_000, "line 5 has more than 10000 characters"),
        ("(" * 9000 + ",a,b\n" + ("1" * 9000 + "x 1\n") * 100, "line 1 is not understood"),
        ("\n" * 900_000, "names 0 points"),
    ],
)
def test_what_cannot_be_read_is_said(text: str, message: str, tmp_path: Path):
    (tmp_path / "gcp.csv").write_text(text)
    with pytest.raises(InputError, match=message):
        read_control(tmp_path / "gcp.csv")


# ---------------------------------------------------------------- points from marks
def test_a_point_is_where_the_marks_meet_through_the_lens():
    pixels = np.array([pixel(photo, POINTS[0]) for photo in PHOTOS])
    found = place_point(PHOTOS, {1: LENS}, pixels)
    np.testing.assert_allclose(found.position, POINTS[0], atol=1e-8)
    assert found.errors.max() < 1e-6


def test_a_mark_on_the_wrong_thing_is_found_out():
    pixels = np.array([pixel(photo, POINTS[0]) for photo in PHOTOS])
    pixels[2] += (25, -10)
    found = place_point(PHOTOS, {1: LENS}, pixels)
    np.testing.assert_allclose(found.position, POINTS[0], atol=1e-8)
    assert found.agrees.tolist() == [i != 2 for i in range(8)]
    assert found.errors[2] == pytest.approx(np.hypot(25, 10))


def test_marks_that_were_set_by_hand_all_count():
    rough = np.random.default_rng(0).normal(scale=3, size=(8, 2))
    pixels = np.array([pixel(photo, POINTS[0]) for photo in PHOTOS]) + rough
    found = place_point(PHOTOS, {1: LENS}, pixels)
    assert found.agrees.all()
    np.testing.assert_allclose(found.position, POINTS[0], atol=0.03)


def test_where_most_marks_are_wrong_none_is_believed():
    pixels = np.array([pixel(photo, POINTS[0]) for photo in PHOTOS])
    for other in (pixels / 2, pixels * (1, -1) + (0, 480), pixels[:, ::-1]):
        assert place_point(PHOTOS, {1: LENS}, other).position is None


def test_one_mark_or_two_that_do_not_meet_place_nothing():
    pixels = np.array([pixel(photo, POINTS[0]) for photo in PHOTOS])
    assert place_point(PHOTOS[:1], {1: LENS}, pixels[:1]).position is None
    assert place_point([], {1: LENS}, pixels[:0]).position is None
    twin = [PHOTOS[0], PHOTOS[0]]
    assert place_point(twin, {1: LENS}, pixels[[0, 0]]).position is None
    assert place_point(PHOTOS[:2], {1: LENS}, pixels[:2] + np.array([[0, 90], [0, -90]])).position is None


# ---------------------------------------------------------------- the fit
def test_exact_points_give_the_similarity():
    fit = fit_control(POINTS, TRUE.apply(POINTS))
    np.testing.assert_allclose(fit.similarity.apply(POINTS), TRUE.apply(POINTS), atol=1e-6)
    assert fit.used.all()
    assert fit.residual < 1e-6


def test_left_out_residuals_against_a_fit_by_hand():
    known = TRUE.apply(POINTS) + 0.05 * np.random.default_rng(1).normal(size=POINTS.shape)
    fit = fit_control(POINTS, known)
    from stages.geometry.similarity import align_points

    for i in range(len(POINTS)):
        rest = np.arange(len(POINTS)) != i
        expected = np.linalg.norm(align_points(POINTS[rest], known[rest]).apply(POINTS[i]) - known[i])
        assert fit.left_out[i] == pytest.approx(expected)
    assert fit.used.all()
    assert 0.02 < fit.residual < 0.2
    assert fit.scale == pytest.approx(7.3, rel=5 * fit.scale_error)


def test_a_point_with_wrong_coordinates_is_left_out():
    known = TRUE.apply(POINTS) + 0.01 * np.random.default_rng(1).normal(size=POINTS.shape)
    known[4, 0] += 10  # a typing error
    fit = fit_control(POINTS, known)
    assert fit.used.tolist() == [i != 4 for i in range(6)]
    assert fit.left_out[4] == pytest.approx(10, abs=0.2)
    assert fit.scale == pytest.approx(7.3, rel=0.01)


@pytest.mark.parametrize(
    ("points", "why"),
    [(POINTS[:2], "2 points could be placed, 3 are needed"), (np.outer([0.0, 1, 2, 5], [1, 2, 3]), "on one line")],
)
def test_what_only_tells_the_scale(points: np.ndarray, why: str):
    fit = fit_control(points, TRUE.apply(points))
    assert fit.similarity is None
    assert fit.scale == pytest.approx(7.3)
    assert why in fit.open


def test_one_point_tells_nothing():
    with pytest.raises(ValueError, match="1 points could be placed, 2 are needed"):
        fit_control(POINTS[:1], POINTS[:1])
    with pytest.raises(ValueError, match="one place"):
        fit_control(np.zeros((4, 3)), POINTS[:4])


# ---------------------------------------------------------------- all of it
def test_control_points_place_the_world_and_check_points_check_it():
    found = surveyed(control(noise=1.0, checks=2))
    assert found.warnings == ()
    assert found.fit.scale == pytest.approx(7.3, rel=0.005)
    np.testing.assert_allclose(found.fit.similarity.apply(POINTS), TRUE.apply(POINTS), atol=0.05)
    assert [point.used for point in found.points] == [True] * 4 + [False] * 2
    assert all(0 < point.left_out_m < 0.1 for point in found.points)
    errors = [mark.error_px for point in found.points for mark in point.marks]
    assert np.sqrt(np.mean(np.square(errors)) / 2) == pytest.approx(1.0, rel=0.2)  # in pixels of the photo as taken


def test_marks_that_miss_and_points_that_are_not_placed_are_named():
    given = control()
    marks = [each for each in given.sightings if each.point != "P5" or each.photo == "000.jpg"]
    at = next(i for i, each in enumerate(marks) if (each.point, each.photo) == ("P1", "003.jpg"))
    marks[at] = replace(marks[at], pixel=(marks[at].pixel[0] + 60, marks[at].pixel[1]))
    found = surveyed(replace(given, sightings=tuple(marks)))
    assert found.warnings[0] == (
        "1 of 8 marks of control point P1 are not used, because they miss where the other photos see it: by 60 px in "
        "dir/003.jpg."
    )
    assert any("P5 (marked in 1 photo with a pose, 2 are needed)" in warning for warning in found.warnings)
    assert found.fit.residual < 1e-6
    assert found.points[5].miss is None


def test_too_few_points_are_counted():
    given = control(points=POINTS[:3])
    few = tuple(each for each in given.sightings if each.point == "P0" or each.photo == "000.jpg")
    with pytest.raises(InputError, match=r"1 points could be placed, 2 are needed.*P1 .marked in 1 photo") as caught:
        surveyed(replace(given, sightings=few))
    assert "--no-control" in caught.value.hint


@pytest.mark.parametrize("kind", ["mixed up", "degrees"])
def test_coordinates_that_do_not_fit_are_doubted(kind: str):
    given = control(points=POINTS[:4] * (1, 1, kind != "degrees"))
    xyz = [given.points[i].xyz for i in (1, 2, 0, 3)]
    if kind == "degrees":
        xyz = [(8.5 + (x - UTM[0]) / 75e3, 47.3 + (y - UTM[1]) / 111e3, z) for x, y, z in (p.xyz for p in given.points)]
    mixed = tuple(replace(point, xyz=at) for point, at in zip(given.points, xyz, strict=True))
    found = surveyed(replace(given, points=mixed))
    assert any("do not lie to each other as their coordinates say" in warning for warning in found.warnings)


def test_names_of_photos():
    given = control()
    renamed = [replace(each, photo="C:/x/" + each.photo.upper().replace(".JPG", "")) for each in given.sightings]
    assert surveyed(replace(given, sightings=tuple(renamed))).fit.residual < 1e-6
    other = tuple(replace(each, photo="IMG_" + each.photo) for each in given.sightings)
    with pytest.raises(InputError, match=r"None of the 8 photos that gcp.csv marks .* e.g. IMG_000.jpg, photos are"):
        surveyed(replace(given, sightings=other))
    some = (replace(given.sightings[0], photo="gone.jpg"), *given.sightings[1:])
    assert surveyed(replace(given, sightings=some)).warnings == (
        "1 of 9 photos with control points are not there, e.g. gone.jpg.",
    )


def test_which_photo_a_name_means():
    sizes = {"a/IMG_1.JPG": (100, 100), "b/IMG_1.JPG": (100, 100), "c/x.jpg": (100, 100), "c/X.jpg": (100, 100)}
    one = GroundControl(Path("g"), (KnownPoint("A", (0, 0, 0), False),), (Sighting("A", "", (1, 1)),))

    def meant(name: str) -> str:
        found, _ = match_sightings(replace(one, sightings=(Sighting("A", name, (1, 1)),)), sizes)
        return found[0][1]

    assert meant("D:/flight/b/img_1.jpg") == "b/IMG_1.JPG"
    assert meant("c/x.jpg") == "c/x.jpg"
    for name in ("IMG_1.JPG", "x.png"):
        with pytest.raises(InputError, match="fits 2 photos"):
            meant(name)


def test_a_mark_outside_its_photo_is_refused():
    given = control()
    beyond = (replace(given.sightings[0], pixel=(1300.0, 20.0)), *given.sightings[1:])
    with pytest.raises(InputError, match=r"P0 is marked at 1300 20 in dir/000.jpg, which has 1280 x 960 pixels"):
        surveyed(replace(given, sightings=beyond))


# ---------------------------------------------------------------- coordinate systems
def test_utm_becomes_metres_on_earth_and_comes_back():
    pytest.importorskip("pyproj")
    found = surveyed(control(), "EPSG:32632")
    assert found.origin[:2] == pytest.approx((47.382, 8.538), abs=0.01)
    assert found.fit.scale == pytest.approx(7.3 / 0.99961, rel=1e-4)  # UTM's grid is smaller than the ground
    place = Place(found.fit.similarity, True, "6 control points", origin=found.origin)
    grid = to_grid(to_geodetic(TRUE.apply(POINTS), "EPSG:32632", "points"), "EPSG:32632")
    np.testing.assert_allclose(grid, TRUE.apply(POINTS), atol=1e-4)
    enu = east_north_up(to_geodetic(TRUE.apply(POINTS), "EPSG:32632", "points"), found.origin)
    in_grid = place.in_grid("EPSG:32632", enu, grid)
    np.testing.assert_allclose(in_grid.world_from_poses.apply(POINTS) + in_grid.offset, grid, atol=1e-3)
    assert "plus 465122 5247811 411" in in_grid.describe()


def test_feet_degrees_and_heights_above_a_geoid():
    pytest.importorskip("pyproj")
    feet = to_geodetic(np.array([[981106.0, 195544.0, 100.0]]), "EPSG:2263", "points")  # New York, US survey feet
    np.testing.assert_allclose(feet[0], [40.7034, -74.0126, 30.48], atol=2e-3)
    degrees = to_geodetic(np.array([[179.9, -16.8, 5.0]]), "EPSG:4326", "points")
    np.testing.assert_allclose(degrees, [[-16.8, 179.9, 5.0]])
    geoid = to_geodetic(np.array([[530000.0, 180000.0, 30.0]]), "EPSG:7405", "points")  # British grid, ODN height
    np.testing.assert_allclose(geoid[0], [51.504, -0.128, 30.0], atol=2e-3)
    fiji = to_geodetic(np.array([[2000000.0, 4000000.0, 5.0]]), "EPSG:3460", "points")  # its area crosses 180 degrees
    np.testing.assert_allclose(fiji[0], [-17.0, 178.75, 5.0], atol=0.01)


@pytest.mark.parametrize(
    ("crs", "xyz", "kind", "message"),
    [
        ("EPSG:32632", [5247811.5, 465123.25, 410.0], InputError, "1 of 1 points lie outside the area of WGS 84 / UTM"),
        ("EPSG:4326", [47.4, 98.5, 410.0], InputError, "lie outside the area of WGS 84"),
        ("EPSG:99999", [0.0, 0.0, 0.0], ConfigError, "There is no coordinate system EPSG:99999"),
        ("+proj=utm +zone=32 +init=/dev/zero:1", [0.0, 0.0, 0.0], ConfigError, "There is no coordinate system"),
        ("+proj=utm +zone=32 +nadgrids=/dev/zero", [0.0, 0.0, 0.0], ConfigError, "There is no coordinate system"),
        ("EPSG:4978", [1.0, 2.0, 3.0], ConfigError, "has no east and north"),
    ],
)
def test_coordinates_that_cannot_be(crs: str, xyz: list[float], kind: type[Exception], message: str):
    pytest.importorskip("pyproj")
    with pytest.raises(kind, match=message):
        to_geodetic(np.array([xyz]), crs, "points")


@pytest.mark.parametrize(
    ("crs", "message"), [("EPSG:2263", "counts in US survey foot"), ("EPSG:4326", "counts in degree")]
)
def test_results_are_in_grids_of_metres(crs: str, message: str):
    pytest.importorskip("pyproj")
    with pytest.raises(ConfigError, match=message):
        to_grid(np.array([[40.7, -74.0, 0.0]]), crs)


def test_without_pyproj_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(__import__("sys").modules, "pyproj", None)
    from stages.errors import SystemRequirementError

    with pytest.raises(SystemRequirementError) as caught:
        to_geodetic(np.zeros((1, 3)), "EPSG:32632", "points")
    assert "hineus[geo]" in caught.value.hint
