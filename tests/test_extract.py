"""The extract stage with an analytic field in place of a trained one."""

from __future__ import annotations

import sys
import types
from dataclasses import replace

import numpy as np
import pytest
from rigs import scene_without_points, three_rings

from configs.params import ExtractParams
from stages import artifacts
from stages.artifacts.blocks import NEIGHBOURS, BoxRecord, Tile, learned_links, write_tile
from stages.engine.stage import StageContext
from stages.errors import ReconstructionError
from stages.extract import EXTRACT, supported_resolution
from stages.geometry.point_cloud import PointCloud
from stages.geometry.similarity import Similarity
from stages.geometry.tiling import BlockBox

CELL = 0.125
BOXES = {
    "b00": BlockBox(np.array([[-4.0, -4, -1], [0, 4, 1]]), np.array([1.0, 1, 1])),
    "b01": BlockBox(np.array([[0.0, -4, -1], [4, 4, 1]]), np.array([1.0, 1, 1])),
}


@pytest.fixture
def tiles(tmp_path, monkeypatch):
    """Runs the stage of both blocks, whose fields are planes at these heights; of a block that is not named, nothing
    was learned. Gives numbers, vertices in the plan's frame and faces of those that are asked for."""

    def frame(name):
        box = BOXES[name].region
        return Similarity(1.05 * float(np.linalg.norm(box[1] - box[0])) / 2, np.eye(3), box.mean(0))

    def run(heights, asked=("b00", "b01"), cloud=None, **params):
        def load_field(path, device):
            name = path.read_text()
            scene = frame(name)
            return types.SimpleNamespace(sdf=lambda p: (scene.apply(p)[:, 2] - heights[name]) / scene.scale)

        stand_in = types.ModuleType("stages.neural.trained_field")
        stand_in.load_field = load_field
        monkeypatch.setitem(sys.modules, "stages.neural.trained_field", stand_in)
        found = []
        for name in asked:
            root = tmp_path / f"{name}_{len(list(tmp_path.iterdir()))}"
            around = root / NEIGHBOURS
            around.mkdir(parents=True)
            boxes = {each: BoxRecord(core=box.core, margin=box.margin) for each, box in BOXES.items()}
            write_tile(around, Tile(name=name, cell=CELL, boxes=boxes))
            for each in heights:
                folder = root / ("train" if each == name else f"of_{each}")
                folder.mkdir()
                (folder / "field.pt").write_text(each)
                artifacts.SCENE.save(folder, replace(scene_without_points(three_rings()), poses_from_scene=frame(each)))
                if each != name:
                    (around / each).mkdir()
                    for file, link in learned_links(around, each).items():
                        link.symlink_to(folder / file)
            for stage in ("densify", "out"):
                (root / stage).mkdir()
            artifacts.POINT_CLOUD.save(root / "densify", cloud or PointCloud.empty())
            context = StageContext(
                inputs={"train": root / "train", "densify": root / "densify"},
                sources={NEIGHBOURS: around},
                out=root / "out",
                scratch=root,
                params=ExtractParams(block=16, **params),
            )
            numbers = EXTRACT.run(context)
            vertices, faces = artifacts.RAW_MESH.load(root / "out")
            found.append((numbers, frame(name).apply(vertices.astype(np.float64)), faces))
        return found

    return run


def test_tiles_meet_at_their_border_whatever_moved_them_elsewhere(tiles):
    """Dense points lift one tile by half a cell; at the border both stay where the blended fields are zero."""
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-4, 4, (40_000, 2)), np.full(40_000, 0.15)]).astype(np.float32)
    normals = np.tile(np.float32([0, 0, 1]), (len(points), 1))
    count = len(points)
    seen = np.tile(np.arange(12, dtype=np.int32), count)
    cloud = PointCloud(
        points, normals, np.zeros((count, 3), np.uint8), np.ones(count, np.float32), 12 * np.arange(count + 1), seen
    )
    (numbers, one, _), (_, other, _) = tiles({"b00": 0.1, "b01": 0.1}, cloud=cloud)
    assert numbers["blended"] == 2
    assert np.median(one[one[:, 0] < -1.5][:, 2]) == pytest.approx(0.15, abs=0.01)
    borders = [each[np.abs(each[:, 0]) < 1e-5] for each in (one, other)]
    borders = [each[np.argsort(each[:, 1])] for each in borders]
    assert len(borders[0]) == 65
    np.testing.assert_allclose(*borders, atol=1e-6)
    assert borders[0][5:-5, 2] == pytest.approx(0.1, abs=1e-5)


def test_fields_that_disagree_are_blended_over_their_overlap(tiles):
    (_, one, _), (_, other, _) = tiles({"b00": 0.0, "b01": 0.2}, fit=False, denoising=0)
    middle = np.concatenate([one, other])
    middle = middle[np.abs(middle[:, 1]) < 0.1]
    heights = np.interp([-2.0, -0.5, 0.0, 0.5, 2.0], *middle[np.argsort(middle[:, 0])][:, [0, 2]].T)
    assert heights[[0, 2, 4]] == pytest.approx([0.0, 0.1, 0.2], abs=1e-3)
    assert 0.01 < heights[1] < 0.05


def test_what_a_block_has_learned_beyond_its_tile_lies_around_it(tiles, tmp_path):
    tiles({"b00": 0.1}, asked=["b00"])
    (out,) = tmp_path.glob("b00_*/out")
    vertices, faces = artifacts.AROUND_MESH.load(out)
    region = BOXES["b00"].region
    x, y, z = (vertices * 1.05 * np.linalg.norm(region[1] - region[0]) / 2 + region.mean(0)).T
    assert len(faces) > 100
    assert z == pytest.approx(np.full(len(z), 0.1), abs=1e-3)
    assert ((x > -1e-5) | (x < -4 + 1e-5) | (np.abs(y) > 4 - 1e-5)).all()
    assert x.max() > 2


def test_a_neighbour_that_has_learned_nothing_is_named(tiles, caplog):
    ((numbers, vertices, _),) = tiles({"b00": 0.1}, asked=["b00"])
    assert numbers["missing"] == "b01"
    assert "(b01)" in caplog.text
    assert vertices[:, 0].max() == pytest.approx(0.0, abs=1e-5)


def test_a_core_without_surface_names_its_block(tiles):
    with pytest.raises(ReconstructionError, match="core of block b01"):
        tiles({"b00": 50.0, "b01": 50.0}, asked=["b01"])


@pytest.fixture
def stage(tmp_path, monkeypatch):
    train, densify, out = (tmp_path / name for name in ("train", "densify", "out"))

    def run(sdf, cloud=None, **params):
        for folder in (train, densify, out):
            folder.mkdir()
        stand_in = types.ModuleType("stages.neural.trained_field")
        stand_in.load_field = lambda path, device: types.SimpleNamespace(sdf=sdf)
        monkeypatch.setitem(sys.modules, "stages.neural.trained_field", stand_in)
        artifacts.SCENE.save(train, scene_without_points(three_rings()))
        artifacts.POINT_CLOUD.save(densify, cloud or PointCloud.empty())
        seen = []
        context = StageContext(
            inputs={"train": train, "densify": densify},
            sources={},
            out=out,
            scratch=tmp_path,
            params=ExtractParams(**params),
            progress=lambda done, total, note="": seen.append((done, total)),
        )
        return EXTRACT.run(context), *artifacts.RAW_MESH.load(out), seen

    return run


def test_mesh_and_numbers(stage):
    numbers, vertices, faces, progress = stage(lambda p: np.linalg.norm(p, axis=1) - 0.5, resolution=48, block=16)
    assert numbers["resolution"] == 48
    assert numbers["faces"] == len(faces)
    assert np.abs(np.linalg.norm(vertices, axis=1) - 0.5).max() < 3e-3
    assert progress[-1][0] == progress[-1][1]


def test_no_finer_than_the_photos(stage):
    numbers, *_ = stage(lambda p: np.linalg.norm(p, axis=1) - 0.5, resolution=512)
    assert numbers["resolution"] == numbers["supported_resolution"] == supported_resolution(three_rings())
    # The unit sphere fills 90 % of the images' 160 pixels; a pixel at its centre is a bit larger than at its front.
    assert 110 < numbers["resolution"] < 160


def test_empty_field_is_an_error_with_a_next_step(stage):
    with pytest.raises(ReconstructionError) as caught:
        stage(lambda p: np.ones(len(p), np.float32), resolution=32)
    assert "0 faces at 32^3" in caught.value.message
    assert "--set train.steps" in caught.value.hint


@pytest.mark.parametrize("fit", [True, False])
def test_the_mesh_goes_to_dense_points(stage, fit):
    rng = np.random.default_rng(0)
    normals = rng.normal(size=(20_000, 3)).astype(np.float32)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    count = len(normals)
    seen = np.tile(np.arange(12, dtype=np.int32), count)
    black, trust = np.zeros((count, 3), np.uint8), np.ones(count, np.float32)
    in_scene = PointCloud(0.52 * normals, normals, black, trust, 12 * np.arange(count + 1), seen)
    cloud = in_scene.moved(scene_without_points(three_rings()).poses_from_scene)
    numbers, vertices, *_ = stage(lambda p: np.linalg.norm(p, axis=1) - 0.5, cloud, resolution=48, fit=fit)
    assert (numbers["points_fitted"] > 10_000) == fit
    assert np.abs(np.linalg.norm(vertices, axis=1) - (0.52 if fit else 0.5)).mean() < 2e-3
