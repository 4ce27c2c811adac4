"""Undistorted images, masks and the scene, on a capture whose projections are known exactly."""

from __future__ import annotations

import re
from dataclasses import fields, replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from dotted_capture import (
    BALL,
    CENTER,
    DOTS,
    FOCAL,
    HEIGHT,
    MODELS,
    NUM_CAMERAS,
    UP,
    WIDTH,
    cam_from_world,
    dots_seen,
    undistort,
    write_capture,
)
from rigs import dome_on_a_table, sightings

from configs.params import PlaceParams
from stages import artifacts
from stages.artifacts import ImageSet
from stages.errors import ConfigError, InputError, WorkspaceError
from stages.geometry.cameras import PinholeCameras, PosedScene
from stages.geometry.place import Place, given_region
from stages.geometry.plane import Plane
from stages.geometry.similarity import Similarity
from stages.place import _given_region
from stages.posing.undistortion import plan_warp, png_names, warp_maps


def place_of(root: Path) -> Place:
    return artifacts.WORLD_PLACE.load(root / "place")


def world_from(scene: PosedScene, root: Path) -> Similarity:
    return scene.world_from_scene(place_of(root))


@pytest.mark.parametrize(("model_name", "parameters"), MODELS)
@pytest.mark.parametrize("max_side", [1600, 200])
def test_points_appear_where_the_scene_cameras_project_them(
    tmp_path: Path, model_name: str, parameters: list[float], max_side: int
):
    inputs = write_capture(tmp_path, model_name, parameters, masks=False)
    scene, out, numbers = undistort(inputs, tmp_path, max_side=max_side)
    assert numbers["images"] == NUM_CAMERAS
    assert scene.cameras.sizes.max() <= max_side
    np.testing.assert_allclose(world_from(scene, tmp_path).apply(scene.points.astype(float)), DOTS, atol=1e-5)
    for i, name in enumerate(scene.cameras.names):
        photo = cv2.imread(str(artifacts.Pictures(out).path(name)), cv2.IMREAD_GRAYSCALE)
        assert photo.shape[::-1] == tuple(scene.cameras.sizes[i])
        pixels, depth = scene.cameras.project(i, scene.points)
        assert depth.min() > 0
        apart = np.linalg.norm(pixels[:, None] - pixels[None], axis=2) + 1e9 * np.eye(len(pixels))
        alone = (apart.min(1) > 14) & np.all((pixels > 8) & (pixels < scene.cameras.sizes[i] - 8), axis=1)
        assert alone.sum() >= 2
        found = dots_seen(photo, pixels[alone])
        np.testing.assert_allclose(found, pixels[alone], atol=0.15)


@pytest.mark.parametrize("max_side", [None, 200])
@pytest.mark.parametrize("shift", [(96.0, -48.0), (-60.0, 30.0)])
def test_rays_are_those_of_the_photo_where_the_principal_point_is_off_the_middle(shift, max_side):
    import pycolmap

    params = [500.0, 320 + shift[0], 240 + shift[1], -0.2, 0.08]
    camera = pycolmap.Camera(model="RADIAL", width=640, height=480, params=params)
    warp = plan_warp(camera, max_side)
    where = np.stack(warp_maps(camera, warp), -1).astype(float) + 0.5  # in the photo, or the reduced one
    if warp.shrink_to is not None:
        where *= np.array([camera.width, camera.height]) / warp.shrink_to
    of_photo = np.asarray(camera.cam_from_img(where.reshape(-1, 2)))
    pixels = np.stack(np.meshgrid(np.arange(warp.size[0]) + 0.5, np.arange(warp.size[1]) + 0.5), -1).reshape(-1, 2)
    rays = np.concatenate([pixels, np.ones((len(pixels), 1))], 1) @ np.linalg.inv(warp.intrinsics).T
    assert camera.mean_focal_length() * np.abs(rays[:, :2] - of_photo).max() < 1e-3  # pixels
    assert (where > -0.5).all()
    assert (where < [640.5, 480.5]).all()
    off = warp.intrinsics[:2, 2] - np.array(warp.size) / 2
    assert (np.abs(off) > 0.5 * np.abs(shift) * max(warp.size) / 640).all()  # cropping moves it towards the middle
    assert (np.sign(off) == np.sign(shift)).all()


def test_image_pixels_all_come_from_the_photo(tmp_path: Path):
    inputs = write_capture(tmp_path, *MODELS[1], masks=False)
    white = np.full((HEIGHT, WIDTH, 3), 255, np.uint8)
    for i in range(NUM_CAMERAS):
        cv2.imwrite(str(artifacts.Pictures(inputs["ingest"]).path(f"photo_{i}.jpg")), white)
    scene, out, _ = undistort(inputs, tmp_path)
    for name in scene.cameras.names:
        assert cv2.imread(str(artifacts.Pictures(out).path(name))).min() == 255


@pytest.mark.slow
@pytest.mark.parametrize(("model_name", "parameters"), MODELS[1:3])
@pytest.mark.parametrize("max_side", [1600, 200])
def test_masks_are_warped_by_the_same_maps(tmp_path: Path, model_name: str, parameters: list[float], max_side: int):
    inputs = write_capture(tmp_path, model_name, parameters, masks=True)
    scene, out, numbers = undistort(inputs, tmp_path, mask_erode=0, max_side=max_side)
    assert numbers["masks"] == NUM_CAMERAS
    center = world_from(scene, tmp_path).inverse().apply(CENTER)
    radius = BALL / world_from(scene, tmp_path).scale
    for i, name in enumerate(scene.cameras.names):
        mask = cv2.imread(str(artifacts.Pictures(out).mask_path(name)), cv2.IMREAD_UNCHANGED)
        assert mask.shape[::-1] == tuple(scene.cameras.sizes[i])
        assert set(np.unique(mask)) == {0, 255}
        expected = ball_mask(scene.cameras, i, center, radius)
        assert ((mask > 0) != expected).sum() < 0.05 * expected.sum()


def ball_mask(cameras: PinholeCameras, index: int, center: np.ndarray, radius: float) -> np.ndarray:
    width, height = cameras.sizes[index]
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    origins, rays = cameras.rays(index, np.stack([x.ravel(), y.ravel()], 1))
    to_ball = center - origins
    along = np.einsum("ni,ni->n", to_ball, rays)
    return (np.linalg.norm(to_ball - along[:, None] * rays, axis=1) < radius).reshape(height, width)


def test_masks_set_the_region_and_shrink_by_the_erosion(tmp_path: Path):
    inputs = write_capture(tmp_path, *MODELS[1], masks=True)
    scene, out, numbers = undistort(inputs, tmp_path, mask_erode=3)
    assert numbers["region_from"] == "the visual hull of the masks"
    assert 0.6 < BALL / world_from(scene, tmp_path).scale < 0.95
    assert np.linalg.norm(world_from(scene, tmp_path).inverse().apply(CENTER)) < 0.1
    i, name = 0, scene.cameras.names[0]
    mask = cv2.imread(str(artifacts.Pictures(out).mask_path(name)), cv2.IMREAD_UNCHANGED) > 0
    full = ball_mask(
        scene.cameras, i, world_from(scene, tmp_path).inverse().apply(CENTER), BALL / world_from(scene, tmp_path).scale
    )
    loss = np.sqrt(full.sum() / np.pi) - np.sqrt(mask.sum() / np.pi)
    assert loss == pytest.approx(3.0, abs=0.7)


def test_scene_frame_has_z_up_and_the_object_at_the_origin(tmp_path: Path):
    inputs = write_capture(tmp_path, *MODELS[0], masks=False)
    scene, _, numbers = undistort(inputs, tmp_path)
    assert scene.kind == numbers["kind"] == "object"
    np.testing.assert_allclose(world_from(scene, tmp_path).rotation @ [0, 0, 1], UP, atol=1e-6)
    np.testing.assert_allclose(world_from(scene, tmp_path).translation, CENTER, atol=1e-6)
    np.testing.assert_array_equal(scene.up, [0, 0, 1])
    assert (scene.cameras.centers[:, 2] > 0).all()


def test_observations_name_the_image_and_the_point(tmp_path: Path):
    inputs = write_capture(tmp_path, *MODELS[0], masks=False)
    scene, _, _ = undistort(inputs, tmp_path)
    expected = [[i, k] for i in range(NUM_CAMERAS) for k in range(len(DOTS))]
    np.testing.assert_array_equal(scene.observations, expected)
    assert scene.points.dtype == np.float32
    assert scene.observations.dtype == np.int32


def test_up_axis_and_region_size_can_be_set(tmp_path: Path):
    inputs = write_capture(tmp_path, *MODELS[0], masks=False)
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    plain, _, _ = undistort(inputs, tmp_path / "a")
    turned, _, _ = undistort(inputs, tmp_path / "b", up="-x", roi_scale=1.5)
    world = world_from(turned, tmp_path / "b")
    np.testing.assert_allclose(world.rotation @ turned.up_in(place_of(tmp_path / "b")), [-1, 0, 0], atol=1e-9)
    assert world.scale == pytest.approx(1.5 * world_from(plain, tmp_path / "a").scale)


def test_png_names_stay_unique():
    assert png_names(["a.jpg", "b.png", "c/a.jpg"]) == ["a.png", "b.png", "c/a.png"]
    assert png_names(["a.jpg", "a.png", "b.jpg"]) == ["a.jpg.png", "a.png.png", "b.png"]
    assert png_names(["a.jpg", "a.png", "a.jpg.png"]) == ["a.jpg.png", "a.png.png", "a.jpg.png.png"]


# ---------------------------------------------------------------- region, scale and place
def test_a_given_sphere_is_the_unit_sphere(tmp_path: Path):
    inputs = write_capture(tmp_path, *MODELS[0], masks=False)
    scene, _, numbers = undistort(inputs, tmp_path, region="sphere 2.5 -1 0.5 0.75", roi_scale=3.0, subject=2)
    assert world_from(scene, tmp_path).scale == 0.75
    np.testing.assert_allclose(world_from(scene, tmp_path).translation, [2.5, -1, 0.5])
    assert artifacts.GIVEN_REGION.load(tmp_path / "place").box is None
    assert numbers["region_from"] == "the given sphere"


@pytest.mark.parametrize(
    ("params", "masks", "growable"),
    [({}, False, True), ({"roi_scale": 1.5}, False, True), ({"roi_scale": 0.5}, False, False), ({}, True, False),
     ({"region": "sphere 2.5 -1 0.5 0.75"}, False, False)],
)  # fmt: skip
def test_a_region_that_somebody_chose_or_made_smaller_does_not_grow(tmp_path: Path, params, masks, growable):
    inputs = write_capture(tmp_path, *MODELS[0], masks=masks)
    assert undistort(inputs, tmp_path, **params)[0].growable == growable


def test_a_region_that_no_camera_sees_is_refused(tmp_path: Path):
    inputs = write_capture(tmp_path, *MODELS[0], masks=False)
    with pytest.raises(ConfigError, match=r"sphere 2 50 0.5 1 is seen by 0 of 8 cameras \(need 2\)") as caught:
        undistort(inputs, tmp_path, region="sphere 2 50 0.5 1")
    assert "where the cameras stand about" in caught.value.hint


class PosedModel:
    """Of a pycolmap model what sparse points are read from."""

    def __init__(self, points: np.ndarray, observations: np.ndarray) -> None:
        photos = [[] for _ in points]
        for image, point in observations:
            photos[point].append(SimpleNamespace(image_id=int(image)))
        self.points3D = {
            k: SimpleNamespace(xyz=xyz, error=0.5, track=SimpleNamespace(elements=seen))
            for k, (xyz, seen) in enumerate(zip(points, photos, strict=True))
        }


def given(region: str, masked: bool = False, count: int = 1800):
    """A region of the settings for a dome of radius 2 about (10, 0, 2); the frame of the poses is half as large."""
    cameras, points = dome_on_a_table()
    points = points[:count]
    photos = [SimpleNamespace(image_id=i) for i in range(len(cameras))]
    place = Place(Similarity(2.0, np.eye(3), np.array([10.0, 0, 0])))
    model = PosedModel(points, sightings(cameras, points))
    return _given_region(cameras, model, photos, place, PlaceParams(region=region), masked)


AIR = "sphere 10 0 4.6 0.25"  # above the dome


def test_a_region_that_holds_no_points_is_refused_with_the_one_that_would_be_found():
    with pytest.raises(ConfigError, match=r"sphere 10 0 4.6 0.25 holds 0 of 1800 sparse points \(need 10\)") as caught:
        given(AIR)
    command = re.search(r"`--set 'place.region=(sphere [^']+)'`", caught.value.hint)[1]
    x, y, z, radius = (float(number) for number in command.split()[1:])
    assert np.linalg.norm(np.array([x, y, z]) - [10, 0, 2]) < 0.2
    assert 2.0 < radius < 4.4
    assert given(command).radius == pytest.approx(radius / 2)
    with pytest.raises(ConfigError, match=r"box 9.5 -0.5 4.2 10.5 0.5 5 holds 0 of 1800"):
        given("box 9.5 -0.5 4.2 10.5 0.5 5")


def test_a_region_without_points_is_taken_where_masks_tell_or_there_are_hardly_any():
    assert given(AIR, masked=True).radius == 0.125
    assert given(AIR, count=60).radius == 0.125
    assert given(AIR, count=0).radius == 0.125
    assert given("sphere 10 0 2 2.1").radius == 1.05


def test_a_given_box_is_kept_for_the_crop(tmp_path: Path):
    inputs = write_capture(tmp_path, *MODELS[0], masks=False)
    scene, _, _ = undistort(inputs, tmp_path, region="box 1 -2 0 3 0 1")
    given = artifacts.GIVEN_REGION.load(tmp_path / "place")
    np.testing.assert_array_equal(given.box, [[1, -2, 0], [3, 0, 1]])
    corners = scene.poses_from_scene.inverse().apply(given.box_corners())
    assert np.linalg.norm(corners, axis=1).max() < 0.98


GROWTH = 4.0  # metres a model unit


def with_gps(inputs: dict[str, Path], noise: float) -> None:
    """Records with positions: the model's -y is up, its z is north."""
    import pycolmap

    earth = pycolmap.GPSTransform(pycolmap.GPSTransformEllipsoid.WGS84)
    random = np.random.default_rng(0)
    records = []
    for i, record in enumerate(artifacts.IMAGE_SET.load(inputs["ingest"]).images):
        pose = cam_from_world(i)
        x, y, z = -pose[:, :3].T @ pose[:, 3] * GROWTH + noise * random.normal(size=3)
        position = earth.enu_to_ellipsoid(np.array([[x, z, -y]]), 47.0, 8.5, 400.0)[0]
        records.append(replace(record, gps=tuple(position)))
    artifacts.IMAGE_SET.save(inputs["ingest"], ImageSet(tuple(records)))


def test_gps_makes_the_world_metric_with_z_up(tmp_path: Path):
    inputs = write_capture(tmp_path, *MODELS[0], masks=False)
    with_gps(inputs, noise=0.05)
    scene, _, numbers = undistort(inputs, tmp_path)
    assert (numbers["units"], numbers["scale_from"], numbers["up_from"]) == ("metres", "GPS", "GPS")
    assert 0.02 < numbers["gps_residual_m"] < 0.2
    world = world_from(scene, tmp_path)
    assert place_of(tmp_path).world_from_poses.scale == pytest.approx(GROWTH, rel=0.02)
    np.testing.assert_allclose(world.rotation @ scene.up_in(place_of(tmp_path)), [0, 0, 1], atol=1e-6)
    dots = world.apply(scene.points.astype(float))
    expected = GROWTH * (DOTS - DOTS[0]) @ np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0.0]])  # east, north, up
    np.testing.assert_allclose(dots - dots[0], expected, atol=0.1)
    assert place_of(tmp_path).origin == pytest.approx((47.0, 8.5, 400.0), abs=10)
    assert np.abs(world.translation).max() < 30
    for i in range(len(scene.cameras)):  # the photos still agree
        pixels, _ = scene.cameras.project(i, scene.points)
        pose = cam_from_world(i)
        seen = DOTS @ pose[:, :3].T + pose[:, 3]
        np.testing.assert_allclose(pixels, FOCAL * seen[:, :2] / seen[:, 2:] + [WIDTH / 2, HEIGHT / 2], atol=1e-2)


def test_gps_worse_than_the_spread_is_not_used(tmp_path: Path, caplog):
    inputs = write_capture(tmp_path, *MODELS[0], masks=False)
    with_gps(inputs, noise=20.0)
    _, _, numbers = undistort(inputs, tmp_path)
    assert "GPS is not used: GPS positions miss the cameras" in caplog.text
    assert numbers["units"] == "arbitrary units"
    np.testing.assert_array_equal(place_of(tmp_path).world_from_poses.matrix(), np.eye(4))
    assert place_of(tmp_path).origin is None


def test_up_is_that_of_gps_only_where_it_is_sure(tmp_path: Path, monkeypatch):
    monkeypatch.setattr("stages.place.MAX_GPS_TILT_DEG", 0.0)
    inputs = write_capture(tmp_path, *MODELS[0], masks=False)
    with_gps(inputs, noise=0.05)
    _, _, numbers = undistort(inputs, tmp_path)
    assert (numbers["scale_from"], numbers["up_from"]) == ("GPS", "level cameras")
    assert place_of(tmp_path).up is None


def test_gps_can_be_left_out(tmp_path: Path):
    inputs = write_capture(tmp_path, *MODELS[0], masks=False)
    with_gps(inputs, noise=0.0)
    assert undistort(inputs, tmp_path, gps=False)[2]["units"] == "arbitrary units"


def draw_markers(inputs: dict[str, Path], side: float) -> None:
    """A marker of `side` model units lies at the centre in every photo."""
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100)
    page = np.full((280, 280), 255, np.uint8)
    page[40:240, 40:240] = cv2.aruco.generateImageMarker(dictionary, 3, 200)
    reach = 0.5 * side * 280 / 200
    corners = CENTER + reach * np.array([[-1, 0, 1], [1, 0, 1], [1, 0, -1], [-1, 0, -1.0]])
    for i in range(NUM_CAMERAS):
        pose = cam_from_world(i)
        seen = corners @ pose[:, :3].T + pose[:, 3]
        target = FOCAL * seen[:, :2] / seen[:, 2:] + [WIDTH / 2, HEIGHT / 2] - 0.5
        source = np.array([[0, 0], [280, 0], [280, 280], [0, 280.0]]) - 0.5
        H = cv2.getPerspectiveTransform(source.astype(np.float32), target.astype(np.float32))
        photo = cv2.warpPerspective(page, H, (WIDTH, HEIGHT), flags=cv2.INTER_AREA, borderValue=90)
        assert cv2.imwrite(str(artifacts.Pictures(inputs["ingest"]).path(f"photo_{i}.jpg")), photo)


def test_a_marker_gives_the_scale_with_its_error(tmp_path: Path):
    inputs = write_capture(tmp_path, *MODELS[0], masks=False)
    draw_markers(inputs, side=1.2)
    scene, _, numbers = undistort(inputs, tmp_path, marker_size=0.3, marker_dictionary="5X5_100")
    assert numbers["units"] == "metres"
    assert numbers["scale_from"] == "1 marker (4 sides)"
    assert place_of(tmp_path).world_from_poses.scale == pytest.approx(0.25, rel=0.01)
    assert 0 < place_of(tmp_path).scale_error < 0.02
    np.testing.assert_allclose(world_from(scene, tmp_path).apply(scene.points.astype(float)), 0.25 * DOTS, atol=0.02)


def test_missing_markers_are_an_error(tmp_path: Path):
    inputs = write_capture(tmp_path, *MODELS[0], masks=False)
    with pytest.raises(InputError, match="No marker could be measured: 0 of 8 photos") as caught:
        undistort(inputs, tmp_path, marker_size=0.3)
    assert "marker_dictionary" in caught.value.hint


def test_a_known_distance_gives_the_scale(tmp_path: Path):
    inputs = write_capture(tmp_path, *MODELS[0], masks=False)
    a, b = DOTS[0], DOTS[1]  # 0.4 apart
    text = " ".join(f"{value}" for value in [*a, *b, 1.0])
    scene, _, numbers = undistort(inputs, tmp_path, known_distance=text)
    dots = world_from(scene, tmp_path).apply(scene.points.astype(float))
    assert np.linalg.norm(dots[0] - dots[1]) == pytest.approx(1.0, rel=1e-5)
    assert numbers["scale_from"] == "a known distance"
    assert numbers["scale_error_percent"] is None


def test_a_distance_that_contradicts_gps_is_believed_and_told(tmp_path: Path, caplog):
    inputs = write_capture(tmp_path, *MODELS[0], masks=False)
    with_gps(inputs, noise=0.01)
    undistort(inputs, tmp_path, known_distance="0 0 0 1 0 0 1.2")
    assert "The known distance and GPS disagree on the scale by 20.0 %" in caplog.text
    assert place_of(tmp_path).world_from_poses.scale == pytest.approx(1.2 * GROWTH, rel=0.01)
    assert place_of(tmp_path).origin is not None


def test_coordinates_far_from_the_origin_keep_their_precision(tmp_path: Path):
    far = np.array([465123.0, 5247811.0, 410.0])
    inputs = write_capture(tmp_path, *MODELS[0], masks=False, shift=far)
    scene, _, _ = undistort(inputs, tmp_path)
    model_from_world = place_of(tmp_path).world_from_poses.inverse()
    assert np.abs(world_from(scene, tmp_path).translation).max() < 5
    world = world_from(scene, tmp_path).apply(scene.points.astype(float)).astype(np.float32)
    np.testing.assert_allclose(model_from_world.apply(world.astype(float)), DOTS + far, atol=1e-5)


def test_a_known_distance_changes_nothing_of_the_scene(tmp_path: Path):
    inputs = write_capture(tmp_path, *MODELS[0], masks=False)
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    _, one, _ = undistort(inputs, tmp_path / "a")
    _, other, _ = undistort(inputs, tmp_path / "b", known_distance="0 0 0 1 0 0 3.3")
    for file in ("cameras.json", "scene.json"):
        assert (one / file).read_bytes() == (other / file).read_bytes()
    assert place_of(tmp_path / "b").metric
    assert not place_of(tmp_path / "a").metric


def test_scene_records_survive_saving(tmp_path: Path):
    inputs = write_capture(tmp_path, *MODELS[0], masks=False)
    scene, _, _ = undistort(inputs, tmp_path)
    full = replace(scene, ground=Plane(np.array([0.0, 0, 1]), -0.3, 0.01, 0.4))
    artifacts.SCENE.save(tmp_path, full)
    loaded = artifacts.SCENE.load(tmp_path)
    np.testing.assert_array_equal(loaded.ground.normal, [0, 0, 1])
    assert (loaded.ground.offset, loaded.ground.rms, loaded.ground.share) == (-0.3, 0.01, 0.4)
    for one, other in ((loaded.cameras, full.cameras), (loaded, full)):
        for field in fields(one):
            before, after = getattr(one, field.name), getattr(other, field.name)
            if isinstance(before, np.ndarray):
                np.testing.assert_array_equal(before, after)


def test_places_and_regions_survive_saving(tmp_path: Path):
    moved = Similarity(2.0, np.eye(3)[[1, 2, 0]], np.array([1.0, 2, 3]))
    place = Place(moved, True, "GPS", 0.01, (47.0, 8.5, 400.0), 1.5, np.array([0.0, 0, 1]))
    artifacts.WORLD_PLACE.save(tmp_path, place)
    loaded = artifacts.WORLD_PLACE.load(tmp_path)
    np.testing.assert_array_equal(loaded.world_from_poses.matrix(), moved.matrix())
    np.testing.assert_array_equal(loaded.up, place.up)
    assert tuple(loaded.origin) == place.origin
    assert loaded.describe() == place.describe()
    artifacts.GIVEN_REGION.save(tmp_path, None)
    assert artifacts.GIVEN_REGION.load(tmp_path) is None
    given = given_region("box", (0, 0, 0, 1, 2, 3), moved)
    artifacts.GIVEN_REGION.save(tmp_path, given)
    np.testing.assert_array_equal(artifacts.GIVEN_REGION.load(tmp_path).box_corners(), given.box_corners())


def test_a_damaged_record_is_named(tmp_path: Path):
    (tmp_path / "place.json").write_text('{"metric": "perhaps"}')
    with pytest.raises(WorkspaceError, match=r"place\.json cannot be read: .*world_from_poses") as caught:
        artifacts.WORLD_PLACE.load(tmp_path)
    assert "--force" in caught.value.hint


def test_a_workspace_of_an_older_version_is_told_how_to_go_on(tmp_path: Path):
    with pytest.raises(WorkspaceError, match=r"place\.json cannot be read: No such file") as caught:
        artifacts.WORLD_PLACE.load(tmp_path / "place")
    assert f"`hineus run --workspace {tmp_path}`" in caught.value.hint


def test_a_frame_stays_where_photos_came_or_went_and_it_still_fits(tmp_path: Path, monkeypatch):
    inputs = write_capture(tmp_path, *MODELS[0], masks=False)
    first, folder, numbers = undistort(inputs, tmp_path)
    assert "region_kept" not in numbers
    assert first.contents == tuple(str(i) for i in range(NUM_CAMERAS))
    moved = replace(first.poses_from_scene, scale=1.05 * first.poses_from_scene.scale)
    artifacts.FIRST_SCENE.save(folder, replace(first, poses_from_scene=moved))

    def again(name: str, **params: object) -> tuple[PosedScene, dict[str, object]]:
        (tmp_path / name).mkdir()
        scene, _, numbers = undistort(inputs, tmp_path / name, previous=folder, **params)
        return scene, numbers

    scene, numbers = again("kept")
    assert numbers["region_kept"] is True
    assert scene.poses_from_scene.scale == moved.scale
    assert scene.lineage == first.lineage
    np.testing.assert_allclose(scene.poses_from_scene.apply(scene.points.astype(float)), DOTS, atol=1e-5)
    artifacts.FIRST_SCENE.save(folder, replace(first, poses_from_scene=replace(moved, scale=2 * moved.scale)))
    scene, numbers = again("anew")
    assert numbers["region_kept"] is False
    assert scene.poses_from_scene.scale == pytest.approx(first.poses_from_scene.scale)

    # poses of another lineage, or a scene that was made in another way
    for name, lineage, params in (("poses", "second", {}), ("settings", "first", {"max_side": 200})):
        contents = artifacts.PHOTO_CONTENTS.load(inputs["sfm"])
        artifacts.PHOTO_CONTENTS.save(inputs["sfm"], contents.model_copy(update={"lineage": lineage}))
        scene, numbers = again(name, **params)
        assert "region_kept" not in numbers
        assert scene.lineage != first.lineage
