"""`hineus view`: the report of a workspace on a local web server, or a training run as it goes.

It only reads. Served are the report, the live page, its state and the preview pictures, to this machine alone.
"""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib import resources
from pathlib import Path
from typing import Any

from stages import artifacts
from stages.engine.stage import Stage
from stages.engine.workspace import Workspace
from stages.errors import ConfigError, WorkspaceError

HOST = "127.0.0.1"
LIVE_PAGE = "live.html"


@dataclass(frozen=True)
class Watched:
    """A workspace that is looked at, and its pipeline."""

    workspace: Workspace
    pipeline: Sequence[Stage]

    @property
    def report(self) -> Path:
        return artifacts.PAGE.load(self.workspace.stage_folder("report"))

    @property
    def training(self) -> Path:
        """The folder of curves and previews: of the training under way or broken off, else of the finished one."""
        scratch = self.workspace.scratch_folder("train")
        return scratch if artifacts.METRICS.load(scratch).is_file() else self.workspace.stage_folder("train")

    def shows_report(self) -> bool:
        """Whether the report is there and no run is making another one."""
        return self.report.is_file() and not self.workspace.in_use()

    def state(self) -> dict[str, Any]:
        """What the live page asks for every other second, and the report once."""
        from stages.reporting.curves import training_charts

        return {
            "workspace": str(self.workspace.root),
            "report": self.shows_report(),
            "running": self.workspace.in_use(),
            "stages": [
                {"name": stage.name, "summary": stage.summary, "state": self._stage_state(stage.name)}
                for stage in self.pipeline
            ],
            "charts": training_charts(artifacts.METRICS.load(self.training)),
            "previews": [path.name for path in self._pictures()],
        }

    def picture(self, name: str) -> Path | None:
        """The preview of that name, if there is one."""
        return next((path for path in self._pictures() if path.name == name), None)

    def _pictures(self) -> list[Path]:
        return sorted(artifacts.PREVIEWS.load(self.training).glob("*.png"))

    def _stage_state(self, name: str) -> str:
        if self.workspace.in_use() and self.workspace.is_writing(name):
            return "running"
        return "done" if self.workspace.stage_folder(name).is_dir() else "waiting"


def watch(folder: Path, pipeline: Sequence[Stage]) -> Watched:
    """The workspace in `folder`, if there is something to see.

    Raises:
        WorkspaceError: there is no workspace, or it has no report, no run and no training.
    """
    watched = Watched(Workspace.open(folder), pipeline)
    if not (
        watched.report.is_file() or watched.workspace.in_use() or artifacts.METRICS.load(watched.training).is_file()
    ):
        root = watched.workspace.root
        raise WorkspaceError(
            f"The workspace {root} has no report yet, and nothing is running in it.",
            f"Make it: `hineus run --workspace {root}`; then, or meanwhile, look again.",
        )
    return watched


@contextmanager
def serving(watched: Watched, port: int = 0) -> Iterator[str]:
    """The URL of a server that runs meanwhile; port 0: any free one.

    Raises:
        ConfigError: the port is taken or not allowed.
    """
    try:
        server = ThreadingHTTPServer((HOST, port), partial(_Handler, watched))
    except OSError as error:
        raise ConfigError(
            f"Port {port} cannot be used: {error.strerror}.", "Leave `--port` out, and a free one is taken."
        ) from error
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        yield f"http://{HOST}:{server.server_port}/"
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


class _Handler(BaseHTTPRequestHandler):
    """Four kinds of address: `/`, `/live`, `/state.json`, `/preview/NAME`."""

    def __init__(self, watched: Watched, *arguments: Any) -> None:
        self.watched = watched
        super().__init__(*arguments)

    def do_GET(self) -> None:
        path = self.path.partition("?")[0]
        try:
            if path == "/" and self.watched.shows_report():
                self._send("text/html; charset=utf-8", self.watched.report.read_bytes())
            elif path in ("/", "/live"):
                self._send("text/html; charset=utf-8", _live_page())
            elif path == "/state.json":
                self._send("application/json", json.dumps(self.watched.state()).encode())
            elif picture := self.watched.picture(path.removeprefix("/preview/")):
                self._send("image/png", picture.read_bytes())
            else:
                self.send_error(HTTPStatus.NOT_FOUND)
        except FileNotFoundError:  # a stage was published, and its scratch folder removed, this instant
            self.send_error(HTTPStatus.NOT_FOUND)
        except ConnectionError:  # the browser has gone
            return

    def _send(self, kind: str, body: bytes) -> None:
        self.send_response(HTTPStatus.OK)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(body)))
        self.send_header("Cache-Control", "no-store")
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, format: str, *arguments: Any) -> None:
        """Requests are nobody's concern."""


def _live_page() -> bytes:
    return (resources.files("stages") / "templates" / LIVE_PAGE).read_bytes()
