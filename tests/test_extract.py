"""The extract stage with an analytic field in place of a trained one."""

from __future__ import annotations

import sys
import types

import numpy as np
import pytest
from rigs import scene_without_points, three_rings

from configs.params import ExtractParams
from stages import artifacts
from stages.engine.stage import StageContext
from stages.errors import ReconstructionError
from stages.extract import EXTRACT, supported_resolution
from stages.geometry.point_cloud import PointCloud


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
