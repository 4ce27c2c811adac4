"""Materials under a light that was captured: on a made-up ball in a known light, and the run that is given one."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from toy_pipeline import TOY
from typer.testing import CliRunner

from configs.params import MaterialsParams
from hineus_cli.app import build_app
from stages import reconstruct
from stages.engine.stage import Stage, StageContext
from stages.engine.workspace import Workspace
from stages.errors import InputError
from stages.files.light_files import GIVEN_LIGHT, write_hdr
from stages.geometry.vectors import unit
from stages.light.environment import directions, resized, turned
from stages.light.ggx import ROUGHNESSES
from stages.materials import MATERIALS
from stages.shading.fitting import Materials, coded, slopes
from stages.shading.given_light import GivenLight, Placed
from stages.shading.learning import learn
from stages.shading.observations import Observations
from stages.shading.reflection import LIGHT_ROWS, Reflection, reflection
from stages.shading.surroundings import ROWS, Surroundings

POINTS, VIEWS = 250, 12
COLOR = np.array([0.7, 0.3, 0.15], np.float32)
TURN = 73.0


@dataclass(frozen=True)
class Ball:
    """What photos say of S points of it, what turns light into that, and the truth.

    Attributes:
        exposure: photos show so many times the radiance.
    """

    seen: Observations
    reflected: Reflection
    positions: np.ndarray
    materials: Materials
    exposure: float


def two_lamps() -> np.ndarray:
    """A light [64, 128, 3]: a sky that is brighter above, a strong warm lamp and a weak cold one elsewhere."""
    towards = directions(64)
    light = 0.3 + 0.3 * np.clip(towards[..., 1:2], 0, 1) * np.array([0.6, 0.8, 1.2])
    for place, strength, color in (((0.5, 0.7, 0.3), 30, (1, 0.95, 0.8)), ((-0.6, 0.3, -0.7), 8, (0.8, 0.9, 1))):
        lobe = np.exp((towards @ unit(np.array(place)) - 1) / 0.01)
        light = light + strength * lobe[..., None] * np.array(color)
    return light.astype(np.float32)


def ball_under(light: np.ndarray, level: int, metallic: float) -> Ball:
    """A ball of one material in the open, photographed from above and exposed well."""
    random = np.random.default_rng(0)
    normals = unit(random.normal(size=(POINTS, 3))).astype(np.float32)
    centers = 4 * unit(random.normal(size=(VIEWS, 3)))
    centers[:, 1] = np.abs(centers[:, 1])
    towards = unit(centers[None] - normals[:, None]).astype(np.float32)
    weights = (np.einsum("skc,sc->sk", towards, normals) > 0.2).astype(np.float32)
    rows = (weights > 0).sum(1) >= 3
    normals, count = normals[rows], int(rows.sum())
    photos = np.tile(np.arange(VIEWS), (count, 1))
    blank = Observations(np.zeros((count, VIEWS, 3), np.float32), weights[rows], towards[rows], photos)
    sides = 2 * ROWS**2
    nothing_near = Surroundings(np.ones((count, sides), np.float32), np.zeros((count, sides, 3), np.float32))
    reflected = reflection(blank, normals, nothing_near, np.eye(3))
    small = torch.from_numpy(resized(light, LIGHT_ROWS).reshape(-1, 3))
    slope, offset = slopes(
        reflected.scale[..., level, None],
        reflected.bias[..., level, None],
        reflected.mirrored(small)[:, :, level],
        reflected.diffuse(small)[:, None],
        metallic,
    )
    radiance = slope * torch.from_numpy(COLOR) + offset
    exposure = 0.5 / float(radiance[blank.weights > 0].quantile(0.9))
    noise = 0.005 * torch.randn(radiance.shape, generator=torch.Generator().manual_seed(0))
    seen = replace(blank, colors=(coded(radiance * exposure) + noise).clamp(0, 1).numpy())
    roughness = torch.full((count,), ROUGHNESSES[level])
    materials = Materials(torch.zeros(count, 3), roughness, torch.full((count,), metallic))
    return Ball(seen, reflected, normals, materials, exposure)


def found_on(ball: Ball, given: GivenLight) -> Placed:
    colors, weights = torch.from_numpy(ball.seen.colors), torch.from_numpy(ball.seen.weights)
    return given.find(ball.reflected, colors, weights, ball.materials)


# ---------------------------------------------------------------- turn and scale
def test_a_placement_is_a_turn_and_one_scale_for_all_channels() -> None:
    light = two_lamps()
    given = GivenLight(light)
    expected = 2.5 * resized(turned(light, 90), LIGHT_ROWS).reshape(-1, 3)
    np.testing.assert_allclose(given.light(Placed(90, 2.5)).numpy(), expected, rtol=1e-5)
    np.testing.assert_allclose(given.written(Placed(90, 2.5)), 2.5 * turned(light, 90), rtol=1e-5)
    quarter = np.roll(light, len(light) // 2, axis=1)  # half the height is a quarter of the width: from φ to φ + 90
    np.testing.assert_allclose(given.written(Placed(90, 1)), quarter, rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize(("rows", "written"), [(8, 32), (64, 64), (256, 128)])
def test_the_written_map_is_no_coarser_than_what_is_learned_with_and_not_too_fine(rows: int, written: int) -> None:
    assert GivenLight(np.ones((rows, 2 * rows, 3), np.float32)).written(Placed(0, 1)).shape == (written, 2 * written, 3)


@pytest.mark.slow
def test_the_turn_and_the_exposure_are_found() -> None:
    light = two_lamps()
    ball = ball_under(turned(light, TURN), level=1, metallic=0.0)
    placed = found_on(ball, GivenLight(light))
    assert placed.told
    assert placed.degrees == pytest.approx(TURN, abs=2.5)
    assert placed.scale == pytest.approx(ball.exposure, rel=0.1)


@pytest.mark.slow
def test_a_light_that_is_the_same_from_all_sides_tells_no_turn() -> None:
    light = np.repeat(two_lamps().mean(1, keepdims=True), 128, axis=1)
    assert not found_on(ball_under(light, level=1, metallic=0.0), GivenLight(light)).told


# ---------------------------------------------------------------- materials under it
@pytest.mark.slow
@pytest.mark.parametrize(("level", "metallic"), [(2, 0.0), (3, 1.0)])
def test_materials_are_learned_under_the_light_that_is_given(level: int, metallic: float) -> None:
    light = two_lamps()
    ball = ball_under(turned(light, TURN), level, metallic)
    given = GivenLight(light, TURN)
    learned = learn(ball.seen, ball.reflected, ball.positions, VIEWS, given=given)
    assert learned.placed is not None
    assert learned.placed.degrees == TURN
    np.testing.assert_allclose(learned.light.reshape(-1, 3), given.light(learned.placed).numpy(), rtol=1e-4)
    (material,) = learned.materials
    assert material.metallic == metallic
    assert material.roughness == pytest.approx(ROUGHNESSES[level], abs=0.05)
    color = np.median(learned.color, axis=0)
    if metallic:  # nothing tells how bright a metal is
        color = color * COLOR.mean() / color.mean()
    else:
        assert learned.placed.scale == pytest.approx(ball.exposure, rel=0.1)
    np.testing.assert_allclose(color, COLOR, rtol=0.1)


# ---------------------------------------------------------------- the run
def _says_its_light(context: StageContext[MaterialsParams]) -> dict[str, Any]:
    return {"enabled": context.params.enabled, "light": str(context.sources.get(GIVEN_LIGHT))}


PIPELINE: tuple[Stage, ...] = (*TOY, replace(MATERIALS, run=_says_its_light, reads=(), writes=()))


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current folder, with photos that the toy pipeline takes, and a light."""
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos/0.jpg").write_text("0")
    write_hdr(tmp_path / "studio.hdr", np.ones((4, 8, 3)))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(reconstruct, "has_cuda", lambda: False)
    monkeypatch.setattr(reconstruct, "_tell_preflight", lambda done: None)
    return tmp_path


def run(*arguments: str) -> dict[str, Any]:
    """The materials' manifest after a run."""
    result = CliRunner().invoke(build_app(PIPELINE), ["run", *arguments])
    assert result.exit_code == 0, result.output
    published = Workspace.open(Path("photos_hineus")).published("materials")
    assert published is not None
    return published.numbers


def test_the_light_of_a_run_is_remembered_until_it_is_forgotten(folder: Path) -> None:
    light = str(folder / "studio.hdr")
    assert run("photos") == {"enabled": False, "light": "None"}
    assert run("photos", "--light", "studio.hdr") == {"enabled": True, "light": light}
    assert Workspace.open(folder / "photos_hineus").record.sources[GIVEN_LIGHT] == light
    assert run("photos") == {"enabled": True, "light": light}
    assert run("photos", "--no-light") == {"enabled": True, "light": "None"}


def test_materials_are_learned_again_when_the_light_is_another(folder: Path) -> None:
    run("photos", "--light", "studio.hdr")
    write_hdr(folder / "studio.hdr", 2 * np.ones((8, 16, 3)))
    result = CliRunner().invoke(build_app(PIPELINE), ["run", "photos", "--json"])
    made = {stage["name"]: stage for stage in json.loads(result.stdout)["stages"]}
    assert made["export"]["action"] == "skipped"
    assert made["materials"]["action"] == "ran"
    assert "studio.hdr" in made["materials"]["reason"]


def test_a_light_that_is_not_there_is_refused(folder: Path) -> None:
    result = CliRunner().invoke(build_app(PIPELINE), ["run", "photos", "--light", "nowhere.hdr"])
    assert result.exit_code == InputError.exit_code
    assert "There is no light nowhere.hdr" in result.output
