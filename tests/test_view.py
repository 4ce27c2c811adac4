"""`hineus view`: what is served, and when the live page gives way to the report."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from toy_pipeline import TOY
from typer.testing import CliRunner

from configs.params import Config
from hineus_cli import viewing
from hineus_cli.app import build_app
from hineus_cli.viewing import Watched, serving, watch
from stages import artifacts
from stages.engine.runner import run_pipeline
from stages.engine.workspace import Workspace
from stages.errors import ConfigError, WorkspaceError
from stages.reporting.curves import training_charts

LARGE = 20_000_000
PIPELINE = (*TOY[:2], replace(TOY[2], name="train"))


@pytest.fixture
def workspace(tmp_path: Path) -> Workspace:
    made = Workspace.open(tmp_path / "ws", create=True)
    with made.lock():
        made.remember({"photos": None}, "cpu", {})
    return made


def train_a_little(workspace: Workspace) -> None:
    scratch = workspace.begin("train", "print")[1]
    lines = [json.dumps({"step": 50 * i, "psnr": 10 + i, "loss": 1 / (1 + i)}) for i in range(4)]
    artifacts.METRICS.load(scratch).write_text("\n".join(lines) + '\n{"step": 20')  # a line that is being written
    preview = artifacts.preview_path(scratch, 100)
    preview.parent.mkdir()
    preview.write_bytes(b"a picture")


def write_report(workspace: Workspace) -> None:
    report = artifacts.PAGE.load(workspace.stage_folder("report"))
    report.parent.mkdir()
    report.write_text("<p>the report</p>")


def get(url: str) -> str:
    with urllib.request.urlopen(url, timeout=10) as answer:
        assert answer.headers["Cache-Control"] == "no-store"
        return answer.read().decode()


@pytest.mark.slow
def test_a_training_run_is_shown_as_it_goes_and_then_the_report(workspace):
    with workspace.lock():
        train_a_little(workspace)
        with serving(watch(workspace.root, PIPELINE)) as url:
            assert "under way" in get(url)
            state = json.loads(get(f"{url}state.json"))
            assert state["running"] is True
            assert state["report"] is False
            assert [stage["state"] for stage in state["stages"]] == ["waiting", "waiting", "running"]
            assert [chart["label"] for chart in state["charts"]] == ["psnr", "loss"]
            assert "<polyline" in state["charts"][0]["svg"]
            assert state["previews"] == ["0000100.png"]
            assert get(f"{url}preview/0000100.png") == "a picture"
            write_report(workspace)
            assert "under way" in get(url)  # the run goes on: this may be the report of the one before
    with serving(watch(workspace.root, PIPELINE)) as url:
        assert json.loads(get(f"{url}state.json"))["report"] is True
        assert get(url) == "<p>the report</p>"
        assert "under way" in get(f"{url}live")


def test_nothing_else_is_served(workspace):
    write_report(workspace)
    with serving(watch(workspace.root, PIPELINE)) as url:
        assert url.startswith("http://127.0.0.1:")
        for path in ("workspace.json", "preview/../workspace.json", "preview/none.png", "../../etc/passwd"):
            with pytest.raises(urllib.error.HTTPError, match="404"):
                get(url + path)


def test_what_a_killed_training_has_left_is_not_read(workspace):
    train_a_little(workspace)
    with pytest.raises(WorkspaceError, match="no report yet"):
        watch(workspace.root, PIPELINE)
    write_report(workspace)
    with serving(watch(workspace.root, PIPELINE)) as url:
        state = json.loads(get(f"{url}state.json"))
        assert (state["running"], state["charts"], state["previews"]) == (False, [], [])
        assert state["stages"][-1]["state"] == "waiting"


def test_nor_is_it_by_the_next_run_before_its_own_training(workspace, tmp_path, monkeypatch):
    train_a_little(workspace)
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "a.jpg").write_text("a")
    states = []
    looking = replace(
        TOY[0], run=lambda context: states.append(Watched(workspace, PIPELINE).state()) or TOY[0].run(context)
    )
    sources = {"photos": tmp_path / "photos"}
    run_pipeline((looking, *PIPELINE[1:]), Workspace.open(workspace.root), Config(), sources, until="ingest")
    [state] = states
    assert [stage["state"] for stage in state["stages"]] == ["running", "waiting", "waiting"]
    assert (state["running"], state["charts"], state["previews"]) == (True, [], [])


@pytest.mark.parametrize(
    "line",
    ["", "5", "[]", "{", "[" * 100_000, "\xff", '{"step": "x", "psnr": 1}', '{"step": 1, "psnr": "x"}', '{"psnr": [1]}',
     '{"step": 1' + 400 * "0" + ', "psnr": 2}', '{"step": 3, "psnr": 1e999}', '{"step": NaN, "psnr": 3}'],
)  # fmt: skip
def test_lines_of_metrics_that_cannot_be_read_are_left_out(tmp_path, line):
    path = tmp_path / "metrics.jsonl"
    good = [json.dumps({"step": step, "psnr": step + 0.5, "loss": float("nan")}) for step in (1, 2)]
    path.write_bytes("\n".join([good[0], line, good[1], '{"step": 3, "ps']).encode("latin-1"))
    [chart] = training_charts(path)
    assert (chart["label"], chart["last"]) == ("psnr", "2.5")
    assert "nan" not in chart["svg"]


def test_where_there_is_nothing_to_see_it_says_what_to_do(workspace, tmp_path):
    with pytest.raises(WorkspaceError, match="no report yet, and nothing is running") as caught:
        watch(workspace.root, PIPELINE)
    assert f"hineus run --workspace {workspace.root}" in caught.value.hint
    with pytest.raises(WorkspaceError, match="There is no workspace"):
        watch(tmp_path / "none", PIPELINE)
    result = CliRunner().invoke(build_app(TOY), ["view", str(workspace.root), "--no-browser"])
    assert result.exit_code == 5
    assert "no report yet" in result.stderr


@pytest.mark.slow
@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 0), (signal.SIGTERM, 143)])
def test_the_command_prints_its_address_and_ends_with_ctrl_c(workspace, number, code):
    write_report(workspace)
    command = [sys.executable, "-m", "hineus_cli", "view", str(workspace.root), "--no-browser"]

    def heed_ctrl_c() -> None:  # what runs in the background of a shell inherits that it is ignored
        signal.signal(signal.SIGINT, signal.SIG_DFL)

    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, preexec_fn=heed_ctrl_c
    ) as process:
        try:
            assert process.stdout is not None
            assert get(process.stdout.readline().strip()) == "<p>the report</p>"
            process.send_signal(number)
            assert process.wait(timeout=20) == code
        finally:
            process.kill()


def test_a_port_that_is_taken_is_refused(workspace):
    write_report(workspace)
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        with (
            pytest.raises(ConfigError, match="cannot be used"),
            serving(watch(workspace.root, TOY), taken.getsockname()[1]),
        ):
            pass


def test_a_workspace_is_in_use_while_its_lock_is_held(workspace):
    assert not workspace.in_use()
    with workspace.lock():
        assert workspace.in_use()
        assert Workspace.open(workspace.root).in_use()
    assert not workspace.in_use()
    (workspace.root / ".lock").write_text(json.dumps({"pid": 2**22 + 1, "host": socket.gethostname()}))
    assert not workspace.in_use()  # it was killed


# ---------------------------------------------------------------- those who mean no good
def ask(url: str, request: bytes) -> bytes:
    """What a server answers to these bytes, until it closes the connection."""
    with connect(url) as connection:
        connection.sendall(request)
        return rest(connection)


def connect(url: str) -> socket.socket:
    return socket.create_connection(("127.0.0.1", int(url.rstrip("/").rpartition(":")[2])), timeout=10)


def rest(connection: socket.socket) -> bytes:
    answer = b""
    try:
        while piece := connection.recv(1 << 16):
            answer += piece
    except ConnectionResetError:  # it was closed before all was read
        pass
    return answer


def own_name(url: str) -> str:
    return url.removeprefix("http://").rstrip("/")


@pytest.fixture(scope="module")
def url(tmp_path_factory) -> Iterator[str]:
    """Of a server of a report and a preview, beside which there is what is no picture."""
    workspace = Workspace.open(tmp_path_factory.mktemp("served") / "ws", create=True)
    with workspace.lock():
        workspace.remember({"photos": None}, "cpu", {})
    write_report(workspace)
    previews = workspace.stage_folder("train") / "previews"
    previews.mkdir(parents=True)
    (previews / "0000001.png").write_bytes(b"a picture")
    (previews / "large.png").write_bytes(b"a" * LARGE)
    (previews / "folder.png").mkdir()
    with serving(watch(workspace.root, PIPELINE)) as url:
        (previews / "link.png").symlink_to(workspace.root / "workspace.json")
        os.mkfifo(previews / "pipe.png")
        yield url


@pytest.mark.parametrize("path", ["/", "/live", "/state.json", "/preview/0000001.png", "/none"])
@pytest.mark.parametrize(
    "headers",
    ["", "Host:", "Host: evil.example", "Host: evil.example:{port}", "Host: 127.0.0.1", "Host: 127.0.0.1:1",
     "Host: [::1]", "Host: {own}.evil.example", "Host: {own}@evil.example", "Host: evil.example\r\nHost: {own}",
     "Host: {own}\r\nHost: evil.example", "X-Forwarded-Host: {own}", "Host: \xff"],
)  # fmt: skip
def test_a_request_by_another_name_is_refused(url, path, headers):
    lines = headers.format(own=own_name(url), port=own_name(url).partition(":")[2])
    for version in ("1.0", "1.1"):
        answer = ask(url, f"GET {path} HTTP/{version}\r\n{lines}\r\n\r\n".encode("latin-1"))
        assert b" 403 " in answer.splitlines()[0]
        assert b"report</p>" not in answer


@pytest.mark.parametrize("name", ["127.0.0.1:{port}", "localhost:{port}", "LocalHost:{port}"])
def test_a_request_by_its_own_names_is_answered(url, name):
    name = name.format(port=own_name(url).partition(":")[2])
    head, _, body = ask(url, f"GET / HTTP/1.1\r\nHost: {name}\r\n\r\n".encode()).partition(b"\r\n\r\n")
    assert b" 200 " in head.splitlines()[0]
    assert body == b"<p>the report</p>"
    assert ask(url, f"HEAD / HTTP/1.1\r\nHost: {name}\r\n\r\n".encode()).startswith(head.partition(b"Date")[0])


@pytest.mark.parametrize("path", ["", "live", "state.json", "preview/0000001.png", "none"])
def test_what_is_served_is_for_its_own_page_alone(url, path):
    try:
        answer = urllib.request.urlopen(url + path, timeout=10)
    except urllib.error.HTTPError as error:
        answer = error
    with answer:
        assert answer.headers["X-Content-Type-Options"] == "nosniff"
        assert answer.headers["X-Frame-Options"] == "DENY"
        assert answer.headers["Referrer-Policy"] == "no-referrer"
        assert answer.headers["Cross-Origin-Resource-Policy"] == "same-origin"
        assert "Access-Control-Allow-Origin" not in answer.headers
        assert answer.status == 404 or "frame-ancestors 'none'" in answer.headers["Content-Security-Policy"]


def test_the_live_page_runs_its_own_script_alone(url):
    with urllib.request.urlopen(f"{url}live", timeout=10) as answer:
        policy = answer.headers["Content-Security-Policy"]
        assert "innerHTML" not in answer.read().decode()
    scripts = next(rule for rule in policy.split("; ") if rule.startswith("script-src"))
    assert scripts.startswith("script-src 'sha256-")
    assert "unsafe" not in scripts


TRAVERSALS = (
    "/preview/../workspace.json", "/preview/..%2f..%2fworkspace.json", "/preview/%2e%2e/%2e%2e/workspace.json",
    "//etc/passwd", "/../../../../etc/passwd", "/preview//etc/passwd", "/preview/..\\..\\workspace.json",
    "/report/report.html", "/workspace.json", "/preview/", "/preview/.", "/preview/0000001.png/", "/preview/\xff.png",
    "http://evil.example/", "*", "/live/", "/preview/link.png", "/preview/pipe.png", "/preview/folder.png",
)  # fmt: skip


@pytest.mark.parametrize("path", TRAVERSALS)
def test_no_other_file_is_served(url, path):
    answer = ask(url, f"GET {path} HTTP/1.1\r\nHost: {own_name(url)}\r\n\r\n".encode("latin-1"))
    assert answer.split()[1] in (b"404", b"500")
    assert b"sources" not in answer
    assert b"root:" not in answer


@pytest.mark.parametrize(
    "request_",
    [
        b"POST / HTTP/1.1", b"PUT /x HTTP/1.1", b"OPTIONS * HTTP/1.1", b"TRACE / HTTP/1.1", b"CONNECT a:1 HTTP/1.1",
        b"GET / HTTP/9.9", b"GET / FTP/1.1", b"GET", b"\x16\x03\x01\x02\x00", b"GET /" + b"a" * 70_000 + b" HTTP/1.1",
        b"GET / HTTP/1.1\r\nA: " + b"a" * 70_000, b"GET / HTTP/1.1" + b"\r\nA: a" * 200,
    ],
)  # fmt: skip
def test_what_is_no_request_to_read_is_refused(url, request_):
    answer = ask(url, request_ + f"\r\nHost: {own_name(url)}\r\n\r\n".encode())
    assert b"report</p>" not in answer
    assert get(url) == "<p>the report</p>"  # as before


def test_many_connections_and_half_requests_end_in_time(url, monkeypatch, capfd):
    monkeypatch.setattr(viewing, "ASKING_S", 0.5)
    monkeypatch.setattr(viewing, "STALLED_S", 60.0)  # what would end them else
    started, before = time.monotonic(), threading.active_count()
    open_ones = [connect(url) for _ in range(3 * viewing.MOST_CONNECTIONS)]
    for connection in open_ones[: viewing.MOST_CONNECTIONS]:
        connection.sendall(b"GET / HTTP/1.1\r\nHost")
    answers = [rest(connection) for connection in reversed(open_ones)]
    assert time.monotonic() - started < 30  # a busy machine needs some of it
    assert sum(b" 503 " in answer for answer in answers) >= viewing.MOST_CONNECTIONS
    assert not any(b" 200 " in answer for answer in answers)
    for connection in open_ones:
        connection.close()
    assert get(url) == "<p>the report</p>"
    assert threading.active_count() - before < viewing.MOST_CONNECTIONS
    assert capfd.readouterr().err == ""


def test_a_request_that_comes_drop_by_drop_is_not_waited_for(url, monkeypatch):
    monkeypatch.setattr(viewing, "ASKING_S", 0.5)
    with connect(url) as connection, contextlib.suppress(ConnectionError):
        started = time.monotonic()
        connection.settimeout(0.1)
        while time.monotonic() - started < 30:
            connection.sendall(b"G")
            with contextlib.suppress(TimeoutError):
                if not connection.recv(1):
                    break
    assert time.monotonic() - started < 9


def test_a_client_that_goes_away_leaves_no_trace(url, capfd):
    for _ in range(5):
        with connect(url) as connection:
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))  # a reset
            connection.sendall(f"GET /preview/large.png HTTP/1.1\r\nHost: {own_name(url)}\r\n\r\n".encode())
    assert len(get(f"{url}preview/large.png")) == LARGE
    assert capfd.readouterr().err == ""
