"""Silhouettes that were guessed: those of the same thing are believed, those of something else are not."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from dotted_capture import MODELS, NUM_CAMERAS, undistort, write_capture
from sphere_scene import render, ring_of_cameras

from stages import artifacts
from stages.artifacts import ImageSet
from stages.geometry.cameras import PinholeCameras
from stages.geometry.silhouettes import MIN_IOU, agreeing, silhouette_agreement


def balls(cameras: PinholeCameras) -> list[np.ndarray | None]:
    return [render(cameras, i)[1] for i in range(len(cameras))]


def moved(mask: np.ndarray | None, pixels: int) -> np.ndarray:
    assert mask is not None
    return np.roll(mask, pixels, axis=1)


def test_silhouettes_of_one_thing_all_agree():
    cameras = ring_of_cameras(12)
    scores = silhouette_agreement(cameras, balls(cameras))
    assert scores.min() > 0.85
    assert agreeing(scores).all()


def test_a_silhouette_of_something_else_is_told_and_spoils_no_other():
    cameras = ring_of_cameras(12)
    masks = balls(cameras)
    masks[3], masks[7] = moved(masks[3], 14), None
    scores = silhouette_agreement(cameras, masks)
    assert np.isnan(scores[7])
    assert scores[3] < 0.5
    assert np.flatnonzero(~agreeing(scores)).tolist() == [3, 7]
    assert np.nanmin(np.delete(scores, 3)) > MIN_IOU


def test_a_part_that_most_silhouettes_lack_is_no_reason_to_believe_the_others():
    """As of a helmet whose stand is missed in half of the photos: neither half is enough."""
    cameras = ring_of_cameras(16)
    masks = balls(cameras)
    for i in range(0, 16, 2):
        mask = masks[i]
        assert mask is not None
        mask[len(mask) // 2 :] = 0
    assert not agreeing(silhouette_agreement(cameras, masks)).any()


def test_where_nothing_fits_none_is_believed():
    cameras = ring_of_cameras(12)
    generator = np.random.default_rng(0)
    masks = [moved(mask, int(generator.integers(-20, 20))) for mask in balls(cameras)]
    assert not agreeing(silhouette_agreement(cameras, masks)).any()


def test_too_few_silhouettes_or_parallel_ones_say_nothing():
    cameras = ring_of_cameras(4)
    masks = balls(cameras)
    assert silhouette_agreement(cameras, [masks[0], None, None, None])[0] == 0
    same = PinholeCameras(
        cameras.names, cameras.sizes, cameras.intrinsics, np.repeat(cameras.extrinsics[:1], 4, axis=0)
    )
    assert not silhouette_agreement(same, [masks[0]] * 4).any()
    assert np.isnan(silhouette_agreement(cameras, [None] * 4)).all()


# ---------------------------------------------------------------- in undistort
def guessed_capture(root: Path, wrong: int) -> dict[str, Path]:
    """Masks of the ball that a network made; the first ones show a corner of the photo instead."""
    inputs = write_capture(root, *MODELS[0], masks=True)
    pictures, records = artifacts.Pictures(inputs["ingest"]), artifacts.IMAGE_SET.load(inputs["ingest"]).images
    for i, record in enumerate(records[:wrong]):
        mask = np.zeros((record.height, record.width), np.uint8)
        mask[(i % 2) * 180 :, : 40 + 30 * i] = 255
        cv2.imwrite(str(pictures.mask_path(record.name)), mask)
    artifacts.IMAGE_SET.save(
        inputs["ingest"], ImageSet(tuple(replace(record, made_mask="salient") for record in records))
    )
    return inputs


@pytest.mark.parametrize("wrong", [0, 1])
def test_undistort_keeps_the_masks_that_agree_apart_from_those_of_training(tmp_path: Path, caplog, wrong: int):
    _, out, numbers = undistort(guessed_capture(tmp_path, wrong), tmp_path)
    assert numbers["region_from"] == "the visual hull of the masks"
    assert (numbers["masks"], numbers["masks_dropped"]) == (NUM_CAMERAS - wrong, wrong)
    kept = {path.name for path in artifacts.SILHOUETTES.load(out).masks.iterdir()}
    assert kept == {f"photo_{i}.png.png" for i in range(wrong, NUM_CAMERAS)}
    assert not artifacts.PINHOLE_PHOTOS.load(out).masks.exists()
    assert ("1 of 8 masks that were made do not fit the others" in caplog.text) == bool(wrong)


def test_undistort_uses_none_where_too_few_agree(tmp_path: Path, caplog):
    _, out, numbers = undistort(guessed_capture(tmp_path, 5), tmp_path)
    assert (numbers["masks"], numbers["masks_dropped"]) == (0, NUM_CAMERAS)
    assert numbers["region_from"] != "the visual hull of the masks"
    assert not artifacts.SILHOUETTES.load(out).masks.exists()
    assert "none of the 8 masks that were made is used" in caplog.text
