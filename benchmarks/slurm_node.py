"""Blocks on a cluster of one node: a Slurm of our own, a run through it, and what becomes of it when the node dies.

python -m benchmarks.slurm_node [--seconds 20]
python -m benchmarks.slurm_node --photos PHOTOS [--poses POSES] [--blocks 2] [--set ...]     real, in PHOTOS_slurm

Needs Debian's slurm-wlm and munge (`apt-get install slurm-wlm munge`), hineus[cluster], and root. Everything lies in
a temporary folder, but for a link at /etc/slurm/slurm.conf, where jobs look; nothing is left. The run is a plan of
two blocks: four steps that count seconds in a file and go on from there, as training does from its checkpoint. In the
middle of the first the node dies: its daemon, the jobs and all below them are killed at once. Later it comes back.
What is told at the end: how often each step was begun, whether the run finished, how many seconds were counted, and
for how many GPUs the steps that learn had asked (the node says that it has two). Then the same is begun anew and
stopped as by Ctrl-C, and it is told how many of its jobs are left in the queue.

With photos the steps are those of `hineus run PHOTOS --blocks N --executor slurm`. The node dies when as many
trainings as it has cores for have learned a while and kept that in a checkpoint, as they do each minute. What is told:
which blocks are done and have a tile, the steps from which each training went on, and how long all of it took.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import psutil

from stages.block_by_block import Step
from stages.block_jobs import Job, run_jobs
from stages.workflow import Capacity

T = TypeVar("T")
PROGRAMS = ("munged", "slurmctld", "slurmd", "sbatch")
NODE = "one"
CONTROLLER_PORT, NODE_PORT = 26817, 26818
SYSTEM_CONFIGURATION = Path("/etc/slurm/slurm.conf")  # Snakemake's executor passes none on to jobs
LOST_AFTER_S = 10  # a node that says nothing for so long is down
PATIENCE_S = 60.0
STEPS_OF_A_WHILE = 100
WENT_ON = re.compile(r"training goes on from step (\d+)")
CONFIGURATION = """\
ClusterName=benchmark
SlurmctldHost={host}(127.0.0.1)
SlurmctldPort={controller_port}
SlurmdPort={node_port}
AuthType=auth/munge
AuthInfo=socket={folder}/munge.socket
CredType=cred/munge
SlurmUser=root
SlurmdUser=root
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd.pid
SlurmctldLogFile={folder}/slurmctld.log
SlurmdLogFile={folder}/slurmd.log
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
MpiDefault=none
SelectType=select/cons_tres
SelectTypeParameters=CR_Core_Memory
GresTypes=gpu
SchedulerParameters=defer,batch_sched_delay=1,sched_interval=2
SlurmdTimeout={lost_after}
ReturnToService=2
NodeName={node} NodeHostname={host} NodeAddr=127.0.0.1 CPUs={cores} RealMemory={memory} Gres=gpu:2
PartitionName=blocks Nodes={node} Default=YES MaxTime=INFINITE State=UP
"""
GPUS = f"NodeName={NODE} Name=gpu File=/dev/null,/dev/zero\n"  # nobody looks at them
# Without a database of accounts; on a real cluster such a profile names partition and account (docs/large-scenes.md).
PROFILE = """\
slurm-no-account: true
slurm-status-command: squeue
slurm-init-seconds-before-status-checks: 2
default-resources:
  slurm_partition: blocks
"""
# Counts seconds in a file and goes on from what is there; notes when it begins and ends.
STEP = """
import sys, time
from pathlib import Path
name, folder, seconds = sys.argv[1], Path(sys.argv[2]), int(sys.argv[3])
count = folder / f"{name}.count"
def note(what):
    with (folder / "journal").open("a") as journal:
        journal.write(f"{what} {name}\\n")
def counted():
    return int(count.read_text() or 0) if count.exists() else 0
note("begun")
while counted() < seconds:
    time.sleep(1)
    count.write_text(str(counted() + 1))
    note("counted")
note("done")
"""


def is_possible() -> bool:
    """Whether such a Slurm can be started here."""
    from importlib.util import find_spec

    return (
        all(shutil.which(name) or Path("/usr/sbin", name).exists() for name in PROGRAMS)
        and os.geteuid() == 0
        and not SYSTEM_CONFIGURATION.exists()
        and find_spec("snakemake_executor_plugin_slurm") is not None
    )


@dataclass(frozen=True)
class SlurmNode:
    """A controller and one node.

    Attributes:
        folder: with all of their files. environment: in which Slurm's commands find them.
    """

    folder: Path
    environment: Mapping[str, str]

    def start_node(self) -> None:
        self._start("slurmd", "-N", NODE, "-f", str(self.folder / "slurm.conf"))

    def kill_node(self) -> None:
        """As if its power went: the daemon, the jobs and all below them."""
        if not (self.folder / "slurmd.pid").exists():
            return
        daemon = psutil.Process(int((self.folder / "slurmd.pid").read_text()))
        steps = [each for each in psutil.process_iter(["name"]) if each.info["name"].startswith("slurmstepd")]
        for process in [daemon, *steps, *(below for step in steps for below in step.children(recursive=True))]:
            with _gone_is_fine():
                process.send_signal(signal.SIGKILL)

    def told(self, *command: str) -> str:
        """What one of Slurm's commands says; nothing where its daemons do not answer yet."""
        return subprocess.run(
            command, env=dict(self.environment), capture_output=True, text=True, check=False, timeout=PATIENCE_S
        ).stdout.strip()

    def await_state(self, state: str) -> None:
        """
        Raises:
            TimeoutError: the node does not get there.
        """
        _await(lambda: self.told("sinfo", "--noheader", "--format=%T").startswith(state), f"node {state}")

    def _start(self, program: str, *options: str) -> None:
        found = shutil.which(program) or f"/usr/sbin/{program}"
        subprocess.run([found, *options], env=dict(self.environment), check=True, timeout=PATIENCE_S)

    def _end(self) -> None:
        for name in ("slurmd", "slurmctld", "munged"):
            file = self.folder / f"{name}.pid"
            if file.exists():
                with _gone_is_fine():
                    process = psutil.Process(int(file.read_text()))
                    process.terminate()
                    process.wait(PATIENCE_S)


@contextmanager
def slurm_node() -> Iterator[SlurmNode]:
    """Started, and ended with all that it runs."""
    folder = Path(tempfile.mkdtemp(prefix="slurm_node."))
    folder.chmod(0o755)
    (folder / "munge.key").write_bytes(os.urandom(1024))
    (folder / "munge.key").chmod(0o400)
    for name in ("state", "spool", "profile"):
        (folder / name).mkdir()
    (folder / "profile" / "config.yaml").write_text(PROFILE)
    (folder / "slurm.conf").write_text(
        CONFIGURATION.format(
            host=socket.gethostname(),
            folder=folder,
            node=NODE,
            cores=os.cpu_count(),
            memory=psutil.virtual_memory().total // 2**20 - 1024,
            controller_port=CONTROLLER_PORT,
            node_port=NODE_PORT,
            lost_after=LOST_AFTER_S,
        )
    )
    (folder / "gres.conf").write_text(GPUS)
    environment = {
        **os.environ,
        "SLURM_CONF": str(folder / "slurm.conf"),
        "SNAKEMAKE_PROFILE": str(folder / "profile"),
    }
    node = SlurmNode(folder, environment)
    munge = [f"--{name}-file={folder / file}" for name, file in (("key", "munge.key"), ("pid", "munged.pid"))]
    munge += [f"--log-file={folder / 'munged.log'}", f"--seed-file={folder / 'seed'}"]
    SYSTEM_CONFIGURATION.parent.mkdir(exist_ok=True)
    SYSTEM_CONFIGURATION.symlink_to(folder / "slurm.conf")
    try:
        node._start("munged", f"--socket={folder / 'munge.socket'}", *munge, "--force")
        node._start("slurmctld", "-f", str(folder / "slurm.conf"))
        node.start_node()
        node.await_state("idle")
        yield node
    finally:
        node.kill_node()
        node._end()
        SYSTEM_CONFIGURATION.unlink()
        shutil.rmtree(folder, ignore_errors=True)


def _gone_is_fine() -> suppress:
    return suppress(psutil.NoSuchProcess, psutil.TimeoutExpired)


def _await(holds: Callable[[], bool], what: str, patience: float = PATIENCE_S) -> None:
    end = time.monotonic() + patience
    while not holds():
        if time.monotonic() > end:
            raise TimeoutError(f"no {what} after {patience:.0f} s")
        time.sleep(0.5)


def counting_jobs(folder: Path, seconds: int) -> list[Job]:
    """Two blocks; each learns, and is finished once both have learned."""
    (folder / "step.py").write_text(STEP)
    names, steps = ("b00", "b01"), []
    steps += [Step(f"train {name}", name, "train") for name in names]
    for name, other in (names, names[::-1]):
        steps.append(Step(f"finish {name}", name, None, (f"train {name}",), (f"train {other}",)))
    program = [sys.executable, "-I", str(folder / "step.py")]
    return [
        Job(step, [*program, step.name, str(folder), str(seconds)], 256 << 20, gpus=int(step.until == "train"))
        for step in steps
    ]


def journal(folder: Path) -> Counter[str]:
    """How often each line was written."""
    path = folder / "journal"
    return Counter(path.read_text().splitlines() if path.exists() else [])


def run_with_a_dead_node(run: Callable[[], T], is_in_the_middle: Callable[[], bool]) -> tuple[T, str]:
    """What the run gives through a Slurm whose node dies in its middle; and what its jobs had asked for then.

    Raises:
        RuntimeError: it ended before.
    """
    with slurm_node() as node, _in_environment(node.environment):
        asked: list[str] = []
        ended = threading.Event()

        def strike() -> None:
            _await(lambda: ended.is_set() or is_in_the_middle(), "step in its middle", 60 * PATIENCE_S)
            if ended.is_set():
                return
            asked.append(node.told("squeue", "--noheader", "--Format=tres-per-job:40"))
            node.kill_node()
            node.await_state("down")
            node.start_node()

        striking = threading.Thread(target=strike)
        striking.start()
        try:
            given = run()
        finally:
            ended.set()
            striking.join()
        if not asked:
            raise RuntimeError("the run ended before its steps were in their middle: give them more to do")
        return given, " ".join(asked[0].split())


def count_with_a_dead_node(folder: Path, seconds: int) -> dict[str, object]:
    """The steps that count; the node dies when the first has counted half of its seconds."""
    start = time.monotonic()
    failed, asked = run_with_a_dead_node(
        lambda: run_jobs(counting_jobs(folder, seconds), folder, Capacity(2, "slurm", workers=1), set()),
        lambda: journal(folder)["counted train b00"] >= seconds // 2,
    )
    told = journal(folder)
    return {
        "failed": sorted(failed),
        "begun": {line[6:]: count for line, count in sorted(told.items()) if line.startswith("begun")},
        "done": sorted(line[5:] for line in told if line.startswith("done")),
        "gpus of the jobs when the node died": asked,
        "counted_s": sum(count for line, count in told.items() if line.startswith("counted")),
        "asked_for_s": 4 * seconds,
        "wall_s": round(time.monotonic() - start),
    }


def left_after_ctrl_c(folder: Path) -> dict[str, object]:
    """A run is stopped as by Ctrl-C while two of its jobs are at work."""
    program = (
        "import sys; from pathlib import Path; from benchmarks.slurm_node import *; "
        "run_jobs(counting_jobs(Path(sys.argv[1]), 600), Path(sys.argv[1]), Capacity(2, 'slurm', workers=1), set())"
    )
    with slurm_node() as node, _in_environment(node.environment):
        run = subprocess.Popen([sys.executable, "-c", program, str(folder)], stderr=subprocess.DEVNULL)
        _await(lambda: {"begun train b00", "begun train b01"} <= set(journal(folder)), "jobs at work", 2 * PATIENCE_S)
        before = node.told("squeue", "--noheader")
        start = time.monotonic()
        run.send_signal(signal.SIGINT)
        run.wait(PATIENCE_S)
        ended = time.monotonic() - start
        with suppress(TimeoutError):
            _await(lambda: not node.told("squeue", "--noheader"), "empty queue", 30.0)
        left = node.told("squeue", "--noheader")
        return {
            "jobs before Ctrl-C": len(before.splitlines()),
            "left in the queue after it": len(left.splitlines()),
            "ended_after_s": round(ended, 1),
        }


def reconstruct_with_a_dead_node(
    photos: Path, poses: Path | None, blocks: int, sets: Sequence[str]
) -> dict[str, object]:
    """Real blocks; the node dies when those that learn have kept a checkpoint."""
    from stages.artifacts import checkpoint_path
    from stages.block_jobs import reconstruct_at_once
    from stages.pipeline import PIPELINE
    from stages.request import Request

    workspace = photos.with_name(f"{photos.name}_slurm")
    asked_for = Request(
        photos=photos, workspace=workspace, poses=poses, sets=tuple(sets), device="cpu", workers=1
    )  # fmt: skip
    checkpoint, at_once = checkpoint_path(Path()).name, min(blocks, os.cpu_count() or 1)

    def is_in_the_middle() -> bool:
        kept = [learned_steps(path) for path in (workspace / "blocks").rglob(checkpoint)]
        return sum(steps >= STEPS_OF_A_WHILE for steps in kept) >= at_once

    start = time.monotonic()
    runs, _ = run_with_a_dead_node(
        lambda: reconstruct_at_once(asked_for, blocks, Capacity(blocks, "slurm", workers=1), PIPELINE),
        is_in_the_middle,
    )
    return {
        "blocks": {outcome.name: outcome.state for outcome in runs.outcomes},
        "errors": [outcome.error for outcome in runs.outcomes if outcome.error],
        "tiles": [str(outcome.glb.relative_to(workspace)) for outcome in runs.outcomes if outcome.glb],
        "trainings went on from step": {
            outcome.name: WENT_ON.findall((outcome.workspace / "hineus.log").read_text()) for outcome in runs.outcomes
        },
        "wall_s": round(time.monotonic() - start),
    }


def learned_steps(checkpoint: Path) -> int:
    """Of the training that keeps this file; 0 where it is written anew just now."""
    from stages.engine.checkpoint import CheckpointDamaged, read_checkpoint

    try:
        kept = read_checkpoint(checkpoint)
    except CheckpointDamaged:
        return 0
    return 0 if kept is None else int(kept["trainer"]["step_index"])


@contextmanager
def _in_environment(environment: Mapping[str, str]) -> Iterator[None]:
    before = dict(os.environ)
    os.environ.update(environment)
    try:
        yield
    finally:
        os.environ.clear()
        os.environ.update(before)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=int, default=20, help="that each step counts")
    parser.add_argument("--photos", type=Path, help="folder of photos: real blocks of them")
    parser.add_argument("--poses", type=Path, help="as of hineus run")
    parser.add_argument("--blocks", type=int, default=2)
    parser.add_argument("--set", action="append", default=[], dest="sets", help="as of hineus run")
    wanted = parser.parse_args()
    if not is_possible():
        sys.exit(
            "It needs root, `apt-get install slurm-wlm munge`, `pip install 'hineus[cluster]'`, and no "
            f"{SYSTEM_CONFIGURATION}."
        )
    if wanted.photos:
        _show(reconstruct_with_a_dead_node(wanted.photos, wanted.poses, wanted.blocks, wanted.sets))
        return
    for measure in (lambda folder: count_with_a_dead_node(folder, wanted.seconds), left_after_ctrl_c):
        with tempfile.TemporaryDirectory() as folder:
            _show(measure(Path(folder)))


def _show(found: Mapping[str, object]) -> None:
    for name, value in found.items():
        print(f"{name}: {value}", flush=True)


if __name__ == "__main__":
    main()
