"""Features of rich photos, found without the first octave, against COLMAP's whole search."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from configs.params import SfmParams
from stages.posing.features import append, extract
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


@pytest.mark.parametrize("why", ["a rich one has features already", "masks"])
def test_photos_that_are_hardly_rich_are_searched_once(tmp_path: Path, monkeypatch, why: str):
    """Among photos added later, which are plain, those known before tell nothing; inside masks no photo is rich."""
    import pycolmap

    masked = why == "masks"
    names = [f"{'rich' if masked else 'plain'}{i}.png" for i in range(9)] + ["rich.png"]
    photos(tmp_path / "photos", names)
    params = SfmParams(max_features=MOST)
    found = database(tmp_path / "found.db", tmp_path / "photos", names)
    with pycolmap.Database.open(found) as opened:
        known = opened.read_image_with_name("rich.png").image_id
    extract(found, tmp_path / "photos", params, 1, False, among=[known])
    assert len(features(found)["rich.png"]) >= MOST
    masks = tmp_path / "masks" if masked else None
    if masks is not None:
        masks.mkdir()
        for name in names:
            cv2.imwrite(str(masks / f"{name}.png"), np.full((HEIGHT, WIDTH), 255, np.uint8))
    searched = []
    monkeypatch.setattr(pycolmap, "extract_features", lambda *_, **options: searched.append(options["image_names"]))
    extract(found, tmp_path / "photos", params, 1, False, masks_folder=masks)
    assert searched == ([names[:9]] if masked else [["plain0.png", "plain8.png"], names[:9]])


def test_features_and_matches_are_appended(tmp_path: Path):
    import pycolmap

    random = np.random.default_rng(0)

    def written(path: Path, counts: list[int], matches: dict[tuple[int, int], list[list[int]]]) -> Path:
        with pycolmap.Database.open(path) as opened:
            camera = opened.write_camera(pycolmap.Camera.create_from_model_name(0, "SIMPLE_RADIAL", 90.0, 64, 48))
            for number, count in enumerate(counts):
                image_id = opened.write_image(pycolmap.Image(name=f"{number}.jpg", camera_id=camera))
                opened.write_keypoints(image_id, random.uniform(1, 48, (count, 6)).astype(np.float32))
                data = random.integers(1, 255, (count, 128), dtype=np.uint8)
                opened.write_descriptors(
                    image_id, pycolmap.FeatureDescriptors(pycolmap.FeatureExtractorType.SIFT, data)
                )
            for pair, indices in matches.items():
                opened.write_matches(*pair, np.array(indices, np.uint32))
                opened.write_two_view_geometry(*pair, pycolmap.TwoViewGeometry())
        return path

    own = written(tmp_path / "own.db", [3, 4, 5], {(1, 2): [[0, 1], [2, 3]], (1, 3): [[2, 2]]})
    more = written(tmp_path / "more.db", [6, 7, 8], {(1, 2): [[5, 0]], (2, 3): [[1, 7]]})
    with pycolmap.Database.open(own) as opened:
        before = [(opened.read_keypoints(i), np.asarray(opened.read_descriptors(i).data)) for i in (1, 2, 3)]
    append(more, own, [(1, 2)])
    with pycolmap.Database.open(own) as opened:
        assert [opened.num_keypoints_for_image(i) for i in (1, 2, 3)] == [3 + 6, 4 + 7, 5]
        for i, (keypoints, data) in enumerate(before, 1):
            np.testing.assert_array_equal(opened.read_keypoints(i)[: len(keypoints)], keypoints)
            got = np.asarray(opened.read_descriptors(i).data)
            assert len(got) == opened.num_keypoints_for_image(i)
            np.testing.assert_array_equal(got[: len(data)], data)
            assert not got[len(data) :].any()
        np.testing.assert_array_equal(opened.read_matches(1, 2), [[0, 1], [2, 3], [5 + 3, 0 + 4]])
        np.testing.assert_array_equal(opened.read_matches(1, 3), [[2, 2]])
        assert not opened.exists_two_view_geometry(1, 2)
        assert opened.exists_two_view_geometry(1, 3)
        assert not opened.exists_matches(2, 3)
    append(more, own, [(2, 3)])
    with pycolmap.Database.open(own) as opened:
        np.testing.assert_array_equal(opened.read_matches(2, 3), [[1 + 4 + 7, 7 + 5]])
