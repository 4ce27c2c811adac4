"""Two processes that train together learn what one does: gradients, parameters, numbers; and what if one ends."""

from __future__ import annotations

import io
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from ball_training import SMALL, TINY, make_trainer
from sphere_scene import render, ring_of_cameras
from train_settings import changed
from two_processes import free_port, in_two_processes, torchruns

from stages import artifacts, train
from stages.engine.stage import StageContext
from stages.errors import HineusError
from stages.neural import ranks as ranks_module
from stages.neural.ranks import ALONE, Ranks, ours
from stages.neural.trained_field import load_field
from stages.neural.trainer import Trainer

PROGRAM = Path(__file__).with_name("small_train.py")
STEPS = 20
# Without the term that picks some of the rays at hand; and few rays, of which memory may hold still fewer.
ONE_STEP = changed(TINY, {"terms.planar.form": "off", "sampling.rays": 65})
# The grid that guides samples, and where rays are needed, are looked at twice.
SOME_STEPS = changed(TINY, {"sampling.cache_every": 8})


def joined_trainer(params: Any = TINY, masks: bool = False) -> Trainer:
    """A trainer on the photos of a ball that takes part where this process has joined others."""
    alone = make_trainer(params, masks)
    return Trainer(alone.photos, alone.sightings, alone.dense, params, "cpu", ranks=ours())


# ---------------------------------------------------------------- what runs in each process
def one_step(masks: bool = False, most: dict[int, int] | None = None, steps: int = 1) -> dict[str, Any]:
    """Of a step with samples in the middle of their strata: numbers, gradients, and how many rays were rendered.

    Args:
        most: rays that memory has room for, of some ranks.
        steps: the last of so many.
    """
    trainer, rendered = joined_trainer(ONE_STEP, masks), []
    draw, room = trainer.renderer.render, (most or {}).get(ours().rank, 1000)

    def scarce(batch: Any, moment: Any, places: Any, chance: torch.Generator) -> Any:
        rendered.append(len(batch))
        if len(batch) > room:
            raise RuntimeError("CUDA out of memory. Tried to allocate 2.00 GiB")
        return draw(batch, moment, places)

    trainer.renderer.render = scarce
    for _ in range(steps):
        numbers = {name: float(value) for name, value in trainer.step(0.3).items()}
    numbers["needed"] = float(trainer.needed.errors.sum())
    gradients = {name: p.grad.clone() for name, p in trainer.fields.named_parameters() if p.grad is not None}
    return {"numbers": numbers, "gradients": gradients, "rendered": rendered}


def some_steps(replayed: bool = False) -> dict[str, Any]:
    """State and numbers after some steps; as a GPU makes them where that is said, all but the graph itself."""
    trainer = joined_trainer(SOME_STEPS)
    if replayed:
        trainer.replay = lambda work, kind: work()
    numbers = [{name: float(v) for name, v in trainer.step(i / STEPS).items()} for i in range(STEPS)]
    return {"state": trainer.state(), "upto": trainer.needed.tables, "numbers": numbers}


def all_of_it() -> dict[str, Any]:
    """Everything that needs no processes of its own: to start two takes seconds."""
    return {
        "background": one_step(),
        "masks": one_step(masks=True),
        "scarce": one_step(masks=True, most={1: 20}),
        "several": one_step(steps=8),
        "steps": some_steps(),
        "replayed": some_steps(replayed=True),
        "none": none_here_and_there(),
        "drifted": what_is_said_of_a_drift(),
    }


def none_here_and_there() -> list[Any]:
    """Gradients of parameters that the first, the second, both, or no process has one of."""
    parameters = [torch.zeros(2, requires_grad=True) for _ in range(4)]
    for parameter, holders in zip(parameters, ((0,), (1,), (0, 1), ()), strict=True):
        if ours().rank in holders:
            parameter.grad = torch.full((2,), 1.0 + ours().rank)
    sums = ours().sum_gradients(parameters, [torch.tensor(5.0), torch.eye(2)])
    return [[p.grad for p in parameters], sums]


def what_is_said_of_a_drift() -> str:
    """In a group of its own, since nothing can be done together afterwards."""
    drifting = Ranks(ours().rank, 2)
    parameter = torch.ones(3)
    drifting.check_same([parameter])
    parameter[1] += 1e-7 * ours().rank
    with pytest.raises(HineusError) as caught:
        drifting.check_same([parameter])
    return caught.value.message


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> list[dict[str, Any]]:
    return in_two_processes(all_of_it, tmp_path_factory.mktemp("ranks"))


# ---------------------------------------------------------------- a step
def assert_same_step(here: dict[str, Any], alone: dict[str, Any]) -> None:
    assert here["numbers"] == pytest.approx(alone["numbers"], rel=1e-4, abs=1e-6)
    assert here["gradients"].keys() == alone["gradients"].keys()
    assert len(alone["gradients"]) > 5
    for name, whole in alone["gradients"].items():
        scale = float(whole.abs().max())
        assert scale > 0
        torch.testing.assert_close(here["gradients"][name], whole, rtol=1e-3, atol=1e-5 * scale, msg=name)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["background", "masks"])
def test_gradients_of_two_processes_are_those_of_one(found, kind):
    alone = one_step(masks=kind == "masks")
    assert alone["rendered"] == [65]
    assert [each[kind]["rendered"] for each in found] == [[32], [33]]
    for each in found:
        assert_same_step(each[kind], alone)


@pytest.mark.slow
def test_after_several_steps_numbers_of_two_processes_are_those_of_one(found):
    alone, first = one_step(steps=8)["numbers"], one_step()["numbers"]
    assert alone["loss"] != pytest.approx(first["loss"], rel=0.2)
    for each in found:
        for name in ("loss", "rgb", "opacity", "gradient_norm", "psnr", "needed"):
            assert each["several"]["numbers"][name] == pytest.approx(alone[name], rel=0.01), name


@pytest.mark.slow
def test_one_of_two_processes_may_have_less_memory(found):
    assert [each["scarce"]["rendered"] for each in found] == [[32], [33, 32, 16, 16, 1]]
    for each in found:
        assert_same_step(each["scarce"], one_step(masks=True))


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["steps", "replayed"])
def test_two_processes_stay_the_same_bit_for_bit(found, kind):
    first, second = (each[kind] for each in found)
    assert first["numbers"] == second["numbers"]
    for one, other in zip(first["upto"], second["upto"], strict=True):
        assert torch.equal(one, other)
    assert first["upto"][-1][-1] > 0
    one, other = first["state"], second["state"]
    assert torch.equal(one["cache"], other["cache"])
    assert torch.equal(one["generator"], other["generator"])
    for name, value in one["fields"].items():
        assert torch.equal(value, other["fields"][name]), name
    for i, moments in one["optimizer"]["state"].items():
        for name, value in moments.items():
            assert torch.equal(value, other["optimizer"]["state"][i][name])


@pytest.mark.slow
def test_two_processes_learn_what_one_learns(found):
    """Chance is another one, so not to rounding: how well they meet the colours."""
    alone = some_steps()["numbers"]
    for kind in ("steps", "replayed"):
        errors = [np.mean([step["rgb"] for step in steps[-5:]]) for steps in (alone, found[0][kind]["numbers"])]
        assert errors[1] == pytest.approx(errors[0], rel=0.1)
    course = [step["rgb"] for step in alone]
    assert max(course) > 1.5 * min(course)  # so that it means something to be as near as that


@pytest.mark.slow
def test_each_process_has_chance_of_its_own(found):
    assert len({Ranks(rank).seed(0, step) for rank in (0, 1) for step in range(50)}) == 100
    assert Ranks(1).seed(3, 4) == Ranks(1).seed(3, 4) != Ranks(1).seed(4, 4)


@pytest.mark.slow
def test_a_parameter_has_a_gradient_where_it_had_one_anywhere(found):
    for gradients, sums in (each["none"] for each in found):
        assert [None if g is None else g.tolist() for g in gradients] == [[1, 1], [2, 2], [3, 3], None]
        assert sums[0].item() == 10
        assert torch.equal(sums[1], 2 * torch.eye(2))


@pytest.mark.slow
def test_networks_that_drift_apart_are_an_error(found):
    assert {each["drifted"] for each in found} == {"The networks of the 2 processes are no longer the same."}


@pytest.mark.parametrize("count", [2, 3, 7, 512])
@pytest.mark.parametrize("size", [1, 2])
def test_each_ray_is_rendered_by_one_process(monkeypatch, count, size):
    monkeypatch.setattr(ranks_module.dist, "new_group", lambda **_: None)
    rows = [np.arange(count)[Ranks(rank, size).share(count)] for rank in range(size)]
    assert np.concatenate(rows).tolist() == list(range(count))
    assert max(map(len, rows)) - min(map(len, rows)) <= 1


def test_fewer_rays_than_processes_are_refused(monkeypatch):
    monkeypatch.setattr(ranks_module.dist, "new_group", lambda **_: None)
    with pytest.raises(ValueError, match="1 rays cannot be shared by 2 processes"):
        Ranks(0, 2).share(1)
    assert ALONE.share(0) == slice(0, 0)


def test_processes_that_share_a_gpu_are_refused(monkeypatch):
    monkeypatch.setattr(ranks_module.dist, "new_group", lambda **_: None)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
    ALONE.use("cuda")
    Ranks(1, 2, 1, 2).use("cpu")
    with pytest.raises(HineusError, match="2 processes on this machine, and 1 GPUs"):
        Ranks(1, 2, 1, 2).use("cuda")


@pytest.mark.parametrize("region", [None, train._Region((0.1, 0.0, -0.2), 1.5)])
def test_what_is_told_of_a_training_is_all_that_its_trainer_is_made_of(tmp_path, region):
    params = changed(TINY, {"minutes": 2.5, "field.init": "room"})
    context = StageContext({"undistort": tmp_path}, {}, tmp_path, tmp_path, params, "cuda", 3)
    state = {"step_index": 7, "cache": torch.arange(3.0)}
    training = SimpleNamespace(context=context, region=region, trainer=SimpleNamespace(state=lambda: state))
    told = torch.load(io.BytesIO(train._as_told(training)), weights_only=True)
    understood, in_region = train._from_told(told["of"])
    assert understood.inputs == context.inputs
    assert (understood.params, understood.device, understood.workers) == (params, "cuda", 3)
    assert in_region == region
    assert torch.equal(told["trainer"]["cache"], state["cache"])


# ---------------------------------------------------------------- the command
@pytest.fixture
def photos(tmp_path: Path) -> Path:
    from PIL import Image

    folder = tmp_path / "photos"
    folder.mkdir()
    for i in range(3):
        Image.fromarray(render(ring_of_cameras(), i)[0]).save(folder / f"{i}.png")
    return folder


def arguments(photos: Path, workspace: Path, **sets: object) -> list[str]:
    settings = {**SMALL, "terms.planar.form": "off", **sets}
    named = [part for name, value in settings.items() for part in ("--set", f"train.{name}={value}")]
    return ["train", str(photos), "--workspace", str(workspace), "--device", "cpu", "--workers", "2", *named]


def started(command: list[str], **environment: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, *command], env={**os.environ, "LOG_EVERY": "5", "CHECKPOINT_EVERY": "0", **environment},
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
    )  # fmt: skip


def two_started(command: list[str]) -> list[subprocess.Popen[str]]:
    """As torchrun starts them, but with nobody who ends one of them because the other one ended."""
    port = free_port()
    return [started(command, **torchruns(rank, port)) for rank in range(2)]


def metric_lines(workspace: Path) -> list[dict[str, float]]:
    return [json.loads(line) for line in artifacts.METRICS.load(workspace / "train").read_text().splitlines()]


def scratch_metrics(workspace: Path) -> Path:
    return artifacts.METRICS.load(workspace / ".work" / "train" / "scratch")


@pytest.mark.slow
def test_torchrun_trains_a_workspace_as_one_process_does(tmp_path, photos):
    """Each draws places on its rays of its own, so numbers are those of one process but for chance."""
    with_one, with_two = tmp_path / "one", tmp_path / "two"
    one = started([str(PROGRAM), *arguments(photos, with_one)])
    assert one.wait(900) == 0, one.stdout.read()
    torchrun = ["-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
    two = started([*torchrun, str(PROGRAM), *arguments(photos, with_two)])
    output, _ = two.communicate(timeout=900)
    assert two.returncode == 0, output
    lines = [metric_lines(each) for each in (with_one, with_two)]
    assert [line["step"] for line in lines[0]] == [line["step"] for line in lines[1]] == list(range(5, 61, 5))
    assert [line["progress"] for line in lines[0]] == [line["progress"] for line in lines[1]]
    psnr, rgb = (np.array([[line[name] for line in each] for each in lines]).mean(1) for name in ("psnr", "rgb"))
    assert psnr[1] == pytest.approx(psnr[0], abs=0.3)
    assert rgb[1] == pytest.approx(rgb[0], rel=0.15)
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (200, 3))
    sdfs = [load_field(artifacts.FIELD.load(each / "train")).sdf(points) for each in (with_one, with_two)]
    assert np.abs(sdfs[0] - sdfs[1]).mean() < 0.1 * sdfs[0].std()
    assert output.count("workspace: ") == 1  # one of them tells


@pytest.mark.slow
def test_where_one_process_is_killed_the_other_ends_and_both_go_on_later(tmp_path, photos):
    workspace = tmp_path / "workspace"
    command = [str(PROGRAM), *arguments(photos, workspace, steps=3000)]
    first, second = two_started(command)
    until = time.monotonic() + 900
    while not (scratch_metrics(workspace).exists() and scratch_metrics(workspace).read_text().count("\n") > 3):
        assert time.monotonic() < until
        assert first.poll() is None, first.stdout.read()
        time.sleep(0.1)
    second.send_signal(signal.SIGKILL)
    output, _ = first.communicate(timeout=300)
    assert first.returncode == 6
    told = " ".join(output.split())
    assert "Process 0 of 2 cannot go on without the others" in told
    assert "The last checkpoint is kept: run the same command again to go on." in told
    assert artifacts.checkpoint_path(workspace / ".work" / "train" / "scratch").exists()
    step = json.loads(scratch_metrics(workspace).read_text().splitlines()[-1])["step"]

    first, second = two_started(command)
    time.sleep(0.1)
    while not (
        scratch_metrics(workspace).exists() and f'"step": {step + 20},' in scratch_metrics(workspace).read_text()
    ):
        assert first.poll() is None, first.stdout.read()
        time.sleep(0.1)
    first.send_signal(signal.SIGKILL)
    output, _ = second.communicate(timeout=300)
    assert second.returncode == 6
    assert "Process 1 of 2 cannot go on without the others" in " ".join(output.split())


@pytest.mark.slow
def test_processes_that_have_nothing_to_train_end_with_the_first(tmp_path, photos):
    for first_code, command in (
        (0, ["--help"]),
        (2, ["train", "--preset", "none"]),
        (3, ["train", str(tmp_path / "no")]),
    ):
        first, second = two_started([str(PROGRAM), *command])
        assert first.wait(300) == first_code
        assert second.wait(300) == 0
