"""Which pairs of many photos are compared, on positions, names and looks made by hand."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from stages.artifacts import ImageRecord
from stages.posing import candidates, looks
from stages.posing.candidates import alike_and_apart, candidate_pairs, near_in_space, next_in_order, positions_of
from stages.posing.looks import aggregate, learn_words, nearest_words, signatures
from stages.posing.pairs import NOT_COMPARED, common_features, likely_pairs, partners_of_partners


def descriptors(number: int, seed: int) -> np.ndarray:
    """Such as COLMAP's: 128 whole numbers, 512 long."""
    drawn = np.random.default_rng(seed).gamma(0.5, size=(number, 128))
    return np.rint(512 * drawn / np.linalg.norm(drawn, axis=1, keepdims=True)).clip(0, 255).astype(np.uint8)


def walk(photos: int, each: int = 60, step: int = 12) -> list[np.ndarray]:
    """Features of photos of a round walk: each begins `step` features further on, and the last end where it began."""
    scene = descriptors(photos * step, 0)
    return [scene[np.arange(i * step, i * step + each) % len(scene)] for i in range(photos)]


def write_database(path: Path, photos: list[np.ndarray]) -> None:
    import pycolmap

    with pycolmap.Database.open(path) as opened:
        camera = opened.write_camera(pycolmap.Camera.create_from_model_name(0, "PINHOLE", 50, 100, 100))
        for number, own in enumerate(photos):
            image_id = opened.write_image(pycolmap.Image(name=f"{number:03}.jpg", camera_id=camera))
            opened.write_keypoints(image_id, np.tile(np.array([5, 5, 1, 0, 0, 1], np.float32), (len(own), 1)))
            opened.write_descriptors(image_id, pycolmap.FeatureDescriptors(pycolmap.FeatureExtractorType.SIFT, own))


def test_nearest_places_count_height():
    places = np.array([[0, 0, 0], [1, 0, 0], [0, 0, 1.5], [0, 0, 40.0], [1, 0, 40.0]])
    assert near_in_space(places, 1) == {(0, 1), (0, 2), (3, 4)}
    assert near_in_space(places[:1], 1) == set()
    assert near_in_space(np.zeros((0, 3)), 1) == set()
    assert len(near_in_space(places, 60)) == 10


def test_next_in_order_against_a_slow_loop():
    assert next_in_order(9, 3) == {(i, j) for i in range(9) for j in range(9) if 0 < j - i <= 3}


def test_alike_photos_are_further_apart_than_neighbours(monkeypatch):
    monkeypatch.setattr(candidates, "ROWS_AT_ONCE", 3)
    turns = np.radians([0, 1, 2, 180, 181, 3, 90.0])
    vectors = np.stack([np.cos(turns), np.sin(turns)], 1)
    assert alike_and_apart(vectors, count=1, apart=1) == {(0, 2), (1, 5), (2, 5), (2, 6), (3, 6), (4, 6)}
    assert alike_and_apart(vectors, count=9, apart=6) == set()


def test_photos_that_all_say_one_place_have_no_position():
    def record(i: int, gps: tuple[float, float, float] | None) -> ImageRecord:
        return ImageRecord(f"{i}.jpg", "", 64, 64, 50.0, "c", 1.0, False, "", gps=gps)

    assert positions_of([record(i, (47.0, 8.0, 400.0)) for i in range(5)]) == {}
    assert positions_of([record(0, None)]) == {}
    found = positions_of([record(0, (47.0, 8.0, 400.0)), record(1, (47.0, 8.0, 410.0)), record(2, None)])
    assert set(found) == {"0.jpg", "1.jpg"}
    np.testing.assert_allclose(found["1.jpg"] - found["0.jpg"], [0, 0, 10], atol=1e-3)


def test_words_are_the_middles_of_clusters():
    rng = np.random.default_rng(0)
    middles = np.eye(4, dtype=np.float32)
    features = np.repeat(middles, 50, axis=0) + rng.normal(0, 0.01, (200, 4)).astype(np.float32)
    words = learn_words(features, rng)
    assert np.abs(words[nearest_words(features, words)] - features).max() < 0.05
    assert nearest_words(middles, middles).tolist() == [0, 1, 2, 3]


def test_a_signature_is_a_unit_vector_of_what_features_add_to_their_words():
    words = np.array([[0, 0], [10, 0.0]], np.float32)
    features = np.array([[1, 0], [0, 3], [10, -4.0]], np.float32)
    rooted = np.array([1, np.sqrt(3), 0, -2.0])
    np.testing.assert_allclose(aggregate(features, words), rooted / np.linalg.norm(rooted), rtol=1e-6)


def test_signatures_of_a_walk_tell_neighbours_and_the_closed_loop(monkeypatch):
    monkeypatch.setattr(looks, "WORDS", 32)
    found = signatures([*walk(24), np.zeros((0, 128), np.uint8)])
    likeness = found @ found.T
    for i in range(24):
        assert set(np.argsort(-likeness[i])[1:5].tolist()) == {(i + k) % 24 for k in (-2, -1, 1, 2)}
    assert not found[24].any()


def test_few_candidates_of_a_loop_and_what_grows_from_them_are_compared(tmp_path: Path, monkeypatch, caplog):
    """Names tell neighbours, looks where the loop closes, and no pair of things apart is matched for all that."""
    for name, number in {"NEXT_IN_NAME": 1, "ALIKE": 3}.items():
        monkeypatch.setattr(candidates, name, number)
    path, photos = tmp_path / "a.db", walk(40)
    write_database(path, photos)
    with caplog.at_level("INFO"):
        among = candidate_pairs(path, {})
    assert "0 near in space (0 photos carry a usable GPS position), 39 next in name" in caplog.text
    assert len(among) < 40 * 39 / 2 / 4
    assert (1, 40) in among
    chosen = likely_pairs(path, among)
    share = {(i, j) for i in range(1, 41) for j in range(i + 1, 41) if min(j - i, 40 - j + i) <= 3}
    assert share <= set(chosen)
    again = candidate_pairs(path, {f"{i:03}.jpg": np.array([0.0, 0.0, i]) for i in range(0, 40, 2)})
    assert {(1, 3), (5, 39)} <= set(again)  # of those with a position the nearest sixty are all


def test_partners_of_partners_are_compared_next():
    common = np.full((5, 5), NOT_COMPARED)
    for (i, j), count in {(0, 1): 50, (1, 2): 40, (2, 3): 3, (3, 4): 9}.items():
        common[i, j] = common[j, i] = count
    np.fill_diagonal(common, 0)
    assert partners_of_partners(common) == [(0, 2)]  # what 2 and 3 share is not clear


def test_counts_of_some_pairs_are_those_of_all():
    photos = walk(6)
    some = common_features(photos, [(0, 1), (2, 5)])
    every = common_features(photos)
    assert some[0, 1] == some[1, 0] == every[0, 1] > 0
    assert some[2, 5] == every[2, 5]
    assert (some == NOT_COMPARED).sum() == 6 * 5 - 4
