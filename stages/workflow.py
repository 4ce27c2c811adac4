"""Snakemake in a process of its own: found, run on rules that lie in a folder, and ended with this one.

What it is given it does: which jobs have to wait for which, how many run at once, here or on a cluster (docs/adr/0023).
"""

from __future__ import annotations

import logging
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

from stages.children import program_command
from stages.errors import SystemRequirementError
from stages.limits import available_cores, available_memory

log = logging.getLogger(__name__)

LOCAL = "local"
INSTALL = "pip install 'hineus[cluster]'"
LOOK_S = 0.5  # between two looks at what has been done
GRACE_S = 4.0  # for it to take back what it has sent to a cluster; after 5 everything here is ended
LATENCY_S = 60  # until a file that was written on another machine is seen here
MB = 1 << 20  # Snakemake's, and Slurm's
PR_SET_PDEATHSIG = 1
# Where this process is killed, it hears of it on Linux and takes back what it has sent to a cluster.
ENDS_WITH_US = f"import ctypes; ctypes.CDLL(None).prctl({PR_SET_PDEATHSIG}, {int(signal.SIGINT)}); "
RUN = "import runpy; runpy.run_module('snakemake', run_name='__main__', alter_sys=True)"


@dataclass(frozen=True)
class Capacity:
    """How much is done at once.

    Attributes:
        jobs: at once, at most.
        executor: "local", or the name of one of Snakemake's executor plugins, whose machines see the same folders.
        workers: cores that all of this machine's jobs may take together, or each job on a cluster; None: as many as
            this process may use.
    """

    jobs: int
    executor: str = LOCAL
    workers: int | None = None

    @property
    def is_local(self) -> bool:
        return self.executor == LOCAL

    @property
    def threads(self) -> int:
        """Cores of a job."""
        cores = self.workers or available_cores()
        return max(1, cores // self.jobs) if self.is_local else cores

    def memory_mb(self, asked: int) -> tuple[int, int]:
        """Of a job that asks for so many bytes: at its first attempt, and later.

        On this machine it is no more than there is, or the job would never start.
        """
        first = max(1, asked // MB)
        if self.is_local:
            first = min(first, available_memory() // MB)
            return first, first
        return first, 2 * first


def check_installed(capacity: Capacity) -> None:
    """
    Raises:
        SystemRequirementError: there is no Snakemake, or it has no such executor.
    """
    if find_spec("snakemake") is None:
        raise SystemRequirementError(
            "Several blocks at once are run by Snakemake, which is not installed.",
            f"`{INSTALL}`, or leave out `--jobs` and `--executor`: one block after another needs nothing more.",
        )
    if not capacity.is_local and find_spec(f"snakemake_executor_plugin_{capacity.executor.replace('-', '_')}") is None:
        install = (
            INSTALL if capacity.executor == "slurm" else f"pip install snakemake-executor-plugin-{capacity.executor}"
        )
        raise SystemRequirementError(
            f"Snakemake's executor '{capacity.executor[:40]}' is not installed.",
            f"`{install}`, or leave out `--executor`.",
        )


def run_rules(folder: Path, capacity: Capacity, output: Path, look: Callable[[], None]) -> int:
    """Run the Snakefile in `folder`, which nobody else may do meanwhile; its exit code, which is 0 where all is done.

    Args:
        output: file to which goes what Snakemake says.
        look: called now and then while it is at work.
    """
    with output.open("ab") as said:
        if _is_locked(folder):  # by one that was killed
            subprocess.run(_command(folder, ["--unlock", "--cores", "1"]), stdout=said, stderr=said, check=False)
        process = subprocess.Popen(
            _command(folder, _options(capacity)), stdin=subprocess.DEVNULL, stdout=said, stderr=subprocess.STDOUT
        )
        try:
            while process.poll() is None:
                time.sleep(LOOK_S)
                look()
        except BaseException:
            _end(process)
            raise
    return process.returncode


def _end(process: subprocess.Popen[bytes]) -> None:
    """As by Ctrl-C. It waits for jobs on this machine, and whoever ends this process ends those."""
    if process.poll() is None:
        process.send_signal(signal.SIGINT if sys.platform != "win32" else signal.SIGTERM)
        try:
            process.wait(GRACE_S)
        except subprocess.TimeoutExpired:
            log.debug("Snakemake goes on for now")


def _is_locked(folder: Path) -> bool:
    return any((folder / ".snakemake" / "locks").glob("*"))


def _command(folder: Path, options: Sequence[str]) -> list[str]:
    program = (ENDS_WITH_US if sys.platform == "linux" else "") + RUN
    return program_command(program, "--snakefile", str(folder / "Snakefile"), "--directory", str(folder), *options)


def _options(capacity: Capacity) -> list[str]:
    """What is up to date is told by markers alone: stages know better than Snakemake what has changed."""
    options = ["--keep-going", "--retries", "1", "--rerun-incomplete", "--rerun-triggers", "mtime", "--nocolor"]
    options += ["--scheduler", "greedy", "--executor", capacity.executor]
    if capacity.is_local:
        memory = available_memory() // MB
        return [*options, "--cores", str(capacity.jobs * capacity.threads), "--resources", f"mem_mb={memory}"]
    options += ["--jobs", str(capacity.jobs), "--latency-wait", str(LATENCY_S)]
    # Jobs of a node that died wait for another turn. Snakemake alone would try once more, and never on that node.
    return [*options, "--slurm-requeue"] if capacity.executor == "slurm" else options
