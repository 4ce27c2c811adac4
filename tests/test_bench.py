"""`hineus bench`: scenes run to the undistorted photos, training stood in for by the ball itself; peers; tables."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from PIL import Image
from sphere_scene import RADIUS, render, ring_of_cameras, sphere_scene
from suite_layouts import COUNT, LAYOUTS, cameras, write_suite
from typer.testing import CliRunner, Result

from hineus_cli.app import build_app
from stages import artifacts, reconstruct
from stages.engine.stage import Stage, StageContext
from stages.engine.workspace import Workspace
from stages.errors import ConfigError, InputError, ReconstructionError
from stages.evaluation.peers.running import parse_peer, run_peer
from stages.evaluation.photos import scoring
from stages.evaluation.photos.novel_views import NovelPhotos
from stages.evaluation.reading import read_mesh
from stages.evaluation.suites import runs as bench_module
from stages.evaluation.suites.registry import SUITES, find_scenes
from stages.evaluation.suites.runs import load_results
from stages.evaluation.suites.scene import Wanted
from stages.evaluation.suites.scores import Part, posed_mesh, result_mesh
from stages.evaluation.suites.tables import score_table, tables_of
from stages.geometry.cameras import PinholeCameras
from stages.geometry.place import Place
from stages.geometry.similarity import Similarity
from stages.ingest import INGEST
from stages.neural.drawing import FieldDrawing
from stages.place import PLACE
from stages.sfm import SFM
from stages.undistort import UNDISTORT


def clean_ball(context: StageContext) -> dict[str, Any]:
    """The cleanup stage's stand-in: the true ball, in the scene frame."""
    scene = context.read(artifacts.SCENE)
    ball = trimesh.creation.icosphere(4, RADIUS)
    vertices = scene.poses_from_scene.inverse().apply(np.asarray(ball.vertices))
    context.write(artifacts.CLEAN_MESH, (vertices, np.asarray(ball.faces)))
    return {"seed": context.params.seed}


def posed(context: StageContext) -> dict[str, Any]:
    """The sfm stage, with the true cameras where it would have to find them: no photo this small has features."""
    if "poses" in context.sources:
        return SFM.run(context)
    truth = context.inputs["ingest"].parents[4] / "data" / "ball" / "transforms.json"
    return SFM.run(replace(context, sources={"poses": truth}, workers=1))


def untrained(context: StageContext) -> dict[str, Any]:
    """The train stage's stand-in."""
    context.write(artifacts.SCENE, context.read(artifacts.FIRST_SCENE))
    return {}


PIPELINE = (
    INGEST,
    replace(SFM, run=posed),
    PLACE,
    UNDISTORT,
    Stage("train", 1, lambda config: config.train, untrained, (artifacts.FIRST_SCENE,), (artifacts.SCENE,)),
    Stage("cleanup", 1, lambda config: config.train, clean_ball, (artifacts.SCENE,), (artifacts.CLEAN_MESH,)),
)


@pytest.fixture
def data(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(reconstruct, "has_cuda", lambda: False)
    (tmp_path / "data").mkdir()
    return tmp_path / "data"


def hineus_bench(*arguments: str, pipeline: Sequence[Stage] = PIPELINE) -> Result:
    return CliRunner().invoke(build_app(pipeline), ["bench", *arguments, "--preset", "tiny", "--workers", "1"])


def results_of(*arguments: str, pipeline: Sequence[Stage] = PIPELINE) -> list[dict[str, Any]]:
    result = hineus_bench(*arguments, "--json", pipeline=pipeline)
    assert result.exit_code == 0, result.output
    return list(json.loads(result.stdout)["results"])


# ---------------------------------------------------------------- runs
@pytest.mark.parametrize("suite", LAYOUTS)
def test_a_scene_of_every_suite_comes_to_its_undistorted_photos_without_its_tests(data: Path, suite: str):
    write_suite(suite, data)
    (result,) = results_of(suite, str(data), "--until", "undistort")
    assert result["suite"] == suite
    scene = find_scenes(SUITES[suite], data, Wanted())[0]
    tests = 0 if scene.views is None else len(scene.views.names)
    assert result["photos"] == COUNT - tests
    place = Path("bench") / suite / scene.name / "tiny-seed0"
    posed_scene = artifacts.FIRST_SCENE.load(place / "undistort")
    true = cameras()
    for i, name in enumerate(posed_scene.cameras.names):
        number = int("".join(filter(str.isdigit, Path(name).stem)))
        in_poses = posed_scene.poses_from_scene.apply(posed_scene.cameras.centers[i])
        np.testing.assert_allclose(in_poses, true.centers[number], atol=1e-5)
    if suite == "nerf-synthetic":  # alpha is the mask
        assert artifacts.Pictures(place / "undistort").mask(posed_scene.cameras.names[0]) is not None


def test_one_json_a_run_with_settings_costs_and_scores(data: Path):
    write_suite("blendedmvs", data)
    (result,) = results_of("blendedmvs", str(data), "--set", "undistort.max_side=64", "--seeds", "1")
    file = Path("bench/blendedmvs/5bfe5ae0fe0ea555e6a969ca/tiny-seed0.json")
    assert json.loads(file.read_text()) == result
    assert (result["method"], result["preset"], result["seed"]) == ("hineus", "tiny", 0)
    assert result["settings"]["undistort.max_side"] == 64
    assert result["settings"]["train.steps"] == 500
    assert "train.hold_out" not in result["settings"]
    assert [stage["name"] for stage in result["stages"]] == ["ingest", "sfm", "place", "undistort", "train", "cleanup"]
    assert result["wall_s"] > 0
    learned = sum(stage["wall_s"] for stage in result["stages"][-2:])
    assert result["wall_after_poses_s"] == pytest.approx(learned, abs=0.02)
    assert result["peak_rss"] > 1 << 20
    assert result["machine"]["python"] == sys.version.split()[0]
    # the ball itself lies on the truth's points, which are few: photos are small
    scores = result["scores"]["mesh"]
    assert scores["completeness"]["mean"] < 0.002 * scores["extent"]
    assert scores["chamfer_percent"] < 2


def test_a_second_call_runs_nothing_and_scores_nothing(data: Path, monkeypatch: pytest.MonkeyPatch):
    write_suite("known", data)
    first = results_of("known", str(data))
    assert first[0]["scores"]["mesh"]["mean"] < 1

    def never(*arguments: object) -> None:
        raise AssertionError("it was scored again")

    monkeypatch.setattr(bench_module, "score_result", never)
    assert results_of("known", str(data)) == first


def test_seeds_share_the_poses(data: Path):
    write_suite("dtu", data)
    results = results_of("dtu", str(data), "--seeds", "2")
    assert [result["seed"] for result in results] == [0, 1]
    assert results[0]["made_from"]["sfm"] == results[1]["made_from"]["sfm"]
    assert results[0]["made_from"]["cleanup"] != results[1]["made_from"]["cleanup"]
    assert results[1]["settings"]["train.seed"] == 1
    made = [
        json.loads((Path("bench/dtu/24") / f"tiny-seed{seed}/sfm/manifest.json").read_text())["created"]
        for seed in (0, 1)
    ]
    assert made[0] == made[1]


def test_what_cannot_be_scored_is_said_and_the_rest_is_kept(data: Path):
    write_suite("dtu", data)
    result = hineus_bench("dtu", str(data))
    assert result.exit_code == 0
    assert "24: no distance: DTU's evaluation data (ObsMask/ObsMask24_10.mat" in result.stderr
    assert "Neuralangelo" in result.stdout
    (kept,) = load_results(Path("bench"))
    assert kept["scores"] == {}
    assert len(kept["lacking"]) == 2


def test_truth_that_comes_later_is_scored_by(data: Path):
    place = write_suite("glossy-synthetic", data)
    (place / "3-depth.png").rename(data / "kept.png")
    (before,) = results_of("glossy-synthetic", str(data))
    assert before["scores"] == {}
    (data / "kept.png").rename(place / "3-depth.png")
    (after,) = results_of("glossy-synthetic", str(data))
    assert after["scores"]["mesh"]["chamfer"] < 0.02


def test_a_scene_that_fails_does_not_stop_the_others(data: Path):
    write_suite("glossy-synthetic", data)
    (data / "angel").mkdir()
    (data / "angel" / "0-camera.pkl").write_bytes(b"nothing")
    result = hineus_bench("glossy-synthetic", str(data), "--json")
    assert result.exit_code == InputError.exit_code
    answer = json.loads(result.stdout)
    assert answer["ok"] is False
    assert [each["scene"] for each in answer["results"]] == ["angel", "bell"]
    assert "cannot be read" in answer["results"][0]["error"]["message"]
    assert "error" not in answer["results"][1]
    assert [kept["scene"] for kept in load_results(Path("bench"))] == ["bell"]


def test_a_mesh_is_scored_in_the_frame_of_its_poses_whatever_gps_made_of_the_world(tmp_path: Path):
    moved = Place(Similarity(2.0, np.eye(3), np.array([10.0, 0, 0])), metric=True, scale_from="GPS")
    scene = sphere_scene(ring_of_cameras())
    workspace = Workspace.open(tmp_path / "workspace", create=True)
    for name in ("place", "train", "cleanup"):
        workspace.stage_folder(name).mkdir(parents=True)
    artifacts.WORLD_PLACE.save(workspace.stage_folder("place"), moved)
    artifacts.SCENE.save(workspace.stage_folder("train"), scene)
    corners = np.eye(3)
    artifacts.CLEAN_MESH.save(workspace.stage_folder("cleanup"), (corners, np.array([[0, 1, 2]])))
    world = scene.world_from_scene(moved).apply(corners)
    ours = result_mesh([Part(workspace, Similarity.identity())], {"cleanup"}, tmp_path / "ours.ply")
    assert ours is not None
    np.testing.assert_allclose(read_mesh(ours)[0], (world - [10, 0, 0]) / 2, atol=1e-5)
    trimesh.Trimesh(world, [[0, 1, 2]], process=False).export(tmp_path / "theirs.ply")
    theirs = posed_mesh(workspace, tmp_path / "theirs.ply", tmp_path / "moved.ply")
    np.testing.assert_allclose(read_mesh(theirs)[0], (world - [10, 0, 0]) / 2, atol=1e-5)
    assert result_mesh([Part(workspace, Similarity.identity())], {"undistort"}, tmp_path / "none.ply") is None


def test_peers_are_not_for_scenes_in_blocks(data: Path):
    write_suite("known", data)
    result = hineus_bench("known", str(data), "--blocks", "2", "--peer", "poisson")
    assert result.exit_code == ConfigError.exit_code
    assert "`--peer` does not go with `--blocks`" in result.stderr


def test_a_block_that_fails_is_in_the_result_of_the_scene(data: Path):
    write_suite("urbanscene3d", data)
    result = hineus_bench("urbanscene3d", str(data), "--blocks", "2", "--until", "train", "--json")
    (told,) = json.loads(result.stdout)["results"]
    assert "`--until` does not go with `--blocks`" in told["error"]["message"]
    assert told["asked"]["blocks"] == "2"
    assert not (Path("bench") / "urbanscene3d" / "residence-pixsfm" / "tiny-seed0").exists()


def test_results_do_not_go_among_the_data(data: Path):
    write_suite("known", data)
    result = hineus_bench("known", str(data), "--out", str(data))
    assert result.exit_code == InputError.exit_code
    assert "Results would lie among the data" in result.stderr


# ---------------------------------------------------------------- test photos
@pytest.mark.parametrize("suite", ["dtu", "nerf-synthetic", "mipnerf360", "urbanscene3d"])
def test_test_photos_show_the_ball_where_the_scene_has_it(data: Path, suite: str):
    write_suite(suite, data)
    results_of(suite, str(data), "--until", "undistort", "--hold-out", "4")
    scene = find_scenes(SUITES[suite], data, Wanted(hold_out=4))[0]
    assert scene.views is not None
    workspace = Workspace.open(Path("bench") / suite / scene.name / "tiny-seed0")
    trained = artifacts.FIRST_SCENE.load(workspace.stage_folder("undistort"))
    photos = NovelPhotos(scene.views, trained)
    assert photos.cameras.names == scene.views.names
    apart = np.linalg.norm(photos.cameras.centers[:, None] - trained.cameras.centers[None], axis=2)
    assert apart.min() > 0.1
    poses_from_scene = trained.poses_from_scene
    for index in range(len(photos.cameras)):
        pixels, mask = photos.load(index)
        height, width = pixels.shape[:2]
        assert (width, height) == tuple(photos.cameras.sizes[index])
        center, _ = photos.cameras.project(index, poses_from_scene.inverse().apply(np.zeros((1, 3))))
        np.testing.assert_allclose(center[0], [width / 2, height / 2], atol=0.05)
        ball = np.abs(pixels.astype(int) - pixels[0, 0]).max(2) > 20
        y, x = np.nonzero(ball)
        np.testing.assert_allclose([x.mean() + 0.5, y.mean() + 0.5], center[0], atol=2)
        if suite == "nerf-synthetic":
            assert (pixels[0, 0] == 255).all()
            assert mask is not None
            assert not mask[0, 0]
            assert mask[height // 2, width // 2]
        else:
            assert mask is None


@pytest.mark.parametrize("suite", ["dtu", "glossy-synthetic", "known"])
def test_test_photos_have_the_masks_that_the_scene_is_run_with(data: Path, suite: str):
    write_suite(suite, data)
    (result,) = results_of(suite, str(data), "--until", "undistort", "--hold-out", "4", "--masks")
    scene = find_scenes(SUITES[suite], data, Wanted(masks=True, hold_out=4))[0]
    assert scene.views is not None
    workspace = Workspace.open(Path("bench") / suite / scene.name / "tiny-seed0")
    posed_scene = artifacts.FIRST_SCENE.load(workspace.stage_folder("undistort"))
    assert result["settings"]["undistort.masks"] == "alone"
    photos = NovelPhotos(scene.views, posed_scene, scene.masks)
    poses_from_scene = posed_scene.poses_from_scene
    for index in range(len(photos.cameras)):
        pixels, mask = photos.load(index)
        assert mask is not None
        assert mask.shape == pixels.shape[:2]
        center, _ = photos.cameras.project(index, poses_from_scene.inverse().apply(np.zeros((1, 3))))
        y, x = np.nonzero(mask)
        np.testing.assert_allclose([x.mean() + 0.5, y.mean() + 0.5], center[0], atol=1)


class GreyBall:
    """Draws a grey ball as a field without a background does: black where nothing is."""

    def draw(self, _: PinholeCameras, index: int) -> FieldDrawing:
        covered = render(cameras(), 6 + index)[1] > 0  # the tests are the last two
        colors = np.where(covered[..., None], 100, 0).astype(np.uint8).repeat(3, 2)[..., :3]
        return FieldDrawing(colors, covered.astype(np.float32), covered, background=False)


@pytest.mark.slow
def test_views_of_nerf_synthetic_are_whole_photos_on_white(data: Path, monkeypatch: pytest.MonkeyPatch):
    write_suite("nerf-synthetic", data)
    monkeypatch.setattr(scoring, "field_drawer", lambda workspace, device: GreyBall())

    def no_training(context: StageContext) -> dict[str, Any]:
        context.to_write(artifacts.FIELD).write_text("")
        return untrained(context)

    writes = artifacts.FIELD, artifacts.SCENE
    train = Stage("train", 1, lambda config: config.train, no_training, (artifacts.FIRST_SCENE,), writes)
    (result,) = results_of("nerf-synthetic", str(data), pipeline=(*PIPELINE[:4], train))
    views = result["scores"]["views"]
    assert (views["counted"], set(views["mean"])) == (2, {"field"})
    scene = find_scenes(SUITES["nerf-synthetic"], data, Wanted())[0]
    assert scene.views is not None
    with Image.open(scene.views.folder / "r_0.png") as stored:
        rgba = np.asarray(stored).astype(float)
    alpha = rgba[..., 3:] / 255
    truth = rgba[..., :3] * alpha + 255 * (1 - alpha)
    error = ((truth - np.where(alpha > 0.5, 100, 255)) / 255) ** 2
    expected = -10 * np.log10(error.mean())
    assert views["photos"][0]["field"]["whole"]["psnr"] == pytest.approx(expected, abs=0.5)


# ---------------------------------------------------------------- peers
COPY = "import shutil, sys; shutil.copy(sys.argv[1], sys.argv[2])"


@pytest.mark.slow
def test_a_peer_s_mesh_is_scored_by_the_same_protocol_in_the_same_run(data: Path):
    truth = write_suite("known", data) / "gt_mesh.ply"
    peer = f'{sys.executable} -c "{COPY}" {truth} {{out}}'
    ours, theirs = results_of("known", str(data), "--peer", f"perfect={peer}")
    assert theirs["method"] == "perfect"
    assert theirs["photos"] == ours["photos"] == COUNT
    assert theirs["scores"]["mesh"]["mean"] == pytest.approx(ours["scores"]["mesh"]["mean"], abs=0.2)
    assert theirs["wall_s"] > 0
    given = Path("bench/known/ball/peers/tiny-photos")
    assert len(list((given / "images").iterdir())) == COUNT
    assert (given / "sparse" / "cameras.bin").is_file()


def test_a_peer_gets_photos_model_and_masks_and_is_timed(tmp_path: Path):
    look = "import sys, pathlib; pathlib.Path(sys.argv[-1]).write_text(' '.join(sys.argv[1:-1]))"
    peer = parse_peer(f'look={sys.executable} -c "{look}" {{photos}} {{model}} {{masks}} {{out}}')
    used = run_peer(peer, tmp_path / "given with a space", tmp_path / "look")
    expected = [str(tmp_path / "given with a space" / name) for name in ("images", "sparse", "masks")]
    assert (tmp_path / "look" / "mesh.ply").read_text() == " ".join(expected)
    assert used["cpu_s"] > 0
    assert used["peak_rss"] > 1 << 20


@pytest.mark.parametrize(
    ("command", "sentence"),
    [
        (
            "import sys; print('no memory for', sys.argv[-1][:0] + 'this'); sys.exit(3)",
            "ended with 3: no memory for this",
        ),
        ("pass", "wrote no mesh.ply: it said nothing"),
    ],
)
def test_a_peer_that_fails_is_told_with_its_last_words(tmp_path: Path, command: str, sentence: str):
    peer = parse_peer(f'bad={sys.executable} -c "{command}" {{out}}')
    with pytest.raises(ReconstructionError, match=f"Peer bad {sentence}"):
        run_peer(peer, tmp_path, tmp_path / "bad")


def test_a_program_that_is_not_there(tmp_path: Path):
    with pytest.raises(ReconstructionError, match="Peer none could not be started: /no/such/program"):
        run_peer(parse_peer("none=/no/such/program {out}"), tmp_path, tmp_path / "none")


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("poison", "There is no built-in peer 'poison'"),
        ("mine=run.sh {photos}", "is not of the form NAME=COMMAND"),
        ("a/b=run.sh {out}", "is not of the form NAME=COMMAND"),
        ("mine=run.sh '{out}", "No closing quotation"),
    ],
)
def test_peers_that_make_no_sense(text: str, sentence: str):
    with pytest.raises(ConfigError, match=sentence):
        parse_peer(text)


# ---------------------------------------------------------------- tables
def run_result(scene: str, seed: int, score: float, method: str = "hineus") -> dict[str, Any]:
    return {
        "suite": "dtu", "scene": scene, "method": method, "preset": "cpu", "seed": seed, "masks": False, "asked": {},
        "scores": {"mesh": {"overall": score}}, "wall_s": 90.0, "cpu_s": 60.0, "peak_rss": 1 << 30,
    }  # fmt: skip


def test_our_scores_stand_beside_the_paper_s_over_the_same_scenes():
    results = [
        run_result("37", 0, 1.0), run_result("24", 0, 0.5), run_result("24", 1, 0.7), run_result("37", 0, 9.0, "mvs"),
    ]  # fmt: skip
    table = score_table(SUITES["dtu"], results)
    assert table.header == ("method", "24", "37", "average")
    rows = {row[0]: row[1:] for row in table.rows}
    assert rows["NeuS"] == ("1.00", "1.37", "1.19")
    assert rows["ours (cpu)"] == ("0.60 (0.50 to 0.70)", "1.00", "0.80")
    assert rows["peer: mvs"] == ("-", "9.00", "-")
    assert [row[0] for row in table.rows][-2:] == ["peer: mvs", "ours (cpu)"]


def test_an_average_that_the_paper_prints_otherwise_is_said_where_all_its_scenes_are_shown():
    scenes = ["24", "37", "40", "55", "63", "65", "69", "83", "97", "105", "106", "110", "114", "118", "122"]
    table = score_table(SUITES["dtu"], [run_result(scene, 0, 0.5) for scene in reversed(scenes)])
    assert table.header[1:-1] == tuple(scenes)
    rows = {row[0]: row[-1] for row in table.rows}
    assert rows["NeuS2"] == "0.69 (printed: 0.70)"
    assert rows["NeuS"] == "0.84"


def test_runs_that_failed_are_in_no_table():
    tables = tables_of(SUITES["dtu"], [{**run_result("24", 0, 0.5), "error": {}}, run_result("37", 0, 0.5)])
    assert [table.title for table in tables] == ["DTU: Chamfer distance, mm", "DTU: time and memory"]
    assert tables[0].header == ("method", "37", "average")
    assert [row[0] for row in tables[1].rows] == ["37"]
