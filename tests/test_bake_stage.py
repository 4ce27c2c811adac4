"""The bake stage on files: what it reads, what it writes, what it says when something is wrong."""

from __future__ import annotations

import sys
from dataclasses import replace
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
from rigs import scene_without_points

from configs.params import BakeParams
from stages import artifacts
from stages.artifacts import AtlasMesh, Pictures, write_png
from stages.bake import BAKE
from stages.drawing.rendering import look_at
from stages.engine.stage import StageContext
from stages.errors import ReconstructionError, WorkspaceError
from stages.geometry.cameras import PinholeCameras
from stages.texture.baking import Provenance

SKY = np.array([90, 160, 210], np.uint8)


@pytest.fixture
def context(tmp_path, monkeypatch) -> StageContext:
    """A square seen from the front by two cameras; its back is another square nobody sees."""
    fake = ModuleType("stages.neural.trained_field")
    fake.load_field = lambda path, device: SimpleNamespace(  # type: ignore[attr-defined]
        color=lambda points, normals, view_dirs: np.full(points.shape, 0.5, np.float32)
    )
    monkeypatch.setitem(sys.modules, "stages.neural.trained_field", fake)
    folders = {name: tmp_path / name for name in (*BAKE.needs, "out", "scratch")}
    for folder in folders.values():
        folder.mkdir()
    square = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * 0.5
    front = np.stack([square[:, 0], np.zeros(4), square[:, 1]], 1)  # faces -y
    normals = np.tile([0.0, -1, 0], (4, 1))
    uvs = (square + 0.5) * [0.4, 0.8] + [0.05, 0.1]
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    atlas = AtlasMesh(
        np.concatenate([front, front]).astype(np.float32),
        np.concatenate([normals, -normals]).astype(np.float32),
        np.concatenate([uvs, uvs + np.array([0.5, 0])]).astype(np.float32),
        np.concatenate([faces, faces[:, ::-1] + 4]).astype(np.int32),
        64,
    )
    artifacts.ATLAS_MESH.save(folders["atlas"], atlas)
    artifacts.CLEAN_FULL_MESH.save(folders["cleanup"], (atlas.vertices + 0.05 * atlas.normals, atlas.faces))
    up = np.array([0.0, 0, 1])
    views = [look_at(np.array([x, -2.5, 0.2]), np.zeros(3), up, 48, 40, 40) for x in (-0.5, 0.6)]
    cameras = PinholeCameras(
        ("one.png", "sub/two.png"),
        np.concatenate([view.sizes for view in views]),
        np.concatenate([view.intrinsics for view in views]),
        np.concatenate([view.extrinsics for view in views]),
    )
    artifacts.SCENE.save(folders["train"], scene_without_points(cameras))
    for name in cameras.names:
        path = artifacts.Pictures(folders["undistort"]).path(name)
        path.parent.mkdir(parents=True, exist_ok=True)
        write_png(path, np.broadcast_to(SKY, (40, 48, 3)).copy())
    return StageContext(
        inputs={name: folders[name] for name in BAKE.needs},
        sources={},
        out=folders["out"],
        scratch=folders["scratch"],
        params=BakeParams(),
    )


def test_files_and_numbers(context):
    import cv2

    numbers = BAKE.run(context)
    color = cv2.imread(str(artifacts.BASE_COLOR.load(context.out)))[..., ::-1]
    kinds = cv2.imread(str(artifacts.PROVENANCE.load(context.out)), cv2.IMREAD_GRAYSCALE)
    assert color.shape == (64, 64, 3)
    assert np.abs(color[kinds == Provenance.PHOTO].astype(int) - SKY).max() <= 1  # red stays red
    assert (kinds[10:50, :28] == Provenance.PHOTO).mean() > 0.8
    assert not (kinds[:, 34:] == Provenance.PHOTO).any()
    assert (kinds == Provenance.FIELD).sum() > 1000
    assert numbers["seen_share"] == pytest.approx(0.5, abs=0.06)  # the rim of a photo's silhouette is not used
    assert numbers["mean_views"] == pytest.approx(2, abs=0.1)


def test_maps_of_normals_and_occlusion_are_made_as_set(context):
    import cv2

    numbers = BAKE.run(context)
    normal_map = cv2.imread(str(artifacts.NORMAL_MAP.load(context.out)))[..., ::-1]
    assert numbers["normals_share"] == 1.0
    assert np.abs(normal_map.astype(int) - [128, 128, 255]).max() <= 1  # the full mesh is as flat
    occlusion = cv2.imread(str(artifacts.OCCLUSION.load(context.out)), cv2.IMREAD_UNCHANGED)
    assert occlusion.shape == (64, 64)
    assert (occlusion == 255).all()  # nothing stands before the square
    for folder in (context.out, context.scratch):
        for path in folder.iterdir():
            path.unlink()
    BAKE.run(replace(context, params=BakeParams(normal_map=False, occlusion_rays=0)))
    assert not artifacts.NORMAL_MAP.load(context.out).exists()
    assert not artifacts.OCCLUSION.load(context.out).exists()


def test_the_quality_of_each_vertex_is_kept(context):
    BAKE.run(context)
    quality = artifacts.QUALITY.load(context.out)
    assert quality.seen_by.shape == (8,)
    assert (quality.invented[4:] == 1).all()  # the back
    assert (quality.seen_by[4:] == 0).all()
    assert quality.invented[:4].max() < 0.5
    np.testing.assert_allclose(quality.texel_density, np.sqrt(64**2 * 0.4 * 0.8), rtol=1e-5)


def test_the_exposure_of_each_photo_is_kept(context):
    baked = BAKE.run(context)
    gains = artifacts.GAINS.load(context.out)
    assert list(gains) == ["one.png", "sub/two.png"]
    assert baked["gain_max"] == pytest.approx(max(max(of) for of in gains.values()), abs=1e-4)
    BAKE.run(replace(context, params=BakeParams(gain=False, normal_map=False, occlusion_rays=0)))
    assert set(artifacts.GAINS.load(context.out).values()) == {(1.0, 1.0, 1.0)}


def test_each_photo_is_read_and_its_depths_drawn_once(context, monkeypatch):
    from stages.texture import photo_views

    loaded, drawn = [], []
    draw = photo_views.depth_map
    load = Pictures.masked
    monkeypatch.setattr(Pictures, "masked", lambda photos, name: loaded.append(name) or load(photos, name))
    monkeypatch.setattr(photo_views, "depth_map", lambda *what: drawn.append(what[1]) or draw(*what))
    BAKE.run(context)
    assert sorted(loaded) == ["one.png", "sub/two.png"]
    assert sorted(drawn) == [0, 1]


def test_what_lies_around_a_tile_hides_it(context):
    wall = np.array([[0, -1, -1], [0, -1, 1], [1, -1, 1], [1, -1, -1]], np.float32)
    artifacts.AROUND_MESH.save(context.inputs["extract"], (wall, np.array([[0, 1, 2], [0, 2, 3]], np.int32)))
    assert BAKE.run(context)["seen_share"] < 0.4  # 0.5 without


def test_a_mask_hides_what_lies_outside_it(context):
    for name in ("one.png", "sub/two.png"):
        path = artifacts.Pictures(context.inputs["undistort"]).mask_path(name)
        path.parent.mkdir(parents=True, exist_ok=True)
        write_png(path, np.zeros((40, 48), np.uint8))
    _, mask = context.read(artifacts.PINHOLE_PHOTOS).masked("sub/two.png")
    assert mask is not None
    assert not mask.any()
    assert BAKE.run(context)["seen_share"] == 0


def test_an_image_that_cannot_be_read_is_named(context):
    artifacts.Pictures(context.inputs["undistort"]).path("sub/two.png").write_bytes(b"")
    with pytest.raises(WorkspaceError, match=r"sub/two\.png cannot be read"):
        BAKE.run(context)


def test_a_mask_that_cannot_be_read_is_named_and_not_ignored(context):
    path = artifacts.Pictures(context.inputs["undistort"]).mask_path("one.png")
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(b"no mask")
    with pytest.raises(WorkspaceError, match=r"one\.png\.png cannot be read") as caught:
        BAKE.run(context)
    assert "--force undistort" in caught.value.hint


def test_an_image_of_the_wrong_size_is_explained(context):
    write_png(artifacts.Pictures(context.inputs["undistort"]).path("one.png"), np.zeros((10, 10, 3), np.uint8))
    with pytest.raises(ReconstructionError, match=r"photo one\.png: expected shape \(40, 48, 3\)"):
        BAKE.run(context)


def test_photos_that_were_held_out_are_not_in_the_texture(context):
    import cv2

    path = artifacts.Pictures(context.inputs["undistort"]).path("sub/two.png")
    write_png(path, np.broadcast_to(255 - SKY, (40, 48, 3)).copy())
    artifacts.HELD_OUT.save(context.inputs["train"], ["sub/two.png"])
    numbers = BAKE.run(context)
    color = cv2.imread(str(artifacts.BASE_COLOR.load(context.out)))[..., ::-1]
    kinds = cv2.imread(str(artifacts.PROVENANCE.load(context.out)), cv2.IMREAD_GRAYSCALE)
    assert np.abs(color[kinds == Provenance.PHOTO].astype(int) - SKY).max() <= 1
    assert numbers["mean_views"] == 1
