"""Steps of blocks as jobs of Snakemake: their order, failures, a second run, and what is told where it is missing."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import psutil
import pytest
from small_town import town_workspace
from test_block_by_block import PLAN

from stages import block_jobs, workflow
from stages.artifacts.blocks import block_folder
from stages.block_by_block import steps_of
from stages.block_jobs import Job, run_jobs
from stages.divide import divide
from stages.engine.workspace import Workspace
from stages.errors import SystemRequirementError
from stages.pipeline import PIPELINE
from stages.workflow import Capacity, check_installed

# A step that writes its name and how it fared into a journal. It is bad as long as the file bad/<name> is there.
STEP = """
import sys, time
from pathlib import Path
name, folder = sys.argv[1], Path(sys.argv[2])
seconds = float(sys.argv[3])
def note(what):
    with (folder / "journal").open("a") as journal:
        journal.write(f"{what} {name}\\n")
note("begun")
time.sleep(seconds)
if (folder / "bad" / name).exists():
    note("failed")
    sys.exit("Error: It diverged.\\nTry less.")
note("done")
"""


def jobs_in(folder: Path, seconds: float = 0.0) -> list[Job]:
    (folder / "bad").mkdir(exist_ok=True)
    (folder / "step.py").write_text(STEP)
    program = [sys.executable, "-I", str(folder / "step.py")]
    return [Job(step, [*program, step.name, str(folder), str(seconds)], 1 << 20) for step in steps_of(PLAN)]


def journal(folder: Path) -> list[str]:
    return (folder / "journal").read_text().splitlines() if (folder / "journal").exists() else []


@pytest.fixture
def engine(monkeypatch, tmp_path):
    """In place of Snakemake: does what steps.json says, in its order, each of `bad` in vain."""
    seen = SimpleNamespace(runs=[], bad=set(), code=None)

    def run_rules(folder, capacity, output, look):
        steps = json.loads((folder / "steps.json").read_text())["steps"]
        ran = []
        output.write_text("said\n")
        for kind, blocks in steps.items():
            for block, step in blocks.items():
                marker = folder / f"steps/{kind}/{block}.done"
                if marker.exists() or not all((folder / need).exists() for need in step["needs"]):
                    continue
                ran.append(f"{kind} {block}")
                marker.with_suffix(".log").write_text("Error: It diverged.\nTry less.\n" if ran[-1] in seen.bad else "")
                if ran[-1] not in seen.bad:
                    marker.touch()
        look()
        seen.runs.append(ran)
        everything = [folder / f"steps/{kind}/{block}.done" for kind, blocks in steps.items() for block in blocks]
        return int(not all(marker.exists() for marker in everything)) if seen.code is None else seen.code

    monkeypatch.setattr(block_jobs, "run_rules", run_rules)
    return seen


def test_what_is_done_is_left_alone(engine, tmp_path):
    assert run_jobs(jobs_in(tmp_path), tmp_path, Capacity(2), {"train b00", "train b02"}) == {}
    assert engine.runs == [["train b01", "finish b00", "finish b01", "finish b02"]]


def test_markers_of_an_earlier_run_count_for_nothing(engine, tmp_path):
    run_jobs(jobs_in(tmp_path), tmp_path, Capacity(2), set())
    run_jobs(jobs_in(tmp_path), tmp_path, Capacity(2), {"train b00"})  # other settings: the rest is stale
    assert "train b01" in engine.runs[1]
    assert "train b00" not in engine.runs[1]


def test_neighbours_of_a_block_that_failed_are_finished_without_it(engine, tmp_path):
    engine.bad = {"train b01"}
    failed = run_jobs(jobs_in(tmp_path), tmp_path, Capacity(2), set())
    assert set(failed) == {"train b01", "finish b01"}
    assert engine.runs == [["train b00", "train b01", "train b02"], ["finish b00", "finish b02"]]
    error = failed["finish b01"]
    assert error.message == "It diverged."
    assert error.hint == f"Try less. What it said: {tmp_path / 'steps/train/b01.log'}."


def test_failing_twice_over_ends(engine, tmp_path):
    engine.bad = {"train b01", "finish b00"}
    assert set(run_jobs(jobs_in(tmp_path), tmp_path, Capacity(2), set())) == {"train b01", "finish b01", "finish b00"}
    assert engine.runs[1:] == [["finish b00", "finish b02"]]


def test_an_engine_that_fails_itself_is_an_error_and_no_block_failed(engine, tmp_path):
    engine.code = 1
    with pytest.raises(SystemRequirementError, match="said"):
        run_jobs(jobs_in(tmp_path), tmp_path, Capacity(2), set())


def test_cores_and_memory_are_shared_here_and_asked_for_there(monkeypatch):
    monkeypatch.setattr(workflow, "available_cores", lambda: 8)
    monkeypatch.setattr(workflow, "available_memory", lambda: 4 << 30)
    here, there = Capacity(3), Capacity(3, "slurm")
    assert (here.threads, there.threads) == (2, 8)
    assert here.memory_mb(2 << 30) == (2048, 2048)
    assert here.memory_mb(9 << 30) == (4096, 4096), "it would never start"
    assert there.memory_mb(9 << 30) == (9216, 18432)
    assert Capacity(16).threads == 1


@pytest.mark.parametrize(
    ("missing", "executor", "hint"),
    [
        ("snakemake", "local", "hineus[cluster]"),
        ("snakemake_executor_plugin_slurm", "slurm", "hineus[cluster]"),
        ("snakemake_executor_plugin_tes_too", "tes-too", "pip install snakemake-executor-plugin-tes-too"),
    ],
)
def test_what_is_missing_is_named_with_its_command(monkeypatch, missing, executor, hint):
    monkeypatch.setattr(workflow, "find_spec", lambda name: None if name == missing else object())
    with pytest.raises(SystemRequirementError) as caught:
        check_installed(Capacity(2, executor))
    assert hint in caught.value.hint


@pytest.mark.parametrize(("device", "gpus"), [("cuda", 1), ("auto", 0), ("cpu", 0)])
def test_a_step_asks_for_a_gpu_where_it_is_told_to_use_one(engine, tmp_path, device, gpus):
    whole = town_workspace(tmp_path / "whole")
    plan = divide(whole, 2)
    jobs = block_jobs._jobs(Workspace.open(whole), plan, device)
    assert all(job.command[job.command.index("--device") + 1] == device for job in jobs)
    run_jobs(jobs, tmp_path, Capacity(2, "slurm"), set())
    steps = json.loads((tmp_path / "steps.json").read_text())["steps"]
    assert {step["gpu"] for blocks in steps.values() for step in blocks.values()} == {gpus}


def test_settings_of_a_block_that_cannot_be_read_are_its_own_failure(tmp_path):
    whole = town_workspace(tmp_path / "whole")
    plan = divide(whole, 2)
    broken = Workspace.open(block_folder(whole, "b01")).config_path
    broken.write_text("train: {stepz: 1}\n")
    assert [block_jobs._is_done(whole, step, PIPELINE) for step in steps_of(plan)] == [False] * 4


# ---------------------------------------------------------------- with Snakemake
@pytest.mark.slow
def test_snakemake_tries_again_and_goes_on(tmp_path):
    pytest.importorskip("snakemake")
    jobs = jobs_in(tmp_path)
    (tmp_path / "bad" / "train b01").touch()
    failed = run_jobs(jobs, tmp_path, Capacity(2, workers=2), set())
    told = journal(tmp_path)
    assert set(failed) == {"train b01", "finish b01"}
    assert "It diverged." in failed["train b01"].message
    assert told.count("failed train b01") == 2, "tried once more"
    assert {"done finish b00", "done finish b02"} <= set(told)
    assert told.index("begun finish b00") > told.index("done train b00")

    (tmp_path / "bad" / "train b01").unlink()
    done = {"train b00", "train b02"}
    assert run_jobs(jobs, tmp_path, Capacity(2, workers=2), done) == {}
    again = journal(tmp_path)[len(told) :]
    assert again[:2] == ["begun train b01", "done train b01"]
    assert {line for line in again[2:] if line.startswith("done")} == {f"done finish b0{i}" for i in range(3)}


# Stopped by signals, as a command is.
RUN = """
import signal, sys
from pathlib import Path
signal.signal(signal.SIGINT, signal.default_int_handler)  # it is ignored below what a shell runs in the background
sys.path.insert(0, sys.argv[2])
from test_block_jobs import jobs_in
from hineus_cli.at_once import Stopped
from hineus_cli.session import Session
from hineus_cli.stopping import stopped_by_signals
from stages.block_jobs import run_jobs
from stages.workflow import Capacity
folder = Path(sys.argv[1])
try:
    with stopped_by_signals(), Session(()).working():
        run_jobs(jobs_in(folder, seconds=float(sys.argv[3])), folder, Capacity(2, workers=2), set())
except Stopped as stop:
    sys.exit(stop.exit_code)
"""


def begun(folder: Path, seconds: float) -> tuple[subprocess.Popen[bytes], list[psutil.Process]]:
    """A run whose steps take so many seconds each, in the middle of the first two, and the processes below it."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    command = [sys.executable, "-c", RUN, str(folder), str(Path(__file__).parent), str(seconds)]
    run = subprocess.Popen(command, env=environment, start_new_session=True)
    while sum(line.startswith("begun") for line in journal(folder)) < 2:
        assert run.poll() is None
        time.sleep(0.2)
    return run, psutil.Process(run.pid).children(recursive=True)


@pytest.mark.slow
@pytest.mark.parametrize("sent_to", ["the run", "its terminal"])
def test_ctrl_c_ends_the_steps_with_the_run(tmp_path, sent_to):
    pytest.importorskip("snakemake")
    run, below = begun(tmp_path, seconds=600)
    assert len([process for process in below if any("step.py" in word for word in process.cmdline())]) >= 2
    if sent_to == "the run":
        run.send_signal(signal.SIGINT)
    else:
        os.killpg(run.pid, signal.SIGINT)
    assert run.wait(60) == 128 + signal.SIGINT
    _, alive = psutil.wait_procs(below, 30)
    assert alive == []


@pytest.mark.slow
def test_a_run_that_was_killed_is_gone_on_with(tmp_path):
    pytest.importorskip("snakemake")
    run, below = begun(tmp_path, seconds=2)
    for process in [psutil.Process(run.pid), *below]:
        process.send_signal(signal.SIGKILL)
    run.wait()
    assert list((tmp_path / ".snakemake" / "locks").iterdir()), "nothing to be unlocked"
    assert run_jobs(jobs_in(tmp_path), tmp_path, Capacity(2, workers=2), set()) == {}
    assert {f"done finish b0{i}" for i in range(3)} <= set(journal(tmp_path))
