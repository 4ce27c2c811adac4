"""Measure the defaults against the same with all terms off, and other variants of the training settings.

python -m benchmarks.ablate DATA                                            both, two seeds, every set that has a truth
python -m benchmarks.ablate DATA plain mirror --steps 2000                  these sets, a fixed number of steps
python -m benchmarks.ablate DATA plain --variants parts                     each part of the method alone, or left out
python -m benchmarks.ablate DATA --variants paper --budget 4                the paper's ablation, four times the budget
python -m benchmarks.ablate DATA --extra far:all,terms.reflection.reach=0.3 and one more: `all` with that setting
python -m benchmarks.ablate --table-only                                    only rewrite the tables

A truth is a known surface (`gt_mesh.ply`, `transforms.json`), and the score is the distance of the clean mesh to it; or
known cameras (`cameras_sphere.npz`, with masks where there are any), and the score is the PSNR of photos that were left
out of the training. Other sets run where they are named, with poses found from all photos.

Photos, poses and dense points are made ready once a set and shared by all its runs. A run is the stages train, extract
and cleanup, called in a process of its own with one thread; as many run side by side as there are cores. Results go to
benchmarks/results/ablation/SET-VARIANT-SEED-STEPS-POSES.json as each ends; runs that have one with the same steps,
poses and settings (those of presets and defaults too) are skipped, so an interrupted call goes on where it stopped. Run
folders lie in benchmarks/out/ablation/ until scored, and the log of a run that failed stays there.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from statistics import fmean
from typing import Any

from benchmarks.pages import NOT_MEASURED, markdown_table, write_tables
from benchmarks.run_sets import OUT, RESULTS, ROOT, find_sets, known_cameras, machine, photos_of, run_hineus
from configs.load import load_config
from configs.params import Config
from configs.renames import RENAMED
from stages.engine.stage import Stage, StageContext
from stages.errors import HineusError
from stages.evaluation.suites.paper import PaperRow, paper_tables
from stages.evaluation.suites.registry import SUITES
from stages.posing import neus

DEFAULTS, BASE = "defaults", "terms-off"


@dataclass(frozen=True)
class Part:
    """A part of the method that can be left out.

    Attributes:
        off: what leaves it out.
        forms: name -> what puts it in, of each of its forms.
    """

    off: dict[str, str]
    forms: dict[str, dict[str, str]]


def _term(name: str, off: str = "off", **paper: str) -> Part:
    """One of the paper's terms; `paper`: what its published form sets besides, of the same term, as `paper.yaml` has
    it."""
    form = f"train.terms.{name}.form"
    literal = {f"train.terms.{name}.{key}": value for key, value in paper.items()}
    return Part({form: off}, {"stable": {form: "stable"}, "paper": {form: "paper", **literal}})


# A new part is a line here, all else follows from it; its only form of ours is called as the others' first is.
PARTS: dict[str, Part] = {
    "colors": Part({"train.field.colors": "network"}, {"stable": {"train.field.colors": "shaded"}}),
    "evidence": Part({"train.evidence": "false"}, {"stable": {"train.evidence": "true"}}),
    "ambiguity": _term("ambiguity", visibility="paper"),
    "reflection": _term("reflection", samples="64"),
    "planar": _term("planar", weight="1.0", features="mlp", scale_until="0.2", rays="1024"),
    "eikonal": _term("eikonal", off="plain"),
}
# What every variant starts from but the defaults: colours, the plain Eikonal term and points. Written out, so that it
# stays what it is whatever the presets and defaults become.
TERMS_OFF = {
    **{key: value for part in PARTS.values() for key, value in part.off.items()},
    "train.terms.ambiguity.visibility": "stable",
    "train.terms.planar.features": "radiance",
    "train.density.form": "laplace",
    "train.density.scale": "scheduled",
    "train.field.gradients": "analytic",
}
BACKBONES = ("neus2", "hfneus", "neuralangelo")
NO_STEREO = {"train.losses.dense": "0"}


def _in_form(form: str, without: str | None = None) -> dict[str, str]:
    """All parts that have a form in that form, but for one."""
    return {
        key: value for name, part in PARTS.items() if name != without for key, value in part.forms.get(form, {}).items()
    }


def _is_default(settings: dict[str, str]) -> bool:
    return load_config(None, None, [f"{key}={value}" for key, value in settings.items()]) == load_config(None, None, [])


def _all_of_paper(form: str) -> dict[str, dict[str, str]]:
    """All terms in a form, and the paper's ablation of them; the names are in `PAPER_ROWS`, too."""
    name = ALL[form]
    rows = {name: _in_form(form), f"{name}-mesh": {**_in_form(form), "train.terms.ambiguity.visibility": "mesh"}}
    return rows | {f"{name}-{part}": _in_form(form, part) for part in PARTS if form in PARTS[part].forms}


FORMS = tuple(dict.fromkeys(form for part in PARTS.values() for form in part.forms))
ALL = {form: "all" if form == FORMS[0] else f"all-{form}" for form in FORMS}
# What each variant sets otherwise, by group, the most telling first: they run in this order. Those whose name begins
# with "defaults-" start from the defaults and are compared with them, all others with `BASE`.
GROUPS: dict[str, dict[str, dict[str, str]]] = {
    "terms": {BASE: {}, DEFAULTS: {}},
    "parts": {
        **{f"{DEFAULTS}-{name}": part.off for name, part in PARTS.items() if not _is_default(part.off)},
        **{
            name if form == FORMS[0] else f"{name}-{form}": settings
            for name, part in PARTS.items()
            for form, settings in part.forms.items()
        },
        "visibility-paper": {**PARTS["ambiguity"].forms["stable"], "train.terms.ambiguity.visibility": "paper"},
        "visibility-mesh": {**PARTS["ambiguity"].forms["stable"], "train.terms.ambiguity.visibility": "mesh"},
    },
    "paper": {name: changes for form in FORMS for name, changes in _all_of_paper(form).items()},
    # what is in the base, taken out or otherwise
    "base": {
        # the colours and the Eikonal term alone, as in NeuS: no points, no reflected direction
        "rgb+eikonal": {**NO_STEREO, "train.losses.sparse": "0", "train.field.radiance_inputs": "view"},
        # held to the SfM points alone
        "no-stereo": NO_STEREO,
        "density-neus": {"train.density.form": "neus"},
        "scale-learned": {"train.density.scale": "learned"},
        "gradients-numerical": {"train.field.gradients": "numerical"},
        "view-only": {"train.field.radiance_inputs": "view"},
    },
    # what a step leaves out, put back
    "steps": {
        "rays-even": {"train.sampling.needed_share": "0"},
        "colors-16": {"train.schedule.deferred_from": "null"},
        "samples-16": {"train.sampling.samples_end": "16"},
        "background-16": {"train.sampling.background_samples": "16"},
        "proposal": {"train.sampling.sampler": "proposal"},
    },
    # the paper's "integrated into" rows: each backbone without and with the terms
    "backbones": {
        f"{name}{tail}": {"train.backbone": name, **terms}
        for name in BACKBONES
        for tail, terms in (("", {}), ("+all", _in_form(FORMS[0])))
    },
}
VARIANTS = {name: changes for group in GROUPS.values() for name, changes in group.items()}

# The paper's ablation: its rows, what is left out of all terms in each, and the sets at hand that stand for its suites.
PAPER_ROWS = {
    "HiNeuS": "",
    "HiNeuS, no ambiguity weight": "-ambiguity",
    "HiNeuS, no self-reflection": "-reflection",
    "HiNeuS, visibility of a mesh": "-mesh",
    "HiNeuS, visibility as RefNeuS": "-mesh",
    "HiNeuS, no planar term": "-planar",
    "HiNeuS, plain Eikonal term": "-eikonal",
}
STAND_INS = {
    "dtu": ("dtu_scan24",),
    "nerf-synthetic": ("synth_helmet", "textured", "thin"),
    "glossy-synthetic": ("polished", "mirror", "synth_spotmetal"),
    "mipnerf360": ("treetrunk", "banana"),
}

RUNS = RESULTS / "ablation"
FOLDERS = OUT / "ablation"
POSED, SHARED = ("undistort", "densify"), "densify"  # what trainings start from, and up to where all runs share it
# Of `stages`, what the stages measured are made of.
SOURCES = ("train.py", "extract.py", "cleanup.py", "compiling.py", "neural", "surface", "geometry")
# Sections of settings that no stage measured depends on.
LATER = ("atlas", "bake", "materials", "splats", "export", "report")
HOLDOUT = 8  # every so many photos one is left out, on sets whose score is the PSNR
# Two runs with a thread each do more on two cores than one run with two.
ONE_THREAD = {
    name: "1"
    for name in ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OMP_THREAD_LIMIT")
}


@dataclass(frozen=True)
class Plan:
    """One run to make: a variant's settings on one set of photos with one seed and budget.

    Attributes:
        steps: of the training; with `covered` the most, as in `train.steps`.
        covered: whether points that cover the surface shorten it, as in a default run.
        settings: of the variant, on top of the preset. holdout: every so many photos one is left out; 0: none.
    """

    set: str
    variant: str
    seed: int
    steps: int
    preset: str
    settings: tuple[str, ...]
    holdout: int = 0
    covered: bool = False

    @property
    def name(self) -> str:
        return f"{self.set}-{self.variant}-{self.seed}"

    @property
    def sets(self) -> list[str]:
        """All that is set on top of the preset."""
        # Minutes would overrule a budget of steps; a preview at the end is enough.
        budget = ["train.minutes=null", f"train.steps={self.steps}", "train.preview_every=1"]
        if not self.covered:
            budget.append("train.steps_if_covered=1")
        return [*self.settings, *budget, f"train.seed={self.seed}", f"train.hold_out={self.holdout}"]


@dataclass(frozen=True)
class Run:
    """What came of it.

    Attributes:
        plan: what was run.
        command: that ran it, with DATA for the folder of sets.
        machine: CPU, cores, versions, device, how many runs went side by side.
        poses: hash of the undistorted photos, poses and dense points it started from.
        code: hash of the sources of the stages measured, see `code_hash`.
        score: distances of the clean mesh, see `protocols.known_object`; None without a known surface.
        psnr: of the training's rays at its end, dB.
        held_out_psnr: of photos left out of the training, dB; None where none were.
        train_wall_s, train_cpu_s: seconds of the training stage.
        steps: that the training took.
        config: hash of all settings, those of presets and defaults included.
    """

    plan: Plan
    command: str
    machine: dict[str, str]
    poses: str
    code: str
    score: dict[str, float] | None
    psnr: float | None
    held_out_psnr: float | None
    train_wall_s: float
    train_cpu_s: float
    steps: int
    config: str

    @property
    def value(self) -> float | None:
        """What variants are compared by: the distance (less is better) where there is one, else the held-out PSNR."""
        return self.score["mean"] if self.score else self.held_out_psnr


# ---------------------------------------------------------------- variants
def compared_with(variant: str) -> str:
    """What a variant is compared with, and starts from."""
    return DEFAULTS if variant.startswith(f"{DEFAULTS}-") else BASE


def settings_of(variant: str, changes: dict[str, str]) -> tuple[str, ...]:
    """A variant's settings, those of `BASE` that it does not change included; of `DEFAULTS` none."""
    if DEFAULTS in (variant, compared_with(variant)):
        return tuple(f"{key}={value}" for key, value in changes.items())
    base = dict(TERMS_OFF)
    if "train.backbone" in changes:  # sets these itself
        for key in ("train.density.form", "train.density.scale", "train.field.gradients"):
            del base[key]
    return tuple(f"{key}={value}" for key, value in {**base, **changes}.items())


def named_variants(text: str) -> dict[str, dict[str, str]]:
    """The variants that names or groups of them, separated by commas, stand for: those to compare with first.

    Raises:
        ValueError: there is no such variant or group.
    """
    words = text.split(",")
    if unknown := [word for word in words if word not in GROUPS and word not in VARIANTS]:
        groups, names = ", ".join(GROUPS), ", ".join(VARIANTS)
        raise ValueError(f"no variant {', '.join(unknown)}; there are the groups {groups} and the variants {names}")
    named = {name: VARIANTS[name] for word in words for name in GROUPS.get(word, (word,))}
    return dict(sorted(named.items(), key=lambda item: item[0] not in GROUPS["terms"]))


def parse_extra(text: str) -> tuple[str, dict[str, str]]:
    """ "name:setting=value,..." as a name and what it changes; a variant's name in the list stands for its settings.

    Raises:
        ValueError: it has another form.
    """
    name, _, listed = text.partition(":")
    if not re.fullmatch(r"[\w.+-]+", name) or name in VARIANTS or not listed:
        raise ValueError(f"{text}: expected NEW_NAME:setting=value,setting=value")
    changes: dict[str, str] = {}
    for item in listed.split(","):
        key, equals, value = item.partition("=")
        if equals:
            key = key if key.partition(".")[0] in Config.model_fields else f"train.{key}"
            changes[RENAMED.get(key, key)] = value
        elif item in VARIANTS:
            changes |= VARIANTS[item]
        else:
            raise ValueError(f"{text}: {item} is neither setting=value nor a variant")
    return name, changes


def make_plans(
    sets: dict[str, int],
    variants: dict[str, dict[str, str]],
    seeds: int,
    steps: int,
    preset: str,
    covered: bool = False,
) -> list[Plan]:
    """All runs: by variant, then seed, then set, so that what is done when it is interrupted can be compared.

    Args:
        sets: name -> every so many photos one is left out, 0: none.
        variants: name -> what it changes.
        steps, covered: see `Plan`.
    """
    return [
        Plan(name, variant, seed, steps, preset, settings_of(variant, changes), holdout, covered)
        for variant, changes in variants.items()
        for seed in range(seeds)
        for name, holdout in sets.items()
    ]


# ---------------------------------------------------------------- making ready
def prepare(name: str, data: Path, preset: str) -> None:
    """Make the photos, poses and dense points that all runs of a set share, unless they are there.

    Raises:
        RuntimeError: `hineus` failed.
    """
    shared = FOLDERS / name / "shared"
    if (shared / SHARED).is_dir():
        return
    arguments = ["run", str(photos_of(data / name)), "--workspace", str(shared), "--until", SHARED, "--preset", preset]
    if (cameras := known_cameras(data / name)) is not None:
        arguments += ["--poses", str(cameras)]
        if (masks := data / name / neus.MASKS).is_dir():
            arguments += ["--masks", str(masks)]
    run_hineus([*arguments, "--set", "sfm.deterministic=true", "--json"])


def poses_hash(shared: Path) -> str:
    """Hash of all files that the trainings of a set start from."""
    from stages.engine.fingerprint import digest
    from stages.engine.manifest import describe_outputs

    files = {
        f"{stage}/{path}": file.sha256 for stage in POSED for path, file in describe_outputs(shared / stage).items()
    }
    return digest(files)[:12]


def config_hash(plan: Plan) -> str:
    """Hash of the settings of a run: a result is one of now only where presets and defaults are the same."""
    from stages.engine.fingerprint import digest

    settings = load_config(plan.preset, None, plan.sets).model_dump(mode="json", exclude=set(LATER))
    return digest(settings)[:12]


def default_steps(preset: str) -> int:
    """Steps of a default run, the most where points that cover the surface shorten it."""
    return load_config(preset, None, []).train.steps


def code_hash() -> str:
    """Hash of the sources that decide what a training, and the mesh of it, come to."""
    chosen = [ROOT / "stages" / name for name in SOURCES]
    sources = sorted(source for path in chosen for source in ([path] if path.is_file() else path.rglob("*.py")))
    return hashlib.sha256(b"".join(source.read_bytes() for source in sources)).hexdigest()[:8]


# ---------------------------------------------------------------- one run
def measured_stages(truth: Path) -> list[Stage]:
    """The stages of a run; a mesh that nothing is known of is not made."""
    from stages.cleanup import CLEANUP
    from stages.evaluation.protocols.known_object import has_truth
    from stages.extract import EXTRACT
    from stages.train import TRAIN

    return [TRAIN, EXTRACT, CLEANUP] if has_truth(truth) else [TRAIN]


def measure(plan: Plan, data: Path, jobs: int = 1, keep: bool = False) -> Run:
    """Run one plan in this process and score what came out; its folder is removed unless `keep`.

    Raises:
        HineusError: a stage failed, or the mesh cannot be scored.
    """
    from stages.reconstruct import has_cuda

    code = code_hash()
    import stages.neural.trainer  # noqa: F401 - now, so that its seconds are not those of the training

    device = "cuda" if has_cuda() else "cpu"
    config = load_config(plan.preset, None, plan.sets)
    shared = FOLDERS / plan.set / "shared"
    # Of a training that goes on from a checkpoint only the last part's CPU seconds would be known: it starts anew.
    folder = _run_folder(plan)
    shutil.rmtree(folder, ignore_errors=True)
    numbers: dict[str, dict[str, Any]] = {}
    wall: dict[str, float] = {}
    cpu: dict[str, float] = {}
    measured = measured_stages(data / plan.set)
    own = {stage.name for stage in measured}
    for stage in measured:
        inputs = {name: (folder if name in own else shared) / name for name in stage.needs}
        out, scratch = folder / stage.name, folder / f"{stage.name}.scratch"
        out.mkdir(parents=True)
        scratch.mkdir()
        wall_before, cpu_before = time.monotonic(), time.process_time()
        context = StageContext(inputs, {}, out, scratch, stage.settings(config), device, workers=1)
        numbers[stage.name] = stage.run(context)
        wall[stage.name] = round(time.monotonic() - wall_before, 1)
        cpu[stage.name] = round(time.process_time() - cpu_before, 1)
        print(f"{stage.name}: {wall[stage.name]} s", file=sys.stderr, flush=True)
    trained = numbers["train"]
    run = Run(
        plan=plan,
        command=command(plan),
        machine={**machine(), "device": device, "jobs": str(jobs)},
        poses=poses_hash(shared),
        code=code,
        score=score_clean_mesh(folder, shared, data / plan.set),
        psnr=trained.get("psnr"),
        held_out_psnr=trained.get("held_out_psnr"),
        train_wall_s=wall["train"],
        train_cpu_s=cpu["train"],
        steps=trained.get("steps", plan.steps),
        config=config_hash(plan),
    )
    if not keep:
        shutil.rmtree(folder)
    return run


def command(plan: Plan) -> str:
    """The call that makes this run (and those of lower seeds)."""
    budget = f"--budget {plan.steps / default_steps(plan.preset):g}" if plan.covered else f"--steps {plan.steps}"
    words = ["python -m benchmarks.ablate DATA", plan.set, f"{budget} --preset {plan.preset}"]
    if plan.variant in VARIANTS:
        words.append(f"--variants {plan.variant}")
    else:
        start = compared_with(plan.variant)
        changed = [text for text in plan.settings if text not in settings_of(start, {})]
        words.append(f"--variants {start} --extra {plan.variant}:{','.join(changed)}")
    return " ".join([*words, f"--seeds {plan.seed + 1}"])


def score_clean_mesh(
    folder: Path, shared: Path, truth: Path, known_stem: Callable[[str], str] | None = None
) -> dict[str, float] | None:
    """Distances of the run's clean mesh to the known surface, None where there is none; see `score_mesh`."""
    from stages import artifacts
    from stages.evaluation.protocols.known_object import file_stem, has_truth, score_mesh

    if not has_truth(truth):
        return None
    vertices, faces = artifacts.CLEAN_MESH.load(folder / "cleanup")
    poses_from_scene = artifacts.SCENE.load(folder / "train").poses_from_scene
    with tempfile.TemporaryDirectory() as world:
        artifacts.CLEAN_MESH.save(Path(world), (poses_from_scene.apply(vertices), faces))
        return score_mesh(
            Path(world) / artifacts.CLEAN_MESH.files[0],
            artifacts.MODEL.load(shared / "sfm"),
            truth,
            known_stem or file_stem,
        )


def _run_folder(plan: Plan) -> Path:
    return FOLDERS / plan.set / f"{plan.variant}-{plan.seed}"


# ---------------------------------------------------------------- all runs
def run_apart(plan: Plan, data: Path, jobs: int, keep: bool) -> None:
    """Run one plan in a process of its own, which saves the result.

    Raises:
        RuntimeError: it failed; the last line of its log is included.
    """
    folder = _run_folder(plan)
    order, log = folder.with_name(f"{folder.name}.json"), folder.with_name(f"{folder.name}.log")
    order.write_text(json.dumps({"plan": asdict(plan), "data": str(data), "jobs": jobs, "keep": keep}))
    words = [sys.executable, "-m", "benchmarks.ablate", "--one", str(order)]
    with log.open("w", encoding="utf-8") as lines:
        done = subprocess.run(
            words, cwd=ROOT, env={**os.environ, **ONE_THREAD}, stdout=lines, stderr=lines, check=False
        )
    order.unlink()
    if done.returncode != 0:
        said = log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
        raise RuntimeError(f"{said[-1] if said else f'ended with {done.returncode}'} (see {log})")
    if not keep:
        log.unlink()


def run_ordered(order: Path) -> None:
    """What the process of one run does."""
    given = json.loads(order.read_text(encoding="utf-8"))
    save_run(measure(_plan(given["plan"]), Path(given["data"]), given["jobs"], given["keep"]))


def run_plans(plans: Sequence[Plan], data: Path, jobs: int, keep: bool) -> list[str]:
    """Run all, `jobs` at a time; returns the names of those that failed."""
    failed = []
    with ThreadPoolExecutor(jobs) as pool:
        pending = {pool.submit(run_apart, plan, data, jobs, keep): plan for plan in plans}
        try:
            for count, future in enumerate(as_completed(pending), start=1):
                name = pending[future].name
                error = future.exception()
                print(f"[{count} of {len(plans)}] {name}: {error or 'done'}", file=sys.stderr, flush=True)
                if error is not None:
                    failed.append(name)
        except KeyboardInterrupt:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
    return failed


# ---------------------------------------------------------------- result files
def save_run(run: Run) -> None:
    RUNS.mkdir(parents=True, exist_ok=True)
    most = "-covered" if run.plan.covered else ""
    path = RUNS / f"{run.plan.name}-{run.plan.steps}{most}-{run.poses}.json"
    partial = path.with_suffix(".partial")
    partial.write_text(json.dumps(asdict(run), indent=1, allow_nan=False) + "\n", encoding="utf-8")
    partial.replace(path)


def load_runs() -> list[Run]:
    """All there are: by set, then in the order of VARIANTS (those no longer in it last), then by seed."""
    runs = []
    for path in sorted(RUNS.glob("*.json")):
        data = json.loads(path.read_text(encoding="utf-8"))
        runs.append(Run(plan=_plan(data.pop("plan")), **data))
    order = {name: place for place, name in enumerate(VARIANTS)}
    return sorted(runs, key=lambda r: (r.plan.set, order.get(r.plan.variant, len(order)), r.plan.variant, r.plan.seed))


def _plan(data: dict[str, Any]) -> Plan:
    """A plan as it was saved, also by code that had other names for the settings."""
    settings = (text.partition("=") for text in data["settings"])
    return Plan(**{**data, "settings": tuple(f"{RENAMED.get(key, key)}={value}" for key, _, value in settings)})


# ---------------------------------------------------------------- tables
def terms_table(runs: Sequence[Run]) -> str:
    """The defaults against the same with all terms off: a row a set and budget."""
    header = [
        "set", "steps", "seeds", "distance % or held-out PSNR dB, terms off", "defaults", "change", "verdict",
        "normals °, terms off", "defaults", "training CPU a step",
    ]  # fmt: skip
    groups: dict[tuple[object, ...], list[tuple[Run, Run]]] = {}
    for run in runs:
        for base in runs if run.plan.variant == DEFAULTS else ():
            if _compares(run, base):
                plan = run.plan
                key = (plan.set, plan.steps, plan.covered, plan.preset, run.poses)
                groups.setdefault(key, []).append((run, base))
    rows = []
    for pairs in groups.values():
        ours, theirs = zip(*pairs, strict=True)
        rows.append(
            [
                ours[0].plan.set,
                _steps(ours),
                str(len(pairs)),
                *(_values(side) for side in (theirs, ours)),
                *_change_and_verdict(pairs),
                *(_mean(_normals(side), 1) for side in (theirs, ours)),
                _cpu_ratio(pairs),
            ]
        )
    return markdown_table(header, rows) if rows else NOT_MEASURED


def ablation_table(runs: Sequence[Run]) -> str:
    """A table a set with a row a variant, what code they were made with, and at last what each variant sets."""
    parts = []
    for name in dict.fromkeys(run.plan.set for run in runs):
        of_set = [run for run in runs if run.plan.set == name]
        parts += [f"**{name}**", _set_table(of_set)]
        if note := _code_note(of_set):
            parts.append(note)
    changed = {
        run.plan.variant: [
            text for text in run.plan.settings
            if run.plan.variant == BASE or text not in settings_of(compared_with(run.plan.variant), {})
        ]
        for run in runs if run.plan.settings
    }  # fmt: skip
    legend = [f"- {variant}: {', '.join(f'`{text}`' for text in texts)}" for variant, texts in changed.items()]
    return "\n\n".join([*parts, "\n".join(legend)])


def _set_table(runs: Sequence[Run]) -> str:
    header = [
        "variant", "steps", "seeds", "distance %", "normals °", "held-out PSNR dB", "spread", "change", "verdict",
        "training CPU a step", "training PSNR dB",
    ]  # fmt: skip
    rows = []
    for group in _by_variant(runs):
        values = [run.value for run in group if run.value is not None]
        pairs = [(run, base) for run in group for base in runs if _compares(run, base)]
        rows.append(
            [
                group[0].plan.variant,
                _steps(group),
                str(len(group)),
                _mean([run.score["mean"] for run in group if run.score], 3),
                _mean(_normals(group), 1),
                _mean([run.held_out_psnr for run in group if run.held_out_psnr is not None], 2),
                f"{_spread(values):.3f}" if len(values) > 1 else "-",
                *_change_and_verdict(pairs),
                _cpu_ratio(pairs),
                _mean([run.psnr for run in group if run.psnr is not None], 2),
            ]
        )
    return markdown_table(header, rows)


def paper_table(runs: Sequence[Run]) -> str:
    """The paper's ablation: what it claims that leaving a term out does, and what that does on the sets at hand."""
    header = ["suite", "row", "claimed", "set", "steps", *(f"seen, {form}" for form in FORMS)]
    rows = []
    for suite, sets in STAND_INS.items():
        full, *others = (row for row in paper_tables()[suite].rows if row.method in PAPER_ROWS)
        for row in others:
            for name in sets:
                seen = [_seen(runs, name, ALL[form], PAPER_ROWS[row.method]) for form in FORMS]
                if any(seen):
                    steps = _steps([run for pairs in seen for pair in pairs for run in pair])
                    cells = [_change_and_verdict(pairs)[0] for pairs in seen]
                    rows.append([SUITES[suite].title, row.method, _claim(suite, row, full), name, steps, *cells])
    return markdown_table(header, rows) if rows else NOT_MEASURED


def _claim(suite: str, row: PaperRow, full: PaperRow) -> str:
    """How a row's average differs from that of the whole method, by the figures in the table."""
    if SUITES[suite].unit == "dB":
        return f"{row.average - full.average:+.2f} dB"
    return f"{100 * (row.average / full.average - 1):+.1f} %"


def _seen(runs: Sequence[Run], name: str, everything: str, left_out: str) -> list[tuple[Run, Run]]:
    """Runs of a set without one of the terms, each with the run that has them all; those of the largest budget."""
    pairs = [
        (a, b)
        for a in runs if (a.plan.set, a.plan.variant) == (name, everything + left_out)
        for b in runs if b.plan.variant == everything and _same_but_variant(a, b)
    ]  # fmt: skip
    most = max((a.plan.steps for a, _ in pairs), default=0)
    return [(a, b) for a, b in pairs if a.plan.steps == most]


def _by_variant(runs: Sequence[Run]) -> list[list[Run]]:
    """Those that differ in the seed alone, together."""
    groups: dict[tuple[object, ...], list[Run]] = {}
    for run in runs:
        plan = run.plan
        key = (plan.set, plan.variant, plan.steps, plan.covered, plan.preset, plan.settings, run.poses)
        groups.setdefault(key, []).append(run)
    return list(groups.values())


def _compares(run: Run, base: Run) -> bool:
    """Whether `base` is what `run` is compared with, and differs from it in the variant's settings alone."""
    return run.plan.variant != base.plan.variant == compared_with(run.plan.variant) and _same_but_variant(run, base)


def _same_but_variant(run: Run, other: Run) -> bool:
    a, b = (replace(each.plan, variant="", settings=()) for each in (run, other))
    return a == b and run.poses == other.poses


def _steps(runs: Sequence[Run]) -> str:
    """Steps that were taken, by each seed where they differ."""
    taken = sorted({run.steps for run in runs})
    return f"{taken[0]}" if len(taken) == 1 else f"{taken[0]} to {taken[-1]}"


def _values(runs: Sequence[Run]) -> str:
    """The mean of what variants are compared by, and the values of the seeds."""
    values = [run.value for run in runs if run.value is not None]
    several = f" ({', '.join(f'{value:.2f}' for value in values)})" if len(values) > 1 else ""
    return f"{_mean(values, 3)}{several}"


def _normals(runs: Sequence[Run]) -> list[float]:
    return [run.score["normals_deg"] for run in runs if run.score and "normals_deg" in run.score]


def _cpu_ratio(pairs: Sequence[tuple[Run, Run]]) -> str:
    """CPU seconds of a step against those of the other side, over the pairs that one machine made."""
    timed = [(a.train_cpu_s / a.steps, b.train_cpu_s / b.steps) for a, b in pairs if a.machine == b.machine]
    return f"x {sum(a for a, _ in timed) / max(sum(b for _, b in timed), 1e-9):.2f}" if timed else "-"


def _change_and_verdict(pairs: Sequence[tuple[Run, Run]]) -> tuple[str, str]:
    """Over the seeds that both have: what the variant changes, and whether that is more than the seeds do."""
    scored = [(a, b) for a, b in pairs if a.value is not None and b.value is not None]
    if not scored:
        return "-", "-"
    ours, theirs = ([run.value or 0.0 for run in side] for side in zip(*scored, strict=True))
    by_distance = scored[0][0].score is not None
    difference = fmean(ours) - fmean(theirs)
    change = f"{100 * difference / max(fmean(theirs), 1e-9):+.1f} %" if by_distance else f"{difference:+.2f} dB"
    if any(a.code != b.code for a, b in scored):
        change += " *"
    if len(scored) < 2:
        return change, "-"
    if abs(difference) <= max(_spread(ours), _spread(theirs)):
        return change, "within spread"
    return change, "helps" if (difference < 0) == by_distance else "hurts"


def _code_note(runs: Sequence[Run]) -> str:
    """Which variants were made with which version of the code, where they differ."""
    variants: dict[str, dict[str, None]] = {}
    for run in runs:
        variants.setdefault(run.code, {})[run.plan.variant] = None
    if len(variants) < 2:
        return ""
    listed = "; ".join(f"`{code}` {', '.join(names)}" for code, names in variants.items())
    return f"\\* The code changed between this run and its base. Versions: {listed}."


def _spread(values: Sequence[float]) -> float:
    return max(values) - min(values)


def _mean(values: Sequence[float], digits: int) -> str:
    return f"{fmean(values):.{digits}f}" if values else "-"


def tables() -> dict[str, str]:
    """The tables, from the result files of the settings of now: those of others would be averaged with them."""
    every = load_runs()
    runs = [run for run in every if _is_of_now(run)]
    older = len(every) - len(runs)
    note = f"\n\nLeft out: {older} runs from before variants, presets or defaults changed." if older else ""
    return {
        "ablation terms": terms_table(runs),
        "ablation": (ablation_table(runs) if runs else NOT_MEASURED) + note,
        "ablation paper": paper_table(runs),
    }


def _is_of_now(run: Run) -> bool:
    """Whether its variant sets the same today, on presets and defaults that are the same."""
    variant = run.plan.variant
    if variant in VARIANTS and run.plan.settings != settings_of(variant, VARIANTS[variant]):
        return False
    try:
        return run.config == config_hash(run.plan)
    except HineusError:  # a setting that is no more
        return False


# ---------------------------------------------------------------- command
def main(argv: Sequence[str] | None = None) -> int:
    from stages.evaluation.protocols.known_object import has_truth
    from stages.limits import available_cores
    from stages.reconstruct import default_preset, has_cuda

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, nargs="?", help="folder of sets")
    parser.add_argument("sets", nargs="*", help="names of sets; default: all with a known surface or known cameras")
    budget = parser.add_mutually_exclusive_group()
    budget.add_argument("--budget", type=float, default=1.0, help="times the steps of a default run (default: 1)")
    budget.add_argument("--steps", type=int, help="training steps of every run instead, however much points cover")
    parser.add_argument("--seeds", type=int, default=2, help="how many seeds, from 0")
    parser.add_argument(
        "--variants", default="terms", help=f"names, separated by commas, or groups of them: {', '.join(GROUPS)}"
    )
    parser.add_argument("--extra", action="append", default=[], help="NAME:setting=value,...: one more variant")
    parser.add_argument("--preset", help="default: that of `hineus run`")
    parser.add_argument("--jobs", type=int, help="runs side by side; default: one a core, or one on a GPU")
    parser.add_argument("--again", action="store_true", help="also runs that have a result")
    parser.add_argument("--keep", action="store_true", help="keep the run folders")
    parser.add_argument("--table-only", action="store_true", help="run nothing")
    parser.add_argument("--one", type=Path, help=argparse.SUPPRESS)
    arguments = parser.parse_args(argv)
    if arguments.one is not None:
        run_ordered(arguments.one)
        return 0
    failed: list[str] = []
    if not arguments.table_only:
        try:
            variants = named_variants(arguments.variants) | dict(map(parse_extra, arguments.extra))
        except ValueError as error:
            parser.error(str(error))
        if arguments.data is None:
            parser.error("name a folder of sets, or --table-only")
        data, preset = arguments.data.resolve(), arguments.preset or default_preset()
        names = find_sets(data, arguments.sets)
        if not arguments.sets:
            names = [name for name in names if has_truth(data / name) or known_cameras(data / name)]
        sets = {name: 0 if has_truth(data / name) else HOLDOUT for name in names}
        steps = arguments.steps or round(arguments.budget * default_steps(preset))
        plans = make_plans(sets, variants, arguments.seeds, steps, preset, covered=arguments.steps is None)
        poses: dict[str, str] = {}
        for name in sets:
            try:
                prepare(name, data, preset)
                poses[name] = poses_hash(FOLDERS / name / "shared")
            except (RuntimeError, HineusError) as error:
                print(f"{name}: {error}", file=sys.stderr)
                failed += [plan.name for plan in plans if plan.set == name]
        done = set() if arguments.again else {(run.plan, run.poses, run.config) for run in load_runs()}
        plans = [plan for plan in plans if plan.set in poses and (plan, poses[plan.set], config_hash(plan)) not in done]
        print(f"{len(plans)} runs to make (others have a result; --again measures them anew)", file=sys.stderr)
        jobs = arguments.jobs or (1 if has_cuda() else available_cores())
        failed += run_plans(plans, data, jobs, arguments.keep)
    write_tables(tables())
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
