"""360-degree pictures: told from photos, split into the views a pinhole camera would see, placed by one pose each."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from drawn_rooms import Room, heading, pinhole_rays, sphere_rays
from PIL import Image
from typer.testing import CliRunner

from hineus_cli.app import app
from stages import artifacts
from stages.artifacts import ImageRecord
from stages.capture import panoramas, photo_reading
from stages.capture.listing import list_captures
from stages.capture.panoramas import VIEWS, Sphere, borders_meet, find_spheres, focal_px, is_dual_fisheye, split
from stages.geometry.similarity import align_points
from stages.posing.rigs import has_rigs, write_rigs

HEIGHT = 256


@pytest.fixture(scope="module")
def room() -> Room:
    return Room()


def sphere_picture(room: Room, center: np.ndarray, world_from_panorama: np.ndarray, height: int = HEIGHT) -> np.ndarray:
    return room.draw(center, sphere_rays(height) @ world_from_panorama.T)


@pytest.fixture(scope="module")
def sphere(room: Room) -> np.ndarray:
    return sphere_picture(room, np.array([0.5, -0.3, 0.2]), heading(20))


def grey(pixels: np.ndarray) -> np.ndarray:
    return np.asarray(Image.fromarray(pixels).convert("L"))


# ---------------------------------------------------------------- which pictures
def test_borders_of_a_sphere_meet_and_those_of_a_part_of_it_do_not(sphere: np.ndarray):
    assert borders_meet(grey(sphere))
    assert borders_meet(grey(np.roll(sphere, 100, axis=1)))
    assert not borders_meet(grey(sphere[:, :-40]))
    noise = np.random.default_rng(0).normal(0, 1, sphere.shape[:2])
    sweep = np.linspace(40, 220, HEIGHT)[:, None] + noise  # an object before a studio's backdrop
    assert not borders_meet(sweep.clip(0, 255).astype(np.uint8))


def fisheyes() -> np.ndarray:
    y, x = np.mgrid[0:HEIGHT, 0 : 2 * HEIGHT] + 0.5
    radius = np.hypot(x % HEIGHT - HEIGHT / 2, y - HEIGHT / 2) / (HEIGHT / 2)
    return np.where(radius < 1, 120, 3).astype(np.uint8)


def test_two_circles_on_black_are_no_sphere(tmp_path: Path, sphere: np.ndarray):
    assert is_dual_fisheye(fisheyes())
    assert not is_dual_fisheye(grey(sphere))
    product = np.full((HEIGHT, 2 * HEIGHT), 3, np.uint8)  # photographed before black cloth
    product[60:200, 150:360] = 140
    assert not is_dual_fisheye(product)
    Image.fromarray(fisheyes()).save(tmp_path / "R0010.jpg")
    spheres, others = find_spheres({"R0010.jpg": tmp_path / "R0010.jpg"}, "auto")
    assert spheres == {}
    assert "two fisheye lenses" in others["R0010.jpg"]
    assert "equirectangular" in others["R0010.jpg"]


def test_large_pictures_are_judged_within_the_memory_that_is_free(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    file = tmp_path / "large.png"
    Image.new("P", (9000, 4500), 7).save(file)
    seen = []
    monkeypatch.setattr(panoramas, "is_dual_fisheye", lambda grey: seen.append(grey.shape))
    monkeypatch.setattr(photo_reading, "available_memory", lambda: 1 << 29)
    assert find_spheres({"large.png": file}, "auto") == ({}, {})  # whoever reads it says why not
    assert seen == []
    monkeypatch.setattr(photo_reading, "available_memory", lambda: 1 << 30)
    find_spheres({"large.png": file}, "auto")
    assert seen == [(500, 1000)]


def gpano(**tags: object) -> bytes:
    stated = " ".join(f'GPano:{name}="{value}"' for name, value in tags.items())
    return f'<x:xmpmeta><rdf:Description xmlns:GPano="http://ns.google.com/photos/1.0/panorama/" {stated}/>'.encode()


@pytest.mark.parametrize("mode", ["auto", "split", "off"])
def test_what_pictures_say_of_themselves_and_what_most_of_a_size_show(tmp_path: Path, sphere: np.ndarray, mode):
    plain = np.full_like(sphere, 128)  # its borders tell nothing, but the others of its size are spheres
    pictures = {"a.jpg": (sphere, b""), "b.jpg": (np.roll(sphere, 50, 1), b""), "plain.jpg": (plain, b"")}
    pictures["cropped.jpg"] = sphere[:150, :300], b""  # as wide as two heights, and a photo
    pictures["small.jpg"] = sphere[64:192], gpano(ProjectionType="equirectangular", FullPanoWidthPixels=512)
    part = {"FullPanoWidthPixels": 1024, "CroppedAreaImageWidthPixels": 400}
    pictures["part.jpg"] = sphere[:100, :200], gpano(ProjectionType="equirectangular", **part)
    pictures["sweep.jpg"] = sphere[100:150], gpano(ProjectionType="cylindrical")
    files = {}
    for name, (pixels, xmp) in pictures.items():
        files[name] = tmp_path / name
        Image.fromarray(pixels).save(files[name], quality=95, xmp=xmp)
    spheres, others = find_spheres(files, mode)
    if mode == "off":
        assert (spheres, others) == ({}, {})
        return
    assert set(spheres) == {"a.jpg", "b.jpg", "plain.jpg", "small.jpg"} | (
        {"cropped.jpg"} if mode == "split" else set()
    )
    assert spheres["small.jpg"] == Sphere((512, 128), 512.0, 0.0, 64.0)
    assert "a panorama of 141 x 70 degrees" in others["part.jpg"]
    assert "cylindrical" in others["sweep.jpg"]


MANY = "9" * 400


@pytest.mark.parametrize(
    ("width", "cropped", "left"),
    [
        ("0", "0", "0"),
        ("0", "640", MANY),
        (MANY, "640", "0"),
        ("640", MANY, "0"),
        ("640", "640", MANY),
        ("9", "640", "0"),
    ],
)
def test_numbers_of_a_panorama_that_contradict_each_other(tmp_path: Path, width: str, cropped: str, left: str):
    tags = {"CroppedAreaImageWidthPixels": cropped, "CroppedAreaLeftPixels": left, "CroppedAreaTopPixels": left}
    xmp = gpano(ProjectionType="equirectangular", FullPanoWidthPixels=width, **tags)
    Image.new("RGB", (640, 320)).save(tmp_path / "x.jpg", xmp=xmp)
    spheres, others = find_spheres({"x": tmp_path / "x.jpg"}, "auto")
    assert not spheres
    assert "cannot be" in others["x"]


def test_files_that_only_their_makers_stitch_are_named(tmp_path: Path):
    for name in ("IMG_1.insp", "VID_1.insv", "GS01.360"):
        (tmp_path / name).touch()
    *_, skipped = list_captures(tmp_path)
    assert ["Insta360" in item.reason for item in skipped] == [False, True, True]
    assert "GoPro Max" in skipped[0].reason
    assert all("equirectangular" in item.reason for item in skipped)


# ---------------------------------------------------------------- views
def test_a_view_is_what_a_pinhole_camera_sees():
    room, place = Room(octaves=1), np.array([0.5, -0.3, 0.2])
    sphere = sphere_picture(room, place, heading(20))
    whole = Sphere((2 * HEIGHT, HEIGHT), 2 * HEIGHT)
    rays = pinhole_rays(whole.side, whole.side, focal_px(whole.side))
    found = list(split(sphere, whole, whole.side))
    assert [view.name for view, _ in found] == ["000", "045", "090", "135", "180", "225", "270", "315", "up"]
    for view, pixels in found:
        drawn = room.draw(place, rays @ view.cam_from_panorama @ heading(20).T)
        here, half_a_pixel_off = (np.abs(pixels.astype(float) - each).mean() for each in (drawn, _shifted(drawn)))
        assert here < 0.7 < half_a_pixel_off, view.name


def _shifted(pixels: np.ndarray) -> np.ndarray:
    return (pixels.astype(float) + np.roll(pixels, 1, axis=1)) / 2


def test_views_are_rotations_that_look_where_their_names_say():
    for view in VIEWS:
        assert np.allclose(view.cam_from_panorama @ view.cam_from_panorama.T, np.eye(3))
        assert np.linalg.det(view.cam_from_panorama) == pytest.approx(1)
        yaw = np.radians(float(view.name)) if view.name != "up" else 0.0
        looked = [0, -1, 0] if view.name == "up" else [np.sin(yaw), 0, np.cos(yaw)]
        assert np.allclose(view.cam_from_panorama[2], looked)


def test_a_picture_without_the_zenith_gives_the_level_views(sphere: np.ndarray):
    cropped = Sphere((512, 136), 512.0, 0.0, 60.0)
    found = [view.name for view, _ in split(sphere[60:196], cropped, 80)]
    assert found == ["000", "045", "090", "135", "180", "225", "270", "315"]


# ---------------------------------------------------------------- poses
def test_rigs_hold_the_views_of_a_frame_and_leave_photos_alone(tmp_path: Path):
    import pycolmap

    database, records = tmp_path / "a.db", []
    with pycolmap.Database.open(database) as opened:
        lenses = [
            opened.write_camera(pycolmap.Camera.create_from_model_name(0, "PINHOLE", 50, 100, 100)) for _ in "123"
        ]
        for frame in ("a.jpg", "b.jpg", ""):
            for number in (0, 1) if frame else (2,):
                view = VIEWS[number]
                name = f"{frame}/{view.name}.jpg" if frame else "photo.jpg"
                opened.write_image(pycolmap.Image(name=name, camera_id=lenses[number]))
                turn = tuple(map(tuple, view.cam_from_panorama.tolist())) if frame else None
                record = ImageRecord(name, name, 100, 100, 50.0, "", 1.0, False, "", frame=frame, cam_from_frame=turn)
                records.append(record)
    assert write_rigs(database, records) == {1, 2}
    with pycolmap.Database.open(database) as opened:
        rigs = {rig.rig_id: rig for rig in opened.read_all_rigs()}
        frames = opened.read_all_frames()
    assert sorted(len(list(frame.data_ids)) for frame in frames) == [1, 2, 2]
    assert sorted(rig.num_sensors() for rig in rigs.values()) == [1, 2]
    (pair,) = (rig for rig in rigs.values() if rig.num_sensors() == 2)
    ((_, second_from_first),) = pair.non_ref_sensors.items()
    turn = VIEWS[1].cam_from_panorama @ VIEWS[0].cam_from_panorama.T
    assert np.allclose(second_from_first.rotation.matrix(), turn)
    assert write_rigs(database, [record for record in records if not record.frame]) == frozenset()


PLACES = np.array([[x, y, 0.2 + 0.1 * x * y] for x in (-1.5, -0.5, 0.5, 1.5) for y in (-0.6, 0.7)])


@pytest.mark.slow
def test_panoramas_of_a_room_are_all_placed_where_they_were_taken(tmp_path: Path, room: Room):
    import pycolmap

    photos, random = tmp_path / "photos", np.random.default_rng(1)
    photos.mkdir()
    for number, place in enumerate(PLACES):
        pixels = sphere_picture(room, place, heading(random.uniform(0, 360)), height=384)
        Image.fromarray(pixels).save(photos / f"{number}.jpg", quality=95)
    workspace = tmp_path / "ws"
    command = ["undistort", str(photos), "-w", str(workspace), "--preset", "tiny", "--set", "sfm.max_features=1000"]
    result = CliRunner().invoke(app, [*command, "--device", "cpu", "--json"])
    assert result.exit_code == 0, result.output
    numbers = {stage["name"]: stage["numbers"] for stage in json.loads(result.stdout)["stages"]}
    assert numbers["ingest"]["panoramas"] == len(PLACES)
    assert numbers["sfm"]["registered"] == numbers["undistort"]["images"] == len(PLACES) * len(VIEWS)

    model = pycolmap.Reconstruction(str(artifacts.MODEL.load(workspace / "sfm")))
    assert has_rigs(model)
    assert all(camera.mean_focal_length() == pytest.approx(focal_px(244)) for camera in model.cameras.values())
    images = sorted(model.images.values(), key=lambda image: image.name)
    centers = np.array([image.projection_center() for image in images])
    true = np.repeat(PLACES, len(VIEWS), axis=0)
    aligned = align_points(centers, true).apply(centers)
    assert np.linalg.norm(aligned - true, axis=1).max() < 0.01  # metres, in a room of 6 x 5
