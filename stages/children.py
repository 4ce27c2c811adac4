"""Python in a process of its own, for what may crash or never end.

It finds modules where this process does and nowhere else: not in the current folder, which may be somebody else's, and
which `python -m` and `python -c` put before all other places.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

# Its CPU time takes a process so many times as long at most, on a machine that is busy with other things.
PATIENCE = 10

HOME = str(Path(__file__).resolve().parents[1])


def module_command(module: str, *arguments: str) -> list[str]:
    """The command that runs one of our modules."""
    return program_command(_program_of(module), *arguments)


def _program_of(module: str) -> str:
    return f"import runpy; runpy.run_module({module!r}, run_name='__main__', alter_sys=True)"


def program_command(program: str, *arguments: str) -> list[str]:
    """The command that runs a text.

    `-I` leaves out the current folder, and with it PYTHONPATH and the user's own packages: what this process has of
    those is in its path, which is handed over.
    """
    path = [HOME, *(place for place in sys.path if os.path.isabs(place) and place != HOME)]
    utf8 = f"utf8={sys.flags.utf8_mode}"
    return [sys.executable, "-I", "-X", utf8, "-c", f"import sys; sys.path[:] = {path!a}; {program}", *arguments]


def run(words: Sequence[str], time_limit: float) -> subprocess.CompletedProcess[str]:
    """Run a command for so many seconds at most.

    Raises:
        subprocess.TimeoutExpired: it was killed then.
    """
    # what a crash leaves on stderr may be no text
    return subprocess.run(words, capture_output=True, text=True, errors="replace", timeout=time_limit, check=False)


def run_module(module: str, *arguments: str, cpu_limit: float) -> subprocess.CompletedProcess[str]:
    """Run one of our modules for so many seconds of CPU time at most, so that a busy machine changes no result.

    Windows has no such limit: there they are seconds on the clock.

    Raises:
        subprocess.TimeoutExpired: it was killed then, or after `PATIENCE` times as long on the clock.
    """
    if sys.platform == "win32":
        return run(module_command(module, *arguments), cpu_limit)
    limited = f"import signal; signal.setitimer(signal.ITIMER_PROF, {cpu_limit!r}); {_program_of(module)}"
    words = program_command(limited, *arguments)
    done = run(words, PATIENCE * cpu_limit)
    if done.returncode == -signal.SIGPROF:
        raise subprocess.TimeoutExpired(words, cpu_limit)
    return done
