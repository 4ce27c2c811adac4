"""3D Tiles: where tiles lie, what their errors say, and what the validator of their makers finds."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from tetrahedron import CORNERS, UP, WORLD, rotation_about, workspace
from typer.testing import CliRunner
from validators import tileset_issues

from configs.params import Config, ExportParams
from hineus_cli.app import app
from stages import artifacts
from stages.artifacts import AtlasMesh
from stages.engine.runner import run_pipeline
from stages.engine.stage import StageContext
from stages.engine.workspace import Workspace
from stages.export import EXPORT
from stages.files.tiles_3d import TILE_FROM_GLTF, Level, joined, tileset
from stages.geometry.earth import earth_centred, from_east_north_up
from stages.geometry.place import Place
from stages.geometry.similarity import Similarity
from stages.surface.levels_of_detail import deviation

ORIGIN = (47.0, 8.5, 400.0)
ON_EARTH = Place(Similarity.identity(), True, "GPS", 0.01, ORIGIN, 1.2, up=UP)
BOUNDS = np.array([[0.0, -1, 2], [4, 5, 3]])


def chain(tile: dict) -> list[dict]:
    """A tile and its only children."""
    return [tile, *(below for child in tile.get("children", []) for below in chain(child))]


def corners_of(tile: dict, transform: np.ndarray) -> np.ndarray:
    """[8, 3] of a tile's box, moved by its parents' transform [4, 4]."""
    middle, *halves = np.reshape(tile["boundingVolume"]["box"], (4, 3))
    signs = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T
    return (middle + signs @ np.stack(halves)) @ transform[:3, :3].T + transform[:3, 3]


def exported(tmp_path: Path, place: Place, **changes) -> tuple[Path, dict]:
    context = workspace(tmp_path, ExportParams(formats=(), tiles=True, **changes))
    artifacts.WORLD_PLACE.save(context.inputs["place"], place)
    EXPORT.run(context)
    return context.out, json.loads((context.out / artifacts.TILESET).read_text())


def test_the_coarsest_level_is_the_root_and_the_model_its_last_child():
    levels = [Level("model.glb", BOUNDS, 0.0), Level("1.glb", BOUNDS + 0.5, 0.02), Level("2.glb", BOUNDS, 0.01)]
    found = tileset(levels)
    tiles = chain(found["root"])
    assert [tile["content"]["uri"] for tile in tiles] == ["2.glb", "1.glb", "model.glb"]
    assert [tile["geometricError"] for tile in tiles] == [0.02, 0.02, 0.0]  # what is coarser is never said to be finer
    assert {tile["refine"] for tile in tiles} == {"REPLACE"}
    for tile in tiles:  # children lie within their parents
        corners = corners_of(tile, np.eye(4))
        np.testing.assert_allclose([corners.min(0), corners.max(0)], [[0, -1, 2], [4.5, 5.5, 3.5]])
    assert found["geometricError"] == pytest.approx(np.linalg.norm([4.5, 6.5, 1.5]))  # that of drawing nothing
    assert "transform" not in found["root"]
    with pytest.raises(ValueError, match="without error"):
        tileset(levels[1:])


def test_a_flat_model_has_a_box_with_a_volume():
    flat = tileset([Level("model.glb", BOUNDS * [1, 1, 0], 0.0)])
    halves = np.reshape(flat["root"]["boundingVolume"]["box"][3:], (3, 3))
    assert np.linalg.det(halves) > 0


def test_the_deviation_of_a_level_is_that_of_its_ridge():
    """A roof 0.3 high and the floor below it, on the same borders."""
    x, y = np.meshgrid([0.0, 1, 2], [0.0, 1])
    roof = np.stack([x.ravel(), y.ravel(), 0.3 * (x.ravel() == 1)], 1)
    faces = np.array([[0, 1, 4], [0, 4, 3], [1, 2, 5], [1, 5, 4]], np.int32)
    rest = {"normals": np.tile(UP, (6, 1)).astype(np.float32), "uvs": np.zeros((6, 2), np.float32), "texture_size": 8}
    full = AtlasMesh(roof.astype(np.float32), faces=faces, **rest)
    flat = replace(full, vertices=(roof * [1, 1, 0]).astype(np.float32))
    assert deviation(flat, full) == deviation(full, flat) == pytest.approx(0.3, rel=1e-5)
    assert deviation(full, full) < 1e-6


@pytest.mark.slow
def test_tiles_stand_upright_where_the_world_lies_on_the_earth(tmp_path):
    turned = Similarity(1.0, rotation_about(np.array([0.2, 1, 0.4]), 0.5), np.array([5.0, -3, 2]))
    folder, found = exported(tmp_path, replace(ON_EARTH, world_from_poses=turned), heights="ellipsoid")
    assert (folder / "model.glb").exists()  # tiles need it, whatever the formats are
    matrix = np.reshape(found["root"]["transform"], (4, 4)).T
    import trimesh

    mesh = trimesh.load(folder / "model.glb", force="mesh", process=False)
    tile = np.asarray(mesh.vertices) @ TILE_FROM_GLTF.T
    placed = tile @ matrix[:3, :3].T + matrix[:3, 3]
    world = turned.compose(WORLD).apply(CORNERS)
    expected = earth_centred(from_east_north_up(world, ORIGIN))
    distance = np.linalg.norm(placed[:, None] - expected[None], axis=2).min(1)
    assert distance.max() < 1e-4
    corners = corners_of(found["root"], np.eye(4))
    np.testing.assert_allclose([tile.min(0), tile.max(0)], [corners.min(0), corners.max(0)], atol=1e-6)
    assert tileset_issues([folder / artifacts.TILESET]) == []


def test_tiles_of_a_world_on_a_map_meet_those_of_the_same_world_east_north_and_up(tmp_path):
    """EPSG:32632, whose lengths are not metres by parts in ten thousand, and whose north is not north."""
    pytest.importorskip("pyproj")
    from stages.posing.coordinates import to_grid

    cube = 100.0 * np.array([[i, j, k] for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)])
    grid = to_grid(from_east_north_up(cube, ORIGIN), "EPSG:32632")
    for name, place in (("enu", ON_EARTH), ("grid", ON_EARTH.in_grid("EPSG:32632", cube, grid))):
        (tmp_path / name).mkdir()
        _, found = exported(tmp_path / name, place)
        matrix = np.reshape(found["root"]["transform"], (4, 4)).T
        if name == "enu":
            expected = corners_of(found["root"], matrix).mean(0)
    assert np.linalg.norm(corners_of(found["root"], matrix).mean(0) - expected) < 0.05  # boxes about turned corners
    assert np.linalg.norm(matrix[:3, 3]) > 6.3e6


@pytest.mark.slow
def test_levels_state_what_they_miss_of_the_model(tmp_path):
    folder, found = exported(tmp_path, ON_EARTH, lods=2)
    tiles = chain(found["root"])
    assert [tile["content"]["uri"] for tile in tiles] == ["model_lod2.glb", "model_lod1.glb", "model.glb"]
    # a tetrahedron cannot lose a face
    assert all(tile["geometricError"] < 1e-5 for tile in tiles)
    assert all((folder / tile["content"]["uri"]).exists() for tile in tiles)
    assert tileset_issues([folder / artifacts.TILESET]) == []


@pytest.mark.slow
def test_without_a_place_tiles_are_those_of_a_local_frame(tmp_path):
    folder, found = exported(tmp_path, Place(Similarity.identity()))
    assert "transform" not in found["root"]
    assert found["asset"]["extras"]["units"] == "arbitrary units"
    assert tileset_issues([folder / artifacts.TILESET]) == []


@pytest.mark.slow
def test_several_tilesets_under_one_root(tmp_path):
    files = {}
    for k, name in enumerate(("a", "b")):
        (tmp_path / name).mkdir()
        there = Similarity(1.0, rotation_about(UP, 0.3 * k), np.array([40.0 * k, 0, 0]))
        _, files[f"{name}/out/{artifacts.TILESET}"] = exported(
            tmp_path / name, replace(ON_EARTH, world_from_poses=there), lods=1
        )
    together = joined(files)
    path = tmp_path / "tileset.json"
    artifacts.write_json(path, together)
    root = together["root"]
    assert "transform" not in root  # theirs lead to the Earth's centre already
    assert [child["content"]["uri"] for child in root["children"]] == list(files)
    around = corners_of(root, np.eye(4))
    middle, axes = around.mean(0), np.reshape(root["boundingVolume"]["box"][3:], (3, 3))
    for child, (uri, found) in zip(root["children"], files.items(), strict=True):
        matrix = np.reshape(found["root"]["transform"], (4, 4)).T
        inside = corners_of(found["root"], matrix)
        np.testing.assert_allclose(
            np.sort(corners_of(child, np.eye(4)), axis=0), np.sort(inside, axis=0), atol=1e-6, err_msg=uri
        )
        along = (inside - middle) @ np.linalg.inv(axes)
        assert np.abs(along).max() < 1 + 1e-9
        assert child["geometricError"] == found["geometricError"] <= root["geometricError"]
    assert 40 < 2 * np.linalg.norm(axes, axis=1).max() < 50  # two models of some metres, 40 m apart, and no more
    assert tileset_issues([path]) == []


@pytest.mark.slow
def test_the_validator_sees_wrong_tiles(tmp_path):
    folder, found = exported(tmp_path, ON_EARTH, lods=1)
    found["root"]["children"][0]["geometricError"] = 5.0
    found["root"]["children"][0]["content"]["uri"] = "elsewhere.glb"
    artifacts.write_json(folder / artifacts.TILESET, found)
    assert {issue.split(":")[0] for issue in tileset_issues([folder / artifacts.TILESET])} >= {
        "TILE_GEOMETRIC_ERRORS_INCONSISTENT"
    }


def test_what_cannot_be_joined_is_named():
    here, there = tileset([Level("a.glb", BOUNDS, 0.0)]), tileset([Level("b.glb", BOUNDS, 0.0)], np.eye(4))
    with pytest.raises(ValueError, match=r"1 of 2 tilesets say where on Earth they lie, a/t\.json does not"):
        joined({"a/t.json": here, "b/t.json": there})
    with pytest.raises(ValueError, match="none"):
        joined({})
    for broken in (
        {},
        [],
        {**here, "root": {}},
        {**here, "root": []},
        {**here, "geometricError": "much"},
        {**here, "root": {**here["root"], "transform": [1.0] * 15}},
        {**here, "root": {"boundingVolume": {"box": [float("nan")] * 12}}},
    ):
        with pytest.raises(ValueError, match=r"c\.json is no tileset"):
            joined({"c.json": broken})


# ---------------------------------------------------------------- the command
def with_tiles(root: Path, matrix: np.ndarray | None, name: str = artifacts.TILESET) -> Path:
    """A workspace in which nothing but export is published."""

    def run(context: StageContext) -> dict:
        artifacts.write_json(context.out / name, tileset([Level("model.glb", BOUNDS, 0.0)], matrix))
        return {}

    alone = replace(EXPORT, reads=(), reads_manifests=(), run=run)
    run_pipeline([alone], Workspace.open(root, create=True), Config(), {})
    return root


def test_the_command_joins_workspaces(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("a", "b 2"):
        with_tiles(tmp_path / name, np.eye(4))
    done = CliRunner().invoke(app, ["tileset", "a", "b 2", "--out", "all/tiles.json", "--json"])
    assert done.exit_code == 0, done.output
    assert json.loads(done.stdout)["tiles"] == 2
    made = json.loads((tmp_path / "all" / "tiles.json").read_text())
    uris = [child["content"]["uri"] for child in made["root"]["children"]]
    assert uris == ["../a/export/tileset.json", "../b%202/export/tileset.json"]


def test_a_scene_in_blocks_has_a_tileset_over_all_of_them(tmp_path, monkeypatch):
    from stages import tilesets

    for name in ("b00", "b01"):
        with_tiles(tmp_path / "whole" / "blocks" / name, None)
    blocks = [SimpleNamespace(name=name) for name in ("b00", "b01")]
    monkeypatch.setattr(tilesets, "read_plan", lambda root: SimpleNamespace(blocks=blocks))
    told = tilesets.join_tilesets([tmp_path / "whole"], tmp_path / "whole" / "tileset.json")
    assert told["tiles"] == 2
    made = json.loads((tmp_path / "whole" / "tileset.json").read_text())
    uris = [child["content"]["uri"] for child in made["root"]["children"]]
    assert uris == ["blocks/b00/export/tileset.json", "blocks/b01/export/tileset.json"]


def test_what_the_command_cannot_join_is_told(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with_tiles(tmp_path / "a", np.eye(4))
    with_tiles(tmp_path / "b", None)
    with_tiles(tmp_path / "c", None, "model.json")
    for words, told in (
        (["a", "b"], "b/export/tileset.json does not"),
        (["c"], "--set export.tiles=true"),
        (["a", "--out", "a/export/tileset.json"], "is the tileset of"),
    ):
        done = CliRunner().invoke(app, ["tileset", *words])
        assert done.exit_code != 0
        assert told in " ".join(done.stderr.split()), done.stderr
    assert not (tmp_path / "tileset.json").exists()
