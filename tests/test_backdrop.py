"""Whether the model has what lies off the masks: then masks lie beside the photos in the workspace, else they hide."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from dotted_capture import MODELS, NUM_CAMERAS, undistort, write_capture

from stages import artifacts
from stages.posing.backdrop import MIN_FEATURES, MIN_POINTS, seen_background

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


MANY = MIN_POINTS


@pytest.mark.parametrize(
    ("on", "off", "seen"),
    [
        ((50, 25), (4 * MANY, 2 * MANY), True),  # a table
        ((50, 25), (12 * MANY, 2 * MANY), False),  # a turntable before a room that does not turn
        ((50, 5), (12 * MANY, 2 * MANY), True),  # a plain object, whose features are as hard to match
        ((2, 2), (12 * MANY, 2 * MANY), True),  # one with next to none
        ((50, 25), (4 * MANY, 0), False),  # an object that was moved
        ((50, 25), (4, 4), False),  # a black cloth
    ],
)
def test_a_background_is_seen_where_its_features_became_points_as_those_of_the_object(on, off, seen):
    photos = [photo("a", on, off), photo("b", on, off)]
    found = seen_background(MODEL, photos, left_half)
    assert (found.points, found.off) == (off[1], off[1] / off[0])
    assert found.on == (0 if on[0] < MIN_FEATURES else on[1] / on[0])
    assert found.is_seen == seen
    # photos without a mask have no say
    assert seen_background(MODEL, [*photos, photo("bare", (0, 0), (900, 900))], left_half) == found


def test_one_photo_that_shows_much_does_not_speak_for_the_others():
    few = [photo(name, (50, 25), (20, 1)) for name in "abc"]
    assert not seen_background(MODEL, [*few, photo("d", (50, 25), (900, 900))], left_half).is_seen


def test_features_on_the_masks_are_none_of_the_background():
    assert not seen_background(MODEL, [photo("a", (900, 900), (0, 0))], left_half).is_seen
    assert not seen_background(MODEL, [photo("bare", (900, 900), (900, 900))], left_half).is_seen


# ---------------------------------------------------------------- in undistort
STILL, MOVED = 1.0, 0.0  # part of the table's features that are points


def masks_of(out: Path) -> tuple[int, int]:
    """How many lie beside whole photos, and how many alone count."""
    folders = artifacts.OUTLINES.load(out).masks, artifacts.PINHOLE_PHOTOS.load(out).masks
    beside, alone = (len(list(folder.iterdir())) if folder.exists() else 0 for folder in folders)
    return beside, alone


@pytest.mark.parametrize(
    ("table", "masks", "lie_beside"),
    [
        (STILL, "auto", True),
        (MOVED, "auto", False),
        (0.2, "auto", False),  # enough points, but far fewer of the features than on the ball
        (None, "auto", False),
        (STILL, "alone", False),
        (MOVED, "beside", True),
    ],
)
@pytest.mark.parametrize("masked", [NUM_CAMERAS, 5])
def test_masks_lie_beside_the_photos_where_the_background_stood_still(
    tmp_path, caplog, table, masks, lie_beside, masked
):
    caplog.set_level("INFO")
    inputs = write_capture(tmp_path, *MODELS[0], masks=True, table=table)
    for i in range(masked, NUM_CAMERAS):
        artifacts.PHOTOS.load(inputs["ingest"]).mask_path(f"photo_{i}.jpg").unlink()
    _, out, numbers = undistort(inputs, tmp_path, masks=masks)
    assert masks_of(out) == ((masked, 0) if lie_beside else (0, masked))
    assert not artifacts.SILHOUETTES.load(out).masks.exists()
    assert numbers.get("background_is_seen") == (lie_beside if masks == "auto" else None)
    assert ("whole photos count" in caplog.text, "masks alone count" in caplog.text) == (
        (lie_beside, not lie_beside) if masks == "auto" else (False, False)
    )
    assert numbers["region_from"] == "the visual hull of the masks"


def test_a_background_that_sfm_found_to_move_is_not_asked(tmp_path: Path):
    inputs = write_capture(tmp_path, *MODELS[0], masks=True, table=STILL)
    contents = artifacts.PHOTO_CONTENTS.load(inputs["sfm"])
    artifacts.PHOTO_CONTENTS.save(inputs["sfm"], contents.model_copy(update={"background_moved": True}))
    _, out, numbers = undistort(inputs, tmp_path)
    assert numbers["background_is_seen"] is False
    assert masks_of(out) == (0, NUM_CAMERAS)


def test_the_object_is_what_given_masks_show_wherever_they_lie(tmp_path: Path):
    _, out, _ = undistort(write_capture(tmp_path, *MODELS[0], masks=True, table=STILL), tmp_path)
    photos, outlines = artifacts.PINHOLE_PHOTOS.load(out), artifacts.OUTLINES.load(out)
    pixels, mask = artifacts.given_mask_of("photo_0.png", photos, outlines).masked("photo_0.png")
    assert mask is not None
    assert 0.02 < mask.mean() < 0.5
    np.testing.assert_array_equal(pixels, photos.image("photo_0.png"))
    outlines.mask_path("photo_0.png").unlink()
    assert artifacts.given_mask_of("photo_0.png", photos, outlines).mask("photo_0.png") is None
