"""`hineus view`: what is served, and when the live page gives way to the report."""

from __future__ import annotations

import json
import signal
import socket
import subprocess
import sys
import urllib.error
import urllib.request
from dataclasses import replace
from pathlib import Path

import pytest
from toy_pipeline import TOY
from typer.testing import CliRunner

from hineus_cli.app import build_app
from hineus_cli.viewing import serving, watch
from stages import artifacts
from stages.engine.workspace import Workspace
from stages.errors import ConfigError, WorkspaceError

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


def test_a_training_that_was_broken_off_can_be_looked_at(workspace):
    train_a_little(workspace)
    with serving(watch(workspace.root, PIPELINE)) as url:
        state = json.loads(get(f"{url}state.json"))
        assert state["running"] is False
        assert state["stages"][-1]["state"] == "waiting"
        assert len(state["charts"]) == 2


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
