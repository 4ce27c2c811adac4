"""Which pairs of photos are matched, against slow counts and rules by hand."""

from __future__ import annotations

from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from stages.posing import pairs
from stages.posing.features import _pad_descriptors
from stages.posing.pairs import choose_pairs, common_features, likely_pairs, near_pairs


def descriptors(number: int, seed: int) -> np.ndarray:
    """Such as COLMAP's: 128 whole numbers, 512 long."""
    drawn = np.random.default_rng(seed).gamma(0.5, size=(number, 128))
    return np.rint(512 * drawn / np.linalg.norm(drawn, axis=1, keepdims=True)).clip(0, 255).astype(np.float32)


def noisy(of: np.ndarray, seed: int) -> np.ndarray:
    return (of + np.random.default_rng(seed).integers(-8, 9, of.shape)).clip(0, 255).astype(np.float32)


def slow_count(first: np.ndarray, second: np.ndarray) -> int:
    def angle(one: np.ndarray, other: np.ndarray) -> float:
        return float(np.arccos(np.clip(one @ other / np.linalg.norm(one) / np.linalg.norm(other), -1, 1)))

    found = 0
    for i, one in enumerate(first):
        angles = [angle(one, other) for other in second]
        j = int(np.argmin(angles))
        back = [angle(other, second[j]) for other in first]
        nearest, next_nearest = sorted(angles)[:2]
        found += nearest <= 0.7 and nearest <= 0.8 * next_nearest and int(np.argmin(back)) == i
    return found


@pytest.mark.parametrize("at_once", [1, 2, 4, 64])
def test_counts_are_those_of_a_slow_loop_and_of_features_that_are_there_twice(monkeypatch, at_once: int):
    monkeypatch.setattr(pairs, "AT_ONCE", at_once)
    scene = descriptors(40, 0)
    photos = [
        noisy(scene[:30], 1),
        noisy(scene[20:], 2),
        descriptors(25, 3),
        np.concatenate([noisy(scene[:10], 4), noisy(scene[:10], 4)]),  # each has a rival as near
        np.zeros((0, 128), np.float32),
        noisy(scene[:1], 5),  # one alone passes no test of a ratio
    ]
    common = common_features(photos)
    np.testing.assert_array_equal(common, common.T)
    for i, j in combinations(range(4), 2):
        assert common[i, j] == slow_count(photos[i], photos[j])
    assert common[0, 1] == 10
    assert common[0, 3] == 0
    assert not common[4].any()
    assert common_features([]).shape == (0, 0)


def few_partners(monkeypatch: pytest.MonkeyPatch, **numbers: int) -> None:
    """Only so many partners of each kind, and one tree of pairs."""
    for name, number in {"SPREAD": 0, "APART": 0, "TREES": 1, **numbers}.items():
        monkeypatch.setattr(pairs, name, number)


def seen_from(angles_deg: np.ndarray) -> np.ndarray:
    """[n, n] as many features as photos of directions so far apart have in common: SIFT forgets within some 20 deg."""
    common = np.rint(100 * np.exp(-((angles_deg / 20) ** 2))).astype(int)
    np.fill_diagonal(common, 0)
    return common


@pytest.mark.parametrize(("rings", "least"), [(25, 50), (30, 50), (45, 5)])
def test_two_rings_of_photos_do_not_hang_on_one_pair(rings: float, least: int):
    """Two walks around something, the second one so many degrees higher; past 33 of them no pair across is clear."""
    around = np.arange(75) * 2 * np.pi / 75
    heights = np.radians(np.repeat([10, 10 + rings], 75))
    directions = np.stack(
        [np.cos(heights) * np.cos([*around, *around]), np.cos(heights) * np.sin([*around, *around]), np.sin(heights)], 1
    )
    chosen = choose_pairs(seen_from(np.degrees(np.arccos(np.clip(directions @ directions.T, -1, 1)))))
    assert sum(i < 75 <= j for i, j in chosen) >= least
    assert len(chosen) < 75 * 74 / 3  # of 75 * 149


def test_pairs_of_a_dense_walk_are_far_apart_too():
    """The best twelve partners are at most six photos away, which is 7 degrees here."""
    angles = np.abs(np.subtract.outer(np.arange(150), np.arange(150))) * 180 / 149
    apart = [angles[pair] for pair in choose_pairs(seen_from(angles))]
    assert np.quantile(apart, 0.8) > 15
    assert len(apart) < 15 * 150


def test_a_photo_gets_further_partners_evenly_and_those_apart_from_all_others(monkeypatch: pytest.MonkeyPatch):
    few_partners(monkeypatch, MOST=1, LEAST=1, SPREAD=3, APART=1)
    common = np.zeros((9, 9), int)
    common[0, 1:9] = [90, 40, 35, 30, 25, 20, 15, 2]
    common = common + common.T
    common[1:8, 1:8] = 50 - 40 * (np.arange(1, 8) == 3)[:, None] - 40 * (np.arange(1, 8) == 3)
    assert pairs._partners(common, 0) == [1, 2, 4, 7, 3]


def test_a_photo_gets_its_clear_partners_and_a_few_whatever_they_share(monkeypatch: pytest.MonkeyPatch):
    few_partners(monkeypatch, MOST=3, LEAST=1)
    common = np.zeros((6, 6), int)
    for (i, j), count in {(0, 1): 9, (0, 2): 8, (0, 3): 7, (0, 4): 6, (1, 2): 5, (3, 5): 2}.items():
        common[i, j] = common[j, i] = count
    chosen = choose_pairs(common)
    # 0-4 is the fourth of photo 0, but the best of photo 4; 1-2 is not clear; 3-5 is the best of photo 5
    assert chosen == [(0, 1), (0, 2), (0, 3), (0, 4), (3, 5)]


def test_pairs_connect_all_photos(monkeypatch: pytest.MonkeyPatch):
    few_partners(monkeypatch, MOST=2, LEAST=1)
    common = np.zeros((8, 8), int)
    for group in (range(4), range(4, 8)):
        for i, j in combinations(group, 2):
            common[i, j] = common[j, i] = 50
    common[2, 5] = common[5, 2] = 7
    assert (2, 5) in choose_pairs(common)
    assert choose_pairs(np.zeros((2, 2), int)) == [(0, 1)]
    assert choose_pairs(np.zeros((1, 1), int)) == []
    assert choose_pairs(np.zeros((0, 0), int)) == []


def test_the_largest_features_of_a_database_choose_the_pairs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    import pycolmap

    monkeypatch.setattr(pairs, "LARGEST", 20)
    monkeypatch.setattr(pairs, "LEAST", 0)
    large, small = descriptors(20, 0), descriptors(20, 1)
    path = tmp_path / "a.db"
    with pycolmap.Database.open(path) as opened:
        camera_id = opened.write_camera(pycolmap.Camera.create_from_model_name(0, "SIMPLE_RADIAL", 90.0, 64, 48))
        for number, (of, scales) in enumerate([(large, 9), (small, 9), (large, 9), (small, 1), (None, 0)]):
            image_id = opened.write_image(pycolmap.Image(name=f"{number} a.jpg", camera_id=camera_id))
            if of is None:
                continue
            # features of the other size are there, too, and the first ones
            own = np.concatenate([descriptors(20, 10 + number), noisy(of, number)]).astype(np.uint8)
            sizes = np.repeat([1 + 9 - scales, scales], 20).astype(np.float32)
            keypoints = np.zeros((40, 6), np.float32)
            keypoints[:, 2] = keypoints[:, 5] = sizes
            opened.write_keypoints(image_id, keypoints)
            opened.write_descriptors(image_id, pycolmap.FeatureDescriptors(pycolmap.FeatureExtractorType.SIFT, own))
    with pycolmap.Database.open(path) as opened:  # larger ones without a descriptor count for nothing
        _append_zeros(opened, sizes=30.0, number=25)
    monkeypatch.setattr(pairs, "_connecting", lambda common: [])
    monkeypatch.setattr(pairs, "NEXT", 0)
    assert likely_pairs(path) == [(1, 3)]
    monkeypatch.setattr(pairs, "NEXT", 1)
    assert likely_pairs(path) == [(1, 2), (1, 3), (2, 3), (3, 4), (4, 5)]
    monkeypatch.setattr(pairs, "BEST", 1)
    # next in name: 4 and 5 of photo 5; most in common: photo 1, the first of all that share nothing
    assert near_pairs(path, {"4 a.jpg"}) == [(1, 4), (1, 5), (4, 5)]
    assert near_pairs(path, {"0 a.jpg"}) == [(1, 2), (1, 3), (2, 3)]
    assert near_pairs(path, set()) == []


def _append_zeros(opened: Any, sizes: float, number: int) -> None:
    """As `stages.posing.features.append` does, to all images of an open database that have features."""
    more = np.zeros((number, 6), np.float32)
    more[:, 2] = more[:, 5] = sizes
    ids = [image.image_id for image in opened.read_all_images() if opened.exists_keypoints(image.image_id)]
    for i in ids:
        opened.update_keypoints(i, np.concatenate([opened.read_keypoints(i), more]))
    _pad_descriptors(opened, dict.fromkeys(ids, number))
