"""Photos from one place: a turned camera is refused, a walk is not, a few photos from elsewhere bring a warning."""

from __future__ import annotations

from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from rigs import capture, facade, look_at, ring

from stages.errors import ReconstructionError
from stages.geometry.cameras import PinholeCameras
from stages.posing.turning import MIN_PARALLAX, check_parallax, from_one_place, parallaxes
from stages.sfm import _place_warnings

EYE = np.array([0.0, 0.0, 1.5])


def turned(count: int) -> list[np.ndarray]:
    """Poses of a camera that turns in one place, by 6 degrees a photo."""
    return [
        look_at(EYE, EYE + np.array([np.cos(angle), np.sin(angle), -0.1])) for angle in np.radians(6 * np.arange(count))
    ]


def matched(path: Path, cameras: PinholeCameras, points: np.ndarray, assumed: float = 1.0) -> Path:
    """A database of perfect matches but for half a pixel, the focal length taken for `assumed` times what it is."""
    import pycolmap

    random, ids, seen = np.random.default_rng(0), [], []
    with pycolmap.Database.open(path) as opened:
        width, height = (int(side) for side in cameras.sizes[0])
        focal = assumed * cameras.intrinsics[0, 0, 0]
        lens = opened.write_camera(pycolmap.Camera.create_from_model_name(0, "SIMPLE_PINHOLE", focal, width, height))
        for i, name in enumerate(cameras.names):
            pixels, _ = cameras.project(i, points)
            seen.append(cameras.in_frame(i, points))
            ids.append(opened.write_image(pycolmap.Image(name=name, camera_id=lens)))
            opened.write_keypoints(ids[-1], (pixels + 0.5 * random.normal(size=pixels.shape)).astype(np.float32))
        for first, second in combinations(range(len(cameras)), 2):
            both = np.flatnonzero(seen[first] & seen[second])[:150]
            pair = pycolmap.TwoViewGeometry()
            pair.inlier_matches = np.stack([both, both], 1).astype(np.uint32)
            if len(both):
                opened.write_two_view_geometry(ids[first], ids[second], pair)
    return path


def all_around(count: int = 3000) -> np.ndarray:
    return np.random.default_rng(1).uniform([-6, -6, 0], [6, 6, 3], (count, 3))


@pytest.mark.parametrize("assumed", [1.0, 0.6, 1.7])
def test_a_camera_that_only_turned_is_refused_with_both_numbers(tmp_path: Path, assumed: float):
    path = matched(tmp_path / "a.db", capture(turned(14)), all_around(), assumed)
    with pytest.raises(
        ReconstructionError, match=r"The 14 photos that match \(000.png to 013.png\) were taken"
    ) as caught:
        check_parallax(path)
    assert "(need 0.5 %)" in caught.value.message
    assert "hineus run PHOTOS --until sfm" in caught.value.hint


@pytest.mark.parametrize("kind", ["walk", "facade", "plane"])
def test_a_walk_is_not_refused(tmp_path: Path, kind: str):
    cameras, points = capture(ring(np.array([0.0, 0, 1.5]), distance=4.0, count=16)), all_around() / 3
    if kind != "walk":
        cameras, points = facade()
    if kind == "plane":  # a homography explains all of it, but no turn does
        points = points * [1, 0, 1] + [0, 10, 0]
    path = matched(tmp_path / "a.db", cameras, points)
    check_parallax(path)
    assert np.quantile(list(parallaxes(path).values()), 0.9) > 2 * MIN_PARALLAX
    assert len(from_one_place(parallaxes(path))) < len(cameras) / 2


def test_a_few_photos_from_elsewhere_let_it_go_on_with_a_warning(tmp_path: Path, caplog):
    elsewhere = [look_at(np.array([-1.0, y, 1.5]), np.array([6.0, 3, 1])) for y in (-2.0, 2.0, 3.0)]
    path = matched(tmp_path / "a.db", capture([*turned(8), *elsewhere]), all_around())
    check_parallax(path)
    still = from_one_place(parallaxes(path))
    assert still == [f"{i:03d}.png" for i in range(8)]
    (warning,) = _place_warnings(still, 11)
    assert "8 of 11 photos were taken from one place (000.png to 007.png)" in warning["sentence"]
    assert "3 are left, 20 or more" in caplog.text
    assert _place_warnings(still[:5], 11) == []


def test_too_few_pairs_tell_nothing(tmp_path: Path):
    path = matched(tmp_path / "a.db", capture(turned(2)), all_around())
    assert parallaxes(path) == {}
    check_parallax(path)
    assert from_one_place({}) == []
