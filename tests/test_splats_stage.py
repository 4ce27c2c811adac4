"""The splats stage on files, and its pure parts on a square that is known."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rigs import capture, look_at, scene_without_points

from configs.params import SplatsParams
from stages import artifacts
from stages.artifacts import AtlasMesh, write_png
from stages.drawing.view_scores import psnr
from stages.engine.stage import StageContext
from stages.gaussians.colours import sweep
from stages.gaussians.drawing import draw
from stages.gaussians.gaussians import Gaussians
from stages.gaussians.keeping import read_gaussians
from stages.gaussians.placing import place
from stages.gaussians.refining import AROUND
from stages.geometry.point_cloud import PointCloud
from stages.splats import SPLATTING

SIZE, FOCAL = (64, 48), 70.0


def checks(side: int = 64) -> np.ndarray:
    """[S, S, 3] uint8 squares of two colours, eight each way."""
    rows, columns = np.indices((side, side)) * 8 // side
    return np.where(((rows + columns) % 2 == 0)[..., None], (220, 60, 40), (40, 90, 200)).astype(np.uint8)


def square() -> AtlasMesh:
    """It faces -y; the texture covers it."""
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * 0.5
    return AtlasMesh(
        np.stack([corners[:, 0], np.zeros(4), corners[:, 1]], 1).astype(np.float32),
        np.tile([0.0, -1, 0], (4, 1)).astype(np.float32),
        (corners + 0.5).astype(np.float32),
        np.array([[0, 1, 2], [0, 2, 3]], np.int32),
        64,
    )


def photograph(cameras, index: int, fade: float = 0.0) -> np.ndarray:
    """The square in a camera [H, W, 3] uint8, grey around it; `fade` dims it as the camera goes to the right."""
    import cv2

    width, height = cameras.sizes[index]
    fine = 8
    at = (np.indices((height * fine, width * fine))[::-1].reshape(2, -1).T + 0.5) / fine
    origins, directions = cameras.rays(index, at)
    places = origins + directions * (-origins[:, 1] / directions[:, 1])[:, None]
    x, z = places[:, 0] + 0.5, places[:, 2] + 0.5
    on = (x >= 0) & (x < 1) & (z >= 0) & (z < 1)
    texture = checks()
    colors = np.full((len(at), 3), 128.0)
    colors[on] = texture[((1 - z[on]) * 64).astype(int).clip(0, 63), (x[on] * 64).astype(int)]
    colors[on] *= 1 - fade * cameras.centers[index][0]
    image = colors.reshape(height * fine, width * fine, 3)
    return cv2.resize(image, (int(width), int(height)), interpolation=cv2.INTER_AREA).round().astype(np.uint8)


def workspace(root: Path, fade: float = 0.0) -> StageContext:
    """The square from eighteen places before it, of which one is held out."""
    folders = {name: root / name for name in (*SPLATTING.needs, "out", "scratch")}
    for folder in folders.values():
        folder.mkdir()
    artifacts.ATLAS_MESH.save(folders["atlas"], square())
    places = [np.array([x, -1.3, z]) for x in np.linspace(-0.8, 0.8, 6) for z in (-0.5, 0.0, 0.5)]
    cameras = capture([look_at(place, np.zeros(3)) for place in places], size=SIZE, focal=FOCAL)
    artifacts.SCENE.save(folders["train"], scene_without_points(cameras))
    artifacts.HELD_OUT.save(folders["train"], (cameras.names[7],))
    write_png(artifacts.BASE_COLOR.load(folders["bake"]), checks())
    artifacts.GAINS.save(folders["bake"], {name: (1.0, 1.0, 1.0) for name in cameras.names if name != cameras.names[7]})
    artifacts.POINT_CLOUD.save(folders["densify"], PointCloud.empty())
    pictures = artifacts.Pictures(folders["undistort"])
    for index, name in enumerate(cameras.names):
        pictures.path(name).parent.mkdir(parents=True, exist_ok=True)
        write_png(pictures.path(name), photograph(cameras, index, fade))
    return StageContext(
        inputs={name: folders[name] for name in SPLATTING.needs},
        sources={},
        out=folders["out"],
        scratch=folders["scratch"],
        params=SplatsParams(enabled=True, count=3000, steps=0),
        reads=SPLATTING.reads,
    )


def held_out_psnr(context: StageContext) -> float:
    cameras = context.read(artifacts.SCENE).cameras
    photo = context.read(artifacts.PINHOLE_PHOTOS).image(cameras.names[7])
    image, _ = draw(read_gaussians(artifacts.SPLATS.load(context.out)), cameras, 7)
    on = (np.abs(photo.astype(int) - 128) > 3).any(2)
    return psnr(np.round(image * 255).astype(np.uint8), photo, on)


@pytest.mark.slow
def test_a_sweep_brings_photos_nearer_and_leaves_what_faces_away(tmp_path: Path) -> None:
    from stages.gaussians.drawing import BLACK, camera_of, render

    context = workspace(tmp_path)
    cameras = context.read(artifacts.SCENE).cameras
    photos = [context.read(artifacts.PINHOLE_PHOTOS).image(name).astype(np.float32) / 255 for name in cameras.names]
    on = [(np.abs(photo - 128 / 255) > 0.01).any(2).astype(np.float32) for photo in photos]
    front, normals = place(square(), checks(), 2000, 1)
    both = front.select(np.tile(np.arange(len(front)), 2))
    normals = np.concatenate([normals, -normals])
    told = [(camera_of(cameras, index), photos[index], on[index]) for index in range(len(photos))]
    found = sweep(both, normals, told, np.zeros_like(both.harmonics))

    def error(gaussians: Gaussians) -> float:
        off = [(render(gaussians, camera, BLACK).image - photo)[trust > 0] for camera, photo, trust in told]
        return float((np.concatenate(off) ** 2).mean())

    ahead = slice(0, len(front))
    assert error(found.select(ahead)) < 0.3 * error(front)
    assert not found.harmonics[len(front) :].any()


def test_nothing_is_written_unless_asked(tmp_path: Path) -> None:
    context = workspace(tmp_path)
    assert SPLATTING.run(replace(context, params=SplatsParams())) == {}
    assert not list(context.out.iterdir())


@pytest.mark.slow
def test_a_photo_that_was_held_out_is_met_and_better_after_refining(tmp_path: Path) -> None:
    context = workspace(tmp_path)
    numbers = SPLATTING.run(context)
    assert 2700 < numbers["gaussians"] < 3300
    assert numbers["degree"] == 2
    fitted = held_out_psnr(context)
    assert fitted > 16
    more = SPLATTING.run(replace(context, params=SplatsParams(enabled=True, count=3000, steps=200)))
    assert held_out_psnr(context) > fitted + 3
    assert more["gaussians"] > numbers["gaussians"]
    again = read_gaussians(artifacts.SPLATS.load(context.out))
    # Nothing has left the square by 2 % of its side.
    assert np.abs(again.centers[:, 1]).max() < 0.02
    assert np.abs(again.centers[:, [0, 2]]).max() < 0.52


@pytest.mark.slow
def test_what_lies_behind_is_shown_where_dense_points_tell_of_it(tmp_path: Path) -> None:
    context = workspace(tmp_path)
    wall = np.stack(np.meshgrid(np.linspace(-1, 1, 40), [0.3], np.linspace(-1, 1, 40)), -1).reshape(-1, 3)
    count = len(wall)
    cloud = PointCloud(
        wall.astype(np.float32), np.tile(np.float32([0, -1, 0]), (count, 1)), np.full((count, 3), 90, np.uint8),
        np.where(np.arange(count) % 2, 1, 0.2).astype(np.float32), np.arange(count + 1), np.zeros(count, np.int32),
    )  # fmt: skip
    artifacts.POINT_CLOUD.save(context.inputs["densify"], cloud)
    numbers = SPLATTING.run(replace(context, params=SplatsParams(enabled=True, count=2000, steps=60, background=True)))
    assert 0 < numbers["free"] <= 1.5 * count / 2  # half are not trusted; some are split
    found = read_gaussians(artifacts.SPLATS.load(context.out))
    free = found.select(~found.anchored)
    assert np.linalg.norm(free.centers[:, None] - wall[None], axis=2).min(1).max() < AROUND * 1.01
    cameras = context.read(artifacts.SCENE).cameras
    image, alpha = draw(found, cameras, 8)
    photo = photograph(cameras, 8) / 255
    beside = (np.abs(photo - 128 / 255) < 0.01).all(2) & (alpha > 0.9)
    assert beside.sum() > 300
    assert np.abs(image - photo)[beside].mean() < 0.05  # the points were darker


@pytest.mark.slow
def test_the_same_again_is_the_same(tmp_path: Path) -> None:
    context = workspace(tmp_path)
    context = replace(context, params=SplatsParams(enabled=True, count=1000, steps=40))
    SPLATTING.run(context)
    first = read_gaussians(artifacts.SPLATS.load(context.out))
    SPLATTING.run(replace(context, workers=2))
    second = read_gaussians(artifacts.SPLATS.load(context.out))
    np.testing.assert_array_equal(first.centers, second.centers)
    np.testing.assert_array_equal(first.harmonics, second.harmonics)
