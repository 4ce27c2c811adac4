"""The stage place: which source of the world is believed, and what is said where two of them disagree."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from dotted_capture import DOTS, MODELS, cam_from_world, write_capture
from rigs import three_rings

from configs.params import PlaceParams
from stages import artifacts
from stages.artifacts import ImageSet
from stages.engine.stage import StageContext
from stages.errors import ConfigError
from stages.files.georeference import georeference, metadata_xml
from stages.geometry.earth import earth_centred, from_east_north_up
from stages.geometry.place import Place
from stages.place import PLACE, _locate
from stages.posing.control_files import CONTROL
from stages.reporting.control import describe_control

HOME = (-16.8, 180.0, 20.0)
GROWTH = 4.0  # metres a unit of the poses
AS_IT_IS = np.eye(3)
ENU_FROM_POSES = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0.0]])  # their -y is up, their z is north


@pytest.fixture
def inputs(tmp_path: Path) -> dict[str, Path]:
    return write_capture(tmp_path, *MODELS[1], masks=False)


def in_metres(points: np.ndarray) -> np.ndarray:
    return GROWTH * points @ ENU_FROM_POSES.T


def with_gps(inputs: dict[str, Path], turn: np.ndarray = AS_IT_IS, home: tuple[float, float, float] = HOME) -> None:
    """Each photo says where it was taken, in a world that is turned, or mirrored."""
    records = artifacts.IMAGE_SET.load(inputs["ingest"]).images
    poses = [cam_from_world(i) for i in range(len(records))]
    centers = np.array([-pose[:, :3].T @ pose[:, 3] for pose in poses])
    positions = from_east_north_up(in_metres(centers) @ turn.T, home).tolist()
    located = [replace(record, gps=tuple(position)) for record, position in zip(records, positions, strict=True)]
    artifacts.IMAGE_SET.save(inputs["ingest"], ImageSet(tuple(located)))


def write_control(
    inputs: dict[str, Path],
    file: Path,
    coordinates: np.ndarray,
    head: str = "",
    names: Sequence[str] = "ABCDEF",
    dots: Sequence[int] = range(6),
) -> Path:
    """The dots with these coordinates, marked where the photos show them."""
    import pycolmap

    model = pycolmap.Reconstruction(str(artifacts.MODEL.load(inputs["sfm"])))
    rows = [
        ",".join([name, *(f"{value:.6f}" for value in xyz), image.name, *map(str, image.points2D[k].xy)])
        for image in model.images.values()
        for k, name, xyz in zip(dots, names, coordinates, strict=False)
    ]
    file.write_text("\n".join([*([head] if head else []), "name,x,y,z,photo,px,py", *rows]))
    return file


def place(inputs: dict[str, Path], root: Path, control: Path | None = None, **params: object) -> tuple[Place, dict]:
    out = root / "place"
    out.mkdir()
    sources = {} if control is None else {CONTROL: control}
    numbers = PLACE.run(StageContext(inputs, sources, out, root, PlaceParams(**params)))
    return artifacts.WORLD_PLACE.load(out), numbers


def said(numbers: dict) -> str:
    return " ".join(warning["sentence"] for warning in numbers.get("warnings", ()))


# ---------------------------------------------------------------- GPS
def test_gps_across_the_180th_meridian(inputs, tmp_path: Path):
    with_gps(inputs)
    longitudes = [record.gps[1] for record in artifacts.IMAGE_SET.load(inputs["ingest"]).images]
    assert min(longitudes) < -179 < 179 < max(longitudes)
    found, numbers = place(inputs, tmp_path)
    assert numbers["up_from"] == "GPS"
    assert said(numbers) == ""
    np.testing.assert_allclose(found.world_from_poses.rotation, ENU_FROM_POSES, atol=1e-4)
    assert abs(found.origin[1]) == pytest.approx(180, abs=1e-3)


@pytest.mark.parametrize("axis", [0, 1])
def test_east_and_west_interchanged_do_not_turn_the_scene_over(inputs, tmp_path: Path, caplog, axis: int):
    mirror = np.eye(3)
    mirror[axis, axis] = -1
    with_gps(inputs, mirror, (47.0, 8.0, 400.0))
    found, numbers = place(inputs, tmp_path)
    assert "GPS and level cameras disagree about up by 180 degrees: only the scale is taken" in said(numbers)
    assert said(numbers) in caplog.text
    assert found.world_from_poses.scale == pytest.approx(GROWTH, rel=1e-3)
    np.testing.assert_array_equal(found.world_from_poses.rotation, np.eye(3))
    assert (found.up, found.origin) == (None, None)
    assert "up_from" not in numbers


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_dome_of_photos_in_a_mirrored_world_is_refused_with_the_tags_to_look_at(axis: int, caplog):
    cameras, sides = three_rings(), [1.0, 1.0, 1.0]
    sides[axis] = -1
    positions = from_east_north_up(GROWTH * 10 * cameras.centers * sides, (47.0, 8.0, 400.0)).tolist()
    assert _locate(cameras, dict(enumerate(positions))) is None
    assert "They fit with one of their signs changed: look at EXIF's GPSLongitudeRef" in caplog.text


def test_where_up_is_only_askew_it_is_said_and_gps_believed(inputs, tmp_path: Path):
    angle = np.radians(40)
    tilt = np.array([[1, 0, 0], [0, np.cos(angle), -np.sin(angle)], [0, np.sin(angle), np.cos(angle)]])
    with_gps(inputs, tilt, (47.0, 8.0, 400.0))
    found, numbers = place(inputs, tmp_path)
    assert "disagree about up by 40 degrees: GPS is believed" in said(numbers)
    np.testing.assert_array_equal(found.up, [0, 0, 1])


# ---------------------------------------------------------------- control points
def test_control_points_in_a_frame_of_their_own(inputs, tmp_path: Path):
    far = np.array([500_000.0, 4_000_000.0, 100.0])
    names = ["A", "B", "C", "D", "E", "check6"]
    control = write_control(inputs, tmp_path / "gcp.csv", in_metres(DOTS) + far, names=names)
    found, numbers = place(inputs, tmp_path, control)
    assert (numbers["scale_from"], numbers["up_from"]) == ("5 control points", "the control points")
    assert numbers["control_residual_m"] < 1e-3
    world = found.world_from_poses.apply(DOTS)
    np.testing.assert_allclose(world + found.offset, in_metres(DOTS) + far, atol=1e-3)
    assert np.abs(world).max() < 100  # 32 bits hold it
    assert [point.check for point in found.control] == [False] * 5 + [True]
    shown = describe_control(found)
    assert "5 of 5 control points were used" in shown["sentence"]
    assert "1 only check it" in shown["sentence"]
    assert shown["points"][0]["marks"] == "8 of 8"
    assert metadata_xml(found, None) is None
    assert georeference(found, np.eye(3), None)["offset"] == found.offset
    json.dumps(georeference(found, np.eye(3), None))


def test_control_points_on_earth_go_before_gps(inputs, tmp_path: Path):
    pytest.importorskip("pyproj")
    with_gps(inputs)
    degrees = from_east_north_up(in_metres(DOTS), HOME)[:, [1, 0, 2]]
    control = write_control(inputs, tmp_path / "gcp.csv", degrees, head="EPSG:4326")
    found, numbers = place(inputs, tmp_path, control)
    assert said(numbers) == ""
    assert found.scale_from == "6 control points"
    there = from_east_north_up(found.world_from_poses.apply(DOTS), found.origin)
    np.testing.assert_allclose(earth_centred(there), earth_centred(degrees[:, [1, 0, 2]]), atol=0.1)
    matrix = np.array(georeference(found, np.eye(3), None)["earth_centred_from_world"])
    np.testing.assert_allclose(
        found.world_from_poses.apply(DOTS) @ matrix[:3, :3].T + matrix[:3, 3], earth_centred(there), atol=1e-3
    )
    assert "<SRS>ENU:-16.7999" in metadata_xml(found, None)


def test_the_results_in_a_map_s_grid(inputs, tmp_path: Path):
    pyproj = pytest.importorskip("pyproj")
    with_gps(inputs, home=(47.0, 8.0, 400.0))
    found, _ = place(inputs, tmp_path, epsg=32632)
    latitude, longitude, altitude = from_east_north_up(in_metres(DOTS), (47.0, 8.0, 400.0)).T
    east, north = pyproj.Transformer.from_crs(4326, 32632, always_xy=True).transform(longitude, latitude)
    np.testing.assert_allclose(
        found.world_from_poses.apply(DOTS) + found.offset, np.stack([east, north, altitude], 1), atol=0.01
    )
    assert found.crs == "EPSG:32632"
    east, north, up = found.offset
    assert f"<SRS>EPSG:32632</SRS>\n <SRSOrigin>{east:.3f},{north:.3f},{up:.3f}" in metadata_xml(found, None)


def test_a_grid_needs_a_place_on_earth(inputs, tmp_path: Path):
    with pytest.raises(ConfigError, match=r"`place.epsg` = 32632 asks for a map's coordinates"):
        place(inputs, tmp_path, epsg=32632)


def test_a_wrong_zone_is_noticed_by_gps(inputs, tmp_path: Path):
    pyproj = pytest.importorskip("pyproj")
    home = (47.0, 8.0, 400.0)
    with_gps(inputs, home=home)
    latitude, longitude, altitude = from_east_north_up(in_metres(DOTS), home).T
    east, north = pyproj.Transformer.from_crs(4326, 32632, always_xy=True).transform(longitude, latitude)
    control = write_control(inputs, tmp_path / "gcp.csv", np.stack([east, north, altitude], 1), head="EPSG:32633")
    _, numbers = place(inputs, tmp_path, control)
    assert "km from where GPS has them: is their coordinate system right" in said(numbers)


def test_x_and_y_interchanged_are_noticed_by_the_way_cameras_were_held(inputs, tmp_path: Path):
    flat = in_metres(DOTS[[0, 1, 3]])[:, [1, 0, 2]]
    control = write_control(inputs, tmp_path / "gcp.csv", flat, dots=(0, 1, 3))
    found, numbers = place(inputs, tmp_path, control)
    assert found.control_residual < 1e-3  # three points and their mirror image agree
    assert "disagree about up by 180 degrees: x and y may be interchanged" in said(numbers)
    assert found.up is None


def test_two_control_points_give_the_scale_and_gps_the_rest(inputs, tmp_path: Path):
    with_gps(inputs)
    control = write_control(inputs, tmp_path / "gcp.csv", 1.1 * in_metres(DOTS[:2]))
    found, numbers = place(inputs, tmp_path, control)
    assert found.scale_from == "2 control points"
    assert found.world_from_poses.scale == pytest.approx(1.1 * GROWTH, rel=1e-3)
    assert found.origin is not None
    assert "only tell the scale: 2 points could be placed, 3 are needed" in said(numbers)


def test_a_distance_is_compared_with_control_points(inputs, tmp_path: Path, caplog):
    control = write_control(inputs, tmp_path / "gcp.csv", in_metres(DOTS))
    found, _ = place(inputs, tmp_path, control, known_distance="0 0 0 1 0 0 2")
    assert found.scale_from == "6 control points"
    assert "Control points and the known distance disagree on the scale by -50.0 %" in caplog.text


# ---------------------------------------------------------------- the case
@pytest.mark.slow
def test_photos_on_both_sides_of_the_180th_meridian(cases_dir: Path, tmp_path: Path):
    """24 photos of the demo, 20 m a unit: upright, with the metres and the place that they were made with."""
    from stages.pipeline import PIPELINE
    from stages.reconstruct import reconstruct
    from stages.request import Request

    request = Request(
        cases_dir / "20-gps-antimeridian" / "photos", tmp_path / "ws", preset="tiny", sets=["sfm.wanted=0.6"],
        until="undistort",
    )  # fmt: skip
    reconstruct(request, PIPELINE)
    found = artifacts.WORLD_PLACE.load(tmp_path / "ws" / "place")
    scene = artifacts.FIRST_SCENE.load(tmp_path / "ws" / "undistort")
    assert found.scale_from == "GPS"
    assert found.origin[0] == pytest.approx(-16.8, abs=1e-3)
    assert abs(found.origin[1]) == pytest.approx(180, abs=1e-3)
    assert scene.up_in(found) @ scene.up > np.cos(np.radians(10))  # as the ground says
    heights = found.world_from_poses.apply(scene.poses_from_scene.apply(scene.cameras.centers))[:, 2]
    assert heights.min() > found.world_from_poses.apply(scene.poses_from_scene.apply(scene.points))[:, 2].min()
