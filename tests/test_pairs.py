"""Which pairs of photos are matched, against slow counts and rules by hand."""

from __future__ import annotations

from itertools import combinations
from pathlib import Path

import numpy as np
import pytest

from stages.posing import pairs
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


def test_counts_are_those_of_a_slow_loop_and_of_features_that_are_there_twice():
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


def test_a_photo_gets_its_clear_partners_and_a_few_whatever_they_share(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(pairs, "MOST", 3)
    monkeypatch.setattr(pairs, "LEAST", 1)
    common = np.zeros((6, 6), int)
    for (i, j), count in {(0, 1): 9, (0, 2): 8, (0, 3): 7, (0, 4): 6, (1, 2): 5, (3, 5): 2}.items():
        common[i, j] = common[j, i] = count
    chosen = choose_pairs(common)
    # 0-4 is the fourth of photo 0, but the best of photo 4; 1-2 is not clear; 3-5 is the best of photo 5
    assert chosen == [(0, 1), (0, 2), (0, 3), (0, 4), (3, 5)]


def test_pairs_connect_all_photos(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(pairs, "MOST", 2)
    monkeypatch.setattr(pairs, "LEAST", 1)
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
