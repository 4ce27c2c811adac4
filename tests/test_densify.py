"""The stage on made-up photos, and what it makes of bad ones."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numba
import numpy as np
import pytest
from stereo_scene import POSES_FROM_SCENE, RADIUS, Drawn, around, camera, cameras, draw, plain, ring

from configs.params import Config
from stages import artifacts
from stages.densify import DENSIFY, _Capture, _explained
from stages.engine.stage import StageContext
from stages.errors import ConfigError
from stages.geometry.point_cloud import PointCloud
from stages.stereo import fusion


def densify(
    drawn: Drawn, root: Path, masks=None, workers: int = 1, name: str = "out", **sets
) -> tuple[dict, PointCloud]:
    """The numbers it gives, and its cloud in the frame of the scene."""
    folder = root / "undistort"
    if not folder.exists():
        folder.mkdir(parents=True)
        drawn.write(folder, masks)
    out = root / name
    out.mkdir()
    settings = DENSIFY.settings(Config()).model_copy(update=sets)
    numbers = DENSIFY.run(
        StageContext({"undistort": folder}, {}, out, root, settings, workers=workers, reads=DENSIFY.reads)
    )
    return numbers, artifacts.POINT_CLOUD.load(out).moved(POSES_FROM_SCENE.inverse())


def off(cloud: PointCloud) -> np.ndarray:
    """Distances [n] of the points from ball and floor."""
    ball = np.abs(np.linalg.norm(cloud.points, axis=1) - RADIUS)
    return np.minimum(ball, np.abs(cloud.points[:, 2] + 0.5))


def wrong(cloud: PointCloud) -> float:
    """Of what is trusted about the ball, the share more than 3 % of its diameter off: outlines, in photos so small."""
    about = np.linalg.norm(cloud.points, axis=1) < 1
    return float(np.average(off(cloud)[about] > 0.03, weights=cloud.trust[about]))


def trusted(cloud: PointCloud) -> int:
    return int((cloud.trust > 0.5).sum())


@pytest.fixture(scope="module")
def drawn() -> Drawn:
    return draw(ring())


@pytest.fixture(scope="module")
def sound(drawn: Drawn, tmp_path_factory) -> tuple[dict, PointCloud, Path]:
    root = tmp_path_factory.mktemp("sound")
    return *densify(drawn, root), root


def test_points_lie_on_what_the_photos_show(sound, drawn):
    numbers, cloud, root = sound
    assert numbers["points"] == len(cloud) > 5000
    assert numbers["depth_maps"] == 12
    assert np.median(off(cloud)) < 0.006
    assert wrong(cloud) < 0.06
    assert numbers["explained"]["005.png"] > 0.4
    maps = artifacts.DEPTH_MAPS.load(root / "out")
    depth, trust = maps.load("005.png")
    known = trust > 0.5
    assert depth.dtype == trust.dtype == np.float32
    assert np.median(np.abs(depth / POSES_FROM_SCENE.scale - drawn.depths[5])[known]) < 0.01
    assert maps.load("none.png") is None
    assert all(
        any(a.covers(f.relative_to(root / "out").as_posix()) for a in DENSIFY.writes)
        for f in (root / "out").rglob("*.*")
    )


def test_workers_change_no_byte(sound, drawn):
    _, _, root = sound
    densify(drawn, root, workers=2, name="two")
    for path in (root / "out").rglob("*.*"):
        assert path.read_bytes() == (root / "two" / path.relative_to(root / "out")).read_bytes(), path


def test_threads_are_as_many_as_workers_until_the_points_are_made(drawn, tmp_path, monkeypatch):
    before, seen = (cv2.getNumThreads(), numba.get_num_threads()), []

    def fused(*args):
        seen.append((cv2.getNumThreads(), numba.get_num_threads()))
        return original(*args)

    original = fusion.fused
    monkeypatch.setattr(fusion, "fused", fused)
    densify(drawn, tmp_path, workers=1)
    assert seen == [(1, 1)]
    assert (cv2.getNumThreads(), numba.get_num_threads()) == before


def test_what_is_explained_is_a_share_of_the_mask():
    trust = np.zeros((4, 6), np.float32)
    trust[:2, :3], trust[2, 0] = 0.5, 0.49
    within = np.zeros((4, 6), bool)
    within[:2] = True
    assert _explained(trust, None) == 0.25
    trust[3, 5] = 0.9  # off the object
    assert _explained(trust, within) == 0.5
    assert _explained(0 * trust, np.zeros((4, 6), bool)) == 0


def test_masks_beside_whole_photos_show_the_object_and_hide_nothing(tmp_path):
    mask = np.zeros((4, 6), bool)
    mask[1:3, 2:5] = True
    photos, outlines = artifacts.PINHOLE_PHOTOS.load(tmp_path), artifacts.OUTLINES.load(tmp_path)
    scene = SimpleNamespace(cameras=SimpleNamespace(names=("a.png",)))
    capture = _Capture(scene, np.arange(1), [SimpleNamespace(size=(6, 4))], [], photos, outlines)
    for pictures, hides in ((outlines, False), (photos, True)):
        artifacts.write_png(pictures.mask_path("a.png"), np.uint8(255 * mask))
        np.testing.assert_array_equal(capture.on_object(0), mask)
        assert (capture.within(0) is not None) == hides
        pictures.mask_path("a.png").unlink()
    assert capture.on_object(0) is None


def test_off(drawn, tmp_path):
    numbers, cloud = densify(drawn, tmp_path, method="off")
    assert numbers["points"] == len(cloud) == 0
    assert artifacts.DEPTH_MAPS.load(tmp_path / "out").load("000.png") is None


def test_photos_held_out_from_training_say_nothing(drawn, tmp_path):
    assert DENSIFY.settings(Config.model_validate({"train": {"hold_out": 4}})).hold_out == 4
    numbers, cloud = densify(drawn, tmp_path, hold_out=4)
    assert len(numbers["explained"]) == 9
    assert set(cloud.photos) == {k for k in range(12) if k % 4 != 2}
    assert wrong(cloud) < 0.06


@pytest.mark.parametrize(("every", "found"), [(1, "leaves 0 of 12"), (24, "leaves 12 of 12")])
def test_too_few_photos_left_or_none_left_out_are_refused_before_any_is_compared(
    drawn, tmp_path, monkeypatch, every, found
):
    monkeypatch.setattr("stages.stereo.pairs.pairs_of", lambda *_: pytest.fail("compared"))
    with pytest.raises(ConfigError, match=found):
        densify(drawn, tmp_path, hold_out=every)


def test_photos_that_share_nothing_are_said_and_no_failure(drawn, tmp_path, caplog):
    alone = drawn.scene.observations[:: len(drawn.scene.observations) // 12]
    lonely = replace(drawn, scene=replace(drawn.scene, observations=alone))
    with caplog.at_level(logging.WARNING):
        numbers, cloud = densify(lonely, tmp_path)
    assert numbers["pairs"] == len(cloud) == 0
    assert "no two of the 12 photos share enough points" in caplog.text


# ---------------------------------------------------------------- bad photos
def spoilt(drawn: Drawn, change) -> Drawn:
    return replace(drawn, photos=[change(k, photo.copy()) for k, photo in enumerate(drawn.photos)])


def test_one_blurred_photo_in_ten(drawn, tmp_path, sound):
    blurred = spoilt(drawn, lambda k, photo: cv2.GaussianBlur(photo, (0, 0), 3) if k % 10 == 4 else photo)
    _, cloud = densify(blurred, tmp_path)
    assert len(cloud) > 0.75 * len(sound[1])
    assert wrong(cloud) < 0.07


@pytest.mark.parametrize("gamma", [False, True])
def test_exposures_that_jump(drawn, tmp_path, sound, gamma):
    def change(k: int, photo: np.ndarray) -> np.ndarray:
        part = photo / 255.0
        changed = part ** (0.7, 1, 1.4)[k % 3] if gamma else part * (0.6, 1, 1.6)[k % 3]
        return np.uint8(255 * np.clip(changed, 0, 1))

    _, cloud = densify(spoilt(drawn, change), tmp_path)
    assert len(cloud) > 0.7 * len(sound[1])
    assert wrong(cloud) < 0.07


def test_a_patch_that_moves_between_photos_leaves_nothing(drawn, tmp_path, sound):
    """Someone walks by before the ball: a printed square at another place in each photo."""
    figure = np.random.default_rng(3).integers(0, 255, (40, 24, 1), np.uint8).repeat(3, 2)

    def change(k: int, photo: np.ndarray) -> np.ndarray:
        at = 5 + 37 * k % 130
        photo[50:90, at : at + 24] = figure
        return photo

    _, cloud = densify(spoilt(drawn, change), tmp_path)
    assert len(cloud) > 0.6 * len(sound[1])
    assert wrong(cloud) < 0.07


def test_large_steps_give_little_and_nothing_wrong(tmp_path, sound, caplog):
    _, cloud = densify(draw(ring(10, step_deg=36)), tmp_path / "36")
    assert 500 < len(cloud) < 0.1 * len(sound[1])
    assert wrong(cloud) < 0.03
    numbers, none = densify(draw(ring(8, step_deg=45)), tmp_path / "45")
    assert numbers["pairs"] == len(none) == 0
    assert "no two of the 8 photos share enough points" in caplog.text


def test_what_is_plain_gives_nothing(tmp_path, caplog):
    with caplog.at_level(logging.WARNING):
        numbers, cloud = densify(draw(ring(), plain), tmp_path)
    assert numbers["pairs"] > 0
    assert trusted(cloud) < 600  # 50 000, of what is printed


@pytest.mark.parametrize(("pixels", "kept"), [(1, 0.5), (3, 0.05)])
def test_poses_that_are_wrong_by_pixels(drawn, tmp_path, sound, pixels, kept):
    rng = np.random.default_rng(0)
    extrinsics = drawn.scene.cameras.extrinsics.copy()
    for each in extrinsics:
        turn, _ = cv2.Rodrigues(rng.normal(size=3) / np.sqrt(3) * pixels / 190)
        each[:] = turn @ each
    cams = replace(drawn.scene.cameras, extrinsics=extrinsics)
    _, cloud = densify(replace(drawn, scene=replace(drawn.scene, cameras=cams)), tmp_path)
    assert len(cloud) >= kept * len(sound[1])
    assert np.average(off(cloud) > 0.06, weights=cloud.trust) < 0.03


def test_a_background_that_stays_while_the_object_turns(drawn, tmp_path):
    """A turntable: the ball turns with its poses, what is around it is the same in all photos."""
    still = np.uint8(cv2.GaussianBlur(np.random.default_rng(5).uniform(0, 255, (120, 160, 1)), (0, 0), 1.5))[..., None]
    ball = [np.abs(np.linalg.norm(_places(drawn, k), axis=-1) - RADIUS) < 1e-6 for k in range(12)]
    turning = replace(drawn, photos=[np.where(b[..., None], p, still) for b, p in zip(ball, drawn.photos, strict=True)])
    on_ball = np.linalg.norm(drawn.scene.points, axis=1) < RADIUS + 1e-4
    seen = drawn.scene.observations[on_ball[drawn.scene.observations[:, 1]]]
    turning = replace(turning, scene=replace(turning.scene, observations=seen))
    _, bare = densify(turning, tmp_path / "bare")
    _, masked = densify(turning, tmp_path / "masked", masks=ball)
    # in the middle, what does not move is the same as what lies on the axis
    for cloud, right in ((bare, 0.8), (masked, 0.93)):
        on = np.abs(np.linalg.norm(cloud.points, axis=1) - RADIUS) < 0.03
        assert on.sum() > 1500
        assert np.average(on, weights=cloud.trust) > right


def _places(drawn: Drawn, k: int) -> np.ndarray:
    cams = drawn.scene.cameras
    v, u = np.mgrid[:120, :160]
    origins, directions = cams.rays(k, np.stack([u.ravel() + 0.5, v.ravel() + 0.5], 1))
    along = drawn.depths[k].ravel() / (directions @ cams.forward[k])
    return (origins + along[:, None] * directions).reshape(120, 160, 3)


def test_portrait_and_landscape_and_close_ups(tmp_path):
    centers = list(around(9.0 * np.arange(9), elevation_deg=25.0))
    sizes = [(160, 120), (120, 160), (240, 180)] * 3
    cams = cameras(
        [camera(c, roll_deg=90.0 * (k % 3 == 1)) for k, c in enumerate(centers)], sizes, [190.0, 190, 600] * 3
    )
    numbers, cloud = densify(draw(cams), tmp_path)
    assert numbers["depth_maps"] == 9
    assert len(cloud) > 5000
    assert wrong(cloud) < 0.07
