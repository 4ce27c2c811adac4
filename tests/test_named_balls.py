"""Balls that a run names: which photo and circle they mean, what is wrong with them, and where their light is."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ball_photos import LAMPS, SIZE, Drawn, apart_deg, drawn, lamps, lens, main_source
from rigs import look_at
from scipy.spatial.transform import Rotation

from configs.load import load_config
from configs.texts import read_ball
from hineus_cli.options import of_a_run
from stages.artifacts import ImageRecord, Pictures, write_png
from stages.errors import ConfigError, InputError
from stages.shading.named_balls import light_of_balls, named_balls

SIZES = {"a/IMG_1.jpg": (2000, 1500), "a/IMG_2.jpg": (2000, 1500), "b/IMG_2.jpg": (1500, 2000)}
PLACE, RADIUS = np.array([0.2, 0.1, 1.0]), 0.13


# ---------------------------------------------------------------- what is named
def test_a_ball_is_read_from_a_line() -> None:
    assert read_ball("chrome:a/IMG_1.jpg:1520,840.5,120") == ("chrome", "a/IMG_1.jpg", (1520, 840.5, 120))
    assert read_ball("grey:C:ball.jpg: 10, 20, 15")[1] == "C:ball.jpg"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("IMG_1.jpg:1,2,30", "a ball is KIND:PHOTO:X,Y,RADIUS"),
        ("black:IMG_1.jpg:1,2,30", "chrome or grey as KIND"),
        ("chrome::1,2,30", "a ball is KIND:PHOTO"),
        ("chrome:IMG_1.jpg:1,2", "takes 3 numbers, got 2"),
        ("chrome:IMG_1.jpg:1,2,x", "takes 3 numbers"),
        ("chrome:IMG_1.jpg:1,2,nan", "takes numbers from"),
        ("chrome:IMG_1.jpg:1,2,0", "radius must be positive"),
    ],
)
def test_a_line_that_is_no_ball_is_refused(text: str, words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        load_config("cpu", sets=[f'materials.balls=["{text}"]'])


def test_photos_are_found_as_they_are_called() -> None:
    first, second = named_balls(["chrome:img_1.JPG:1000,700,100", "grey:b/IMG_2.jpg:700,1000,50"], SIZES)
    assert (first.kind, first.source, first.center, first.radius) == ("chrome", "a/IMG_1.jpg", (1000, 700), 100)
    assert second.source == "b/IMG_2.jpg"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("chrome:IMG_7.jpg:100,100,50", "There is no photo IMG_7.jpg, .* called e.g. a/IMG_1.jpg"),
        ("chrome:IMG_2.jpg:100,100,50", "fits 2 photos: a/IMG_2.jpg, b/IMG_2.jpg"),
        ("chrome:IMG_1.jpg:1980,700,100", "reaches out of a/IMG_1.jpg, which has 2000 x 1500 pixels"),
        ("chrome:IMG_1.jpg:-500,700,100", "reaches out of"),
        ("grey:IMG_1.jpg:100,100,9", "a radius of 9 pixels; at least 10 are needed"),
    ],
)
def test_what_cannot_be_a_ball_is_refused(text: str, words: str) -> None:
    with pytest.raises(InputError, match=words):
        named_balls([text], SIZES)


# ---------------------------------------------------------------- what they show
class Capture:
    """Photos of a ball as ingest publishes them, one of them twice as large as it was read, and their model."""

    def __init__(self, folder: Path) -> None:
        import pycolmap

        self.model, self.camera = pycolmap.Reconstruction(), lens(-0.1)
        self.model.add_camera_with_trivial_rig(self.camera)
        self.pictures, self.records = Pictures(folder), []
        self.up = Rotation.from_euler("xyz", [20, 130, -50], degrees=True).as_matrix()

    def add(self, name: str, pose: np.ndarray | None, pixels: np.ndarray, taken: tuple[int, int] | None = None) -> None:
        import pycolmap

        path = self.pictures.path(name)
        path.parent.mkdir(parents=True, exist_ok=True)
        write_png(path, pixels)
        self.records.append(ImageRecord(name, name, *SIZE, None, "", 1.0, False, "", taken=taken))
        if pose is not None:
            image = pycolmap.Image(name, pycolmap.Point2DList([]), 1, len(self.records))
            self.model.add_image_with_trivial_frame(
                image, pycolmap.Rigid3d(pycolmap.Rotation3d(pose[:, :3]), pose[:, 3])
            )

    def light(self, *balls: str, held_out: tuple[str, ...] = ()) -> Any:
        return light_of_balls(balls, self.records, self.pictures, self.model, held_out, self.up)


POSE = look_at(np.array([3.0, 1.0, 2.0]), np.zeros(3))


def named(kind: str, photo: str, taken: Drawn, scale: float = 1.0) -> str:
    x, y = taken.center
    return f"{kind}:{photo}:{scale * x},{scale * y},{scale * taken.radius}"


@pytest.fixture
def photographed(tmp_path: Path) -> tuple[Capture, Callable[..., Drawn]]:
    capture = Capture(tmp_path)

    def draw(kind: str, light: np.ndarray, exposure: float) -> Drawn:
        light_from_cam = capture.up @ POSE[:, :3].T
        return drawn(kind, light, light_from_cam, PLACE, RADIUS, capture.camera, exposure)

    return capture, draw


def test_the_light_is_where_the_poses_have_it(photographed: tuple[Capture, Callable[..., Drawn]]) -> None:
    capture, draw = photographed
    taken = draw("chrome", lamps(2.5), 0.3)
    capture.add("1.png", POSE, taken.pixels)
    found = capture.light(named("chrome", "1.png", taken))
    assert apart_deg(main_source(found.radiance), LAMPS[0]) < 6


def test_circles_are_in_pixels_of_the_photo_as_it_was_taken(
    photographed: tuple[Capture, Callable[..., Drawn]],
) -> None:
    capture, draw = photographed
    taken = draw("chrome", lamps(2.5), 0.3)
    capture.add("1.png", POSE, taken.pixels)
    capture.add("large.png", POSE, taken.pixels, taken=(4 * SIZE[0], 4 * SIZE[1]))
    expected = capture.light(named("chrome", "1.png", taken)).radiance
    found = capture.light(named("chrome", "large.png", taken, 4)).radiance
    np.testing.assert_allclose(found, expected, atol=1e-5)
    with pytest.raises(InputError, match=r"radius of 20 pixels and 5\.0 in the photo as it was reduced"):
        capture.light("chrome:large.png:600,400,20")


def test_photos_that_cannot_tell_are_refused(photographed: tuple[Capture, Callable[..., Drawn]]) -> None:
    capture, draw = photographed
    taken = draw("grey", lamps(2.5), 0.3)
    capture.add("1.png", POSE, taken.pixels)
    capture.add("lost.png", None, taken.pixels)
    capture.add("white.png", POSE, np.full_like(taken.pixels, 255))
    with pytest.raises(InputError, match=r"lost\.png, in which a grey ball is, could not be placed"):
        capture.light(named("grey", "lost.png", taken))
    with pytest.raises(InputError, match=r"1\.png, in which a grey ball is, is held out"):
        capture.light(named("grey", "1.png", taken), held_out=("1.png",))
    for kind in ("grey", "chrome"):
        with pytest.raises(InputError, match=f"The {kind} ball in white.png tells no light: 100 % of it are clipped"):
            capture.light(named(kind, "white.png", taken))


# ---------------------------------------------------------------- the run
def test_a_ball_sets_what_it_needs_and_the_newest_light_counts() -> None:
    ball = "chrome:IMG_1.jpg:1,2,30"
    named = of_a_run(ball=[ball])
    assert f'materials.balls=["{ball}"]' in named.sets
    assert "materials.enabled=true" in named.sets
    assert named.no_light  # a file of the last run is forgotten
    assert "materials.balls=[]" in of_a_run(light=Path("studio.hdr")).sets
    assert "materials.balls=[]" in of_a_run(no_light=True).sets
    assert not any("balls" in text for text in of_a_run().sets)
    with pytest.raises(ConfigError, match="Both `--light` and `--ball`"):
        of_a_run(light=Path("studio.hdr"), ball=[ball])
