"""Photos from one place: a turned camera is refused, a walk is not, a few photos from elsewhere bring a warning."""

from __future__ import annotations

from itertools import combinations
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from rigs import capture, facade, look_at, ring
from typer.testing import CliRunner

from hineus_cli.app import app
from stages.artifacts import Lens
from stages.errors import ReconstructionError
from stages.geometry.cameras import PinholeCameras
from stages.posing.adjustment import LastAdjustment
from stages.posing.turning import MIN_PARALLAX, Depth, from_one_place, judge_depth, refuse_one_place, relief, two_places
from stages.sfm import _check_given_places, _flat_warnings, _place_warnings

FLAT_GROUND = np.random.default_rng(2).uniform([-100, -80, 0], [100, 80, 0], (6000, 3))
EYE = np.array([0.0, 0.0, 1.5])


def turned(count: int) -> list[np.ndarray]:
    """Poses of a camera that turns in one place, by 6 degrees a photo."""
    return [
        look_at(EYE, EYE + np.array([np.cos(angle), np.sin(angle), -0.1])) for angle in np.radians(6 * np.arange(count))
    ]


def matched(
    path: Path, cameras: PinholeCameras, points: np.ndarray, assumed: float = 1.0, noise_px: float = 0.5
) -> Path:
    """A database of perfect matches but for noise, the focal length taken for `assumed` times what it is."""
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
            opened.write_keypoints(ids[-1], (pixels + noise_px * random.normal(size=pixels.shape)).astype(np.float32))
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
        refuse_one_place(judge_depth(path))
    assert "(need 0.5 %)" in caught.value.message
    assert "hineus run PHOTOS --until sfm" in caught.value.hint


def test_a_camera_that_turned_and_zoomed_is_refused(tmp_path: Path):
    zooming = capture(turned(12))
    zooming.intrinsics[:, [0, 1], [0, 1]] *= np.geomspace(0.7, 1.6, 12)[:, None]
    depth = judge_depth(matched(tmp_path / "a.db", zooming, all_around()))
    assert max(depth.parallaxes.values()) > MIN_PARALLAX
    with pytest.raises(ReconstructionError, match="turns and zooms explains"):
        refuse_one_place(depth)


@pytest.mark.parametrize("focal", [450.0, 640.0, 900.0])  # 27, 36 and 51 mm
@pytest.mark.parametrize("assumed", [1.0, 1.6])
def test_a_flight_over_flat_ground_is_not_refused(tmp_path: Path, focal: float, assumed: float):
    rng, poses = np.random.default_rng(0), []
    for x in (-40.0, -20.0, 0.0, 20.0, 40.0):
        for y in (-30.0, -10.0, 10.0, 30.0):
            center = np.array([x, y, 0.15 * focal])
            poses.append(
                look_at(center, center * (1, 1, 0) + np.array([*rng.normal(0, 2, 2), 0.0]), np.array([0, 1.0, 0]))
            )
    depth = judge_depth(matched(tmp_path / "a.db", capture(poses, focal=focal), FLAT_GROUND, assumed, noise_px=0.25))
    refuse_one_place(depth)
    assert depth.is_flat
    assert from_one_place(depth.parallaxes) == []


@pytest.mark.parametrize("kind", ["walk", "facade", "plane"])
def test_a_walk_is_not_refused(tmp_path: Path, kind: str):
    cameras, points = capture(ring(np.array([0.0, 0, 1.5]), distance=4.0, count=16)), all_around() / 3
    if kind != "walk":
        cameras, points = facade()
    if kind == "plane":  # a homography explains all of it, but no turn does
        points = points * [1, 0, 1] + [0, 10, 0]
    path = matched(tmp_path / "a.db", cameras, points)
    depth = judge_depth(path)
    refuse_one_place(depth)
    assert depth.is_flat == (kind == "plane")
    if not depth.is_flat:  # of steps along a plane nobody can tell
        assert np.quantile(list(depth.parallaxes.values()), 0.9) > 2 * MIN_PARALLAX
    assert len(from_one_place(depth.parallaxes)) < len(cameras) / 2


def test_a_few_photos_from_elsewhere_let_it_go_on_with_a_warning(tmp_path: Path, caplog):
    elsewhere = [look_at(np.array([-1.0, y, 1.5]), np.array([6.0, 3, 1])) for y in (-2.0, 2.0, 3.0)]
    path = matched(tmp_path / "a.db", capture([*turned(8), *elsewhere]), all_around())
    depth = judge_depth(path)
    refuse_one_place(depth)
    still = from_one_place(depth.parallaxes)
    assert still == [f"{i:03d}.png" for i in range(8)]
    (warning,) = _place_warnings(still, 11, row(*range(11)))
    assert "8 of 11 photos were taken from one place (000.png to 007.png)" in warning["sentence"]
    assert "3 are left, 20 or more" in caplog.text
    assert _place_warnings(still[:5], 11, row(*range(11))) == []


def along_the_names(steps: np.ndarray, reach: int, far: tuple[int, ...] = ()) -> dict[tuple[str, str], float]:
    """Parallax that grows with the steps between photos, of pairs up to `reach` apart and of some further ones."""
    places = np.cumsum(steps)
    return {
        (f"{i:03d}.png", f"{i + k:03d}.png"): float(places[i + k] - places[i])
        for i in range(len(steps))
        for k in (*range(1, reach + 1), *far)
        if i + k < len(steps)
    }


def test_most_photos_from_one_place_are_found_by_pairs_of_neighbours():
    """70 of 100: none is matched with more than 20 of the others."""
    steps = np.where(np.arange(100) < 70, 1e-5, 0.01)
    still = from_one_place(along_the_names(steps, reach=6, far=(9, 14, 20)))
    assert still == [f"{i:03d}.png" for i in range(70)]


@pytest.mark.parametrize("far", [(), (9, 14, 20)])
def test_a_dense_walk_is_not_one_place(far: tuple[int, ...]):
    """Neighbours show no parallax, photos four steps apart do."""
    still = from_one_place(along_the_names(np.full(100, 0.0013), reach=6, far=far))
    assert len(still) < 12


def test_too_few_pairs_tell_nothing(tmp_path: Path):
    path = matched(tmp_path / "a.db", capture(turned(2)), all_around())
    depth = judge_depth(path)
    assert (depth.parallaxes, depth.is_flat) == ({}, False)
    refuse_one_place(depth)
    assert from_one_place({}) == []


def model(centers: np.ndarray, points: np.ndarray) -> Any:
    """A pycolmap model of photos at these places that all see all points."""
    import pycolmap

    made = pycolmap.Reconstruction()
    made.add_camera_with_trivial_rig(pycolmap.Camera.create_from_model_name(1, "SIMPLE_PINHOLE", 500.0, 640, 480))
    seen = pycolmap.Point2DList([pycolmap.Point2D(np.zeros(2)) for _ in points])
    for i, center in enumerate(centers):
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(np.eye(3)), -center)
        made.add_image_with_trivial_frame(pycolmap.Image(f"{i:03d}.png", seen, 1, i + 1), pose)
    for k, place in enumerate(points):
        track = pycolmap.Track([pycolmap.TrackElement(i + 1, k) for i in range(len(centers))])
        made.add_point3D(place, track, np.zeros(3, np.uint8))
    return made


def row(*xs: float) -> Any:
    return model(np.array([[x, 0.0, 0.0] for x in xs]), np.array([[0.0, 0, 10], [1, 1, 12], [2, 0, 11], [0, 2, 9]]))


def test_photos_from_two_places_bring_a_warning(caplog):
    (warning,) = _place_warnings([], 8, row(0, 0.1, 5, 5.05, 5.1, 0.05, 0.1, 5))
    assert "8 of 8 photos were taken from two places (000.png to 006.png, 002.png to 007.png)" in warning["sentence"]
    assert "Add photos from other places" in caplog.text
    assert two_places(row(0, 1, 2, 3, 3.1, 4)) == (["003.png", "004.png"], ["000.png"])
    assert _place_warnings([], 8, row(*range(8))) == []
    assert _place_warnings([], 4, row(0, 0, 1, 1)) == []  # hardly a capture


def test_known_poses_from_one_place_are_refused_where_the_photos_say_so_too(tmp_path: Path):
    still = matched(tmp_path / "still.db", capture(turned(14)), all_around())
    with pytest.raises(ReconstructionError, match="from one place"):
        _check_given_places(row(1, 1, 1, 1), still)
    with pytest.raises(ReconstructionError, match="from one place"):
        _check_given_places(model(np.eye(3), np.zeros((0, 3))), still)
    _check_given_places(row(0, 1, 2, 3), still)
    walk = matched(tmp_path / "walk.db", capture(ring(np.zeros(3), count=16)), all_around() / 3)
    _check_given_places(model(np.eye(3), np.zeros((0, 3))), walk)


def lens(standard_error: float) -> Lens:
    params = {"f": 500.0, "k": 0.0}
    return Lens(photos=5, size=(640, 480), model="RADIAL", params=params, standard_errors={"f": standard_error})


@pytest.mark.parametrize(
    ("error", "known", "located", "said"),
    [
        (20.0, False, 0, "for which there is no EXIF: 500 px with a standard error of 20 px"),
        (0.1, False, 0, "If it is not meant to be flat"),
        (20.0, True, 0, "If it is not meant to be flat"),
        (20.0, True, 20, ""),  # a survey flight
    ],
)
def test_one_flat_thing_is_doubted(error: float, known: bool, located: int, said: str):
    flat = model(np.arange(60.0).reshape(20, 3), FLAT_GROUND[:50] + np.array([0, 0, 90]))
    bench = SimpleNamespace(priors={1: 500.0} if known else {}, located=located, names=frozenset("abc"))
    found = _flat_warnings(Depth({}, is_flat=True), LastAdjustment(flat, (lens(error),), None), bench)
    assert [said in warning["sentence"] for warning in found] == [True] * bool(said)
    assert _flat_warnings(Depth({}), LastAdjustment(flat, (lens(error),), None), bench) == []
    hills = model(np.arange(60.0).reshape(20, 3), all_around(50) + np.array([0, 0, 90]))
    assert relief(flat) < 1e-6 < 0.01 < relief(hills)
    assert _flat_warnings(Depth({}, is_flat=True), LastAdjustment(hills, (lens(error),), None), bench) == []


@pytest.mark.slow
def test_the_turned_camera_of_the_cases_is_refused(tmp_path: Path, cases_dir: Path):
    photos = str(cases_dir / "15-pure-rotation" / "photos")
    result = CliRunner().invoke(app, ["undistort", photos, "-w", str(tmp_path), "--preset", "tiny", "--json"])
    assert result.exit_code == ReconstructionError.exit_code
    assert "The 14 photos that match (P000.jpg to P013.jpg) were taken from one place" in result.stdout
