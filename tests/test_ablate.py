"""The measuring of variants: plans, what a run does, result files and the table, without training."""

from __future__ import annotations

import ast
import itertools
import json
from dataclasses import asdict, replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from benchmarks import ablate, pages
from benchmarks.ablate import (
    BASE,
    DEFAULTS,
    VARIANTS,
    Plan,
    Run,
    ablation_table,
    load_runs,
    parse_extra,
    save_run,
    settings_of,
)
from configs.load import load_config
from stages import artifacts
from stages.engine.stage import Stage, StageContext


def _plan(variant=BASE, seed=0, steps=1500, name="helmet", holdout=0) -> Plan:
    return Plan(name, variant, seed, steps, "cpu", settings_of(variant, VARIANTS[variant]), holdout)


def _run(variant=BASE, seed=0, mean: float | None = 1.0, cpu=100.0, psnr=30.0, steps=1500, name="helmet", **changes):
    score = None if mean is None else {"mean": mean}
    return Run(**{"plan": _plan(variant, seed, steps, name), "command": "ablate", "machine": {"cpu": "x"}, "poses": "p",
                  "code": "c", "score": score, "psnr": psnr, "held_out_psnr": None, "train_wall_s": cpu / 2,
                  "train_cpu_s": cpu, "steps": steps, "config": "s", **changes})  # fmt: skip


def _rows(runs):
    lines = [line for line in ablation_table(runs).splitlines() if line.startswith("|")]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines if not line.startswith("| ---")][1:]


@pytest.fixture
def here(tmp_path, monkeypatch):
    """Result files, run folders and a page of their own; a set with a known surface and one without."""
    monkeypatch.setattr(ablate, "RUNS", tmp_path / "runs")
    monkeypatch.setattr(ablate, "FOLDERS", tmp_path / "out")
    monkeypatch.setattr(pages, "DOCS", tmp_path)
    tables = "".join(f"<!-- table {name} -->\n<!-- end {name} -->\n" for name in ablate.tables())
    (tmp_path / "page.md").write_text(f"top\n{tables}bottom\n")
    for name in ("helmet", "scan"):
        (tmp_path / "data" / name / "images").mkdir(parents=True)
        for stage in ("undistort", "densify"):
            (tmp_path / "out" / name / "shared" / stage).mkdir(parents=True)
    for name in ("gt_mesh.ply", "transforms.json"):
        (tmp_path / "data" / "helmet" / name).write_text("")
    return tmp_path


# ---------------------------------------------------------------- variants
@pytest.mark.parametrize("variant", VARIANTS)
def test_every_variant_changes_settings_that_exist(variant):
    start = ablate.compared_with(variant)
    plain, changed = (load_config("cpu", None, settings_of(start, changes)) for changes in ({}, VARIANTS[variant]))
    assert (changed != plain) == (variant not in (BASE, DEFAULTS))


def test_no_two_variants_are_the_same():
    assert len({settings_of(name, changes) for name, changes in VARIANTS.items()}) == len(VARIANTS)
    assert sum(map(len, ablate.GROUPS.values())) == len(VARIANTS)


def test_the_defaults_are_those_of_a_run_whatever_they_become():
    assert settings_of(DEFAULTS, VARIANTS[DEFAULTS]) == ()
    assert settings_of("defaults-planar", {"train.terms.planar.form": "off"}) == ("train.terms.planar.form=off",)
    assert (ablate.compared_with("defaults-planar"), ablate.compared_with("planar")) == (DEFAULTS, BASE)


def test_settings_that_the_plan_does_not_name_count_too():
    plans = [_plan(), replace(_plan(), preset="gpu"), _plan("planar")]
    assert len({ablate.config_hash(plan) for plan in plans}) == 3


def test_every_part_can_be_left_out_and_all_but_one_left():
    for name, part in ablate.PARTS.items():
        assert part.off.items() <= ablate.TERMS_OFF.items()
        for form, settings in part.forms.items():
            rest = VARIANTS[f"{ablate.ALL[form]}-{name}"]
            assert {**rest, **settings} == VARIANTS[ablate.ALL[form]]
            assert len(rest) < len(VARIANTS[ablate.ALL[form]])


@pytest.mark.parametrize("term", ["ambiguity", "reflection", "planar", "eikonal"])
def test_a_term_as_published_is_that_of_the_paper_preset(term):
    published = getattr(load_config("paper", None, []).train.terms, term)
    for variant in (f"{term}-paper", "all-paper"):
        plan = replace(_plan(), settings=settings_of(variant, VARIANTS[variant]))
        assert getattr(load_config("cpu", None, plan.sets).train.terms, term) == published


def test_variants_are_named_one_by_one_or_by_group():
    assert list(ablate.named_variants("planar,terms")) == [BASE, DEFAULTS, "planar"]
    assert list(ablate.named_variants("steps")) == list(ablate.GROUPS["steps"])
    with pytest.raises(ValueError, match="no variant plane; there are the groups terms, "):
        ablate.named_variants("plane")


def test_the_base_has_every_term_off_whatever_the_defaults():
    sets = ["train.terms.planar.form=paper", "train.terms.ambiguity.form=stable", *settings_of(BASE, {})]
    train = load_config("cpu", None, sets).train
    terms = train.terms
    forms = (terms.ambiguity.form, terms.reflection.form, terms.planar.form, terms.eikonal.form)
    assert forms == ("off", "off", "off", "plain")


@pytest.mark.parametrize("preset", ["cpu", "gpu", "demo"])
def test_a_plan_fixes_steps_seed_and_hold_out_whatever_the_preset(preset):
    plan = Plan("helmet", "ambiguity", 3, 700, preset, settings_of("ambiguity", VARIANTS["ambiguity"]), 8)
    train = load_config(preset, None, plan.sets).train
    assert (train.steps, train.minutes, train.seed, train.hold_out) == (700, None, 3, 8)
    assert train.steps_if_covered == 1
    assert load_config(preset, None, replace(plan, covered=True).sets).train.steps_if_covered < 1
    assert train.terms.ambiguity.form == "stable"


def test_an_extra_variant_is_named_settings_on_top_of_the_base_or_of_a_variant():
    assert parse_extra("far:reflection_reach=0.3,cleanup.min_views=2") == (
        "far", {"train.terms.reflection.reach": "0.3", "cleanup.min_views": "2"}
    )  # fmt: skip
    _, changes = parse_extra("far:planar-paper,weight_planar=0.3")
    assert changes == {**VARIANTS["planar-paper"], "train.terms.planar.weight": "0.3"}
    assert load_config("cpu", None, settings_of("far", changes)).train.terms.planar.weight == 0.3


@pytest.mark.parametrize("text", ["far", "far:", "planar:steps=3", "a/b:steps=3", "far:nothing"])
def test_an_extra_variant_of_another_form_is_refused(text):
    with pytest.raises(ValueError, match=text):
        parse_extra(text)


def test_runs_go_by_variant_then_seed_then_set():
    plans = ablate.make_plans({"a": 0, "b": 8}, {BASE: {}, "planar": VARIANTS["planar"]}, 2, 9, "cpu")
    names = [plan.name for plan in plans]
    assert names[:5] == ["a-terms-off-0", "b-terms-off-0", "a-terms-off-1", "b-terms-off-1", "a-planar-0"]
    assert [plan.holdout for plan in plans[:2]] == [0, 8]


# ---------------------------------------------------------------- table
def test_a_variant_is_compared_with_base_over_the_seeds():
    runs = [_run(mean=1.0), _run(seed=1, mean=1.2), _run("planar", mean=0.9, cpu=150.0, psnr=29.0),
            _run("planar", seed=1, mean=0.86, cpu=130.0, psnr=31.0)]  # fmt: skip
    assert _rows(runs) == [
        ["terms-off", "1500", "2", "1.100", "-", "-", "0.200", "-", "-", "-", "30.00"],
        ["planar", "1500", "2", "0.880", "-", "-", "0.040", "-20.0 %", "helps", "x 1.40", "30.00"],
    ]
    table = ablation_table(runs)
    assert table.startswith("**helmet**\n\n| variant |")
    assert "- planar: `train.terms.planar.form=stable`" in table


@pytest.mark.parametrize(
    ("means", "verdict"),
    [((0.95, 1.00), "within spread"), ((0.85, 0.90), "helps"), ((1.20, 1.30), "hurts"), ((0.6, 1.2), "within spread")],
)
def test_a_change_counts_when_it_is_more_than_the_larger_spread(means, verdict):
    runs = [_run(mean=1.0), _run(seed=1, mean=1.1)]
    runs += [_run("planar", seed=seed, mean=mean) for seed, mean in enumerate(means)]
    assert _rows(runs)[1][8] == verdict


def test_only_the_seeds_that_both_have_are_compared():
    runs = [_run(mean=1.0), _run("planar", mean=0.5), _run("planar", seed=1, mean=9.0)]
    assert _rows(runs)[1][3:9] == ["4.750", "-", "-", "8.500", "-50.0 %", "-"]


@pytest.mark.parametrize("other", [{"steps": 300}, {"name": "viking"}, {"poses": "q"}])
def test_runs_of_another_budget_set_or_start_are_not_compared(other):
    rows = [row for row in _rows([_run(), _run("planar", **other)]) if row[0] == "planar"]
    assert rows[0][7:10] == ["-", "-", "-"]


def test_seconds_of_another_machine_are_not_compared():
    assert _rows([_run(), _run("planar", mean=0.5, machine={"cpu": "y"})])[1][7:10] == ["-50.0 %", "-", "-"]


def test_sets_without_a_surface_are_compared_by_the_photos_left_out():
    runs = [_run(variant, seed, None, held_out_psnr=psnr + 0.1 * seed)
            for variant, psnr in ((BASE, 25.0), ("planar", 25.6), ("eikonal", 24.0)) for seed in (0, 1)]  # fmt: skip
    assert [row[5:9] for row in _rows(runs)] == [
        ["25.05", "0.100", "-", "-"],
        ["25.65", "0.100", "+0.60 dB", "helps"],
        ["24.05", "0.100", "-1.00 dB", "hurts"],
    ]


def test_results_of_other_code_are_marked():
    runs = [_run(), _run("planar", mean=0.5, code="d"), _run("eikonal", mean=0.5)]
    assert [row[7] for row in _rows(runs)] == ["-", "-50.0 % *", "-50.0 %"]
    assert "Versions: `c` terms-off, eikonal; `d` planar." in ablation_table(runs)
    assert "Versions" not in ablation_table([_run(), _run("planar")])


def test_the_defaults_stand_beside_the_same_without_terms():
    """A row a set and budget: distances of both, of each seed, the normals, and what a step costs."""

    def scored(variant, seed, mean, cpu=100.0, **changes):
        return _run(variant, seed, cpu=cpu, score={"mean": mean, "normals_deg": 20 * mean}, **changes)

    runs = [scored(BASE, 0, 1.0), scored(BASE, 1, 1.1), scored(DEFAULTS, 0, 0.7, 240.0, steps=1500),
            scored(DEFAULTS, 1, 0.8, 240.0), scored("planar", 0, 0.1),
            scored(DEFAULTS, 0, 0.5, name="other")]  # fmt: skip
    runs[2] = replace(runs[2], steps=3000)  # it took more
    lines = ablate.terms_table(runs).splitlines()
    assert len(lines) == 3
    assert [cell.strip() for cell in lines[2].strip("|").split("|")] == [
        "helmet", "1500 to 3000", "2", "1.050 (1.00, 1.10)", "0.750 (0.70, 0.80)", "-28.6 %", "helps", "21.0", "15.0",
        "x 1.80",
    ]  # fmt: skip
    assert ablate.terms_table(runs[:2]) == pages.NOT_MEASURED


def test_what_the_paper_claims_stands_beside_what_is_seen():
    names = {"all": 1.0, "all-ambiguity": 1.2, "all-paper": 2.0, "all-paper-ambiguity": 1.0, "planar": 1.0}
    runs = [_run(variant, mean=mean, name="mirror") for variant, mean in names.items()]
    runs += [_run("all-ambiguity", mean=9.0, name="mirror", steps=9)]  # another budget
    runs += [_run("all-reflection", None, mean=None, name="treetrunk", held_out_psnr=20.0)]
    lines = ablate.paper_table(runs).splitlines()
    assert [cell.strip() for cell in lines[2].strip("|").split("|")] == [
        "GlossySynthetic", "HiNeuS, no ambiguity weight", "+15.2 %", "mirror", "1500", "+20.0 %", "-50.0 %"
    ]  # fmt: skip
    assert len(lines) == 3


def test_every_row_of_the_papers_ablation_is_a_variant():
    rows = {row.method for table in ablate.paper_tables().values() for row in table.rows}
    ours = {method for method in rows if method.startswith("HiNeuS")}
    assert ours == set(ablate.PAPER_ROWS)
    assert {ablate.ALL[form] + left for form in ablate.FORMS for left in ablate.PAPER_ROWS.values()} <= set(VARIANTS)


# ---------------------------------------------------------------- running
def test_runs_of_settings_before_something_changed_are_not_in_the_tables(here):
    now, before = _plan("planar"), _plan("planar", 1)
    otherwise = replace(now, seed=2, settings=(*now.settings, "train.terms.planar.weight=0.3"))
    no_more = replace(now, variant="far", settings=("train.no_such=1",))
    for plan in (now, otherwise):
        save_run(_run(mean=1.0 + 8 * plan.seed, plan=plan, config=ablate.config_hash(plan)))
    for plan in (before, no_more):
        save_run(_run(mean=9.0, plan=plan, config="s"))
    table = ablate.tables()["ablation"]
    assert table.splitlines()[4].replace(" ", "").startswith("|planar|1500|1|1.000|")
    assert table.splitlines()[5] == ""
    assert table.endswith("Left out: 3 runs from before variants, presets or defaults changed.")
    for run in ablate.RUNS.glob("*.json"):
        if "planar-0" not in run.name:
            run.unlink()
    assert "Left out" not in ablate.tables()["ablation"]


def test_all_that_the_stages_measured_import_is_in_the_hash_of_their_code():
    """But what reads, writes and says, and the settings, which have a hash of their own."""
    stages = ablate.ROOT / "stages"
    seen, pending = set(), [f"stages.{name}" for name in ("train", "extract", "cleanup")]
    while pending:
        module = stages.parent.joinpath(*pending.pop().split("."))
        source = next((s for s in (module.with_suffix(".py"), module / "__init__.py") if s.is_file()), None)
        if source is None or source in seen:
            continue
        seen.add(source)
        for node in ast.walk(ast.parse(source.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("stages"):
                pending += [node.module, *(f"{node.module}.{name.name}" for name in node.names)]
    parts = {source.relative_to(stages).parts[0] for source in seen}
    assert {"train.py", "neural", "surface", "geometry"} <= parts
    elsewhere = {"__init__.py", "artifacts", "blocks.py", "caches.py", "engine", "errors.py", "inputs", "limits.py"}
    assert parts - elsewhere == set(ablate.SOURCES)


def test_results_survive_their_files_in_the_order_of_the_variants(here):
    runs = [_run(), _run(seed=1), _run("planar"), _run("all", mean=None)]
    for run in reversed(runs):
        save_run(run)
    assert load_runs() == runs


def test_runs_that_have_a_result_are_skipped_and_a_failure_stops_no_other(here, monkeypatch):
    made = []

    def run_apart(plan, data, jobs, keep):
        made.append(plan.name)
        if plan.name == "scan-planar-1":
            raise RuntimeError("no")
        save_run(_run(plan=plan, steps=plan.steps, config=ablate.config_hash(plan)))

    monkeypatch.setattr(ablate, "run_apart", run_apart)
    monkeypatch.setattr(ablate, "poses_hash", lambda folder: "p")
    monkeypatch.setattr(ablate, "config_hash", lambda plan: "s")
    command = [str(here / "data"), "--steps", "9", "--variants", "planar,terms-off", "--preset", "cpu", "--jobs", "1"]
    every = ["helmet-terms-off-0", "scan-terms-off-0", "helmet-terms-off-1", "scan-terms-off-1",
             "helmet-planar-0", "scan-planar-0", "helmet-planar-1", "scan-planar-1"]  # fmt: skip
    (here / "data" / "scan" / "cameras_sphere.npz").write_text("")
    assert ablate.main(command) == 1  # one failed, the others have results
    assert made == every
    ablate.main(command)
    assert made[8:] == ["scan-planar-1"]
    ablate.main([*command, "--steps", "10", "--seeds", "1"])
    assert made[9:] == [every[0], every[1], every[4], every[5]]
    monkeypatch.setattr(ablate, "poses_hash", lambda folder: "q")  # photos and poses were made ready anew
    ablate.main([*command, "--steps", "10", "--seeds", "1"])
    assert len(made) == 17
    monkeypatch.setattr(ablate, "config_hash", lambda plan: "t")  # a default is another now
    ablate.main([*command, "--steps", "10", "--seeds", "1"])
    assert len(made) == 21
    ablate.main([*command, "--table-only"])
    assert len(made) == 21
    page = (here / "page.md").read_text()
    assert page.startswith("top\n")
    assert "| planar | 10 |" in page
    assert "| planar | 9 |" not in page
    for wrong in (["--variants", "plane"], ["--extra", "far"]):
        with pytest.raises(SystemExit):
            ablate.main([*command, *wrong])


def test_all_sets_with_a_truth_are_run_and_those_named(here, monkeypatch):
    made = []
    monkeypatch.setattr(ablate, "run_plans", lambda plans, *_: made.extend(plans) or [])
    command = [str(here / "data"), "--variants", BASE, "--seeds", "1"]
    ablate.main(command)
    ablate.main([*command[:1], "scan", *command[1:]])
    assert [(plan.set, plan.holdout) for plan in made] == [("helmet", 0), ("scan", ablate.HOLDOUT)]


def test_a_budget_is_of_the_steps_of_the_preset(here, monkeypatch):
    made = []
    monkeypatch.setattr(ablate, "run_plans", lambda plans, *_: made.extend(plan.steps for plan in plans) or [])
    for preset in ("cpu", "demo"):
        ablate.main([str(here / "data"), "--variants", BASE, "--seeds", "1", "--budget", "2", "--preset", preset])
    assert made == [2 * load_config(preset, None, []).train.steps for preset in ("cpu", "demo")]
    assert made[0] != made[1]


def test_a_process_of_its_own_has_one_thread_and_says_what_failed(here, monkeypatch):
    seen = {}

    def process(words, cwd, env, stdout, stderr, check):
        seen.update(order=json.loads(Path(words[-1]).read_text()), threads=env["OMP_NUM_THREADS"])
        stdout.write("Traceback\nthe last line\n")
        return SimpleNamespace(returncode=seen.get("code", 0))

    monkeypatch.setattr(ablate.subprocess, "run", process)
    plan = _plan("planar", 1)
    ablate.run_apart(plan, here / "data", 2, keep=False)
    assert ablate._plan(seen["order"]["plan"]) == plan
    assert (seen["threads"], seen["order"]["jobs"]) == ("1", 2)
    assert [path.name for path in (here / "out" / "helmet").iterdir()] == ["shared"]
    seen["code"] = 1
    with pytest.raises(RuntimeError, match=r"the last line \(see .*planar-1\.log\)"):
        ablate.run_apart(plan, here / "data", 2, keep=False)


def _stub_stages(monkeypatch):
    """In the place of the real ones: stages that write down what they were handed."""
    calls = []

    def run(context):
        calls.append(context)
        (context.out / "file").write_text("")
        return {"psnr": 31.25, "held_out_psnr": 28.5}

    reads = {"train": (artifacts.FIRST_SCENE, artifacts.POINT_CLOUD), "extract": (artifacts.CAMERAS, artifacts.FIELD)}
    stages = [
        Stage("train", 1, lambda config: config.train, run, reads["train"]),
        Stage("extract", 1, lambda config: config.extract, run, reads["extract"]),
    ]
    monkeypatch.setattr(ablate, "measured_stages", lambda truth: stages)
    monkeypatch.setattr(ablate, "score_clean_mesh", lambda *_: {"mean": 0.5})
    return calls


def test_a_run_calls_the_stages_on_the_shared_poses_and_leaves_its_figures_only(here, monkeypatch):
    calls = _stub_stages(monkeypatch)
    shared = here / "out" / "helmet" / "shared" / "undistort"
    (shared / "scene.json").write_text("{}")
    plan = _plan("planar", 1, 9)
    run = ablate.measure(plan, here / "data", jobs=2)
    train, extract = calls
    assert (dict(train.inputs), train.workers) == ({name: shared.parent / name for name in ("undistort", "densify")}, 1)
    assert (train.params.terms.planar.form, train.params.seed, train.params.steps) == ("stable", 1, 9)
    assert extract.inputs["train"] == train.out
    assert (run.psnr, run.held_out_psnr, run.value, run.code) == (31.25, 28.5, 0.5, ablate.code_hash())
    assert run.machine["jobs"] == "2"
    assert not train.out.exists()
    ablate.measure(plan, here / "data", keep=True)
    assert (train.out / "file").exists()
    for made in (shared / "scene.json", shared.parent / "densify" / "cloud.npz"):
        made.write_text("{ }")
        other = ablate.measure(plan, here / "data")
        assert other.poses != run.poses
        run = other
    order = here / "order.json"
    order.write_text(json.dumps({"plan": asdict(plan), "data": str(here / "data"), "jobs": 2, "keep": False}))
    assert ablate.main(["--one", str(order)]) == 0
    assert [saved.plan for saved in load_runs()] == [plan]


def test_a_mesh_of_which_nothing_is_known_is_not_made(here):
    names = [[stage.name for stage in ablate.measured_stages(here / "data" / name)] for name in ("helmet", "scan")]
    assert names == [["train", "extract", "cleanup"], ["train"]]


def test_the_command_of_a_run_makes_that_run_again():
    assert ablate.command(_plan("planar", 1, 9)) == (
        "python -m benchmarks.ablate DATA helmet --steps 9 --preset cpu --variants planar --seeds 2"
    )
    name, changes = parse_extra("far:planar,weight_planar=0.3")
    words = ablate.command(Plan("helmet", name, 0, 9, "cpu", settings_of(name, changes))).split()
    assert parse_extra(words[words.index("--extra") + 1]) == (name, changes)
    whole = Plan("helmet", DEFAULTS, 0, load_config("demo", None, []).train.steps, "demo", (), covered=True)
    assert "--budget 1 --preset demo" in ablate.command(whole)
    late = Plan("helmet", "defaults-late", 0, 16000, "cpu", ("train.schedule.coarse_until=0.6",), covered=True)
    assert ablate.command(late) == (
        "python -m benchmarks.ablate DATA helmet --budget 2 --preset cpu --variants defaults "
        "--extra defaults-late:train.schedule.coarse_until=0.6 --seeds 1"
    )


def test_poses_that_are_there_are_not_made_again(here, monkeypatch):
    calls = []
    monkeypatch.setattr(ablate, "run_hineus", calls.append)
    ablate.prepare("helmet", here / "data", "cpu")
    assert calls == []
    (here / "out" / "helmet" / "shared" / "densify").rmdir()
    ablate.prepare("helmet", here / "data", "cpu")
    assert "densify" in calls[0]
    assert "--poses" not in calls[0]


def test_known_cameras_and_masks_are_taken(here, monkeypatch):
    calls = []
    monkeypatch.setattr(ablate, "run_hineus", calls.append)
    scan = here / "data" / "scan"
    (scan / "mask").mkdir()
    (scan / "cameras_sphere.npz").write_bytes(b"")
    (here / "out" / "scan" / "shared" / "densify").rmdir()
    ablate.prepare("scan", here / "data", "cpu")
    after = dict(itertools.pairwise(calls[0]))
    assert (after["--poses"], after["--masks"]) == (str(scan / "cameras_sphere.npz"), str(scan / "mask"))


def test_the_mesh_is_scored_in_the_world_frame(here, monkeypatch):
    from stages.geometry.similarity import Similarity

    folder, truth = here / "run", here / "data"
    assert ablate.score_clean_mesh(folder, here / "shared", truth / "scan") is None
    (folder / "cleanup").mkdir(parents=True)
    corners = np.eye(3)
    artifacts.CLEAN_MESH.save(folder / "cleanup", (corners, np.array([[0, 1, 2]])))
    world = Similarity(2.0, np.eye(3), np.array([1.0, 0.0, 0.0]))
    monkeypatch.setattr(artifacts, "SCENE", SimpleNamespace(load=lambda _: SimpleNamespace(poses_from_scene=world)))
    seen = {}

    def score_mesh(mesh, model, where, known_stem):
        seen["vertices"], seen["model"] = artifacts.CLEAN_MESH.load(mesh.parent)[0], model
        return {"mean": 1.0}

    monkeypatch.setattr("stages.evaluation.protocols.known_object.score_mesh", score_mesh)
    assert ablate.score_clean_mesh(folder, here / "shared", truth / "helmet") == {"mean": 1.0}
    assert np.allclose(seen["vertices"], 2 * corners + [1, 0, 0])
    assert seen["model"] == here / "shared" / "sfm" / "model"


@pytest.mark.slow
def test_a_scene_without_sparse_points_trains(tmp_path):
    from rigs import scene_without_points
    from sphere_scene import ring_of_cameras, write_densified, write_undistorted
    from train_settings import small

    from stages import train

    cameras = ring_of_cameras()
    folder, out, scratch = (tmp_path / name for name in ("undistort", "out", "scratch"))
    write_undistorted(folder, cameras)
    artifacts.FIRST_SCENE.save(folder, scene_without_points(cameras))
    out.mkdir()
    scratch.mkdir()
    params = small({
        "steps": 2, "sampling.rays": 32, "sampling.samples": 8, "field.levels": 2, "schedule.start_levels": 2,
        "field.log2_rows": 9, "field.coarsest": 8, "field.finest": 16, "field.sdf_width": 8, "field.radiance_width": 8,
        "sampling.cache_resolution": 16, "field.background": False,
    })  # fmt: skip
    inputs = {"undistort": folder, "densify": write_densified(tmp_path / "densify")}
    numbers = train.run(StageContext(inputs, {}, out, scratch, params))
    assert (numbers["steps"], numbers["sightings"], numbers["dense_sightings"]) == (2, 0, 0)
    assert artifacts.FIELD.load(out).exists()
