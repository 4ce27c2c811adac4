"""Signals end a run as Ctrl-C does, wherever it is: exit code, sentence, log, children, and what is kept."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import psutil
import pytest

from stages.engine.workspace import Workspace

REPOSITORY = Path(__file__).parents[1]

TOY_CLI = """
import sqlite3, subprocess, sys, time
sys.path.insert(0, {tests!r})
from toy_pipeline import TOY, with_stage
from hineus_cli.app import build_app

def in_python(context):
    print("running", flush=True)
    time.sleep(60)

def in_c(context):  # a query that hears no signal, with Python's lock released as the libraries release it
    print("running", flush=True)
    sqlite3.connect(":memory:").execute(
        "with recursive n(i) as (select 1 union all select i + 1 from n where i < 20000000000) select max(i) from n"
    ).fetchone()

def with_a_child(context):
    child = subprocess.Popen(["sleep", "60"])
    print("running", child.pid, flush=True)
    time.sleep(60)

def after_pycolmap(context):
    import pycolmap
    in_python(context)

build_app(with_stage("sfm", run={stage}))(sys.argv[1:])
"""


class Run:
    """`hineus run` with one stage of the toy pipeline replaced, in a process of its own."""

    def __init__(self, folder: Path, stage: str, *options: str, ignored: int | None = None) -> None:
        (folder / "photos").mkdir(exist_ok=True)
        (folder / "photos/0.jpg").write_text("0")
        program = TOY_CLI.format(tests=str(Path(__file__).parent), stage=stage)

        def dispositions() -> None:  # what runs in the background of a shell inherits that Ctrl-C is ignored
            for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
                signal.signal(number, signal.SIG_IGN if number == ignored else signal.SIG_DFL)

        self.workspace = folder / "photos_hineus"
        self.process = subprocess.Popen(
            [sys.executable, "-c", textwrap.dedent(program), "run", "photos", *options],
            cwd=folder,
            env={**os.environ, "PYTHONPATH": str(REPOSITORY)},
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            preexec_fn=dispositions,
        )

    def told(self) -> str:
        """The line that the stage prints once it runs."""
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        time.sleep(0.3)  # until it is deep in what comes next
        return line

    def end(self, *signals: signal.Signals) -> tuple[int, str, float]:
        """Exit code, stderr and the seconds it took to end."""
        started = time.monotonic()
        for number in signals:
            self.process.send_signal(number)
            time.sleep(0.2)
        _, said = self.process.communicate(timeout=30)
        return self.process.returncode, said, time.monotonic() - started

    def log(self) -> str:
        return (self.workspace / "hineus.log").read_text()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("number", "code", "sentence"),
    [
        (signal.SIGTERM, 143, "Stopped by SIGTERM."),
        (signal.SIGHUP, 129, "Stopped by SIGHUP."),
        (signal.SIGINT, 130, "Stopped."),
    ],
)
def test_a_signal_is_told_and_the_next_run_goes_on(tmp_path, number, code, sentence) -> None:
    run = Run(tmp_path, "in_python")
    assert run.told() == "running\n"
    found, said, _ = run.end(number)
    assert found == code
    assert said.count(f"Error: {sentence}") == 1
    assert "run the same command to go on" in said
    assert "Traceback" not in said
    assert "stages.tracebacks: stopped by" in run.log()
    workspace = Workspace.open(run.workspace)
    assert workspace.published("ingest") is not None
    assert workspace.published("sfm") is None
    with workspace.lock():  # nobody holds it
        pass


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_deep_in_a_library_it_ends_after_a_while(tmp_path, number) -> None:
    run = Run(tmp_path, "in_c")
    run.told()
    code, said, seconds = run.end(number)
    assert code == 128 + number
    assert 4 < seconds < 9
    assert "Error: Stopped" in said
    assert "in the middle of a step" in run.log()


@pytest.mark.slow
def test_a_second_ctrl_c_ends_it_at_once(tmp_path) -> None:
    run = Run(tmp_path, "in_c")
    run.told()
    code, said, seconds = run.end(signal.SIGINT, signal.SIGINT)
    assert (code, said.count("Error: Stopped.")) == (130, 1)
    assert seconds < 3


@pytest.mark.slow
def test_children_end_too(tmp_path) -> None:
    run = Run(tmp_path, "with_a_child")
    child = psutil.Process(int(run.told().split()[1]))
    assert run.end(signal.SIGTERM)[0] == 143
    deadline = time.monotonic() + 5
    while child.is_running() and child.status() != psutil.STATUS_ZOMBIE:
        assert time.monotonic() < deadline
        time.sleep(0.05)


@pytest.mark.slow
def test_what_nohup_ignores_stays_ignored(tmp_path) -> None:
    run = Run(tmp_path, "in_python", ignored=signal.SIGHUP)
    run.told()
    run.process.send_signal(signal.SIGHUP)
    time.sleep(0.5)
    assert run.process.poll() is None
    assert run.end(signal.SIGTERM)[0] == 143


@pytest.mark.slow
def test_pycolmap_does_not_keep_sigterm_for_itself(tmp_path) -> None:
    run = Run(tmp_path, "after_pycolmap")
    run.told()
    code, said, seconds = run.end(signal.SIGTERM)
    assert code == 143
    assert "stack trace" not in said
    assert seconds < 4


def run_python(program: str, number: signal.Signals, again: bool = False) -> tuple[int, str]:
    """Exit code and stderr of a program that is sent a signal, or two at once, when it has printed a line."""
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY)}
    process = subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(program)],
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(number, signal.SIG_DFL),
    )
    assert process.stdout is not None
    process.stdout.readline()
    process.send_signal(number)
    if again:  # as a terminal's, which the supervising parent passes on
        process.send_signal(number)
    _, said = process.communicate(timeout=30)
    return process.returncode, said


@pytest.mark.parametrize(
    ("number", "sentence"),
    [(signal.SIGTERM, "Stopped by SIGTERM."), (signal.SIGHUP, "Stopped by SIGHUP."), (signal.SIGINT, "Stopped.")],
)
def test_a_signal_before_the_command_starts(number, sentence) -> None:
    program = """
        from hineus_cli.at_once import end_at_once_by_signals
        end_at_once_by_signals()
        import time
        print("on", flush=True)
        time.sleep(60)
    """
    assert run_python(program, number) == (128 + number, f"Error: {sentence}\n")


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_while_arguments_are_read(number) -> None:
    program = """
        import sys, time
        from hineus_cli.app import HineusGroup, build_app

        def parse_args(self, context, arguments):
            print("on", flush=True)
            time.sleep(60)

        HineusGroup.parse_args = parse_args
        build_app()(["status"])
    """
    code, said = run_python(program, number)
    assert code == 128 + number
    assert said.count("Error: Stopped") == 1
    assert "Traceback" not in said


@pytest.mark.slow
def test_a_signal_that_comes_twice_is_one() -> None:
    program = """
        import sys, time
        from hineus_cli.app import HineusGroup, build_app

        def parse_args(self, context, arguments):
            try:
                print("on", flush=True)
                time.sleep(60)
            finally:
                time.sleep(0.5)
                print("put in order", file=sys.stderr)

        HineusGroup.parse_args = parse_args
        build_app()(["status"])
    """
    code, said = run_python(program, signal.SIGINT, again=True)
    assert code == 130
    assert said.startswith("put in order\nError: Stopped.")


@pytest.mark.slow
def test_a_signal_where_no_exception_can_go_shows_none() -> None:
    program = """
        import time
        from hineus_cli.app import HineusGroup, build_app

        class Slow:
            def __del__(self):
                print("on", flush=True)
                time.sleep(60)

        def parse_args(self, context, arguments):
            Slow()
            time.sleep(60)

        HineusGroup.parse_args = parse_args
        build_app()(["status"])
    """
    code, said = run_python(program, signal.SIGTERM)
    assert code == 143
    assert "Exception ignored" not in said
    assert said.count("Error: Stopped by SIGTERM.") == 1


def test_signals_wait_for_an_import() -> None:
    program = """
        import time
        from hineus_cli.at_once import end_at_once_by_signals, sent_by_ourselves, signals_wait
        end_at_once_by_signals()
        with signals_wait():
            print("on", flush=True)
            time.sleep(0.3)
            assert not sent_by_ourselves()
            print("imported", file=__import__("sys").stderr)
        time.sleep(60)
    """
    assert run_python(program, signal.SIGTERM) == (143, "imported\nError: Stopped by SIGTERM.\n")


@pytest.mark.slow
def test_a_package_that_catches_everything_while_it_is_imported_keeps_nothing_from_ending(tmp_path) -> None:
    (tmp_path / "catching.py").write_text(
        "import time\ntry:\n    print('on', flush=True)\n    time.sleep(1)\nexcept BaseException:\n    pass\n"
    )
    program = f"""
        import sys, time
        from hineus_cli.app import HineusGroup, build_app
        sys.path.insert(0, {str(tmp_path)!r})

        def parse_args(self, context, arguments):
            import catching
            sys.exit(0)

        HineusGroup.parse_args = parse_args
        build_app()(["status"])
    """
    code, said = run_python(program, signal.SIGTERM)
    assert (code, said.count("Error: Stopped by SIGTERM.")) == (143, 1)


def test_a_library_that_stops_us_is_told_from_a_signal() -> None:
    program = """
        import os, signal
        from hineus_cli.at_once import sent_by_ourselves, signals_wait
        with signals_wait():
            signal.raise_signal(signal.SIGINT)  # as OpenBLAS does where it gets no thread
            assert sent_by_ourselves()
        os._exit(6)
    """
    ended = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(program)],
        env={**os.environ, "PYTHONPATH": str(REPOSITORY)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert (ended.returncode, ended.stderr) == (6, "")


@pytest.mark.slow
def test_a_crash_shows_no_cpp_stack(tmp_path) -> None:
    run = Run(tmp_path, "lambda context: (__import__('pycolmap'), __import__('os').abort())")
    code, said, _ = run.end()
    assert code == -signal.SIGABRT
    assert "stack trace" not in said


@pytest.mark.slow
def test_the_answer_is_json_too(tmp_path) -> None:
    run = Run(tmp_path, "in_python", "--json")
    while "sfm" not in run.process.stderr.readline():  # its stdout is kept for the JSON
        pass
    run.process.send_signal(signal.SIGTERM)
    answer, _ = run.process.communicate(timeout=30)
    assert json.loads(answer)["error"]["exit_code"] == 143


@pytest.mark.slow
def test_case_23_sigterm_in_sfm(tmp_path) -> None:
    """Case 23: in pycolmap's own threads."""
    command = [sys.executable, "-m", "hineus_cli", "demo", "-w", str(tmp_path / "demo"), "--preset", "tiny"]
    with subprocess.Popen(
        command, cwd=REPOSITORY, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True
    ) as process:
        try:
            assert process.stderr is not None
            while not process.stderr.readline().startswith("sfm"):
                assert process.poll() is None
            time.sleep(2)
            process.send_signal(signal.SIGTERM)
            said = process.stderr.read()
            assert process.wait(timeout=30) == 143
        finally:
            process.kill()
    assert "Stopped by SIGTERM." in said
    assert "stack trace" not in said
    assert "stopped by SIGTERM" in (tmp_path / "demo/workspace/hineus.log").read_text()
