"""Scale and place from GPS, markers and a known distance, against captures whose metres are known."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from rigs import UP, capture, flight, look_at, ring

from stages.geometry.earth import east_north_up, from_east_north_up, middle_position
from stages.geometry.normalisation import into_frame, rotation_onto
from stages.geometry.place import Place, given_region, locate
from stages.geometry.similarity import Similarity
from stages.geometry.up import angle_deg
from stages.posing.markers import detect_markers, measure_markers

HOME = (47.3769, 8.5417, 408.0)
# metres from the model's frame
TRUE = Similarity(7.3, rotation_onto(UP, np.array([0.48, -0.6, 0.64])), np.array([3.0, -8.0, 12.0]))


def gps_of(metres: np.ndarray, noise: float = 0.0, seed: int = 0) -> np.ndarray:
    """Latitude, longitude and altitude of positions east, north, up of HOME, with GPS noise in metres."""
    import pycolmap

    random = np.random.default_rng(seed)
    transform = pycolmap.GPSTransform(pycolmap.GPSTransformEllipsoid.WGS84)
    return np.asarray(transform.enu_to_ellipsoid(metres + noise * random.normal(size=metres.shape), *HOME))


def model_of(cameras):
    """The same cameras in the model's frame."""
    return into_frame(cameras, TRUE)


# ---------------------------------------------------------------- GPS
def test_east_north_up_against_another_implementation():
    metres = np.random.default_rng(1).uniform(-500, 500, (20, 3))
    np.testing.assert_allclose(east_north_up(gps_of(metres), HOME), metres, atol=1e-5)
    a_minute_north = np.array([[HOME[0] + 1 / 60, HOME[1], HOME[2]]])
    np.testing.assert_allclose(east_north_up(a_minute_north, HOME)[0], [0, 1853, 0], atol=2)


@pytest.mark.parametrize("noise", [0.0, 2.0])
def test_a_flight_gets_its_metres_and_its_north(noise: float):
    cameras, _ = flight()
    model = model_of(cameras)
    found = locate(model.centers, gps_of(cameras.centers, noise))
    assert found.used > 0.8 * len(model)
    assert found.world_from_poses.scale == pytest.approx(TRUE.scale, rel=1e-6 + 4 * found.scale_error)
    assert found.scale_error < 0.01
    assert angle_deg(found.up, TRUE.rotation[2]) < 0.01 + 4 * found.tilt_error_deg
    truth = east_north_up(gps_of(cameras.centers), found.origin)
    assert np.linalg.norm(found.world_from_poses.apply(model.centers) - truth, axis=1).max() < 0.02 + 2 * noise
    if noise:
        assert found.residual == pytest.approx(np.sqrt(3) * noise, rel=0.25)


def test_wild_positions_do_not_move_the_place():
    cameras, _ = flight()
    model, positions = model_of(cameras), gps_of(cameras.centers, 0.5)
    positions[::5, :2] += 0.01  # a kilometre off
    found = locate(model.centers, positions)
    assert found.world_from_poses.scale == pytest.approx(TRUE.scale, rel=0.01)
    assert found.used <= 0.8 * len(model) + 1


def test_positions_of_another_walk_are_refused():
    cameras = capture(ring(np.zeros(3), distance=20.0, count=8))
    elsewhere = np.random.default_rng(2).uniform(-20, 20, (8, 3))
    with pytest.raises(ValueError, match=r"agree with the cameras|GPS positions miss"):
        locate(model_of(cameras).centers, gps_of(elsewhere))


def test_a_phone_around_a_chair_is_refused_with_both_numbers():
    cameras = capture(ring(np.zeros(3), distance=2.0, count=30))
    with pytest.raises(ValueError, match=r"GPS positions miss the cameras by .* while they spread over"):
        locate(model_of(cameras).centers, gps_of(cameras.centers, 4.0))


def test_too_few_or_in_line_is_refused():
    cameras, _ = flight()
    centers, positions = cameras.centers, gps_of(cameras.centers)
    with pytest.raises(ValueError, match="3 photos carry a GPS position with altitude, 4 are needed"):
        locate(centers[:3], positions[:3])
    line = np.linspace([0, 0, 2], [100, 40, 2], 9)
    with pytest.raises(ValueError, match="one line"):
        locate(line, gps_of(line))


# ---------------------------------------------------------------- markers
def test_a_drawn_marker_is_found_where_it_is():
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    page = np.full((300, 400), 255, np.uint8)
    page[60:180, 100:220] = cv2.aruco.generateImageMarker(dictionary, 7, 120)
    found = detect_markers(np.repeat(page[..., None], 3, 2), "4X4_50")
    assert list(found) == [7]
    expected = np.array([[100, 60], [220, 60], [220, 180], [100, 180]])  # edges: corners of pixels
    np.testing.assert_allclose(found[7], expected, atol=0.6)
    assert detect_markers(np.full((100, 100, 3), 255, np.uint8), "4X4_50") == {}


def test_a_number_seen_twice_in_one_photo_names_no_marker():
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    page = np.full((300, 400), 255, np.uint8)
    for x, number in ((20, 7), (150, 7), (280, 3)):
        page[60:160, x : x + 100] = cv2.aruco.generateImageMarker(dictionary, number, 100)
    assert list(detect_markers(np.repeat(page[..., None], 3, 2), "4X4_50")) == [3]


SIDE = 0.2  # metres
MARKERS = {4: np.array([0.3, 0.1, 0.0]), 9: np.array([-0.5, 0.2, 0.0])}


def sightings(cameras, noise: float = 0.0, seed: int = 0) -> list[dict[int, np.ndarray]]:
    """Corners of flat markers as each camera (in metres) sees them."""
    random = np.random.default_rng(seed)
    square = SIDE / 2 * np.array([[-1, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]])
    return [
        {
            number: cameras.project(i, middle + square)[0] + noise * random.normal(size=(4, 2))
            for number, middle in MARKERS.items()
        }
        for i in range(len(cameras))
    ]


@pytest.mark.parametrize("noise", [0.0, 0.5])
def test_markers_give_metres(noise: float):
    cameras = capture(ring(np.zeros(3), distance=2.0, pitch_deg=40))
    found = measure_markers(model_of(cameras), sightings(cameras, noise), SIDE)
    assert (found.markers, found.sides) == (2, 8)
    assert found.factor == pytest.approx(TRUE.scale, rel=1e-6 + 4 * found.error)
    assert found.error < 0.01
    assert (found.error > 1e-5) == (noise > 0)


def test_a_marker_that_was_moved_or_seen_once_measures_nothing():
    cameras = capture(ring(np.zeros(3), distance=2.0, pitch_deg=40, count=6))
    seen = sightings(cameras)
    moved = [{4: each[9] if i % 2 else each[4]} for i, each in enumerate(seen)]
    assert measure_markers(cameras, moved, SIDE) is None
    assert measure_markers(cameras, [seen[0]] + [{}] * 5, SIDE) is None
    # two photos from one place know the direction, not the distance
    twins = capture([look_at(np.array([x, -2.0, 1.0]), np.zeros(3)) for x in (0.0, 0.01)])
    assert measure_markers(twins, sightings(twins), SIDE) is None


# ---------------------------------------------------------------- the record
def test_a_far_origin_moves_near_and_a_near_one_stays():
    place = Place(Similarity(1.0, np.eye(3), np.zeros(3)))
    assert place.near(np.array([30.0, 2.0, 1.0]), 5.0) is place
    utm = np.array([465123.25, 5247811.5, 410.0])
    moved = place.near(utm, 5.0)
    np.testing.assert_allclose(moved.world_from_poses.apply(utm), [0.25, -0.5, 0.0], atol=0.51)
    corner = utm + 1e-3
    there = moved.world_from_poses.apply(corner).astype(np.float32)
    np.testing.assert_allclose(there - moved.world_from_poses.apply(utm), 1e-3, atol=1e-6)


def test_what_the_record_says():
    assert "not known" in Place(TRUE).describe()
    text = Place(TRUE, True, "GPS", 0.004, HOME, 1.3).describe()
    assert "metres ± 0.4 %, from GPS" in text
    assert "latitude 47.376900" in text
    known = Place(TRUE).rescaled(2.0, "a known distance", None)
    assert known.world_from_poses.scale == pytest.approx(2 * TRUE.scale)
    np.testing.assert_allclose(known.world_from_poses.apply(np.ones(3)), 2 * TRUE.apply(np.ones(3)))
    assert known.describe() == "Lengths are in metres, from a known distance."


def test_a_given_box_and_sphere():
    still = Similarity.identity()
    sphere = given_region("sphere", (1, 2, 3, 4), still)
    assert (*sphere.center, sphere.radius) == (1, 2, 3, 4)
    box = given_region("box", (0, 0, 0, 2, 4, 4), still)
    np.testing.assert_array_equal(box.box, [[0, 0, 0], [2, 4, 4]])
    np.testing.assert_array_equal(box.center, [1, 2, 2])
    assert 3.0 / box.radius < 0.98  # the corners survive the cut near the sphere


def test_a_region_given_in_metres_is_brought_into_the_frame_of_the_poses():
    world_from_poses = Similarity(2.0, np.eye(3)[[1, 2, 0]], np.array([10.0, 20, 30]))
    sphere = given_region("sphere", (10, 20, 30, 4), world_from_poses)
    np.testing.assert_allclose((*sphere.center, sphere.radius), (0, 0, 0, 2), atol=1e-12)
    box = given_region("box", (10, 20, 30, 12, 22, 34), world_from_poses)
    corners = world_from_poses.apply(box.box_corners())
    np.testing.assert_allclose(corners.min(0), [10, 20, 30])
    np.testing.assert_allclose(corners.max(0), [12, 22, 34])
    np.testing.assert_allclose(np.linalg.norm(box.box_corners() - box.center, axis=1), box.radius / 1.05)


# ---------------------------------------------------------------- the globe
@pytest.mark.parametrize(
    "home",
    [
        (-16.8, 180.0, 5.0),
        (-16.8, -180.0, 5.0),
        (90.0, 0.0, 2800.0),
        (-89.9999, 77.0, 2800.0),
        (31.5, 35.5, -430.0),
    ],
)
def test_a_flight_anywhere_on_the_globe(home: tuple[float, float, float]):
    import pycolmap

    cameras, _ = flight()
    transform = pycolmap.GPSTransform(pycolmap.GPSTransformEllipsoid.WGS84)
    positions = np.asarray(transform.enu_to_ellipsoid(cameras.centers, *home))
    found = locate(model_of(cameras).centers, positions)
    assert found.used >= len(cameras) - 2
    assert found.residual < 1e-4
    assert found.world_from_poses.scale == pytest.approx(TRUE.scale, rel=1e-6)
    assert angle_deg(found.up, TRUE.rotation[2]) < 0.01
    truth = east_north_up(positions, found.origin)
    np.testing.assert_allclose(found.world_from_poses.apply(model_of(cameras).centers), truth, atol=0.01)
    assert abs(abs(found.origin[1]) - 180) < 0.01 or abs(home[1]) < 179


@pytest.mark.parametrize("origin", [HOME, (0.0, 180.0, 0.0), (89.99, -120.0, 3000.0), (-90.0, 0.0, -10.0)])
def test_there_and_back(origin: tuple[float, float, float]):
    metres = np.random.default_rng(3).uniform(-5000, 5000, (30, 3))
    np.testing.assert_allclose(east_north_up(from_east_north_up(metres, origin), origin), metres, atol=1e-6)


def test_less_than_half_of_the_positions_may_be_anywhere():
    positions = np.tile((10.0, 179.9999, 7.0), (5, 1))
    positions[:2] = (0.1, 0.1, 9000.0)
    positions[2, 1] = -179.9999
    latitude, longitude, altitude = middle_position(positions)
    assert latitude == pytest.approx(10, abs=0.01)
    assert longitude % 360 == pytest.approx(180, abs=0.01)
    assert altitude == 7


def test_one_photo_a_thousand_kilometres_away_changes_nothing():
    cameras, _ = flight()
    positions = gps_of(cameras.centers, 0.5)
    positions[3, 0] += 9
    found = locate(model_of(cameras).centers, positions)
    assert found.world_from_poses.scale == pytest.approx(TRUE.scale, rel=0.01)
    assert found.origin[:2] == pytest.approx(HOME[:2], abs=0.01)


@pytest.mark.parametrize("places", [1, 3])
def test_photos_of_one_place_tell_nothing(places: int):
    cameras, _ = flight()
    positions = gps_of(cameras.centers)[np.arange(len(cameras)) % places]
    with pytest.raises(ValueError, match=f"only {places} different positions, 4 are needed"):
        locate(model_of(cameras).centers, positions)


def test_a_far_origin_on_earth_moves_and_stays_on_earth():
    place = Place(TRUE, True, "GPS", origin=HOME)
    far = np.array([40e3, -30e3, 200.0])
    moved = place.near(far, 5.0)
    inside = far + np.array([[0.0, 0, 0], [3, 2, 1]])
    poses = TRUE.inverse().apply(inside)
    np.testing.assert_allclose(
        from_east_north_up(moved.world_from_poses.apply(poses), moved.origin),
        from_east_north_up(inside, HOME),
        atol=1e-8,
    )
    assert np.abs(moved.world_from_poses.apply(poses)).max() < 5
