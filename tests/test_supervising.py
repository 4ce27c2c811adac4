"""A command that is killed or crashes ends with a sentence; one that ends by itself with its own exit code."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="commands are supervised on Linux")

REPOSITORY = Path(__file__).parents[1]
PROGRAM = """
import ctypes, os, signal, sys, time
from hineus_cli.supervising import supervised

def command():
    {command}

supervised(command)
"""
KILLED = "Error: The command was killed (SIGKILL), most probably by the system as memory ran out: it had taken"
FAILED = (
    "Error: The command was ended by a library that failed{}, as they do when memory or threads run out: it had taken"
)


def start(command: str, *options: str) -> subprocess.Popen[str]:
    program = [sys.executable, "-c", PROGRAM.format(command=command), *options]
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY)}
    return subprocess.Popen(program, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


@pytest.mark.parametrize(
    ("command", "code", "sentence"),
    [
        ("os.kill(os.getpid(), signal.SIGKILL)", 6, KILLED),
        ("os.abort()", 6, FAILED.format(" (SIGABRT)")),
        ("ctypes.string_at(0)", 6, FAILED.format(" (SIGSEGV)")),
        ("os._exit(1)", 6, FAILED.format("")),
        ("sys.exit(4)", 4, ""),
        ("sys.exit()", 0, ""),
        ("sys.exit('that is all')", 1, "that is all"),
        ("os._exit(143)", 143, ""),
    ],
)
def test_how_it_ended_is_told(command: str, code: int, sentence: str) -> None:
    process = start(command)
    _, said = process.communicate(timeout=30)
    assert process.returncode == code
    assert said.startswith(sentence)
    assert said.count("Error: ") == (1 if code == 6 else 0)


def test_a_crash_at_the_very_end_does_not_undo_the_success() -> None:
    process = start("import atexit; atexit.register(os.abort); sys.exit(0)")
    assert process.communicate(timeout=30) == ("", "")
    assert process.returncode == 0


def test_the_answer_is_json_too() -> None:
    answer, _ = start("os.abort()", "--json").communicate(timeout=30)
    assert json.loads(answer)["error"]["exit_code"] == 6


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_signals_are_passed_on(number: signal.Signals) -> None:
    if signal.getsignal(number) == signal.SIG_IGN:
        pytest.skip("ignored by whoever runs the tests, as Ctrl-C is in the background of a script")
    process = start(f"signal.signal({number:d}, lambda *_: os._exit(7)); print('on', flush=True); time.sleep(60)")
    assert process.stdout is not None
    assert process.stdout.readline() == "on\n"
    process.send_signal(number)
    assert process.wait(timeout=30) == 7


def test_what_is_killed_takes_the_command_with_it() -> None:
    process = start("print(os.getpid(), flush=True); time.sleep(60)")
    assert process.stdout is not None
    command = psutil.Process(int(process.stdout.readline()))
    process.kill()
    process.wait()
    deadline = time.monotonic() + 5
    while command.is_running() and command.status() != psutil.STATUS_ZOMBIE:
        assert time.monotonic() < deadline
        time.sleep(0.02)
