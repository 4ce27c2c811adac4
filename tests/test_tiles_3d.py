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
from stages import artifacts, tilesets
from stages.artifacts import AtlasMesh
from stages.engine.runner import run_pipeline
from stages.engine.stage import StageContext
from stages.engine.workspace import Workspace
from stages.export import EXPORT
from stages.files.glb import read_glb
from stages.files.tiles_3d import TILE_FROM_GLTF, Level, Overview, joined, roots, tileset
from stages.geometry.earth import earth_centred, from_east_north_up
from stages.geometry.place import Place
from stages.geometry.similarity import Similarity
from stages.surface.levels_of_detail import deviation
from stages.tilesets import join_tilesets

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


def far_east(count: int) -> dict[str, dict]:
    """Tilesets in a row, each with a coarsest level that misses 0.1 m, on the Earth; the third is turned, too."""
    levels = [Level("model.glb", BOUNDS, 0.0), Level("model_lod1.glb", BOUNDS, 0.1)]
    matrices = [np.eye(4) for _ in range(count)]
    for k, matrix in enumerate(matrices):
        matrix[:3, :3] = rotation_about(np.array([1.0, 2, 3]), 0.7) @ rotation_about(UP, 0.2 * (k == 2))
        matrix[:3, 3] = 4e6 + 10.0 * k, 3e6, 4e6
    return {f"{k}/tileset.json": tileset(levels, matrix) for k, matrix in enumerate(matrices)}


def tiles_in_place(tile: dict, matrix: np.ndarray) -> list[tuple[dict, np.ndarray]]:
    """A tile and all below, each with its transform to the root's frame."""
    here = matrix @ np.reshape(tile.get("transform", np.eye(4).ravel()), (4, 4)).T
    return [(tile, here), *(found for child in tile.get("children", []) for found in tiles_in_place(child, here))]


def test_overviews_are_replaced_by_what_they_stand_for_where_that_lies():
    files = far_east(3)
    pair = Overview(Level("far/0.glb", np.add(BOUNDS, (3, 0, 0)), 0.5), tuple(list(files)[:2]))
    whole = joined(Overview(Level("far/1.glb", 2 * BOUNDS, 0.8), (pair, list(files)[2])), roots(files))
    tiles = tiles_in_place(whole["root"], np.eye(4))
    assert [tile["content"]["uri"] for tile, _ in tiles] == ["far/1.glb", "far/0.glb", *files]
    assert [tile["geometricError"] for tile, _ in tiles] == [0.8, 0.5, 0.1, 0.1, 0.1]
    assert whole["root"]["refine"] == whole["root"]["children"][0]["refine"] == "REPLACE"
    np.testing.assert_allclose(whole["root"]["transform"], files["0/tileset.json"]["root"]["transform"])
    outer = corners_of(whole["root"], np.eye(4))
    for tile, matrix in tiles:  # all lie within the root's box
        corners = corners_of(tile, np.linalg.inv(tiles[0][1]) @ matrix)
        np.testing.assert_array_less(outer.min(0) - 1e-6, corners.min(0))
        np.testing.assert_array_less(corners.max(0), outer.max(0) + 1e-6)
    for (tile, matrix), (uri, found) in zip([tiles[2], tiles[3], tiles[4]], files.items(), strict=True):
        own = np.reshape(found["root"]["transform"], (4, 4)).T
        np.testing.assert_allclose(matrix @ own, own, atol=1e-6, err_msg=uri)  # each lies where it did
        np.testing.assert_allclose(corners_of(tile, matrix), corners_of(found["root"], own), atol=1e-6)
    assert whole["geometricError"] > 20  # of drawing nothing


def test_a_coarser_overview_never_claims_to_be_the_better_one():
    files = far_east(1)
    whole = joined(Overview(Level("0.glb", BOUNDS, 0.02), tuple(files)), roots(files))
    assert whole["root"]["geometricError"] == 0.1


@pytest.mark.slow
def test_several_workspaces_under_one_model(tmp_path):
    """Ten models in two rows: overviews of quarters below one of all."""
    for k in range(10):
        there = Similarity(1.0, rotation_about(UP, 0.3 * k), np.array([8.0 * (k // 2), 8.0 * (k % 2), 0]))
        with_model(tmp_path / f"w{k}", replace(ON_EARTH, world_from_poses=there))
    told = join_tilesets([tmp_path / f"w{k}" for k in range(10)], tmp_path / "all" / "city.json")
    assert (told["tiles"], told["overviews"]) == (10, 5)
    whole = json.loads((tmp_path / "all" / "city.json").read_text())
    tiles = tiles_in_place(whole["root"], np.eye(4))
    contents = [tile["content"]["uri"] for tile, _ in tiles]
    assert contents[0] == "city_overviews/4.glb"
    assert sum(uri.startswith("city_overviews/") for uri in contents) == 5
    sizes = [(tmp_path / "all" / uri).stat().st_size for uri in contents if uri.startswith("city_overviews/")]
    assert told["bytes"] == {"first": sizes[0], "overviews": sum(sizes)}
    for tile, _ in tiles:
        assert all(tile["geometricError"] > child["geometricError"] for child in tile.get("children", []))
    assert tileset_issues([tmp_path / "all" / "city.json"]) == []
    # the model of all has the corners of each where it lies on the Earth
    mesh, _ = read_glb((tmp_path / "all" / contents[0]).read_bytes())
    matrix = tiles[0][1]
    far = mesh.vertices.astype(np.float64) @ TILE_FROM_GLTF.T @ matrix[:3, :3].T + matrix[:3, 3]
    for k in range(10):
        there = Similarity(1.0, rotation_about(UP, 0.3 * k), np.array([8.0 * (k // 2), 8.0 * (k % 2), 0]))
        corners = earth_centred(from_east_north_up(there.compose(WORLD).apply(CORNERS), ORIGIN))
        assert np.linalg.norm(corners[:, None] - far[None], axis=2).min(1).max() < 1e-2
    (tmp_path / "all" / "city_overviews" / "7.glb").write_bytes(b"of more workspaces")
    assert join_tilesets([tmp_path / "w0"], tmp_path / "all" / "city.json")["overviews"] == 1
    assert [path.name for path in (tmp_path / "all" / "city_overviews").iterdir()] == ["0.glb"]


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
        roots({"a/t.json": here, "b/t.json": there})
    with pytest.raises(ValueError, match="none"):
        roots({})
    for broken in (
        {},
        [],
        {**here, "root": {}},
        {**here, "root": []},
        {**here, "root": {**here["root"], "geometricError": "much"}},
        {**here, "root": {**here["root"], "content": {}}},
        {**here, "root": {**here["root"], "transform": [1.0] * 15}},
        {**here, "root": {**here["root"], "boundingVolume": {"box": [float("nan")] * 12}}},
    ):
        with pytest.raises(ValueError, match=r"c\.json is no tileset"):
            roots({"c.json": broken})


# ---------------------------------------------------------------- the command
def with_model(root: Path, place: Place, name: str = artifacts.TILESET) -> Path:
    """A workspace in which nothing but export is published: a tetrahedron, its tileset under this name."""

    def run(context: StageContext) -> dict:
        source = workspace(context.scratch, ExportParams(formats=(), tiles=True, heights="ellipsoid"))
        artifacts.WORLD_PLACE.save(source.inputs["place"], place)
        numbers = EXPORT.run(replace(source, out=context.out))
        (context.out / artifacts.TILESET).rename(context.out / name)
        return numbers

    alone = replace(EXPORT, reads=(), reads_manifests=(), run=run)
    run_pipeline([alone], Workspace.open(root, create=True), Config(), {})
    return root


NOWHERE = Place(Similarity.identity())


def children_of(file: Path) -> list[str]:
    return [child["content"]["uri"] for child in json.loads(file.read_text())["root"]["children"]]


@pytest.mark.slow
def test_the_command_joins_workspaces(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("a", "b 2"):
        with_model(tmp_path / name, ON_EARTH)
    done = CliRunner().invoke(app, ["tileset", "a", "b 2", "--out", "all/tiles.json", "--json"])
    assert done.exit_code == 0, done.output
    assert json.loads(done.stdout)["tiles"] == 2
    uris = ["../a/export/tileset.json", "../b%202/export/tileset.json"]
    assert children_of(tmp_path / "all" / "tiles.json") == uris


@pytest.mark.slow
def test_a_scene_in_blocks_has_a_tileset_over_all_of_them(tmp_path, monkeypatch):
    for name in ("b00", "b01"):
        with_model(tmp_path / "whole" / "blocks" / name, NOWHERE)
    blocks = [SimpleNamespace(name=name) for name in ("b00", "b01")]
    monkeypatch.setattr(tilesets, "read_plan", lambda root: SimpleNamespace(blocks=blocks))
    told = join_tilesets([tmp_path / "whole"], tmp_path / "whole" / "tileset.json")
    assert told["tiles"] == 2
    uris = ["blocks/b00/export/tileset.json", "blocks/b01/export/tileset.json"]
    assert children_of(tmp_path / "whole" / "tileset.json") == uris
    assert tileset_issues([tmp_path / "whole" / "tileset.json"]) == []


@pytest.mark.slow
def test_what_the_command_cannot_join_is_told(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with_model(tmp_path / "a", ON_EARTH)
    with_model(tmp_path / "b", NOWHERE)
    with_model(tmp_path / "c", NOWHERE, "model.json")
    damaged = with_model(tmp_path / "d", NOWHERE) / "export" / "model.glb"
    damaged.write_bytes(damaged.read_bytes()[:-100])
    for words, told in (
        (["a", "b"], "b/export/tileset.json does not"),
        (["c"], "--set export.tiles=true"),
        (["d"], "model.glb"),
        (["a", "--out", "a/export/tileset.json"], "is the tileset of"),
    ):
        done = CliRunner().invoke(app, ["tileset", *words])
        assert done.exit_code != 0
        assert told in " ".join(done.stderr.split()), done.stderr
    assert not (tmp_path / "tileset.json").exists()
