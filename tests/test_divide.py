"""A workspace cut into blocks: the plan, and what the blocks' own workspaces are given."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from small_town import town_workspace

from benchmarks.small_town import flight
from configs.load import load_config
from configs.params import Config
from stages import artifacts
from stages.artifacts.blocks import (
    NEIGHBOURS,
    ROUGH_GAINS,
    block_folder,
    given_folder,
    plan_path,
    read_plan,
    read_rough_gains,
    read_tile,
    rough_gains_path,
    whole_of,
)
from stages.block_status import block_statuses, workspace_status
from stages.divide import divide, in_words
from stages.engine.fingerprint import SourceDigests
from stages.engine.runner import naming_command, run_pipeline
from stages.engine.workspace import Workspace
from stages.errors import WorkspaceError
from stages.geometry.similarity import Similarity
from stages.geometry.tiling import within
from stages.pipeline import PIPELINE
from stages.posing.parts import rebuilt
from stages.posing.undistortion import registered_photos, sparse_points
from stages.preflight import photos_held
from stages.reconstruct import reconstruct
from stages.request import Request


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    """A workspace whose photos have poses."""
    return town_workspace(tmp_path_factory.mktemp("town") / "whole")


@pytest.fixture
def whole(made, tmp_path) -> Path:
    root = tmp_path / "whole"
    shutil.copytree(made, root)
    return root


def run(block: Path, until: str) -> None:
    reconstruct(Request(workspace=block, until=until, device="cpu", workers=1), PIPELINE)


def test_the_plan_is_on_one_lattice_with_the_ground_below(whole):
    plan = divide(whole, 3)
    assert read_plan(whole).model_dump_json() == plan.model_dump_json()
    assert [block.name for block in plan.blocks] == ["b00", "b01", "b02"]
    cell = plan.lattice.cell
    for block in plan.blocks:
        np.testing.assert_array_equal(block.region / cell, np.round(block.region / cell))
        assert block.core[0, 2] < 0 < 0.8 < block.core[1, 2] < 2, "houses are 0.8 high, and up is +Z"
    up = plan.plan_from_poses.similarity().rotation[2]
    np.testing.assert_allclose(up, [0, 0, 1], atol=0.05)
    assert len({name for block in plan.blocks for name in block.photos}) == len(flight())
    assert "3 blocks of" in in_words(plan)


def test_a_world_that_is_upright_is_the_plans_own(tmp_path):
    root = town_workspace(tmp_path / "whole", up="+z")
    assert divide(root, 2).plan_from_poses.similarity().matrix().tolist() == Similarity.identity().matrix().tolist()


def test_a_block_is_a_workspace_with_the_poses_and_points_of_the_whole(whole):
    plan = divide(whole, 2)
    block = plan.blocks[0]
    folder = block_folder(whole, block.name)
    assert whole_of(folder) == whole
    assert whole_of(whole) is None
    run(folder, "undistort")
    model = pycolmap.Reconstruction(str(artifacts.MODEL.load(folder / "sfm")))
    before = pycolmap.Reconstruction(str(artifacts.MODEL.load(whole / "sfm")))
    photos = registered_photos(model)
    assert tuple(photo.name for photo in photos) == block.photos
    plan_from_poses = plan.plan_from_poses.similarity()
    centers = {image.name: image.projection_center() for image in before.images.values()}
    for photo in photos:
        np.testing.assert_allclose(photo.projection_center(), plan_from_poses.apply(centers[photo.name]), atol=1e-9)
    points, errors, seen = sparse_points(model, photos)
    assert (np.bincount(seen[:, 1]) >= 2).all()
    assert (errors == 0.5).all()
    theirs = plan_from_poses.apply(np.array([point.xyz for point in before.points3D.values()]))
    away = np.linalg.norm(points[:, None] - theirs[None], axis=2).min(1)
    assert away.max() < 1e-9
    assert within(theirs, block.region).sum() <= within(points, block.region).sum() + 5, "points of its region are lost"
    assert model.compute_mean_reprojection_error() == pytest.approx(0.5)
    pixels = {photo.name: photo for photo in photos}[block.photos[0]]
    for place in pixels.points2D[:20]:
        point = model.points3D[place.point3D_id].xyz
        np.testing.assert_allclose(pixels.project_point(point), place.xy, atol=1e-6)


def test_a_block_learns_its_box_upright_in_the_frame_of_the_plan(whole):
    plan = divide(whole, 2)
    folder = block_folder(whole, "b01")
    run(folder, "undistort")
    scene = artifacts.FIRST_SCENE.load(folder / "undistort")
    np.testing.assert_array_equal(scene.poses_from_scene.rotation, np.eye(3))
    np.testing.assert_allclose(scene.poses_from_scene.translation, plan.blocks[1].region.mean(0))
    half = np.linalg.norm(plan.blocks[1].region[1] - plan.blocks[1].region[0]) / 2
    assert half < scene.poses_from_scene.scale < 1.1 * half
    assert not scene.growable
    place = artifacts.WORLD_PLACE.load(folder / "place")
    assert place.world_from_poses.matrix().tolist() == np.eye(4).tolist()


def test_what_is_known_of_the_world_goes_with_the_blocks(tmp_path):
    root = town_workspace(tmp_path / "whole", known_distance="0 0 0 1 0 0 20")
    plan = divide(root, 2)
    assert plan.plan_from_poses.scale == pytest.approx(20)
    folder = block_folder(root, "b00")
    run(folder, "place")
    place = artifacts.WORLD_PLACE.load(folder / "place")
    assert place.metric
    assert place.scale_from == "a known distance"
    assert place.world_from_poses.scale == 1.0


def test_photos_are_linked_and_masks_come_with_them(tmp_path):
    root = town_workspace(tmp_path / "whole", masks=True)
    plan = divide(root, 2)
    folder = block_folder(root, "b00")
    links = [path for path in given_folder(folder, "photos").rglob("*") if path.is_symlink()]
    assert len(links) == len(plan.blocks[0].photos)
    assert not any(Path(link.readlink()).is_absolute() for link in links), "a moved workspace would lose its photos"
    run(folder, "ingest")
    records = artifacts.IMAGE_SET.load(folder / "ingest").images
    assert tuple(record.name for record in records) == plan.blocks[0].photos
    assert all(record.has_mask for record in records)
    source = artifacts.PHOTOS.load(root / "ingest").path(records[0].name)
    assert artifacts.PHOTOS.load(folder / "ingest").path(records[0].name).read_bytes() == source.read_bytes()


def test_each_block_is_told_how_bright_its_photos_are_among_all(whole):
    plan = divide(whole, 2)
    for block in plan.blocks:
        folder = block_folder(whole, block.name)
        path = rough_gains_path(folder)
        gains = read_rough_gains(path)
        assert gains["row_1/012.png"][0] / gains["row_1/010.png"][0] == pytest.approx(10 / 12, rel=1e-3)
        assert gains["row_1/012.png"][1] == pytest.approx(1, abs=1e-3)
        assert set(gains) <= set(block.photos)
        run(folder, "place")
        assert Workspace.open(folder).record.sources[ROUGH_GAINS] == str(path)
    before = path.read_bytes()
    divide(whole, 2, anew=True)
    assert path.read_bytes() == before, "or textures would be made again"


def test_blocks_of_an_earlier_version_are_told_it_now(whole):
    divide(whole, 2)
    path = rough_gains_path(block_folder(whole, "b00"))
    before = path.read_bytes()
    path.unlink()
    divide(whole, 2)
    assert path.read_bytes() == before


def test_neighbours_that_learn_make_the_tile_stale(whole):
    """By the workspace's own rules: what the neighbours learned is a source like photos."""
    divide(whole, 2)
    folder = given_folder(block_folder(whole, "b00"), NEIGHBOURS)
    before = SourceDigests({NEIGHBOURS: folder}).files(NEIGHBOURS)
    assert set(before) == {"tile.json"}
    learned = block_folder(whole, "b01") / "train"
    learned.mkdir()
    (learned / "field.pt").write_bytes(b"a field")
    after = SourceDigests({NEIGHBOURS: folder}).files(NEIGHBOURS)
    assert set(after) == {"tile.json", "b01/field.pt"}
    assert set(read_tile(folder).boxes) == {"b00", "b01"}


def test_the_same_plan_stays_and_another_asks_first(whole):
    plan = divide(whole, 2)
    folder = block_folder(whole, "b00")
    poses = SourceDigests({"poses": given_folder(folder, "poses")}).files("poses")
    (folder / "train").mkdir()
    again = divide(whole, 2)
    assert again.model_dump_json() == plan.model_dump_json()
    assert (folder / "train").is_dir()
    assert SourceDigests({"poses": given_folder(folder, "poses")}).files("poses") == poses
    with pytest.raises(WorkspaceError, match="2 blocks already") as caught:
        divide(whole, 3)
    assert "--anew" in caught.value.hint
    assert len(divide(whole, 3, anew=True).blocks) == 3
    assert not (folder / "train").exists()


def test_poses_are_given_bit_for_bit_alike(whole):
    """Or a new plan of the same poses would find them anew."""
    divide(whole, 2)
    given = given_folder(block_folder(whole, "b00"), "poses")
    before = SourceDigests({"poses": given}).files("poses")
    divide(whole, 2, anew=True)
    assert SourceDigests({"poses": given}).files("poses") == before


def test_settings_of_the_whole_reach_the_blocks(whole):
    divide(whole, 2)
    own = Workspace.open(block_folder(whole, "b00"))
    first = load_config(None, own.config_path)
    assert first.place.region.startswith("box ")
    workspace = Workspace.open(whole)
    config = load_config(None, workspace.config_path, ["train.steps=77"])
    with workspace.lock():
        workspace.remember({"photos": Path(workspace.record.sources["photos"])}, "tiny", config.model_dump(mode="json"))
    divide(whole, 2)
    second = load_config(None, own.config_path)
    assert second.train.steps == 77
    assert second.place.region == first.place.region


def test_a_workspace_without_poses_is_refused(tmp_path):
    root = tmp_path / "empty"
    workspace = Workspace.open(root, create=True)
    run_pipeline([], workspace, Config(), {"photos": None})
    with pytest.raises(WorkspaceError, match="no poses to cut it by") as caught:
        divide(root, 2)
    assert "--until place" in caught.value.hint


def test_auto_gives_no_block_more_photos_than_a_process_holds(whole, monkeypatch):
    monkeypatch.setattr("stages.divide.photos_held", lambda *_: 16)
    plan = divide(whole, None)
    assert len(plan.blocks) > 1
    assert max(len(block.photos) for block in plan.blocks) <= 17
    monkeypatch.setattr("stages.divide.photos_held", lambda *_: 1000)
    assert len(divide(whole, None, anew=True).blocks) == 1


def test_more_memory_holds_more_photos():
    config, sizes = Config(), [(1600, 1200)] * 9
    assert photos_held(sizes, config, 1.0) == 0
    few, many = photos_held(sizes, config, 8.0), photos_held(sizes, config, 16.0)
    assert 100 < few < many
    assert photos_held([(400, 300)], config, 8.0) > few


def test_what_lies_elsewhere_is_not_touched_through_a_link(whole, tmp_path):
    """A workspace may come from somebody else: `given` that leads to one's own photos would be emptied."""
    divide(whole, 2)
    precious = tmp_path / "precious"
    (precious / "photos").mkdir(parents=True)
    (precious / "photos" / "only.jpg").touch()
    given = given_folder(block_folder(whole, "b00"), "photos").parent
    shutil.rmtree(given)
    given.symlink_to(precious)
    for anew in (False, True):
        with pytest.raises(WorkspaceError, match="is a link"):
            divide(whole, 2, anew)
    assert (precious / "photos" / "only.jpg").exists()


def test_a_plan_that_leads_out_of_its_folder_is_refused(whole):
    divide(whole, 2)
    plan_path(whole).write_text(plan_path(whole).read_text().replace("row_0/000.png", "../../000.png"))
    with pytest.raises(WorkspaceError, match="leads out"):
        read_plan(whole)


def test_a_block_whose_neighbours_are_gone_names_the_command_that_gives_them(whole):
    command = naming_command(NEIGHBOURS, block_folder(whole, "b00"))
    assert command == f"hineus blocks {whole}"


def test_photos_that_were_reduced_since_keep_their_poses(whole):
    model = pycolmap.Reconstruction(str(artifacts.MODEL.load(whole / "sfm")))
    names = [image.name for image in model.images.values()][:6]
    small = rebuilt(model, {name: (f"small/{name}", (120, 90)) for name in names})
    assert small.num_reg_images() == 6
    assert small.compute_mean_reprojection_error() == pytest.approx(0.5)
    for image in small.images.values():
        assert (image.camera.width, image.camera.focal_length) == (120, pytest.approx(100.0))
        place = image.points2D[0]
        np.testing.assert_allclose(image.project_point(small.points3D[place.point3D_id].xyz), place.xy, atol=1e-6)


def test_status_tells_of_each_block(whole):
    assert list(block_statuses(whole, PIPELINE)) == []
    divide(whole, 2)
    run(block_folder(whole, "b01"), "place")
    first, second = block_statuses(whole, PIPELINE)
    assert (first.fresh, first.waiting, first.reason) == (0, "ingest", "not made yet")
    assert (second.name, second.fresh, second.waiting) == ("b01", 3, "undistort")
    assert not second.is_running
    states = {status.name: status.state for status in workspace_status(Workspace.open(whole), PIPELINE)}
    assert states["place"] == "fresh"


def test_a_block_that_is_gone_is_told_of(whole):
    divide(whole, 2)
    shutil.rmtree(block_folder(whole, "b00"))
    first, _ = block_statuses(whole, PIPELINE)
    assert re.search("no workspace", first.reason)
