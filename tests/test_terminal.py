"""What is printed where: terminals that are narrow, dumb or ASCII only, pipes, closed and full streams, odd names."""

from __future__ import annotations

import fcntl
import json
import os
import pty
import re
import signal
import struct
import subprocess
import sys
import termios
import time
import unicodedata
from pathlib import Path

import pytest
from toy_pipeline import TOY
from typer.testing import CliRunner

from hineus_cli.app import build_app
from hineus_cli.session import as_argument
from stages import reconstruct
from stages.engine.run_log import plain

REPOSITORY = Path(__file__).parents[1]
ODD = ("[red]Größe :key:.jpg", "\x1b]0;pwned\x07.jpg", "\udcff.jpg")

PROGRAM = f"""
import logging, sys, threading, warnings
sys.path.insert(0, {str(Path(__file__).parent)!r})
from toy_pipeline import TOY, with_stage
import hineus_cli.app

def notes(context):
    for index, path in enumerate(sorted(context.sources["photos"].rglob("*"))):
        name = str(path.relative_to(context.sources["photos"]))
        context.progress(index, 9, name)
        warnings.warn(name)
        logging.getLogger("library").warning("%s", name)
        failing = threading.Thread(target=fail, args=(name,))
        failing.start()
        failing.join()
        Failing.name = name
        Failing()
    return TOY[0].run(context)

def fail(name):
    raise ValueError(name)

class Failing:
    def __del__(self):
        fail(self.name)

hineus_cli.app.app = hineus_cli.app.build_app(with_stage("ingest", run=notes))
hineus_cli.app.main()
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with `photos/`, files of odd names in it."""
    photos = tmp_path / "photos"
    photos.mkdir()
    for name in ODD:
        (photos / name).write_text("a")
    (photos / "0.jpg").write_text("b")
    return tmp_path


def environment(changes: dict[str, str]) -> dict[str, str]:
    given = {**os.environ, "PYTHONPATH": str(REPOSITORY), "TERM": "xterm-256color", **changes}
    for name in ("NO_COLOR", "FORCE_COLOR", "COLUMNS", "LINES"):
        if name not in changes:
            given.pop(name, None)
    return given


def on_terminal(folder: Path, columns: int, *arguments: str, **changes: str) -> tuple[int, str]:
    """Exit code, and all that came to a terminal of so many columns."""
    ours, its = pty.openpty()
    fcntl.ioctl(its, termios.TIOCSWINSZ, struct.pack("HHHH", 30, columns, 0, 0))
    process = subprocess.Popen(
        [sys.executable, "-c", PROGRAM, *arguments],
        cwd=folder, env=environment(changes), stdin=its, stdout=its, stderr=its, close_fds=True,
    )  # fmt: skip
    os.close(its)
    came = b""
    try:
        while chunk := os.read(ours, 1 << 16):
            came += chunk
    except OSError:  # how Linux says that the other end is closed
        pass
    os.close(ours)
    return process.wait(timeout=30), came.decode("utf-8", "replace")


def in_shell(folder: Path, command: str, **changes: str) -> subprocess.CompletedProcess[bytes]:
    """A line of bash in which HINEUS is the command; its exit code is that of HINEUS, first in a pipe."""
    (folder / "program.py").write_text(PROGRAM)
    line = command.replace("HINEUS", f"{sys.executable} program.py")
    given = environment(changes)
    return subprocess.run(
        ["bash", "-c", f"{line}; exit ${{PIPESTATUS[0]}}"], cwd=folder, env=given, capture_output=True, check=False
    )


# ---------------------------------------------------------------- terminals
@pytest.mark.slow
@pytest.mark.parametrize("columns", [40, 80])
def test_names_are_printed_as_they_are_on_a_terminal(folder: Path, columns: int) -> None:
    code, came = on_terminal(folder, columns, "run", "photos")
    assert code == 0, came
    assert "[red]Größe :key:.jpg" in came
    assert "\x1b]0;" not in came
    table = [line for line in came.splitlines() if line.startswith(("│", "┃"))]
    shown = [re.sub(r"\x1b\[[0-9;]*m", "", line) for line in table]
    assert max(map(len, shown)) <= columns
    assert any("undistort" in line and "not made" in line for line in shown)
    assert came.rstrip().endswith("(to see it: `hineus view photos_hineus`)")


NASTY = (
    "\x1b]0;pwned\x07",
    "\x1b[2J",
    "\x1b]8;;http://x\x1b\\",
    "\x9b31m",
    "\x7f\b\r",
    "\u202egpj.exe",
    "\u2066\u2069\u200f\u061c",
    "\u2028\u2029\x85",
    "\udcff\udc9b",
    "\U000e0041",
    "\ufeff\u200b",
    "[/]",
    "[red]",
    "[link=x]",
    ":key:",
    "a\nError: forged",
)
FORBIDDEN = {"Cc", "Cf", "Cs", "Zl", "Zp"}


@pytest.mark.slow
@pytest.mark.parametrize(
    "command",
    [
        "check photos", "check photos --json", "run photos; status photos_hineus", "status NAME", "run NAME",
        "run photos -w NAME", "run photos -w photos/NAME", "run photos --masks NAME", "run photos --poses NAME",
        "run photos --json; status photos_hineus --json", "run photos --control NAME", "run photos --preset NAME",
        "run photos --until NAME", "run photos --force NAME", "run photos --from NAME",
        "run photos --device NAME", "run photos --time NAME", "run photos --hold-out NAME",
        "run photos --workers NAME", "run photos --NAME", "NAME", "config --config NAME", "config --set NAME",
        "config --set sfm.seed=NAME", "config --set NAME=1", "config --set train.backbone=NAME", "config --preset NAME",
        "config --config holding.yaml", "view NAME", "view . --port NAME", "export-colmap NAME out",
        "evaluate mesh NAME NAME", "evaluate NAME", "compare NAME NAME", "doctor --folder NAME", "bench NAME .",
        "bench dtu NAME", "bench dtu . --peer NAME",
    ],
)  # fmt: skip
def test_no_command_sends_a_terminal_what_it_obeys(folder: Path, command: str) -> None:
    name = "".join(NASTY)
    for part in NASTY:
        (folder / f"photos/{part.replace('/', '')}.jpg").write_text("c")
    (folder / "holding.yaml").write_text(f"sfm:\n  matcher: {json.dumps(name)}\n")
    text = ""
    for part in command.split("; "):
        text += on_terminal(folder, 80, *(word.replace("NAME", name) for word in part.split()), TERM="dumb")[1]
    text = text.replace("\r\n", "\n")
    assert "Traceback" not in text
    assert "Unexpected error" not in text
    if (log := folder / "photos_hineus/hineus.log").exists():
        text += log.read_text()
    assert {c for c in text if unicodedata.category(c) in FORBIDDEN} <= {"\n"}, text
    assert not any(line.startswith("Error: forged") for line in text.splitlines())


@pytest.mark.slow
def test_a_markup_that_closes_nothing_is_only_a_name(folder: Path) -> None:
    (folder / "photos/[").mkdir()
    (folder / "photos/[/].jpg").write_text("c")
    _, came = on_terminal(folder, 80, "run", "photos", "--until", "ingest")
    assert "MarkupError" not in came
    assert "[/].jpg" in came


@pytest.mark.slow
@pytest.mark.parametrize(
    ("changes", "unwanted"),
    [({"NO_COLOR": "1"}, r"\x1b\[[0-9;]*3[0-7]m"), ({"TERM": "dumb"}, "\x1b"), ({"TERM": "unknown"}, "\x1b")],
)
def test_no_colours_where_none_are_wanted(folder: Path, changes: dict[str, str], unwanted: str) -> None:
    code, came = on_terminal(folder, 80, "run", "photos", **changes)
    assert code == 0
    assert re.search(unwanted, came) is None
    code, came = on_terminal(folder, 80, "run", "nowhere", **changes)
    assert (code, re.search(unwanted, came)) == (3, None)


@pytest.mark.slow
def test_a_pipe_gets_plain_lines_and_no_bars_even_where_colours_are_forced(folder: Path) -> None:
    bare = in_shell(folder, "HINEUS run photos")
    assert b"\x1b" not in bare.stdout + bare.stderr
    forced = in_shell(folder, "HINEUS run photos --force sfm", FORCE_COLOR="1")
    assert b"\x1b[2m" in forced.stderr
    assert re.search(rb"\x1b\[(\?|[0-9;]*[A-KJ])", forced.stderr) is None  # the cursor moves nowhere


@pytest.mark.slow
@pytest.mark.parametrize(
    "changes",
    [
        {"PYTHONIOENCODING": "ascii"},
        {"LC_ALL": "POSIX", "PYTHONCOERCECLOCALE": "0", "PYTHONUTF8": "0"},
        {"LANG": "C", "LC_ALL": "C"},
        {"PYTHONIOENCODING": "latin-1"},
    ],
)
def test_any_encoding_takes_what_is_printed(folder: Path, changes: dict[str, str]) -> None:
    for command in ("run photos", "status photos_hineus", "config --describe", "run --help", "check photos"):
        done = in_shell(folder, f"HINEUS {command}", **changes)
        assert b"Traceback" not in done.stderr, done.stderr
        assert b"Unexpected error" not in done.stderr, done.stderr
        if "ascii" in changes.values():
            (done.stdout + done.stderr).decode("ascii")


# ---------------------------------------------------------------- streams
@pytest.mark.slow
@pytest.mark.parametrize("command", ["config --describe", "status photos_hineus", "presets", "--help", "run --json"])
def test_a_reader_that_has_enough_is_no_error(folder: Path, command: str) -> None:
    in_shell(folder, "HINEUS run photos")
    where = "-w photos_hineus" if command.startswith("run") else ""
    for reader in ("head -n 1", "true"):
        done = in_shell(folder, f"HINEUS {command} {where} | {reader}")
        assert done.returncode in (0, 1)
        assert b"Traceback" not in done.stderr
        assert b"rror" not in done.stderr


@pytest.mark.slow
def test_a_run_that_nobody_reads_any_more_says_so_in_its_log(folder: Path) -> None:
    done = in_shell(folder, "HINEUS run photos --until ingest 2>&1 | true")
    assert done.returncode == 1
    assert "nobody reads what is printed any more" in (folder / "photos_hineus/hineus.log").read_text()


@pytest.mark.slow
@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
@pytest.mark.parametrize("command", ["config", "presets", "config --describe", "run photos --json"])
def test_output_that_cannot_be_written_is_told(folder: Path, command: str) -> None:
    done = in_shell(folder, f"HINEUS {command} > /dev/full")
    assert done.returncode == 1
    assert done.stderr.count(b"Error: The output cannot be written: [Errno 28] No space left on device.") == 1
    assert b"Traceback" not in done.stderr


@pytest.mark.slow
@pytest.mark.parametrize("closed", ["2>&-", ">&-", ">&- 2>&-", "<&- >&- 2>&-"])
def test_closed_streams_stop_nothing(folder: Path, closed: str) -> None:
    for options in ("", "--json"):
        done = in_shell(folder, f"HINEUS run photos --until ingest {options} {closed}")
        lost = options and re.search(r"(^| )>&-", closed)
        assert done.returncode == (1 if lost else 0), done.stderr
        assert (folder / "photos_hineus/ingest/letters.txt").is_file()


@pytest.mark.slow
@pytest.mark.parametrize("closed", [">&-", ">&- 2>&-", "<&- >&- 2>&-"])
@pytest.mark.parametrize("command", ["config", "presets", "config --describe", "check photos --json", "--version"])
def test_what_is_asked_for_and_cannot_be_printed_is_an_error(folder: Path, command: str, closed: str) -> None:
    done = in_shell(folder, f"HINEUS {command} {closed}")
    assert done.returncode == 1
    assert b"Traceback" not in done.stderr
    told = done.stderr.count(b"Error: The output cannot be written: [Errno 9] Bad file descriptor.")
    assert told == ("2>&-" not in closed)


@pytest.mark.slow
def test_closed_streams_are_no_file_s_numbers(folder: Path) -> None:
    """What a library prints to number 1 or 2 must not land in a file that was opened since."""
    (folder / "prints.py").write_text(
        "import os\n"
        "from hineus_cli.streams import mend_streams\n"
        "mend_streams()\n"
        "with open('kept.txt', 'w') as file:\n"
        "    for number in (1, 2):\n"
        "        os.write(number, b'noise')\n"
        "    os.system('echo noise; echo noise >&2')\n"
        "    file.write(str(file.fileno() > 2))\n"
    )
    subprocess.run(
        ["bash", "-c", f"{sys.executable} prints.py <&- >&- 2>&-"], cwd=folder, env=environment({}), check=True
    )
    assert (folder / "kept.txt").read_text() == "True"


@pytest.mark.slow
@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
@pytest.mark.parametrize("options", ["", "--json"])
def test_a_run_goes_on_where_only_its_progress_cannot_be_shown(folder: Path, options: str) -> None:
    done = in_shell(folder, f"HINEUS run photos {options} 2> /dev/full")
    assert done.returncode == 0
    assert (folder / "photos_hineus/export/model.glb").is_file()
    assert bool(done.stdout) == bool(options)
    assert in_shell(folder, "HINEUS run nowhere 2> /dev/full").returncode == 3
    assert in_shell(folder, "HINEUS config > /dev/full 2> /dev/full").returncode == 1


@pytest.mark.slow
@pytest.mark.parametrize("size", ["1", "0", "-3", "junk", "", "²", "9999", "99999999999"])
def test_any_size_of_a_terminal_is_fine(folder: Path, size: str) -> None:
    sizes = {"COLUMNS": size, "LINES": size, "TERMINAL_WIDTH": size}
    for command in ("--help", "run --help", "presets", "run photos", "status photos_hineus", "run nowhere"):
        code, came = on_terminal(folder, 80, *command.split(), **sizes)
        assert code == (3 if "nowhere" in command else 0), came
        assert "Traceback" not in came


@pytest.mark.slow
@pytest.mark.parametrize(("before", "code"), [("", 129), ("trap '' HUP;", 0)], ids=["stopped", "disowned"])
def test_a_terminal_that_is_closed(folder: Path, before: str, code: int) -> None:
    (folder / "program.py").write_text(PROGRAM)
    given = environment({"TOY_SLEEP": "2"})  # in sfm
    line = f"cd {folder}; {before} exec {sys.executable} program.py run photos"
    process, terminal = pty.fork()
    if process == 0:
        signal.signal(signal.SIGHUP, signal.SIG_DFL)  # the tests may run under `nohup`
        os.execvpe("bash", ["bash", "-c", line], given)
    came = b""
    while b"sfm" not in came:
        came += os.read(terminal, 1 << 16)
    time.sleep(0.5)
    os.close(terminal)
    assert os.waitstatus_to_exitcode(os.waitpid(process, 0)[1]) == code
    workspace = folder / "photos_hineus"
    assert (workspace / "export/model.glb").exists() == (code == 0)
    assert ("stopped by SIGHUP" in (workspace / "hineus.log").read_text()) == (code != 0)


# ---------------------------------------------------------------- the last line
def test_the_last_line_is_the_file_and_how_to_open_it(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(reconstruct, "has_cuda", lambda: False)

    def last(*arguments: str) -> str:
        return CliRunner().invoke(build_app(TOY), arguments).stderr.splitlines()[-1]

    model = f"{tmp_path}/my photos_hineus/export/model.glb"
    (tmp_path / "photos").rename("my photos")
    assert last("run", "my photos", "--until", "sfm").endswith("to go on: `hineus run --workspace 'my photos_hineus'`)")
    assert last("run", "my photos") == f"textured model: {model} (to see it: `hineus view 'my photos_hineus'`)"
    assert last("run", "my photos", "--until", "sfm").startswith("workspace: ")  # the model may be an old one
    monkeypatch.chdir("my photos_hineus")
    assert last("run") == f"textured model: {model} (to see it: `hineus view .`)"
    assert last("run", "nowhere") == "Check the path with `ls`."


def test_paths_as_arguments(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert as_argument(tmp_path / "a b") == "'a b'"
    assert as_argument(Path("/elsewhere/x")) == "/elsewhere/x"


def test_control_characters_are_shown() -> None:
    assert plain("a\x1b[31mb\x9b\x7f\r\ttab\nline ü") == "a\\x1b[31mb\\x9b\\x7f\\x0d\ttab\nline ü"
    assert plain("\u202egpj\u2028\udcff\U000e0041", kept="") == "\\u202egpj\\u2028\\udcff\\U000e0041"
    assert plain("line\nline", kept="") == "line\\x0aline"
    for name in ("Größe", "日本語　写真", "a\xa0b", "👩\u200d🚀", "क्\u200dष", "[red]"):
        assert plain(name) == name
