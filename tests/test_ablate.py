"""The measuring of variants: plans, copies of the shared stages, result files and the table, without training."""

from __future__ import annotations

import json
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from toy_pipeline import TOY

from benchmarks import ablate
from benchmarks.ablate import BASE, VARIANTS, Plan, Run, ablation_table, load_runs, save_run, start_from
from configs.load import load_config
from configs.params import Config
from stages.engine.runner import run_pipeline
from stages.engine.workspace import Workspace


def _run(variant=BASE, seed=0, mean: float | None = 1.0, cpu=100.0, psnr=30.0, steps=1500, name="banana", **changes):
    plan = Plan(name, variant, seed, steps, "cpu", VARIANTS[variant])
    score = None if mean is None else {"mean": mean}
    return Run(**{"plan": plan, "command": "hineus run", "machine": {"cpu": "x"}, "poses": "p", "score": score,
                  "psnr": psnr, "train_wall_s": cpu / 2, "train_cpu_s": cpu, **changes})  # fmt: skip


def _rows(runs):
    lines = ablation_table(runs).split("\n\n")[0].splitlines()[2:]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]


@pytest.fixture
def here(tmp_path, monkeypatch):
    """Result files, run folders and a page of their own, and one set of photos without truth."""
    monkeypatch.setattr(ablate, "RUNS", tmp_path / "runs")
    monkeypatch.setattr(ablate, "FOLDERS", tmp_path / "out")
    monkeypatch.setattr(ablate, "PAGE", tmp_path / "page.md")
    (tmp_path / "page.md").write_text("top\n<!-- table ablation -->\n<!-- end ablation -->\nbottom\n")
    (tmp_path / "data" / "banana" / "images").mkdir(parents=True)
    return tmp_path


# ---------------------------------------------------------------- variants
@pytest.mark.parametrize("variant", VARIANTS)
def test_every_variant_changes_settings_that_exist(variant):
    plain, changed = load_config("cpu"), load_config("cpu", None, VARIANTS[variant])
    assert (changed != plain) == (variant != BASE)


@pytest.mark.parametrize("preset", ["cpu", "gpu", "demo"])
def test_a_plan_fixes_steps_and_seed_whatever_the_preset(preset):
    arguments = Plan("banana", "ambiguity", 3, 700, preset, VARIANTS["ambiguity"]).arguments
    sets = [after for word, after in pairwise(arguments) if word == "--set"]
    train = load_config(preset, None, sets).train
    assert (train.steps, train.minutes, train.seed, train.ambiguity) == (700, None, 3, True)


# ---------------------------------------------------------------- table
def test_a_variant_is_compared_with_base_over_the_seeds():
    runs = [_run(mean=1.0), _run(seed=1, mean=1.2), _run("planar", mean=0.9, cpu=150.0, psnr=29.0),
            _run("planar", seed=1, mean=0.86, cpu=130.0, psnr=31.0)]  # fmt: skip
    assert _rows(runs) == [
        ["banana", "base", "1500", "2", "1.100", "0.200", "-", "-", "30.00"],
        ["banana", "planar", "1500", "2", "0.880", "0.040", "-20.0 %", "x 1.40", "30.00"],
    ]
    assert "- base: the preset as it is\n- planar: `train.planar=true`" in ablation_table(runs)


def test_only_the_seeds_that_both_have_are_compared():
    runs = [_run(mean=1.0), _run("planar", mean=0.5), _run("planar", seed=1, mean=9.0)]
    assert _rows(runs)[1][4:7] == ["4.750", "8.500", "-50.0 %"]


@pytest.mark.parametrize("other", [{"steps": 300}, {"name": "viking"}, {"poses": "q"}])
def test_runs_of_another_budget_set_or_start_are_not_compared(other):
    rows = _rows([_run(), _run("planar", **other)])
    assert rows[1][5:8] == ["-", "-", "-"]


def test_seconds_of_another_machine_are_not_compared():
    assert _rows([_run(), _run("planar", mean=0.5, machine={"cpu": "y"})])[1][6:8] == ["-50.0 %", "-"]


def test_sets_without_truth_get_their_psnr():
    rows = _rows([_run(mean=None), _run("planar", mean=None, psnr=31.5)])
    assert rows[1] == ["banana", "planar", "1500", "1", "-", "-", "-", "x 1.00", "31.50"]


def test_the_table_of_the_page_is_that_of_the_result_files():
    page = ablate.PAGE.read_text(encoding="utf-8")
    runs = load_runs()
    body = ablation_table(runs) if runs else ablate.NOT_MEASURED
    assert page == ablate.with_table(page, "ablation", body), "run `make docs`"


# ---------------------------------------------------------------- running
def test_results_survive_their_files_in_the_order_of_the_variants(here):
    runs = [_run(), _run(seed=1), _run("planar"), _run("all", mean=None)]
    for run in reversed(runs):
        save_run(run)
    assert load_runs() == runs


def test_runs_that_have_a_result_are_skipped(here, monkeypatch):
    made = []

    def measure(plan, data, keep):
        made.append(plan.name)
        if plan.name == "banana-ambiguity-1":
            raise RuntimeError("no")
        return _run(plan.variant, plan.seed, steps=plan.steps, plan=plan)

    monkeypatch.setattr(ablate, "measure", measure)
    command = [str(here / "data"), "--steps", "9", "--variants", "base,ambiguity", "--preset", "cpu"]
    every = ["banana-base-0", "banana-ambiguity-0", "banana-base-1", "banana-ambiguity-1"]
    assert ablate.main(command) == 1  # one failed, the others have results
    assert made == every
    ablate.main(command)
    assert made[4:] == ["banana-ambiguity-1"]
    ablate.main([*command, "--steps", "10", "--seeds", "1"])
    assert made[5:] == every[:2]
    ablate.main([*command, "--table-only"])
    assert len(made) == 7
    page = (here / "page.md").read_text()
    assert page.startswith("top\n")
    assert "| banana | ambiguity | 10 |" in page
    with pytest.raises(SystemExit):
        ablate.main([*command, "--variants", "plane"])


def test_the_copies_of_shared_stages_are_fresh(tmp_path):
    """Also when the folder held a run with other settings before."""
    photos = tmp_path / "photos"
    photos.mkdir()
    (photos / "a.jpg").write_text("abc")
    sources = {"photos": photos, "masks": None}

    def run(name, **options):
        return run_pipeline(TOY, Workspace.open(tmp_path / name, create=True), Config(), sources, **options)

    run("shared", until="undistort")
    for _ in range(2):
        start_from(tmp_path / "shared", tmp_path / "run", ["ingest", "sfm", "undistort"])
        assert [outcome.action for outcome in run("run")] == ["skipped", "skipped", "skipped", "ran"]


def _stub(calls, action="skipped"):
    """In the place of `hineus`: makes the folders that are copied and scored."""

    def hineus(arguments):
        calls.append(arguments)
        folder = Path(arguments[arguments.index("--workspace") + 1])
        for name in ablate.shared_stages():
            (folder / name).mkdir(parents=True, exist_ok=True)
        for name in ("workspace.json", "config.yaml"):
            (folder / name).write_text("{}")
        numbers = {"psnr": 31.25}
        names = [*ablate.shared_stages(), "train", "extract", "cleanup"]
        stages = [{"name": n, "action": action, "reason": "why", "numbers": numbers, "wall_s": 2.04, "cpu_s": 3.06}
                  for n in names]  # fmt: skip
        return {"device": "cpu", "stages": stages}

    return hineus


def test_a_run_starts_from_the_shared_stages_and_leaves_its_figures_only(here, monkeypatch):
    calls: list[list[str]] = []
    monkeypatch.setattr(ablate, "run_hineus", _stub(calls))
    manifest = SimpleNamespace(outputs_digest="0123456789abcdef")
    monkeypatch.setattr("stages.engine.manifest.load_manifest", lambda folder: manifest)
    plan = Plan("banana", "planar", 1, 9, "cpu", VARIANTS["planar"])
    run = ablate.measure(plan, here / "data")
    assert [Path(call[3]).name for call in calls] == ["shared", "planar-1"]
    assert "undistort" in calls[0]
    assert (run.psnr, run.train_wall_s, run.train_cpu_s, run.poses) == (31.25, 2.0, 3.1, "0123456789ab")
    assert (run.score, run.machine["device"]) == (None, "cpu")
    assert run.command.startswith("hineus run DATA/banana/images --until cleanup --preset cpu --set train.planar=true")
    assert not (here / "out" / "banana" / "planar-1").exists()
    assert (here / "out" / "banana" / "shared" / "sfm").is_dir()
    ablate.measure(plan, here / "data", keep=True)
    assert (here / "out" / "banana" / "planar-1").is_dir()
    save_run(run)
    assert json.loads((here / "runs" / "banana-planar-1.json").read_text())["plan"]["steps"] == 9


def test_a_run_with_poses_of_its_own_is_refused(here, monkeypatch):
    monkeypatch.setattr(ablate, "run_hineus", _stub([], action="ran"))
    with pytest.raises(RuntimeError, match="ingest, sfm, undistort ran again"):
        ablate.measure(Plan("banana", BASE, 0, 9, "cpu", ()), here / "data")


def test_the_mesh_is_scored_in_the_world_frame(tmp_path, monkeypatch):
    from stages import artifacts
    from stages.geometry.similarity import Similarity

    truth, folder = tmp_path / "truth", tmp_path / "run"
    (folder / "cleanup").mkdir(parents=True)
    truth.mkdir()
    assert ablate.score_clean_mesh(folder, truth) is None
    for name in ("gt_mesh.ply", "transforms.json"):
        (truth / name).write_text("")
    corners = np.eye(3)
    artifacts.save_mesh(folder / "cleanup", corners, np.array([[0, 1, 2]]))
    world = Similarity(2.0, np.eye(3), np.array([1.0, 0.0, 0.0]))
    monkeypatch.setattr(artifacts, "load_scene", lambda path: SimpleNamespace(world_from_scene=world))
    seen = {}

    def score_mesh(mesh, model, where):
        seen["vertices"], seen["model"] = artifacts.load_mesh(mesh.parent)[0], model
        return {"mean": 1.0}

    monkeypatch.setattr("hineus_cli.scoring.score_mesh", score_mesh)
    assert ablate.score_clean_mesh(folder, truth) == {"mean": 1.0}
    assert np.allclose(seen["vertices"], 2 * corners + [1, 0, 0])
    assert seen["model"] == folder / "sfm" / "model"
