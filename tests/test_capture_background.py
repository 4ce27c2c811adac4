"""Masks from plain backgrounds, on pictures whose mask is known."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from configs.params import IngestParams
from stages import artifacts
from stages.capture.background import find_background, object_mask
from stages.engine.stage import StageContext
from stages.errors import InputError
from stages.ingest import INGEST

SIZE = (240, 180)
OUTLINE = 0.93  # a pixel more all around the disc of 45 pixels is 0.955, and the bar has outline, too
BACKGROUNDS = {"black": (14, 13, 15), "white": (236, 235, 232), "green": (30, 170, 60)}


def picture(
    colour: tuple[int, int, int], seed: int = 0, fall_off: float = 0.15, grain: float = 2.0
) -> tuple[np.ndarray, np.ndarray]:
    """A textured disc with a bar on a background whose light falls off to one side, a soft shadow; and its mask."""
    generator = np.random.default_rng(seed)
    width, height = SIZE
    light = 1 + fall_off * np.linspace(-1, 1, width)
    pixels = np.asarray(colour, float) * light[None, :, None] * np.ones((height, 1, 1))
    shadow = np.zeros((height, width))
    cv2.ellipse(shadow, (140, 130), (50, 20), 0, 0, 360, 1.0, -1)
    pixels *= 1 - 0.12 * cv2.GaussianBlur(shadow, (0, 0), 6)[:, :, None]
    mask = np.zeros((height, width), np.uint8)
    cv2.circle(mask, (110 + seed % 5, 90), 45, 1, -1)
    cv2.rectangle(mask, (110, 30), (125, 60), 1, -1)
    patches = cv2.resize(generator.integers(60, 190, (12, 16, 3)).astype(float), SIZE, interpolation=cv2.INTER_CUBIC)
    pixels = np.where(mask[:, :, None] > 0, patches * (1.0, 0.75, 0.5), pixels)
    pixels += generator.normal(0, grain, pixels.shape)
    return pixels.clip(0, 255).astype(np.uint8), mask > 0


def iou(a: np.ndarray, b: np.ndarray) -> float:
    return float((a & b).sum() / (a | b).sum())


@pytest.mark.parametrize("name", BACKGROUNDS)
def test_object_is_told_from_a_plain_background_with_uneven_light_and_a_shadow(name: str):
    rgb, truth = picture(BACKGROUNDS[name])
    background = find_background(rgb)
    assert background.is_plain
    mask = object_mask(rgb, background)
    assert mask is not None
    assert iou(mask, truth) > OUTLINE


def test_spots_of_the_backgrounds_colour_inside_the_object_are_filled():
    rgb, truth = picture(BACKGROUNDS["black"])
    cv2.circle(rgb, (110, 90), 12, BACKGROUNDS["black"], -1)
    mask = object_mask(rgb, find_background(rgb))
    assert mask is not None
    assert mask[90, 110]
    assert iou(mask, truth) > OUTLINE


def test_large_photos_get_masks_of_their_size():
    rgb, truth = picture(BACKGROUNDS["white"])
    large = cv2.resize(rgb, None, fx=6, fy=6, interpolation=cv2.INTER_CUBIC)
    mask = object_mask(large, find_background(large))
    assert mask is not None
    assert mask.shape == (SIZE[1] * 6, SIZE[0] * 6)
    assert iou(mask, np.kron(truth, np.ones((6, 6), bool))) > OUTLINE


def test_grain_patterns_and_scenes_are_not_plain():
    carpet, _ = picture((120, 118, 115), grain=14)
    assert not find_background(carpet).is_plain
    print_on_table = np.random.default_rng(0).integers(0, 256, (18, 24, 3), dtype=np.uint8)
    assert not find_background(cv2.resize(print_on_table, SIZE)).is_plain
    horizon, _ = picture(BACKGROUNDS["white"])
    horizon[120:] //= 3
    assert not find_background(horizon).is_plain


def test_an_empty_frame_has_no_mask():
    empty = np.full((180, 240, 3), 200, np.uint8)
    assert object_mask(empty, find_background(empty)) is None


def ingest(folder: Path, **params: object) -> tuple[artifacts.ImageSet, Path, dict[str, object]]:
    out = folder.parent / "out"
    out.mkdir()
    sources, settings = {"photos": folder}, IngestParams(**params)  # type: ignore[arg-type]
    numbers = INGEST.run(StageContext({}, sources, out, folder.parent / "scratch", settings, workers=2))
    return artifacts.IMAGE_SET.load(out), out, numbers


def write_set(folder: Path, count: int, others: int = 0) -> list[np.ndarray]:
    folder.mkdir()
    truths = []
    for i in range(count + others):
        rgb, truth = picture(BACKGROUNDS["black"], seed=i, grain=2 if i < count else 30)
        Image.fromarray(rgb).save(folder / f"{i:03d}.png")
        truths.append(truth)
    return truths


def test_ingest_makes_masks_where_asked_and_leaves_out_the_odd_photo(tmp_path: Path):
    truths = write_set(tmp_path / "photos", 11, others=1)
    image_set, out, numbers = ingest(tmp_path / "photos", auto_mask="plain")
    assert numbers["masks"] == numbers["images"] == 11
    assert [(item.source, item.reason) for item in image_set.skipped] == [("011.png", "its background is not plain")]
    assert not artifacts.image_path(out, "011.png").exists()
    mask = artifacts.load_mask(out, "003.png")
    assert mask is not None
    assert iou(mask > 0, truths[3]) > OUTLINE


def test_ingest_makes_no_masks_unless_asked(tmp_path: Path):
    write_set(tmp_path / "photos", 3)
    assert ingest(tmp_path / "photos")[2]["masks"] == 0


def test_a_background_that_is_not_plain_is_an_error(tmp_path: Path):
    write_set(tmp_path / "photos", 6, others=4)
    with pytest.raises(InputError, match=r"plain in 6 of 10 photos \(need 9\), for example not in 006\.png") as caught:
        ingest(tmp_path / "photos", auto_mask="plain")
    assert "ingest.auto_mask=off" in caught.value.hint


@pytest.mark.data
@pytest.mark.parametrize(("name", "plain"), [("viking", True), ("banana", False), ("synth_helmet", False)])
def test_real_backgrounds(data_dir: Path, name: str, plain: bool):
    files = sorted((data_dir / name / "images").iterdir())[::8]
    judged = [find_background(np.asarray(Image.open(file).convert("RGB"))).is_plain for file in files]
    assert np.mean(judged) > 0.9 if plain else np.mean(judged) < 0.6
