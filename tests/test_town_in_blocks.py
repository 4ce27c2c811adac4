"""A large scene in small: photos of a strip of land to two tiles that meet, by one command's worth of calls."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks.small_town import HEIGHT, LAND, SIZE, photograph, town
from stages import artifacts
from stages.artifacts.blocks import block_folder, read_plan
from stages.block_by_block import BlockRuns, reconstruct_in_blocks
from stages.block_status import block_statuses
from stages.engine.workspace import Workspace
from stages.evaluation.photos.novel_views import NovelViews
from stages.evaluation.reading import read_mesh
from stages.evaluation.suites.scores import Part, result_mesh, score_tiles
from stages.pipeline import PIPELINE
from stages.request import Request
from stages.surface.triangle_mesh import raycaster

SETTINGS = ("train.steps=40", "train.steps_if_covered=1", "atlas.texture_size=128", "cleanup.target_faces=1500")


def run(folder: Path) -> BlockRuns:
    asked = Request(
        photos=folder / "photos",
        poses=folder / "transforms.json",
        workspace=folder / "whole",
        preset="tiny",
        sets=SETTINGS,
        device="cpu",
        workers=1,
    )
    return reconstruct_in_blocks(asked, 2, PIPELINE)


@pytest.mark.slow
def test_photos_to_tiles_that_meet(tmp_path):
    import open3d as o3d

    photograph(tmp_path)
    result = run(tmp_path)
    assert result.failure() is None
    whole, plan = result.whole.workspace.root, read_plan(tmp_path / "whole")
    assert all(outcome.glb.is_file() and outcome.report.is_file() for outcome in result.outcomes)
    plan_from_poses = plan.plan_from_poses.similarity()

    borders, heights = [], []
    axis = int(np.argmax(np.abs(plan.blocks[0].core.mean(0) - plan.blocks[1].core.mean(0))[:2]))
    at = plan.blocks[1].core[0, axis]
    for block in plan.blocks:
        folder = block_folder(whole, block.name)
        frame = artifacts.SCENE.load(folder / "train").poses_from_scene
        vertices = frame.apply(artifacts.RAW_MESH.load(folder / "extract")[0].astype(np.float64))
        border = vertices[np.abs(vertices[:, axis] - at) < 1e-5]
        borders.append(border[np.lexsort(np.round(border, 4).T)])
        clean = frame.apply(artifacts.CLEAN_MESH.load(folder / "cleanup")[0].astype(np.float64))
        heights.append(plan_from_poses.inverse().apply(clean))
    assert len(borders[0]) == len(borders[1]) > 20
    np.testing.assert_allclose(*borders, atol=1e-5)

    surface = np.concatenate(heights).astype(np.float32)  # after so few steps the land is roughly where it should be
    flown = surface[((surface[:, :2] > LAND[0]) & (surface[:, :2] < LAND[1])).all(1)]
    vertices, faces = town()
    truth = raycaster(vertices.astype(np.float32), faces.astype(np.int32))
    assert np.median(truth.compute_distance(o3d.core.Tensor(flown)).numpy()) < 0.1 * HEIGHT

    parts = [Part(Workspace.open(outcome.workspace), plan_from_poses.inverse()) for outcome in result.outcomes]
    views = NovelViews(tmp_path, tuple(f"photos/{i:03d}.png" for i in (3, 12)), tmp_path / "transforms.json")
    scored = score_tiles(views, None, parts)
    assert scored["counted"] == 2
    for photo in scored["photos"]:  # tiles of both blocks make the picture
        assert photo["mesh"]["object"]["pixels"] > 0.8 * SIZE[0] * SIZE[1]
        assert photo["mesh"]["object"]["psnr"] > 15
    joined = read_mesh(result_mesh(parts, {"cleanup"}, tmp_path / "joined.ply"))[0]
    np.testing.assert_allclose(np.sort(joined, 0), np.sort(surface, 0), atol=1e-4)

    again = run(tmp_path)
    assert all(outcome.action == "skipped" for outcome in again.whole.outcomes)
    assert all(block.fresh == block.stages for block in block_statuses(whole, PIPELINE))
    assert plan_from_poses.scale == 1.0, "the world of poses that are given is theirs"
