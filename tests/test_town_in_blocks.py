"""A large scene in small: photos of a strip of land to two tiles that meet, by the command that a user gives.

Its jobs are real ones: Snakemake runs `hineus` for each block.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.small_town import HEIGHT, LAND, SIZE, photograph, town
from stages import artifacts
from stages.artifacts.blocks import BlockPlan, block_folder
from stages.block_status import BlockStatus, block_statuses
from stages.divide import divide
from stages.engine.workspace import Workspace
from stages.evaluation.photos.novel_views import NovelViews
from stages.evaluation.reading import read_mesh
from stages.evaluation.suites.scores import Part, result_mesh, score_tiles
from stages.pipeline import PIPELINE
from stages.place import PLACE
from stages.reconstruct import reconstruct
from stages.request import Request
from stages.surface.triangle_mesh import raycaster
from stages.tilesets import join_tilesets

SETTINGS = (
    "train.steps=40",
    "train.steps_if_covered=1",
    "atlas.texture_size=128",
    "cleanup.target_faces=1500",
    "export.tiles=true",
)


def run_watched(whole: Path) -> tuple[dict[str, Any], list[BlockStatus]]:
    """What `hineus run --blocks 2 --jobs 2` answers, and how the blocks stood, time and again while it was at work."""
    command = [sys.executable, "-m", "hineus_cli", "run", "--workspace", str(whole), "--blocks", "2", "--jobs", "2"]
    command += ["--workers", "2", "--device", "cpu", "--json"]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    told, answer, stood = whole.with_name("told"), whole.with_name("answer"), list[BlockStatus]()
    with told.open("w") as stderr, answer.open("w") as stdout:
        run = subprocess.Popen(command, env=environment, stdout=stdout, stderr=stderr)
        while run.poll() is None:
            stood += block_statuses(whole, PIPELINE)
            time.sleep(5)  # looking costs a fifth of a second
    assert run.returncode == 0, told.read_text()
    return json.loads(answer.read_text()), stood


@pytest.mark.slow
def test_photos_to_tiles_that_meet(tmp_path):
    pytest.importorskip("snakemake")
    photograph(tmp_path)
    whole = tmp_path / "whole"
    reconstruct(
        Request(
            photos=tmp_path / "photos",
            poses=tmp_path / "transforms.json",
            workspace=whole,
            preset="tiny",
            sets=SETTINGS,
            device="cpu",
            workers=1,
            until=PLACE.name,
        ),
        PIPELINE,
    )
    plan = divide(whole, 2)
    assert plan.plan_from_poses.similarity().scale == 1.0, "the world of poses that are given is theirs"

    answer, stood = run_watched(whole)
    assert any(block.is_running and block.waiting and block.fresh for block in stood)
    assert all(block.fresh == block.stages for block in block_statuses(whole, PIPELINE))
    assert all(Path(block[made]).is_file() for block in answer["blocks"] for made in ("glb", "report"))

    meets_at_the_border(whole, plan)
    lies_where_the_land_is(whole, plan)
    is_scored_as_one(whole, plan)
    assert join_tilesets([whole], tmp_path / "tileset.json")["tiles"] == 2


def all_tiles(whole: Path, plan: BlockPlan) -> np.ndarray:
    """Vertices [V, 3] of all blocks' meshes, in the frame of the poses."""
    poses_from_plan, vertices = plan.plan_from_poses.similarity().inverse(), []
    for block in plan.blocks:
        folder = block_folder(whole, block.name)
        plan_from_scene = artifacts.SCENE.load(folder / "train").poses_from_scene  # poses of a block are the plan's
        clean = artifacts.CLEAN_MESH.load(folder / "cleanup")[0].astype(np.float64)
        vertices.append(poses_from_plan.apply(plan_from_scene.apply(clean)))
    return np.concatenate(vertices)


def meets_at_the_border(whole: Path, plan: BlockPlan) -> None:
    borders = []
    axis = int(np.argmax(np.abs(plan.blocks[0].core.mean(0) - plan.blocks[1].core.mean(0))[:2]))
    at = plan.blocks[1].core[0, axis]
    for block in plan.blocks:
        folder = block_folder(whole, block.name)
        frame = artifacts.SCENE.load(folder / "train").poses_from_scene
        vertices = frame.apply(artifacts.RAW_MESH.load(folder / "extract")[0].astype(np.float64))
        border = vertices[np.abs(vertices[:, axis] - at) < 1e-5]
        borders.append(border[np.lexsort(np.round(border, 4).T)])
    assert len(borders[0]) == len(borders[1]) > 20
    np.testing.assert_allclose(*borders, atol=1e-5)


def lies_where_the_land_is(whole: Path, plan: BlockPlan) -> None:
    """Roughly, after so few steps."""
    import open3d as o3d

    surface = all_tiles(whole, plan).astype(np.float32)
    flown = surface[((surface[:, :2] > LAND[0]) & (surface[:, :2] < LAND[1])).all(1)]
    vertices, faces = town()
    truth = raycaster(vertices.astype(np.float32), faces.astype(np.int32))
    assert np.median(truth.compute_distance(o3d.core.Tensor(flown)).numpy()) < 0.1 * HEIGHT


def is_scored_as_one(whole: Path, plan: BlockPlan) -> None:
    place = plan.plan_from_poses.similarity().inverse()
    parts = [Part(Workspace.open(block_folder(whole, block.name)), place) for block in plan.blocks]
    views = NovelViews(whole.parent, tuple(f"photos/{i:03d}.png" for i in (3, 12)), whole.parent / "transforms.json")
    scored = score_tiles(views, None, parts)
    assert scored["counted"] == 2
    for photo in scored["photos"]:  # tiles of both blocks make the picture
        assert photo["mesh"]["object"]["pixels"] > 0.8 * SIZE[0] * SIZE[1]
        assert photo["mesh"]["object"]["psnr"] > 15
    joined = read_mesh(result_mesh(parts, {"cleanup"}, whole.parent / "joined.ply"))[0]
    np.testing.assert_allclose(np.sort(joined, 0), np.sort(all_tiles(whole, plan), 0), atol=1e-4)
