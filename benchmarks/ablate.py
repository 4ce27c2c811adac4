"""Measure variants of the training settings at equal budget, over sets of photos and seeds.

python -m benchmarks.ablate DATA --steps 1500 --seeds 2                          every set, every variant
python -m benchmarks.ablate DATA banana --variants base,ambiguity                these
python -m benchmarks.ablate --table-only                                         only rewrite the table

Ingest, structure from motion and undistortion run once a set; every run starts from a copy of them, so variants
differ in their training alone. Results go to benchmarks/results/ablation/SET-VARIANT-SEED.json; runs that have one
with the same steps, preset and settings are skipped. Run folders lie in benchmarks/out/ablation/ until scored.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import fmean

from benchmarks.run_sets import (
    NOT_MEASURED,
    OUT,
    PAGE,
    RESULTS,
    find_sets,
    machine,
    markdown_table,
    photos_of,
    run_hineus,
    with_table,
)
from stages.errors import HineusError

BASE = "base"
VARIANTS: dict[str, tuple[str, ...]] = {
    BASE: (),
    "ambiguity": ("train.ambiguity=stable",),
    "planar": ("train.planar=stable",),
    "eikonal": ("train.eikonal=stable",),
    "all": ("train.ambiguity=stable", "train.planar=stable", "train.eikonal=stable"),
}

RUNS = RESULTS / "ablation"
FOLDERS = OUT / "ablation"
SHARED_UNTIL = "undistort"
RUN_UNTIL = "cleanup"


@dataclass(frozen=True)
class Plan:
    """One run to make: a variant's settings on one set of photos with one seed and budget."""

    set: str
    variant: str
    seed: int
    steps: int
    preset: str
    settings: tuple[str, ...]

    @property
    def name(self) -> str:
        return f"{self.set}-{self.variant}-{self.seed}"

    @property
    def arguments(self) -> list[str]:
        """Of `hineus run`, without where."""
        # A budget of minutes would overrule that of steps.
        sets = [*self.settings, "train.minutes=null", f"train.steps={self.steps}", f"train.seed={self.seed}"]
        given = [word for text in sets for word in ("--set", text)]
        return ["--until", RUN_UNTIL, "--preset", self.preset, *given]


@dataclass(frozen=True)
class Run:
    """What came of it.

    Attributes:
        plan: what was run.
        command: that ran it, with DATA for the folder of sets.
        machine: CPU, cores, versions, device.
        poses: hash of the undistorted photos and poses it started from.
        score: distances of the clean mesh, see `stages.meshing.evaluation`; None without truth.
        psnr: of the training's rays at its end, dB.
        train_wall_s, train_cpu_s: seconds of the training stage.
    """

    plan: Plan
    command: str
    machine: dict[str, str]
    poses: str
    score: dict[str, float] | None
    psnr: float | None
    train_wall_s: float
    train_cpu_s: float


# ---------------------------------------------------------------- running
def measure(plan: Plan, data: Path, keep: bool = False) -> Run:
    """Run one plan and score its mesh; its folder is removed unless `keep`.

    Raises:
        RuntimeError: `hineus` failed, or did not take the shared stages over.
        HineusError: the mesh cannot be scored.
    """
    from stages.engine.manifest import load_manifest

    photos = photos_of(data / plan.set)
    assert photos is not None  # find_sets looked
    shared = FOLDERS / plan.set / "shared"
    folder = FOLDERS / plan.set / f"{plan.variant}-{plan.seed}"
    where = ["run", str(photos), "--workspace"]
    run_hineus([*where, str(shared), "--until", SHARED_UNTIL, "--preset", plan.preset, "--json"])
    start_from(shared, folder, shared_stages())
    answer = run_hineus([*where, str(folder), *plan.arguments, "--json"])
    stages = {stage["name"]: stage for stage in answer["stages"]}
    if again := [name for name in shared_stages() if stages[name]["action"] != "skipped"]:
        raise RuntimeError(f"{', '.join(again)} ran again ({stages[again[0]]['reason']}): its poses are its own")
    manifest = load_manifest(folder / SHARED_UNTIL)
    assert manifest is not None  # it was fresh
    train = stages["train"]
    run = Run(
        plan=plan,
        command=" ".join(["hineus run", f"DATA/{plan.set}/{photos.name}", *plan.arguments]),
        machine={**machine(), "device": answer["device"]},
        poses=manifest.outputs_digest[:12],
        score=score_clean_mesh(folder, data / plan.set),
        psnr=train["numbers"].get("psnr"),
        train_wall_s=round(train["wall_s"], 1),
        train_cpu_s=round(train["cpu_s"], 1),
    )
    if not keep:
        shutil.rmtree(folder)
    return run


def shared_stages() -> list[str]:
    """Names of the stages that all runs of a set have in common."""
    from stages.pipeline import PIPELINE

    names = [stage.name for stage in PIPELINE]
    return names[: names.index(SHARED_UNTIL) + 1]


def start_from(shared: Path, folder: Path, stages: Sequence[str]) -> None:
    """Make `folder` a workspace with the published `stages` of workspace `shared` and nothing else.

    A stage is known by the contents of its folder and of its sources, so the copies are fresh.
    """
    # Of a training that goes on from a checkpoint only the last part's CPU seconds would be known: it starts anew.
    shutil.rmtree(folder, ignore_errors=True)
    for name in stages:
        shutil.copytree(shared / name, folder / name)
    for name in ("workspace.json", "config.yaml"):
        shutil.copy(shared / name, folder / name)


def score_clean_mesh(folder: Path, truth: Path) -> dict[str, float] | None:
    """Distances of the workspace's clean mesh to the truth, None where there is no truth."""
    from hineus_cli.scoring import has_truth, score_mesh
    from stages import artifacts

    if not has_truth(truth):
        return None
    vertices, faces = artifacts.load_mesh(folder / RUN_UNTIL)
    world_from_scene = artifacts.load_scene(folder / "undistort").world_from_scene
    with tempfile.TemporaryDirectory() as world:
        artifacts.save_mesh(Path(world), world_from_scene.apply(vertices), faces)
        return score_mesh(Path(world) / artifacts.MESH, artifacts.model_path(folder / "sfm"), truth)


# ---------------------------------------------------------------- result files
def save_run(run: Run) -> None:
    RUNS.mkdir(parents=True, exist_ok=True)
    text = json.dumps(asdict(run), indent=1, allow_nan=False)
    (RUNS / f"{run.plan.name}.json").write_text(text + "\n", encoding="utf-8")


def load_runs() -> list[Run]:
    """All there are: by set, then in the order of VARIANTS (those no longer in it last), then by seed."""
    runs = []
    for path in RUNS.glob("*.json"):
        data = json.loads(path.read_text(encoding="utf-8"))
        plan = data.pop("plan")
        runs.append(Run(plan=Plan(**{**plan, "settings": tuple(plan["settings"])}), **data))
    order = {name: place for place, name in enumerate(VARIANTS)}
    return sorted(runs, key=lambda r: (r.plan.set, order.get(r.plan.variant, len(order)), r.plan.variant, r.plan.seed))


# ---------------------------------------------------------------- table
def ablation_table(runs: Sequence[Run]) -> str:
    """One row a set and variant, and below the table what each variant sets."""
    header = ["set", "variant", "steps", "seeds", "distance %", "spread", "change", "training CPU", "PSNR dB"]
    groups: dict[tuple[object, ...], list[Run]] = {}
    for run in runs:
        plan = run.plan
        groups.setdefault((plan.set, plan.variant, plan.steps, plan.preset, plan.settings, run.poses), []).append(run)
    rows = []
    for group in groups.values():
        plan = group[0].plan
        distances = [run.score["mean"] for run in group if run.score]
        psnrs = [run.psnr for run in group if run.psnr is not None]
        pairs = [(run, base) for run in group for base in runs if _compares(run, base)]
        scored = [(a.score["mean"], b.score["mean"]) for a, b in pairs if a.score and b.score]
        timed = [(a.train_cpu_s, b.train_cpu_s) for a, b in pairs if a.machine == b.machine]
        rows.append(
            [
                plan.set,
                plan.variant,
                str(plan.steps),
                str(len(group)),
                f"{fmean(distances):.3f}" if distances else "-",
                f"{max(distances) - min(distances):.3f}" if len(distances) > 1 else "-",
                f"{100 * (_ratio(scored) - 1):+.1f} %" if scored else "-",
                f"x {_ratio(timed):.2f}" if timed else "-",
                f"{fmean(psnrs):.2f}" if psnrs else "-",
            ]
        )
    settings = {run.plan.variant: run.plan.settings for run in runs}
    legend = [
        f"- {variant}: {', '.join(f'`{text}`' for text in texts) or 'the preset as it is'}"
        for variant, texts in settings.items()
    ]
    return "\n".join([markdown_table(header, rows), "", *legend])


def _compares(run: Run, base: Run) -> bool:
    """Whether `run` is no base, and `base` is one that differs from it in the variant's settings alone."""
    a, b = run.plan, base.plan
    same = (a.set, a.seed, a.steps, a.preset, run.poses) == (b.set, b.seed, b.steps, b.preset, base.poses)
    return a.variant != BASE and b.variant == BASE and same


def _ratio(pairs: Sequence[tuple[float, float]]) -> float:
    return sum(a for a, _ in pairs) / max(sum(b for _, b in pairs), 1e-9)


def write_table() -> None:
    runs = load_runs()
    body = ablation_table(runs) if runs else NOT_MEASURED
    PAGE.write_text(with_table(PAGE.read_text(encoding="utf-8"), "ablation", body), encoding="utf-8")


def main(argv: Sequence[str] | None = None) -> int:
    from hineus_cli.reconstruct import default_preset

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, nargs="?", help="folder of sets")
    parser.add_argument("sets", nargs="*", help="names of sets; default: all")
    parser.add_argument("--steps", type=int, default=1500, help="training steps of every run")
    parser.add_argument("--seeds", type=int, default=2, help="how many seeds, from 0")
    parser.add_argument("--variants", default=",".join(VARIANTS), help="names, separated by commas")
    parser.add_argument("--preset", help="default: that of `hineus run`")
    parser.add_argument("--again", action="store_true", help="also runs that have a result")
    parser.add_argument("--keep", action="store_true", help="keep the run folders")
    parser.add_argument("--table-only", action="store_true", help="run nothing")
    arguments = parser.parse_args(argv)
    failed = []
    if not arguments.table_only:
        variants = arguments.variants.split(",")
        if unknown := [name for name in variants if name not in VARIANTS]:
            parser.error(f"no variant {', '.join(unknown)}; there are {', '.join(VARIANTS)}")
        if arguments.data is None:
            parser.error("name a folder of sets, or --table-only")
        preset = arguments.preset or default_preset()
        done = {run.plan for run in load_runs()}
        for plan in [
            Plan(name, variant, seed, arguments.steps, preset, VARIANTS[variant])
            for name in find_sets(arguments.data, arguments.sets)
            for seed in range(arguments.seeds)
            for variant in variants
        ]:
            if plan in done and not arguments.again:
                print(f"{plan.name}: has a result (--again measures it anew)", file=sys.stderr)
                continue
            print(f"{plan.name}: running", file=sys.stderr)
            try:
                save_run(measure(plan, arguments.data.resolve(), arguments.keep))
            except (RuntimeError, HineusError) as error:
                print(f"{plan.name}: {error}", file=sys.stderr)
                failed.append(plan.name)
    write_table()
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
