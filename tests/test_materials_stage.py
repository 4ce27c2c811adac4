"""The materials stage on files: what it writes, and when it writes nothing."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import ball_photos
import cv2
import numpy as np
import pytest
from lit_sphere import ROWS, use_small_maps
from rigs import capture, look_at, scene_without_points
from scipy.spatial.transform import Rotation

from configs.params import MaterialsParams
from stages import artifacts, materials
from stages.artifacts import AtlasMesh, ImageRecord, ImageSet, write_png
from stages.engine.stage import StageContext
from stages.errors import ConfigError, InputError, ReconstructionError, WorkspaceError
from stages.files.light_files import GIVEN_LIGHT, read_light
from stages.geometry.place import Place
from stages.geometry.similarity import Similarity
from stages.geometry.up import gltf_from_scene
from stages.light.environment import mean_radiance, resized
from stages.materials import MATERIALS
from stages.shading import given_light
from stages.shading.texels import Told

GREY = 120


def workspace(root: Path, photos: int) -> StageContext:
    """A square that faces -y, photographed in one grey from so many places before it; none shows its back."""
    folders = {name: root / name for name in (*MATERIALS.needs, "out", "scratch")}
    for folder in folders.values():
        folder.mkdir()
    square = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * 0.5
    front = np.stack([square[:, 0], np.zeros(4), square[:, 1]], 1)
    normals = np.tile([0.0, -1, 0], (4, 1))
    uvs = (square + 0.5) * [0.4, 0.8] + [0.05, 0.1]
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    atlas = AtlasMesh(
        np.concatenate([front, front + np.array([0, 0.1, 0])]).astype(np.float32),
        np.concatenate([normals, -normals]).astype(np.float32),
        np.concatenate([uvs, uvs + np.array([0.5, 0])]).astype(np.float32),
        np.concatenate([faces, faces[:, ::-1] + 4]).astype(np.int32),
        64,
    )
    artifacts.ATLAS_MESH.save(folders["atlas"], atlas)
    places = [np.array([x, -2.5, z]) for x in (-1.0, 0.1, 1.2) for z in (-0.6, 0.7)]
    cameras = capture([look_at(place, np.zeros(3)) for place in places[:photos]], size=(48, 40), focal=55.0)
    artifacts.SCENE.save(folders["train"], scene_without_points(cameras))
    artifacts.HELD_OUT.save(folders["train"], ())
    artifacts.WORLD_PLACE.save(folders["place"], Place(Similarity.identity()))
    write_png(artifacts.BASE_COLOR.load(folders["bake"]), np.full((64, 64, 3), GREY, np.uint8))
    for name in cameras.names:
        path = artifacts.Pictures(folders["undistort"]).path(name)
        path.parent.mkdir(parents=True, exist_ok=True)
        write_png(path, np.full((40, 48, 3), GREY, np.uint8))
    return StageContext(
        inputs={name: folders[name] for name in MATERIALS.needs},
        sources={},
        out=folders["out"],
        scratch=folders["scratch"],
        params=MaterialsParams(enabled=True),
    )


def test_unless_asked_nothing_is_written(tmp_path: Path):
    context = workspace(tmp_path, photos=1)
    assert MATERIALS.run(replace(context, params=MaterialsParams())) == {}
    assert list(context.out.iterdir()) == []


def test_points_that_too_few_photos_see_are_refused_with_numbers(tmp_path: Path):
    context = workspace(tmp_path, photos=2)
    with pytest.raises(ReconstructionError, match=r"0 of \d+ points on the surface are seen by 3 photos") as caught:
        MATERIALS.run(context)
    assert "need 50" in caught.value.message
    assert "materials.enabled=false" in caught.value.hint
    assert list(context.out.iterdir()) == []


def test_a_texture_that_cannot_be_read_is_named(tmp_path: Path):
    context = workspace(tmp_path, photos=1)
    artifacts.BASE_COLOR.load(context.inputs["bake"]).write_bytes(b"no image")
    with pytest.raises(WorkspaceError, match=r"base_color\.png cannot be read") as caught:
        MATERIALS.run(context)
    assert "--force bake" in caught.value.hint


def with_a_ball(context: StageContext, light: np.ndarray) -> StageContext:
    """The same with a chrome ball in the first photo, as ingest took it, and poses found in another frame."""
    import pycolmap

    turn = Rotation.from_euler("xyz", [40, -100, 15], degrees=True).as_matrix()
    cameras = artifacts.SCENE.load(context.inputs["train"]).cameras
    scene = scene_without_points(cameras, Similarity(2.0, turn, np.array([1.0, 2, 3])))
    artifacts.SCENE.save(context.inputs["train"], scene)
    names = [f"{i:03d}.jpg" for i in range(len(cameras))]
    records = [ImageRecord(name, name, *ball_photos.SIZE, None, "", 1.0, False, "") for name in names]
    artifacts.IMAGE_SET.save(context.inputs["ingest"], ImageSet(tuple(records)))
    model, lens = pycolmap.Reconstruction(), ball_photos.lens()
    model.add_camera_with_trivial_rig(lens)
    for i, name in enumerate(names):
        cam_from_poses = pycolmap.Rigid3d(pycolmap.Rotation3d(cameras.extrinsics[i][:, :3] @ turn.T), np.zeros(3))
        model.add_image_with_trivial_frame(pycolmap.Image(name, pycolmap.Point2DList([]), 1, i + 1), cam_from_poses)
    folder = artifacts.MODEL.load(context.inputs["sfm"])
    folder.mkdir()
    model.write(folder)
    light_from_scene = gltf_from_scene(scene, Place(Similarity.identity())).rotation
    light_from_cam = light_from_scene @ cameras.extrinsics[0][:, :3].T
    taken = ball_photos.drawn("chrome", light, light_from_cam, np.array([0.2, 0.1, 1.0]), 0.13, lens, 0.3)
    path = artifacts.PHOTOS.load(context.inputs["ingest"]).path(names[0])
    path.parent.mkdir()
    cv2.imwrite(str(path), taken.pixels[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 98])
    ball = f"chrome:{names[0]}:{taken.center[0]},{taken.center[1]},{taken.radius}"
    return replace(context, params=MaterialsParams(enabled=True, balls=(ball,)))


@pytest.mark.slow
def test_the_light_of_a_ball_is_the_light_that_is_written(tmp_path: Path, monkeypatch):
    use_small_maps(monkeypatch)
    monkeypatch.setattr(given_light, "LIGHT_ROWS", ROWS)
    monkeypatch.setattr(materials, "POINTS", 300)
    truth = ball_photos.lamps(2.5)
    context = with_a_ball(workspace(tmp_path, photos=6), truth)
    numbers = MATERIALS.run(context)
    light = read_light(artifacts.LIGHT.load(context.out))
    assert ball_photos.apart_deg(ball_photos.main_source(light), ball_photos.LAMPS[0]) < 6
    share = resized(light, 8) / mean_radiance(light) - resized(truth, 8) / mean_radiance(truth)
    assert np.abs(share).mean() < 0.05
    assert (numbers["light_turn_deg"], numbers["light_turn_told"], numbers["light_clipped"]) == (0, True, 0)
    assert 0 < numbers["light_unseen"] < 0.15


def test_balls_in_photos_held_out_and_two_lights_are_refused(tmp_path: Path):
    context = with_a_ball(workspace(tmp_path, photos=6), ball_photos.lamps(2.5))
    with pytest.raises(ConfigError, match=r"given twice: as studio\.hdr and by balls"):
        MATERIALS.run(replace(context, sources={GIVEN_LIGHT: Path("studio.hdr")}))
    artifacts.HELD_OUT.save(context.inputs["train"], ("000.png",))
    with pytest.raises(InputError, match="is held out"):
        MATERIALS.run(context)


@pytest.mark.slow
def test_files_and_numbers(tmp_path: Path, monkeypatch):
    use_small_maps(monkeypatch)
    monkeypatch.setattr(materials, "POINTS", 300)
    context = workspace(tmp_path, photos=6)
    numbers = MATERIALS.run(context)
    assert sum(material["share"] for material in numbers["materials"]) == pytest.approx(1, abs=0.01)
    assert numbers["gain_min"] <= 1 <= numbers["gain_max"]
    assert numbers["cost"] < 0.05  # one grey is easily explained
    color = cv2.imread(str(artifacts.MATERIAL_COLOR.load(context.out)))
    orm = cv2.imread(str(artifacts.ORM.load(context.out)))[..., ::-1]
    known = cv2.imread(str(artifacts.KNOWN.load(context.out)), cv2.IMREAD_UNCHANGED)
    assert color.shape == orm.shape == (64, 64, 3)
    assert known.shape == (64, 64)
    assert set(np.unique(known)) <= set(Told)
    assert np.isin(known[16:48, 8:24], (Told.COLOR, Told.ALL)).mean() > 0.9  # the front
    assert (known[16:48, 40:56] == Told.NOTHING).all()  # the back
    assert (orm[16:48, 8:24, 0] == 255).all()  # no map of occlusion: all open
    assert set(np.unique(orm[..., 2])) <= {0, 255}
    assert color[16:48, 8:24].std() < 12  # one grey, one colour
    light = read_light(artifacts.LIGHT.load(context.out))
    assert light.shape == (ROWS, 2 * ROWS, 3)
    np.testing.assert_allclose(read_light(artifacts.LIGHT_HDR.load(context.out)), light, rtol=0.02, atol=1e-3)
    assert artifacts.LIGHT_HARMONICS.load(context.out).exists()
