"""Whether what lies off the masks stood still: then masks lie beside the photos in the workspace, else they hide."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from dotted_capture import MODELS, NUM_CAMERAS, undistort, write_capture

from stages import artifacts
from stages import undistort as stage
from stages.posing.backdrop import MIN_POINTS, stands_still

WIDTH, HEIGHT = 320, 240
CAMERA = SimpleNamespace(width=WIDTH, height=HEIGHT)
MODEL = SimpleNamespace(cameras={1: CAMERA})


def photo(name: str, on: tuple[int, int], off: tuple[int, int]) -> SimpleNamespace:
    """Features on the left half and off it: how many there are, and how many of them are points."""

    def features(x: float, count: int, known: int) -> list[SimpleNamespace]:
        rows = np.linspace(10, HEIGHT - 10, count)
        return [SimpleNamespace(xy=(x, y), has_point3D=lambda k=k: k < known) for k, y in enumerate(rows)]

    return SimpleNamespace(name=name, camera_id=1, points2D=features(80, *on) + features(240, *off))


def left_half(name: str) -> np.ndarray | None:
    mask = np.zeros((HEIGHT // 2, WIDTH // 2), np.uint8)  # of another size than the photo
    mask[:, : WIDTH // 4] = 255
    return None if name == "bare" else mask


MANY = round(MIN_POINTS)


@pytest.mark.parametrize(
    ("off", "still"),
    [
        ((4 * MANY, 2 * MANY), True),  # a table
        ((40 * MANY, 2 * MANY), False),  # a turntable before a room that does not turn
        ((4 * MANY, 0), False),  # an object that was moved
        ((4, 2), False),  # a black cloth
    ],
)
def test_a_background_stands_still_where_its_features_became_points(off, still):
    photos = [photo("a", (50, 5), off), photo("b", (50, 5), off)]
    assert stands_still(MODEL, photos, left_half) == still
    # photos without a mask have no say
    assert stands_still(MODEL, [*photos, photo("bare", (0, 0), (900, 900))], left_half) == still


def test_features_on_the_masks_are_none_of_the_background():
    assert not stands_still(MODEL, [photo("a", (900, 900), (0, 0))], left_half)
    assert not stands_still(MODEL, [photo("bare", (900, 900), (900, 900))], left_half)


def test_masks_lie_beside_the_photos_where_the_background_stood_still(tmp_path: Path, monkeypatch):
    monkeypatch.setattr(stage, "stands_still", lambda *_: True)
    _, out, numbers = undistort(write_capture(tmp_path, *MODELS[0], masks=True), tmp_path)
    assert numbers["background_still"] is True
    assert len(list(artifacts.SILHOUETTES.load(out).masks.iterdir())) == NUM_CAMERAS
    assert not artifacts.PINHOLE_PHOTOS.load(out).masks.exists()
    assert numbers["region_from"] == "the visual hull of the masks"


def test_masks_hide_a_background_that_was_moved(tmp_path: Path):
    _, out, numbers = undistort(write_capture(tmp_path, *MODELS[0], masks=True), tmp_path)
    assert numbers["background_still"] is False
    assert len(list(artifacts.PINHOLE_PHOTOS.load(out).masks.iterdir())) == NUM_CAMERAS
    assert not artifacts.SILHOUETTES.load(out).masks.exists()
