"""Training: it learns, every term reaches the networks, a killed run goes on with the same loss curve."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from ball_training import TINY, assert_finds_the_ball, ball_sightings, even_rays, make_trainer
from sphere_scene import (
    RADIUS,
    render,
    ring_of_cameras,
    sphere_cloud,
    sphere_scene,
    write_densified,
    write_undistorted,
)
from train_settings import changed

from configs.training import TrainParams
from stages import artifacts, train
from stages.engine.stage import StageContext
from stages.errors import InputError
from stages.geometry.cameras import PosedScene
from stages.geometry.hull import cube, hull_distances
from stages.geometry.normalisation import regrown
from stages.geometry.point_cloud import PointCloud
from stages.geometry.similarity import Similarity
from stages.neural import acceleration, encodings
from stages.neural import fields as fields_module
from stages.neural.evidence import SIDE, Evidence
from stages.neural.fields import contract
from stages.neural.needed_rays import NeededRays
from stages.neural.sightings import Sightings, sighting_loss
from stages.neural.trained_field import load_field
from stages.neural.trainer import Trainer
from stages.neural.training_photos import Photos
from stages.surface import border
from stages.surface.border import BorderCut, region_without_cut
from stages.surface.triangle_mesh import vertex_normals

A_FEW_STEPS = """
import hashlib
import torch
from ball_training import make_trainer
torch.set_num_threads(1)
trainer = make_trainer()
for i in range(3):
    trainer.step(i / 3)
for name, value in trainer.fields.state_dict().items():
    print(name, hashlib.sha256(value.numpy().tobytes()).hexdigest())
"""


@pytest.mark.parametrize("share", [0.0, 1.0], ids=["evenly", "by need"])
def test_rays_see_the_pixels_they_were_drawn_from(share):
    cameras, trainer = ring_of_cameras(), make_trainer(masks=True)
    needed = NeededRays(trainer.photos, share)
    trainer.cache.refresh(lambda p: p.norm(dim=1) - RADIUS)
    needed.look(trainer.cache)
    batch, _ = needed.draw(200, torch.Generator().manual_seed(0))
    assert len(batch.leave) == 200
    assert batch.masks is not None
    assert set(batch.masks.tolist()) == {0.0, 1.0}
    for row in range(0, 200, 10):
        image = int(batch.images[row])
        pixel, _ = cameras.project(image, (batch.origins + batch.directions)[row].double().numpy()[None])
        x, y = np.floor(pixel[0]).astype(int)
        assert np.allclose(pixel[0] % 1, 0.5, atol=1e-3)
        color, mask = (seen[y, x] / 255 for seen in render(cameras, image))
        assert np.allclose(batch.colors[row].numpy(), color, atol=1e-6)
        assert float(batch.masks[row]) == mask


@pytest.mark.parametrize("kind", [0, 1], ids=["sparse", "dense"])
def test_sightings_end_at_their_points_and_are_free_before(kind):
    sightings = ball_sightings(ring_of_cameras())[kind]
    assert len(sightings) > 200
    drawn = sightings.draw(200, 0.01, torch.Generator().manual_seed(0))
    on_point, behind, before, free = drawn.places.norm(dim=1).view(4, 200)
    assert torch.allclose(on_point, torch.tensor(RADIUS), atol=1e-5)
    assert (before > RADIUS).all()
    assert (free > RADIUS).all()
    assert free.max() < 1 + 1e-5
    assert free.max() > 0.9
    assert (behind < RADIUS).float().mean() > 0.9  # the others only graze the ball
    assert torch.allclose((drawn.places[200:400] - drawn.places[:200]).norm(dim=1), torch.tensor(0.01), atol=1e-6)


def test_photos_left_out_have_no_sightings():
    cameras = ring_of_cameras()
    training = np.arange(8) != 3
    for sightings in (
        Sightings.from_scene(sphere_scene(cameras), "cpu", training),
        Sightings.from_cloud(sphere_cloud(cameras), cameras.centers, "cpu", training),
    ):
        assert set(sightings.lines[:, 0].tolist()) == {0, 1, 2, 4, 5, 6, 7}


def test_sightings_of_nothing_are_drawn_and_cost_nothing():
    nothing = Sightings.from_cloud(PointCloud.empty(), ring_of_cameras().centers, "cpu")
    drawn = nothing.draw(50, 0.01, torch.Generator().manual_seed(0))
    assert [len(part) for part in drawn] == [0, 0]
    assert float(sighting_loss(torch.zeros(0), drawn.weights, 0.01, 0.01)) == 0


def test_a_sighting_costs_where_the_field_contradicts_it():
    """f = 0 on the points, +0.01 before and on the free lines, -0.01 behind: nothing to correct."""
    right = torch.tensor([0.0, -0.01, 0.01, 0.01])
    weights = torch.tensor([1.0, 0.5])
    of_both = right.repeat_interleave(2)
    assert float(sighting_loss(of_both, weights, 0.01, 0.01)) == 0
    assert float(sighting_loss(-of_both, weights, 0.01, 0.01)) > 0.01
    costs = []
    for one in (0, 1):  # the same error costs half where half is trusted
        wrong = of_both.clone()
        wrong[one] = 0.1
        costs.append(float(sighting_loss(wrong, weights, 0.01, 0.01)))
    assert costs[0] == pytest.approx(2 * costs[1])
    assert costs[0] > 0


def test_sightings_do_not_count_where_it_is_shiny():
    """Reflections lie there; what is seen beside keeps its weight."""
    cameras = ring_of_cameras()
    _, dense = ball_sightings(cameras)
    shiny = torch.zeros(1, 1, *3 * [SIDE])
    shiny[..., : SIDE // 2 - 1] = 1  # x < 0
    weighed = dense.but_where(shiny)
    left, right = dense.points[:, 0] < -0.1, dense.points[:, 0] > 0.1
    assert left.any()
    assert weighed.weights[left].abs().max() < 1e-6
    assert torch.equal(weighed.weights[right], dense.weights[right])
    evidence = Evidence(shiny, torch.zeros_like(shiny))
    photos = Photos(cameras, [render(cameras, i)[0] for i in range(len(cameras))], None, "cpu")
    trainer = Trainer(photos, *ball_sightings(cameras), TINY, "cpu", evidence)
    assert torch.equal(trainer.dense.weights, weighed.weights)
    assert trainer.sightings.weights[trainer.sightings.points[:, 0] < -0.1].abs().max() < 1e-6


def test_rays_pass_beside_what_is_shiny_once_its_outlines_count():
    plain, shiny = make_trainer(), make_trainer()
    shiny.fields.radiance.shiny.fill_(1)
    batch = even_rays(plain.photos, 512)
    for progress, differ in ((0.1, False), (1.0, True)):
        without, outlined = (each.render(batch, progress).opacity for each in (plain, shiny))
        assert (outlined <= without + 1e-6).all()
        assert bool((outlined < without - 0.05).any()) == differ


def test_the_field_is_a_sphere_before_training():
    trainer = make_trainer()
    points = torch.rand(100, 3, generator=torch.Generator().manual_seed(0)) * 2 - 1
    sdf, _, gradients = trainer.fields.sdf(points, 4)
    assert (sdf - (points.norm(dim=1) - TINY.field.sphere_radius)).abs().max() < 1e-3
    assert (gradients.norm(dim=1) - 1).abs().max() < 2e-2
    alone = trainer.fields.sdf.sdf(points, 4)
    torch.testing.assert_close(alone, sdf, rtol=1e-5, atol=1e-6)


def test_gradients_are_the_derivative_of_the_sdf():
    network = make_trainer().fields.sdf
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        network.table += 0.05 * torch.randn(network.table.shape, generator=generator)
    points = torch.rand(40, 3, generator=generator) - 0.5
    _, _, gradients = network(points, 4)
    step = 2e-3
    for axis in range(3):
        offset = torch.zeros(3)
        offset[axis] = step
        difference = (network.sdf(points + offset, 4) - network.sdf(points - offset, 4)) / (2 * step)
        assert np.median((difference - gradients[:, axis]).abs().detach().numpy()) < 2e-2


def test_every_term_reaches_the_networks():
    trainer = make_trainer()
    numbers = trainer.step(0.2)
    assert {k for k, v in numbers.items() if not torch.isfinite(v)} == set()
    for name, parameter in trainer.fields.named_parameters():
        assert parameter.grad is not None, name
        assert parameter.grad.abs().max() > 0, name


def test_the_reference_encoding_trains_like_the_kernels(monkeypatch):
    """The path that CUDA takes, on the CPU: same loss, same gradients."""
    kernels, reference = make_trainer(), make_trainer()
    expected = kernels.step(0.3)
    monkeypatch.setattr(fields_module, "encode", encodings.encode_reference)
    monkeypatch.setattr(fields_module, "encode_features", encodings.features_reference)
    numbers = reference.step(0.3)
    for key, value in expected.items():
        assert float(numbers[key]) == pytest.approx(float(value), rel=1e-3, abs=1e-5), key
    for (name, a), b in zip(kernels.fields.named_parameters(), reference.fields.parameters(), strict=True):
        torch.testing.assert_close(b.grad, a.grad, rtol=1e-2, atol=1e-4 * float(a.grad.abs().max()) + 1e-9, msg=name)


def test_masks_for_some_photos_are_said_to_be_ignored(tmp_path, caplog):
    folder = tmp_path / "undistort"
    cameras = ring_of_cameras()
    write_undistorted(folder, cameras, masks=True)
    assert len(list(train._load_images(artifacts.Pictures(folder), cameras.names)[1])) == 8
    artifacts.Pictures(folder).mask_path(cameras.names[0]).unlink()
    assert train._load_images(artifacts.Pictures(folder), cameras.names)[1] is None
    assert "only 7 of 8 photos have a mask" in caplog.text


def test_masks_switch_the_background_off_and_pull_the_opacity():
    trainer = make_trainer(masks=True)
    assert trainer.fields.background is None
    assert trainer.step(0.2)["mask"] > 0


def test_contraction_keeps_the_ball_and_bounds_the_rest():
    points = torch.tensor([[0.3, 0.2, 0.1], [10.0, 0, 0], [0, -1e6, 0]])
    expected = torch.tensor([[0.3, 0.2, 0.1], [1.9, 0, 0], [0, -2.0, 0]])
    torch.testing.assert_close(contract(points), expected, atol=1e-5, rtol=1e-5)


@pytest.mark.slow
def test_training_finds_the_ball():
    assert_finds_the_ball({})


def context(tmp_path: Path, name: str, params: TrainParams) -> StageContext:
    folder = tmp_path / "undistort"
    if not folder.exists():
        write_undistorted(folder, ring_of_cameras())
    out, scratch = tmp_path / name, tmp_path / f"{name}_scratch"
    out.mkdir(exist_ok=True)
    scratch.mkdir(exist_ok=True)
    inputs = {"undistort": folder, "densify": write_densified(tmp_path / "densify")}
    return StageContext(inputs=inputs, sources={}, out=out, scratch=scratch, params=params)


def metric_lines(path: Path) -> list[dict]:
    return [json.loads(line) for line in path.read_text().splitlines()]


EVERYTHING = {
    "terms.ambiguity.form": "stable", "terms.ambiguity.visibility": "mesh", "terms.reflection.form": "stable",
    "terms.planar.form": "stable", "terms.planar.features": "mlp",
    "terms.eikonal.form": "stable", "density.scale": "learned", "sampling.sampler": "proposal",
}  # fmt: skip


class KilledError(Exception):
    pass


def run_and_kill(run_context: StageContext, monkeypatch: pytest.MonkeyPatch, at: int) -> None:
    """Train until the step `at` is to be made."""
    original = Trainer.step

    def step_until_killed(self, progress):
        if self.step_index == at:
            raise KilledError
        return original(self, progress)

    with monkeypatch.context() as patch:
        patch.setattr(Trainer, "step", step_until_killed)
        with pytest.raises(KilledError):
            train.run(run_context)


def assert_same_training(one: StageContext, other: StageContext) -> None:
    curves = [metric_lines(artifacts.METRICS.load(c.out)) for c in (one, other)]
    assert curves[0] == curves[1]
    assert [line["step"] for line in curves[0]] == list(range(5, 61, 5))
    fields = [load_field(artifacts.FIELD.load(c.out)) for c in (one, other)]
    points = np.random.default_rng(0).uniform(-1, 1, (50, 3))
    assert np.array_equal(fields[0].sdf(points), fields[1].sdf(points))


@pytest.mark.slow
def test_kernels_compiled_just_now_learn_the_same_as_those_kept_before(tmp_path):
    here = Path(__file__).parent
    environment = {
        **os.environ,
        "NUMBA_CACHE_DIR": str(tmp_path),
        "OMP_NUM_THREADS": "1",
        "PYTHONPATH": os.pathsep.join([str(here.parent), str(here)]),
    }
    command = [sys.executable, "-c", A_FEW_STEPS]
    first, second = (
        subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout for _ in range(2)
    )
    assert list(tmp_path.rglob("*.nbc"))
    assert first.count("\n") > 5
    assert first == second


@pytest.mark.slow
@pytest.mark.parametrize("settings", [{}, EVERYTHING], ids=["default", "everything"])
def test_a_killed_run_goes_on_with_the_same_loss_curve(tmp_path, monkeypatch, settings):
    monkeypatch.setattr(train, "LOG_EVERY", 5)
    monkeypatch.setattr(train, "CHECKPOINT_EVERY", 0)
    params = changed(TINY, {"preview_every": 1.0, **settings})
    whole = context(tmp_path, "whole", params)
    numbers = train.run(whole)
    assert numbers["steps"] == TINY.steps
    killed = context(tmp_path, "killed", params)
    run_and_kill(killed, monkeypatch, at=37)
    assert artifacts.checkpoint_path(killed.scratch).exists()
    with artifacts.METRICS.load(killed.scratch).open("a") as file:
        file.write('{"step": 40, "progr')  # what a kill leaves of a line that was being written
    train.run(killed)
    assert_same_training(whole, killed)
    assert list(artifacts.PREVIEWS.load(whole.out).iterdir())


def reshaped(state: dict) -> None:
    state["trainer"]["optimizer"]["state"][0]["exp_avg"] = torch.zeros(3)


def of_others(state: dict) -> None:
    state["trainer"]["fields"] = make_trainer(changed(TINY, {"field.levels": 3})).fields.state_dict()


def rewritten(change):
    def damage(path: Path) -> None:
        state = torch.load(path, weights_only=True)
        change(state)
        torch.save(state, path)

    return damage


def flipped(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 4
    path.write_bytes(content)


DAMAGES = {
    "flipped": flipped,
    "no state": rewritten(lambda state: state.update(trainer={})),
    "of another shape": rewritten(of_others),
    "moments of another shape": rewritten(reshaped),
    "no steps": rewritten(lambda state: state.update(steps=0)),
    "no number": rewritten(lambda state: state.update(seconds=float("nan"))),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_checkpoint_is_set_aside_and_training_starts_over(tmp_path, caplog, damage):
    training = begun(tmp_path, 0)
    training.trainer.step(0.0)
    training.steps = 123
    training.save()
    training.metrics.write_text("a line of then")
    path = artifacts.checkpoint_path(training.context.scratch)
    aside = path.with_name("checkpoint.pt.damaged")
    DAMAGES[damage](path)
    anew = train._Training.begun(training.context)
    assert (anew.trainer.step_index, anew.steps, anew.metrics.read_text()) == (0, None, "")
    warnings = [record.message for record in caplog.records if record.levelname == "WARNING"]
    assert [message.split(" (")[0] for message in warnings] == ["the checkpoint is damaged"]
    assert aside.exists()
    assert not path.exists()


def test_what_lies_beside_the_checkpoint_does_not_matter(tmp_path):
    training = begun(tmp_path, 0)
    training.metrics.write_text('{"step": 50}\n')
    training.trainer.step(0.0)
    training.save()
    training.metrics.unlink()
    training.metrics.mkdir()
    artifacts.checkpoint_path(training.context.scratch).with_name("checkpoint.pt.tmp").mkdir()
    resumed = train._Training.begun(training.context)
    assert resumed.trainer.step_index == 1
    assert resumed.metrics.read_text() == '{"step": 50}\n'
    resumed.save()


def test_a_checkpoint_of_another_device_goes_on_with_rays_of_its_own():
    started, going_on = make_trainer(), make_trainer()
    started.step(0.1)
    state = started.state() | {"generator": torch.zeros(16, dtype=torch.uint8)}  # as CUDA's
    assert going_on.fits(state)
    going_on.load_state(state)
    assert going_on.step_index == 1
    assert torch.isfinite(going_on.step(0.2)["loss"])


def test_the_published_field_answers_in_numpy(tmp_path):
    run_context = context(tmp_path, "out", changed(TINY, {"steps": 3}))
    train.run(run_context)
    field = load_field(artifacts.FIELD.load(run_context.out))
    points = np.array([[0.0, 0, 0.9], [0, 0, 0.1]])
    sdf, normals = field.sdf(points), field.normals(points)
    assert sdf[0] > 0 > sdf[1]
    assert np.allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-5)
    colors = field.color(points, normals, -normals)
    assert colors.shape == (2, 3)
    assert colors.min() >= 0
    assert colors.max() <= 1


@pytest.mark.slow
def test_a_budget_in_minutes_ends_on_time_whatever_the_steps(tmp_path):
    numbers = train.run(context(tmp_path, "out", changed(TINY, {"steps": 10**8, "minutes": 0.02})))
    assert numbers["train_seconds"] < 60  # the first step may have to compile the kernels


def test_without_numba_a_step_is_the_same_and_it_is_said_once(monkeypatch, caplog):
    with_kernels = make_trainer().step(0.5)
    monkeypatch.setitem(sys.modules, "stages.compiling", None)
    acceleration._has_numba.cache_clear()
    try:
        trainer = make_trainer()
        plain = trainer.step(0.5)
        trainer.step(0.5)
    finally:
        acceleration._has_numba.cache_clear()
    assert sum("no CPU kernels" in record.message for record in caplog.records) == 1
    assert float(plain["loss"]) == pytest.approx(float(with_kernels["loss"]), rel=1e-3)


def test_wrong_image_size_is_named():
    cameras = ring_of_cameras()
    with pytest.raises(ValueError, match=r"view_00\.png: got shape \(3, 3, 3\)"):
        Photos(cameras, [np.zeros((3, 3, 3), np.uint8)] * 8, None, "cpu")


def test_photos_show_a_place_where_it_projects():
    trainer = make_trainer()
    cameras = ring_of_cameras()
    points = torch.tensor([[0.023, -0.031, 0.2], [0.3, 0.1, -0.2], [0, 0, 50.0]])
    colors, inside = trainer.photos.observe(points)
    assert inside[:2].all()
    assert not inside[2].any()
    for index in range(8):
        pixel, _ = cameras.project(index, points[:2].double().numpy())
        for row, (x, y) in enumerate(np.floor(pixel).astype(int)):
            assert np.allclose(colors[row, index].numpy(), render(cameras, index)[0][y, x] / 255, atol=1e-6)


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
@pytest.mark.parametrize("settings", [{}, EVERYTHING], ids=["default", "everything"])
def test_a_step_on_cuda_matches_the_cpu(settings):
    params = changed(
        TINY, {**settings, "density.scale": "scheduled", "sampling.sampler": "grid", "precision": "float32"}
    )
    cameras = ring_of_cameras()
    rendered = []
    for device in ("cpu", "cuda"):
        photos = Photos(cameras, [render(cameras, i)[0] for i in range(8)], None, device)
        trainer = Trainer(photos, *ball_sightings(cameras, device), params, device)
        trainer._refresh_cache(trainer.moment(0.3))
        images = torch.arange(8, device=device).repeat(10)
        pixels = torch.tensor([[24.0, 20.0]], device=device).repeat(80, 1)
        batch = photos.rays(images, pixels)
        rendered.append(trainer.render(batch, 0.3).colors.detach().cpu())
        assert torch.isfinite(trainer.step(0.3)["loss"]).item()
    torch.testing.assert_close(rendered[1], rendered[0], rtol=1e-3, atol=1e-3)


def test_gradients_far_from_one_are_warned_of_now_and_then(caplog):
    numbers = {"loss": 1.0, "gradient_norm": 0.4}
    train._check(numbers, train.SETTLED + train.LOG_EVERY)
    train._check({"loss": 1.0, "gradient_norm": 1.1}, train.SETTLED)
    assert not caplog.records
    train._check(numbers, train.SETTLED)
    assert "mean length of 0.40" in caplog.text


# ---------------------------------------------------------------- the budget
def begun(tmp_path: Path, points: int, **sets: object) -> train._Training:
    """A training of 400 steps whose surface is a ball still, with so many dense points on that."""
    radius = TINY.field.sphere_radius
    run_context = context(tmp_path, "out", changed(TINY, {"steps": 400, "steps_if_covered": 0.25, **sets}))
    normals = np.random.default_rng(0).normal(size=(points, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    cloud = PointCloud(
        np.float32(radius * normals), np.float32(normals), np.zeros((points, 3), np.uint8),
        np.ones(points, np.float32), np.arange(points + 1), np.zeros(points, np.int32),
    )  # fmt: skip
    write_densified(tmp_path / "densify", cloud.moved(sphere_scene(ring_of_cameras()).poses_from_scene))
    return train._Training.begun(run_context)


@pytest.mark.parametrize(
    ("points", "part", "steps"),
    [(100_000, 0.25, 100), (0, 0.25, 400), (100_000, 1.0, 400), (100_000, 0.001, 1)],
    ids=["all covered", "none", "as many steps", "hardly any"],
)
def test_steps_are_fewer_where_dense_points_cover_the_surface(tmp_path, points, part, steps):
    training = begun(tmp_path, points, steps_if_covered=part)
    assert (training.steps, training.budget) == (None, 400)
    training.settle()
    assert training.steps == training.budget == pytest.approx(steps, abs=4)


def test_a_half_that_dense_points_cover_saves_half_as_much(tmp_path):
    training = begun(tmp_path, 100_000)
    cloud = training.context.read(artifacts.POINT_CLOUD)
    left = training.scene.poses_from_scene.inverse().apply(cloud.points)[:, 0] < 0
    write_densified(tmp_path / "densify", replace(cloud, trust=np.where(left, 0.4, 1.0).astype(np.float32)))
    training.settle()
    assert training.steps == pytest.approx(250, abs=20)


def test_a_training_that_is_resumed_keeps_its_budget(tmp_path):
    training = begun(tmp_path, 0)
    training.save()
    assert train._Training.begun(training.context).steps is None
    training.steps = 123
    training.save()
    assert train._Training.begun(training.context).budget == 123


def test_in_a_region_that_grows_as_much_of_the_budget_is_spent(tmp_path, monkeypatch):
    training = begun(tmp_path, 100_000)
    training.settle()
    training.trainer.step_index = round(0.2 * training.budget)
    monkeypatch.setattr(train, "_grown", lambda _: train._Region((0.0, 0.0, 0.0), 1.2))
    grown = training.where_nothing_is_cut()
    assert grown.region is not None
    assert grown.budget < 150  # the points cover the surface there, too
    assert grown.progress == pytest.approx(0.2, abs=0.5 / grown.budget)


# ---------------------------------------------------------------- a region that grows
CUT = BorderCut(np.array([[0.0, 0, 0.97], [0, 0.1, 0.95]]), photos=5)
LARGER = region_without_cut(CUT)


def growing(tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch, cut: BorderCut | None) -> StageContext:
    """A training whose region may grow, and is found to be cut like this."""
    monkeypatch.setattr(train, "LOG_EVERY", 5)
    monkeypatch.setattr(train, "CHECKPOINT_EVERY", 0)
    monkeypatch.setattr(border, "border_cut", lambda *_: cut)
    run_context = context(tmp_path, name, changed(TINY, {"preview_every": 1.0}))
    folder = tmp_path / "undistort"
    artifacts.FIRST_SCENE.save(folder, replace(artifacts.FIRST_SCENE.load(folder), growable=True))
    return run_context


@pytest.mark.slow
@pytest.mark.parametrize("at", [7, 12, 37], ids=["before the look", "just after it", "later"])
def test_a_region_grows_once_and_a_killed_run_goes_on_in_it(tmp_path, monkeypatch, at):
    whole = growing(tmp_path, "whole", monkeypatch, CUT)
    numbers = train.run(whole)
    assert numbers["steps"] == TINY.steps
    assert numbers["region_grown"] == pytest.approx(LARGER[1], abs=1e-3)
    first, published = whole.read(artifacts.FIRST_SCENE), artifacts.SCENE.load(whole.out)
    expected = regrown(first, *LARGER)
    assert published.poses_from_scene.scale == pytest.approx(LARGER[1] * first.poses_from_scene.scale)
    np.testing.assert_allclose(published.cameras.extrinsics, expected.cameras.extrinsics)
    np.testing.assert_allclose(published.points, expected.points, atol=1e-6)

    killed = growing(tmp_path, "killed", monkeypatch, CUT)
    run_and_kill(killed, monkeypatch, at)
    train.run(killed)
    assert_same_training(whole, killed)
    np.testing.assert_array_equal(artifacts.SCENE.load(killed.out).cameras.extrinsics, published.cameras.extrinsics)


@pytest.mark.slow
def test_a_region_is_looked_at_once_even_if_the_run_is_killed(tmp_path, monkeypatch):
    killed = growing(tmp_path, "killed", monkeypatch, None)
    run_and_kill(killed, monkeypatch, at=37)
    monkeypatch.setattr(border, "border_cut", lambda *_: CUT)
    numbers = train.run(killed)
    assert numbers["region_grown"] == 1.0
    scenes = artifacts.SCENE.load(killed.out), killed.read(artifacts.FIRST_SCENE)
    np.testing.assert_array_equal(scenes[0].cameras.extrinsics, scenes[1].cameras.extrinsics)


@pytest.mark.slow
def test_a_ball_that_the_region_cuts_comes_out_whole(tmp_path):
    params = changed(
        TINY,
        {
            "steps": 400,
            "sampling.rays": 256,
            "sampling.cache_resolution": 48,
            "field.sphere_radius": 0.6,
            "preview_every": 1.0,
        },
    )
    run_context = context(tmp_path, "out", params)
    folder = tmp_path / "undistort"
    first = regrown(artifacts.FIRST_SCENE.load(folder), np.array([0.3, 0.0, 0.0]), 0.5)  # ends at x = -0.2 in the ball
    artifacts.FIRST_SCENE.save(folder, replace(first, growable=True))
    numbers = train.run(run_context)
    assert numbers["region_grown"] > 1.1
    published = artifacts.SCENE.load(run_context.out)
    side = np.random.default_rng(0).normal(size=(300, 3)) * [1, 1, 0.4]
    side *= RADIUS / np.linalg.norm(side, axis=1, keepdims=True)
    lost = side[side[:, 0] < -0.25]  # on the ball, beyond the first region
    in_poses = Similarity(2.0, np.eye(3), np.array([1.0, 2, 3])).apply(lost)  # as `sphere_scene` has it
    places = published.poses_from_scene.inverse().apply(in_poses)
    assert np.linalg.norm(places, axis=1).max() < 1
    sdf = load_field(artifacts.FIELD.load(run_context.out)).sdf(places)
    assert np.median(np.abs(sdf)) * published.poses_from_scene.scale / 2 < 0.03


def test_a_region_that_was_given_is_not_looked_at(tmp_path, monkeypatch):
    def refuse(*_: object) -> None:
        raise AssertionError("looked at")

    monkeypatch.setattr(border, "border_cut", refuse)
    run_context = context(tmp_path, "out", changed(TINY, {"steps": 5}))
    assert train.run(run_context)["region_grown"] == 1.0


def test_the_coarse_surface_faces_outwards():
    trainer = make_trainer()
    trainer._refresh_cache(trainer.moment(0.0))
    vertices, faces = trainer.coarse_surface()
    used = np.unique(faces)
    np.testing.assert_allclose(np.linalg.norm(vertices[used], axis=1), TINY.field.sphere_radius, atol=0.02)
    assert (vertex_normals(vertices, faces)[used] * vertices[used]).sum(1).min() > 0
    trainer.cache.values.fill_(1.0)  # nothing there
    assert [len(part) for part in trainer.coarse_surface()] == [0, 0]


@pytest.mark.parametrize(("center", "radius"), [((0.0, 0, 0), 1.5), ((0.3, -0.1, 0.2), 1.8)])
def test_a_shape_keeps_its_distances_in_a_larger_region(center, radius):
    trainer = make_trainer()  # its SDF is a ball about the middle
    old = Similarity(2.0, np.eye(3), np.array([1.0, 2, 3]))
    new = old.compose(Similarity(radius, np.eye(3), np.array(center)))
    shape = train._shape_within(trainer.distances, new, old)
    in_poses = np.linalg.norm(new.apply(cube()) - old.translation, axis=-1) - 2.0 * TINY.field.sphere_radius
    np.testing.assert_allclose(shape * new.scale, in_poses, atol=0.02)


@pytest.mark.slow
def test_a_trainer_that_takes_over_starts_from_the_shape_with_its_grid_up_to_date():
    first, second = make_trainer(), make_trainer()
    larger = Similarity(1.5, np.eye(3), np.zeros(3))
    assert second.start_from(train._shape_within(first.distances, larger, Similarity.identity())) < 0.02
    second.step_index = 160  # at which a grid that is up to date would only be refreshed near the surface
    second._refresh_cache(second.moment(0.5))
    radius = np.linalg.norm(second.cache.points(torch.arange(24**3)).numpy(), axis=1)
    found = second.cache.values.flatten().numpy()
    ball = TINY.field.sphere_radius / 1.5
    assert np.abs(found - (radius - ball))[radius < 1].mean() < 0.05


# ---------------------------------------------------------------- the visual hull
def test_the_hull_of_a_ball_is_a_little_more_than_the_ball():
    cameras = ring_of_cameras(count=16)
    distances = hull_distances(cameras, [render(cameras, i)[1] for i in range(len(cameras))], cells=40)
    axis = (np.arange(40) + 0.5) / 20 - 1
    radius = np.linalg.norm(np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1), axis=-1)
    assert distances[radius < RADIUS - 0.06].max() < 0
    assert distances[radius > RADIUS + 0.25].min() > 0
    assert distances.min() == pytest.approx(-RADIUS, abs=0.1)
    far = radius > 0.9
    np.testing.assert_allclose(distances[far], radius[far] - RADIUS, atol=0.2)
    assert hull_distances(cameras, [np.zeros((40, 48), np.uint8)] * 16, cells=20) is None


@pytest.mark.slow
def test_training_can_start_from_the_hull():
    trainer = make_trainer(changed(TINY, {"field.sphere_radius": 0.8, "field.init": "hull"}), masks=True)
    cameras = ring_of_cameras()
    train._start_from_shape(trainer, cameras)
    levels = trainer.moment(0.0).levels
    points = torch.nn.functional.normalize(torch.randn(300, 3, generator=torch.Generator().manual_seed(0)), dim=1)
    with torch.no_grad():
        assert trainer.fields.sdf.sdf((RADIUS - 0.12) * points, levels).max() < 0
        assert trainer.fields.sdf.sdf(0.75 * points, levels).min() > 0  # the sphere of 0.8 is gone
    assert trainer.step_index == 0
    assert all(len(state) == 0 for state in trainer.optimizer.state.values())
    numbers = trainer.step(0.0)
    assert np.isfinite(float(numbers["loss"]))


def test_the_hull_is_that_of_masks_beside_whole_photos_where_they_are(tmp_path):
    """Of two folders, which share the photos."""
    cameras, photos = ring_of_cameras(count=16), SimpleNamespace(masks=None, training=torch.arange(16) != 3)
    masks = [render(cameras, i)[1] for i in range(16)]
    beside = [artifacts.OUTLINES.load(tmp_path), artifacts.SILHOUETTES.load(tmp_path)]
    for i in photos.training.nonzero().flatten().tolist():
        artifacts.write_png(beside[i % 2].mask_path(cameras.names[i]), np.uint8(masks[i]))
    used = [None if i == 3 else mask for i, mask in enumerate(masks)]
    np.testing.assert_array_equal(train._hull(cameras, photos, beside), hull_distances(cameras, used))
    beside[0].mask_path(cameras.names[4]).unlink()
    with pytest.raises(InputError, match="some have none"):
        train._hull(cameras, photos, beside)


@pytest.mark.parametrize(("distance", "room"), [(0.3, True), (2.5, False)])
def test_cameras_inside_the_sphere_start_in_a_free_room(distance, room):
    cameras = ring_of_cameras()
    pose = cameras.extrinsics.copy()
    pose[:, :, 3] *= distance / np.linalg.norm(cameras.centers, axis=1)[:, None]
    trainer = make_trainer()
    train._start_from_shape(trainer, replace(cameras, extrinsics=pose))
    middle = torch.nn.functional.normalize(torch.randn(100, 3, generator=torch.Generator().manual_seed(0)), dim=1)
    with torch.no_grad():
        levels = trainer.moment(0.0).levels
        within = trainer.fields.sdf.sdf(0.3 * middle, levels)
        assert within.min() > 0.3 if room else within.max() < 0
        assert (trainer.fields.sdf.sdf(middle, levels).max() < 0) == room


def test_a_hull_without_masks_is_refused(tmp_path):
    with pytest.raises(InputError, match="needs masks for all 8 photos"):
        train.TRAIN.run(context(tmp_path, "out", changed(TINY, {"field.init": "hull"})))


# ---------------------------------------------------------------- photos that came or went
BALL = changed(TINY, {"steps": 300, "sampling.rays": 256, "field.sphere_radius": 0.6, "preview_every": 1.0})


def seen_by(folder: Path, cameras: list[int], **changes: object) -> PosedScene:
    """The ball's scene with these of its eight photos, as undistort would have published it."""
    whole = sphere_scene(ring_of_cameras())
    row = {camera: i for i, camera in enumerate(cameras)}
    kept = np.isin(whole.observations[:, 0], cameras)
    scene = replace(
        whole,
        cameras=whole.cameras.select(cameras),
        observations=np.array([[row[i], k] for i, k in whole.observations[kept]]),
        contents=tuple(f"photo {i}" for i in cameras),
        lineage="the ball",
    )
    scene = replace(scene, **changes)  # type: ignore[arg-type]
    artifacts.FIRST_SCENE.save(folder, scene)
    return scene


@pytest.fixture(scope="module")
def learned(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What training has published of seven of the photos."""
    root = tmp_path_factory.mktemp("learned")
    run_context = context(root, "out", BALL)
    seen_by(root / "undistort", [0, 1, 2, 3, 4, 5, 6])
    assert "kept_of_budget" not in train.run(run_context)
    assert distance_to_ball(run_context.out) < 0.02
    return run_context.out


def distance_to_ball(out: Path) -> float:
    """Median |f| on the sides of the ball that cameras see, in the units of `sphere_scene`."""
    published = artifacts.SCENE.load(out)
    points = np.random.default_rng(0).normal(size=(500, 3))
    points = RADIUS * points / np.linalg.norm(points, axis=1, keepdims=True)
    in_poses = sphere_scene(ring_of_cameras()).poses_from_scene.apply(points[np.abs(points[:, 2]) < 0.36])
    places = published.poses_from_scene.inverse().apply(in_poses)
    sdf = load_field(artifacts.FIELD.load(out)).sdf(places)
    return float(np.median(np.abs(sdf))) * published.poses_from_scene.scale / 2


def going_on(tmp_path: Path, name: str, previous: Path, params: TrainParams = BALL) -> StageContext:
    return replace(context(tmp_path, name, params), previous=previous)


@pytest.mark.slow
@pytest.mark.parametrize("cameras", [[7, *range(7)], [1, 2, 3, 4, 5, 6]], ids=["one new", "one gone"])
def test_training_goes_on_from_what_it_learned_of_other_photos(tmp_path, monkeypatch, learned, cameras):
    monkeypatch.setattr(train, "LOG_EVERY", 1)
    monkeypatch.setattr(train, "KEPT_NETWORKS", 0.99)  # three steps are left: networks that begin anew are no ball
    run_context = going_on(tmp_path, "out", learned)
    seen_by(tmp_path / "undistort", cameras)
    numbers = train.run(run_context)
    assert numbers["kept_of_budget"] == 0.99
    assert numbers["steps"] == 300
    lines = metric_lines(artifacts.METRICS.load(run_context.out))
    assert [line["step"] for line in lines] == [298, 299, 300]
    last = metric_lines(artifacts.METRICS.load(learned))[-1]
    assert lines[0]["psnr"] > last["psnr"] - 3  # colours are known, too
    assert distance_to_ball(run_context.out) < 0.02


@pytest.mark.slow
def test_photos_keep_their_own_parameters_by_contents(tmp_path, learned):
    run_context = going_on(tmp_path, "out", learned)
    scene = seen_by(tmp_path / "undistort", [7, 3, 0, 1, 2, 4, 5, 6])
    trainer = train._make_trainer(run_context, scene)
    before = artifacts.SCENE.load(learned)
    assert train._take_over(trainer, run_context, scene.contents, before.contents)
    gains, earlier = trainer.fields.log_gains.detach(), load_field(artifacts.FIELD.load(learned)).fields.log_gains
    assert earlier.abs().max() > 0
    assert torch.equal(gains[1], earlier[3])
    assert torch.equal(gains[2], earlier[0])
    assert torch.equal(gains[0], torch.zeros(3))
    other = train._make_trainer(replace(run_context, params=changed(BALL, {"field.sdf_width": 8})), scene)
    assert not train._take_over(other, run_context, scene.contents, before.contents)


@pytest.mark.slow
def test_in_another_region_training_goes_on_from_the_shape(tmp_path, monkeypatch, learned):
    monkeypatch.setattr(train, "KEPT_SHAPE", 0.99)
    run_context = going_on(tmp_path, "out", learned)
    whole = regrown(sphere_scene(ring_of_cameras()), np.array([0.1, 0.0, 0.0]), 0.9)
    scene = seen_by(tmp_path / "undistort", list(range(8)), poses_from_scene=whole.poses_from_scene)
    artifacts.FIRST_SCENE.save(
        tmp_path / "undistort", replace(scene, cameras=whole.cameras, points=whole.points, growable=False)
    )
    assert train.run(run_context)["kept_of_budget"] == 0.99
    assert distance_to_ball(run_context.out) < 0.05


@pytest.mark.slow
def test_a_region_that_had_grown_stays_grown(tmp_path, monkeypatch, learned):
    previous = tmp_path / "previous"
    shutil.copytree(learned, previous)
    run_context = going_on(tmp_path, "out", previous, changed(BALL, {}))
    first = seen_by(tmp_path / "undistort", list(range(8)), growable=True)
    grown = regrown(replace(first, contents=first.contents[:7]), np.array([0.0, 0.0, 0.1]), 1.2)
    artifacts.SCENE.save(previous, grown)
    monkeypatch.setattr(train, "KEPT_NETWORKS", 0.99)
    numbers = train.run(run_context)
    assert numbers["kept_of_budget"] == 0.99
    assert numbers["region_grown"] == pytest.approx(1.2)
    np.testing.assert_allclose(
        artifacts.SCENE.load(run_context.out).poses_from_scene.matrix(), grown.poses_from_scene.matrix()
    )


@pytest.mark.slow
def test_a_training_that_goes_on_and_is_killed_ends_the_same(tmp_path, monkeypatch, learned):
    monkeypatch.setattr(train, "LOG_EVERY", 5)
    monkeypatch.setattr(train, "CHECKPOINT_EVERY", 0)
    results = []
    for name in ("whole", "killed"):
        run_context = going_on(tmp_path, name, learned)
        seen_by(tmp_path / "undistort", list(range(8)))
        if name == "killed":
            run_and_kill(run_context, monkeypatch, at=237)
        train.run(run_context)
        results.append(run_context.out)
    curves = [metric_lines(artifacts.METRICS.load(out)) for out in results]
    assert curves[0] == curves[1]
    assert [line["step"] for line in curves[0]] == list(range(215, 301, 5))


@pytest.mark.parametrize("why", ["other lineage", "no lineage", "held out", "too many new"])
def test_training_starts_anew_where_what_was_learned_is_no_ground(tmp_path, monkeypatch, why, caplog):
    previous = tmp_path / "previous"
    previous.mkdir()
    params = changed(BALL, {"hold_out": 4 if why == "held out" else 0})
    run_context = going_on(tmp_path, "out", previous, params)
    seen_by(previous, [0, 1, 2, 3])
    before = artifacts.FIRST_SCENE.load(previous)
    lineage = {"other lineage": "another", "no lineage": ""}.get(why, "the ball")
    artifacts.SCENE.save(previous, replace(before, lineage="" if why == "no lineage" else "the ball"))
    cameras = list(range(8)) if why == "too many new" else [0, 1, 2, 3, 4]
    scene = seen_by(tmp_path / "undistort", cameras, lineage=lineage)
    with caplog.at_level("INFO"):
        assert train._last_scene(run_context, scene) is None
    assert "training starts anew" in caplog.text
    scene = seen_by(tmp_path / "undistort", [0, 1, 2, 3, 4])
    artifacts.SCENE.save(previous, before)
    assert train._last_scene(replace(run_context, params=BALL), scene) is not None
    with caplog.at_level("INFO"):
        assert train._last_scene(replace(run_context, previous=None), scene) is None
    assert "training starts from the beginning: there is none with these settings" in caplog.text
