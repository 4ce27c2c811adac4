"""Features of rich photos, found without the first octave, against COLMAP's whole search."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from configs.params import SfmParams
from stages.posing.features import extract
from stages.posing.settings import feature_options

WIDTH, HEIGHT = 320, 240
MOST = 200


def photos(folder: Path, names: list[str]) -> None:
    """Blobs of all sizes, the same in each photo; a few large ones only in photos that are called plain."""
    folder.mkdir()
    noise = np.random.default_rng(0).normal(size=(HEIGHT, WIDTH))
    layers = [cv2.GaussianBlur(noise, None, sigma) * sigma for sigma in (1, 3, 6)]
    for name in names:
        pixels = cv2.GaussianBlur(noise, None, 8) * 8 if name.startswith("plain") else sum(layers)
        assert cv2.imwrite(str(folder / name), np.clip(128 + 60 * pixels, 0, 255).astype(np.uint8))


def database(path: Path, folder: Path, names: list[str]) -> Path:
    import pycolmap

    pycolmap.Database.open(path).close()
    pycolmap.import_images(path, folder, image_names=names)
    return path


def features(path: Path) -> dict[str, np.ndarray]:
    import pycolmap

    with pycolmap.Database.open(path) as opened:
        return {image.name: opened.read_keypoints(image.image_id) for image in opened.read_all_images()}


@pytest.mark.parametrize("affine", [False, True])
def test_rich_photos_get_the_features_of_the_whole_search(tmp_path: Path, monkeypatch, affine: bool):
    import pycolmap

    names = [*(f"rich{i}.png" for i in range(9)), "plain.png"]
    photos(tmp_path / "photos", names)
    params = SfmParams(max_features=MOST)
    whole = database(tmp_path / "whole.db", tmp_path / "photos", names)
    pycolmap.extract_features(whole, tmp_path / "photos", **feature_options(params, 1, False, affine))
    searched = []
    extract_features = pycolmap.extract_features

    def watched(path, *arguments, **options):
        searched.append((options["extraction_options"].sift.first_octave, len(options["image_names"])))
        extract_features(path, *arguments, **options)

    monkeypatch.setattr(pycolmap, "extract_features", watched)
    found = database(tmp_path / "found.db", tmp_path / "photos", names)
    extract(found, tmp_path / "photos", params, 1, False, affine)
    assert searched == [(0, 2), (0, 8), (-1, 10)]

    expected, got = features(whole), features(found)
    np.testing.assert_array_equal(got["plain.png"], expected["plain.png"])
    assert 0 < len(got["plain.png"]) < MOST
    for name in names[:-1]:
        distances = np.linalg.norm(got[name][:, None, :2] - expected[name][None, :, :2], axis=2)
        assert len(got[name]) >= MOST
        assert np.mean(distances.min(0) < 0.5) > 0.9  # whole levels are kept: one more may be among what was found


def test_where_the_first_photos_are_plain_the_others_are_not_tried(tmp_path: Path, monkeypatch):
    import pycolmap

    names = [f"plain{i}.png" for i in range(9)]
    photos(tmp_path / "photos", names)
    found = database(tmp_path / "found.db", tmp_path / "photos", names)
    searched = []
    monkeypatch.setattr(pycolmap, "extract_features", lambda *_, **options: searched.append(options["image_names"]))
    extract(found, tmp_path / "photos", SfmParams(), 1, False)
    assert searched == [["plain0.png", "plain8.png"], names]
