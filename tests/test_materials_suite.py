"""The suite of materials: its lights, its scores, how it reads a model; with Mitsuba, the truth judged by itself."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.materials import held_out, lights, scenes, scoring, tables
from benchmarks.materials.glb_model import linear, read_finished, z_up_light
from benchmarks.materials.held_out import Y_UP, Views, write_held_out, y_up_map, z_up_map
from benchmarks.materials.true_model import write_true_model
from benchmarks.synthetic.model import Part, Principled, Scene, plain
from stages.artifacts import write_json
from stages.errors import InputError
from stages.light import environment
from stages.light.srgb import coded
from stages.scenes.room import sphere_directions
from stages.scenes.viewpoints import viewpoint

GREEN, GOLD = Principled(0.3, 0.0), Principled(0.4, 1.0)
COLORS = ((0.1, 0.5, 0.2), (0.9, 0.7, 0.3))


def _balls() -> tuple[Part, ...]:
    """Two balls, one of plastic and one of gold."""
    from trimesh.creation import icosphere

    ball = icosphere(subdivisions=4, radius=0.25)
    points, faces = np.asarray(ball.vertices), np.asarray(ball.faces)
    middles = np.array([[-0.25, 0, 0.25], [0.25, 0, 0.25]])
    return tuple(
        Part(points + middle, faces, finish, plain(*color), points / 0.25)
        for middle, finish, color in zip(middles, (GREEN, GOLD), COLORS, strict=True)
    )


def _scene() -> Scene:
    sky = lights.studio(64)
    return Scene(_balls(), None, sky, np.array([viewpoint(np.array([0.3, -2.0, 1.0]), np.array([0, 0, 0.25]))]))


# ---------------------------------------------------------------- lights
def test_main_sources_are_where_the_formulas_put_them():
    for light, direction in ((lights.studio(128), (40, 42)), (lights.open_sky(256), lights.SUN_DEG)):
        found = scoring.main_source(light)
        assert np.degrees(np.arccos(found @ lights.towards(*direction))) < 2


def test_a_light_that_is_turned_is_off_by_the_turn():
    light = lights.open_sky(128)
    turned = np.roll(light, 128 * 2 * 30 // 360, axis=1)
    sun = np.radians(lights.SUN_DEG[1])
    expected = 2 * np.degrees(np.arcsin(np.cos(sun) * np.sin(np.radians(15))))
    assert scoring.source_error_deg(turned, light) == pytest.approx(expected, abs=1.5)
    assert scoring.source_error_deg(3 * light, light) == pytest.approx(0, abs=1e-3)


def test_a_y_up_map_is_the_same_light_in_the_convention_of_written_ones():
    sky = np.random.default_rng(0).random((16, 32, 3)).astype(np.float32)
    directions = sphere_directions(16)
    np.testing.assert_allclose(environment.look_up(y_up_map(sky), directions @ Y_UP.T), sky, atol=1e-4)
    np.testing.assert_array_equal(z_up_map(y_up_map(sky)), sky)


def test_a_written_light_comes_back_in_the_frame_of_the_truth(tmp_path):
    sky = lights.studio(64)
    held_out.write_exr(tmp_path / "light.exr", y_up_map(sky))
    back = z_up_light(held_out.read_exr(tmp_path / "light.exr"), Y_UP.T)
    assert scoring.source_error_deg(back, sky) < 0.5
    np.testing.assert_allclose(environment.resized(back, 8), environment.resized(sky, 8), rtol=0.05, atol=0.02)


def test_every_light_trains_two_objects_and_the_others_relight_them():
    assert sorted(subject.light for subject in scenes.SUBJECTS.values()) == sorted(2 * list(lights.LIGHTS))
    assert all(len(subject.unseen) == 2 and subject.light not in subject.unseen for subject in scenes.SUBJECTS.values())


# ---------------------------------------------------------------- scores
def _maps(shape=(24, 24)) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(1)
    metallic = np.zeros(shape)
    metallic[:, :12] = 1
    return {"base_color": rng.uniform(0.1, 0.9, (*shape, 3)), "roughness": rng.uniform(0.2, 0.8, shape),
            "metallic": metallic, "coverage": np.ones(shape)}  # fmt: skip


def test_one_scale_a_channel_is_free_and_no_more():
    truth = _maps()
    scaled = {**truth, "base_color": truth["base_color"] * [0.5, 0.4, 0.9]}
    assert scoring.map_scores([scaled], [truth])["base_color_psnr"] > 50
    shaded = {**truth, "base_color": truth["base_color"] * np.linspace(0.3, 1.7, 24)[:, None, None]}
    assert scoring.map_scores([shaded], [truth])["base_color_psnr"] < 20


def test_roughness_and_metalness_are_not_scaled():
    truth = _maps()
    other = {**truth, "roughness": truth["roughness"] + 0.1, "metallic": 0 * truth["metallic"]}
    scores = scoring.map_scores([other], [truth])
    assert scores["roughness_mae"] == pytest.approx(0.1)
    assert (scores["metallic_mae"], scores["told_apart"]) == (0.5, 0.5)


def test_what_a_model_does_not_cover_counts():
    truth = _maps()
    holed = {key: value.copy() for key, value in truth.items()}
    for key in ("base_color", "roughness", "metallic"):
        holed[key][:4] = 0
    assert scoring.map_scores([holed], [truth])["base_color_psnr"] < 20


def test_one_scale_serves_both_lights():
    rng = np.random.default_rng(2)
    truths = [rng.uniform(0.1, 1, (1, 24, 24, 3)) * brightness for brightness in (1, 20)]
    masks = np.ones((1, 24, 24), bool)
    assert scoring.lit_scores([0.3 * truth for truth in truths], truths, masks)["psnr"] > 50
    unequal = [0.3 * truths[0], 0.6 * truths[1]]
    assert scoring.lit_scores(unequal, truths, masks)["psnr"] < 30


def test_pictures_with_what_is_no_number_are_refused():
    with pytest.raises(ValueError, match="finite"):
        scoring.coded(np.array([0.5, np.nan]))


# ---------------------------------------------------------------- models
@pytest.mark.slow
def test_the_true_model_is_read_back_in_the_frame_of_the_truth(tmp_path):
    scene = _scene()
    write_true_model("mixed", scene, tmp_path)
    finished = read_finished(tmp_path)
    model = finished.model
    assert finished.has_materials
    assert finished.baked is None
    assert finished.light is not None
    corners = model.vertices[model.faces].reshape(-1, 3)
    expected = np.concatenate([part.vertices[part.faces].reshape(-1, 3) for part in scene.parts])
    np.testing.assert_allclose(corners, expected, atol=1e-5)
    side = len(model.roughness)
    texels = np.floor(model.uvs * side).astype(int)
    first, last = texels[model.faces[0, 0]], texels[model.faces[-1, 0]]
    for (column, row), finish, color in zip((first, last), (GREEN, GOLD), COLORS, strict=True):
        assert model.roughness[row, column] == pytest.approx(finish.roughness, abs=0.003)
        assert model.metallic[row, column] == finish.metallic
        np.testing.assert_allclose(model.base_color[row, column], color, atol=0.01)


def test_linear_undoes_the_tone_curve():
    codes = np.arange(256, dtype=np.uint8)
    np.testing.assert_allclose(coded(linear(codes)) * 255, codes, atol=1e-3)


# ---------------------------------------------------------------- tables
def test_tables_name_every_score_and_the_mean():
    ours = {"relit_psnr": 30.0, "relit_ssim": 0.9, **{key: 1.0 for key, *_ in tables.MAPS}}
    results = [
        {"name": name, "light": "sky", "fitted_roughness": 0.5, "cost": None,
         "scores": {"ours": ours, "baked": {"relit_psnr": psnr, "relit_ssim": 0.8, "base_color_psnr": 20.0}}}
        for name, psnr in (("a", 20.0), ("b", 24.0))
    ]  # fmt: skip
    relit = tables.relit_table(results).splitlines()
    assert relit[-1].startswith("| mean |  | 30.00 | 0.900 | 22.00 | 0.800 | - | - |")
    assert len(tables.maps_table(results).splitlines()) == 5
    assert "| a | 30.00 | 0.900 | 1.00 |" in tables.judge_table(results)


# ---------------------------------------------------------------- with Mitsuba
@pytest.mark.slow
def test_the_truth_is_judged_nearly_perfect_and_its_mirror_image_is_not(tmp_path):
    pytest.importorskip("mitsuba")
    from dataclasses import replace

    from benchmarks.materials.judge import Judge
    from benchmarks.synthetic.mitsuba_camera import EVERYWHERE

    scene = _scene()
    views = Views(scene.cam_from_world, 110.0, (80, 60))
    write_true_model("mixed", scene, tmp_path)
    write_held_out(scene, views, tmp_path, 64, EVERYWHERE)
    truth = held_out.read_truth(tmp_path, 0)
    model = read_finished(tmp_path).model
    judge = Judge(views, EVERYWHERE)
    (maps,) = judge.maps(model)
    scores = scoring.map_scores([maps], [truth])
    assert scores["base_color_psnr"] > 45
    assert scores["roughness_mae"] < 0.005
    assert scores["told_apart"] == 1
    light = z_up_map(held_out.read_exr(tmp_path / "lights" / "studio.exr"))
    mask = scoring.counted(truth["coverage"])[None]

    def relit(candidate, lamp):
        return scoring.lit_scores([judge.lit(candidate, lamp, 64)], [truth["radiance_studio"][None]], mask)["psnr"]

    assert relit(model, light) > 33
    assert relit(model, light[:, ::-1]) < 25
    assert relit(replace(model, metallic=0 * model.metallic), light) < 25


@pytest.fixture(scope="module")
def published(tmp_path_factory):
    """A scene in the layout of Synthetic4Relight, and the truth as a run would have left it."""
    pytest.importorskip("mitsuba")
    from PIL import Image

    from benchmarks.synthetic.mitsuba_camera import EVERYWHERE
    from stages.light.srgb import as_bytes

    folder, data = tmp_path_factory.mktemp("made"), tmp_path_factory.mktemp("published")
    scene, views = _scene(), Views(_scene().cam_from_world, 110.0, (80, 60))
    write_true_model("mixed", scene, folder)
    write_held_out(scene, views, folder, 64, EVERYWHERE)
    pose = np.linalg.inv(views.cam_from_world[0]) @ np.diag([1.0, -1, -1, 1])
    frames = [{"file_path": "./test/000", "transform_matrix": pose.tolist()}]
    write_json(data / "transforms_test.json", {"camera_angle_x": 2 * np.arctan(40 / 110), "frames": frames})
    truth = held_out.read_truth(folder, 0)
    alpha = (255 * truth["coverage"] + 0.5).astype(np.uint8)[..., None]

    def write(name: str, codes: np.ndarray) -> None:
        (data / name).parent.mkdir(exist_ok=True)
        Image.fromarray(np.concatenate([codes, alpha], axis=2)).save(data / name)

    write("test/000_rgba.png", as_bytes(np.clip(truth["radiance_studio"], 0, 1)))
    write("test/000_albedo.png", as_bytes(truth["base_color"]))
    write("test/000_rough.png", np.repeat((255 * truth["roughness"] + 0.5).astype(np.uint8)[..., None], 3, axis=2))
    write("test_rli/envmap6_000.png", as_bytes(np.clip(truth["radiance_sky"], 0, 1)))
    return data, folder


@pytest.mark.slow
def test_a_true_model_is_judged_nearly_perfect_in_the_layout_of_synthetic4relight(published):
    from benchmarks.materials.synthetic4relight import read_light, score_scene
    from benchmarks.synthetic.mitsuba_camera import EVERYWHERE

    data, folder = published
    light = read_light(folder / "lights" / "sky.exr")
    scores = score_scene(data, folder, {"envmap6": light}, EVERYWHERE)
    assert scores["albedo_psnr"] > 30
    assert scores["relit_envmap6_psnr"] > 30
    assert scores["novel_psnr"] > 30
    assert scores["roughness_mse"] < 1e-3
    turned = score_scene(data, folder, {"envmap6": np.roll(light, light.shape[1] // 3, axis=1)}, EVERYWHERE)
    assert turned["relit_envmap6_psnr"] < scores["relit_envmap6_psnr"] - 3


def test_a_scene_of_synthetic4relight_that_lacks_a_picture_is_told_which(tmp_path):
    from benchmarks.materials.synthetic4relight import read_tests

    write_json(tmp_path / "transforms_test.json", {"camera_angle_x": 0.7, "frames": [{"file_path": "./test/007"}]})
    with pytest.raises(InputError, match=r"no 007.png or 007_rgba.png in .*test"):
        read_tests(tmp_path)
