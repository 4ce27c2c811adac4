"""`hineus view`: the report of a workspace on a local web server, or a training run as it goes.

It only reads. Served are the report, the live page, its state and the preview pictures, to this machine alone, and to
no page of another site that an open browser may show: see `_Handler` and `_Server`.
"""

from __future__ import annotations

import base64
import hashlib
import json
import logging
import re
import socket
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cache
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib import resources
from io import SEEK_END, BytesIO
from pathlib import Path
from shutil import copyfileobj
from typing import Any, BinaryIO

from stages import artifacts
from stages.artifacts.own_files import open_own
from stages.engine.stage import Stage
from stages.engine.workspace import Workspace
from stages.errors import ConfigError, HineusError, WorkspaceError

log = logging.getLogger(__name__)

HOST = "127.0.0.1"
LIVE_PAGE = "live.html"

MOST_CONNECTIONS = 32  # a browser opens six
ASKING_S, ANSWERING_S = 10.0, 300.0  # a report of 100 MB through a slow tunnel takes a while
STALLED_S = 10.0

# What a page may do here: the report's own scripts and pictures lie in it. Nothing is loaded from elsewhere, nor sent.
POLICY = (
    "default-src 'none'; script-src {scripts}; style-src 'unsafe-inline'; img-src 'self' data: blob:; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
# A report's splats are unpacked by WebAssembly and sorted in a worker, both of which lie in it, too.
REPORT_SCRIPTS, NO_SCRIPT = "'unsafe-inline' 'wasm-unsafe-eval' blob:", "'none'"
HEADERS = {
    "Cache-Control": "no-store",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
}


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
        """The folder of curves and previews: of the training under way, else of the finished one.

        What a killed run has left is not looked at: the next one may go on from it, or throw it away.
        """
        scratch = self.workspace.scratch_folder("train")
        under_way = self.workspace.is_writing("train") and artifacts.METRICS.load(scratch).is_file()
        return scratch if under_way else self.workspace.stage_folder("train")

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
        if self.workspace.is_writing(name):
            return "running"
        return "done" if self.workspace.stage_folder(name).is_dir() else "waiting"


def watch(folder: Path, pipeline: Sequence[Stage]) -> Watched:
    """The workspace in `folder`, if there is something to see.

    Raises:
        WorkspaceError: there is no workspace, it has no report, no run and no training, or there are links in it.
    """
    watched = Watched(Workspace.open(folder), pipeline)
    for stage in pipeline:
        watched.workspace.stage_folder(stage.name)
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
        server = _Server(watched, port)
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


class _Server(ThreadingHTTPServer):
    """A server of so many connections at a time, each of which has to end in time.

    Attributes:
        names: what a request may call this server. Any other name is of a site that has itself led to this machine (DNS
            rebinding), to read what is served here.
    """

    request_queue_size = 4 * MOST_CONNECTIONS  # waiting to be told that there are too many

    def __init__(self, watched: Watched, port: int) -> None:
        self.watched = watched
        self._ends: dict[socket.socket, float] = {}  # of each connection, by the clock of `time.monotonic`
        super().__init__((HOST, port), _Handler)
        hosts = (HOST, "localhost")
        self.names = {f"{host}:{self.server_port}" for host in hosts} | (
            set(hosts) if self.server_port == 80 else set()
        )

    def process_request(self, request: Any, client_address: Any) -> None:
        request.settimeout(STALLED_S)
        if len(self._ends) >= MOST_CONNECTIONS:
            with suppress(OSError):
                request.sendall(b"HTTP/1.0 503 Service Unavailable\r\nConnection: close\r\n\r\n")
            self.shutdown_request(request)
            return
        self.give_time(request, ASKING_S)
        super().process_request(request, client_address)

    def give_time(self, connection: socket.socket, seconds: float) -> None:
        """From now until the connection is ended."""
        self._ends[connection] = time.monotonic() + seconds

    def shutdown_request(self, request: Any) -> None:
        self._ends.pop(request, None)
        super().shutdown_request(request)

    def service_actions(self) -> None:  # called twice a second
        now = time.monotonic()
        for connection, end in list(self._ends.items()):
            if end < now:
                with suppress(OSError):  # it has just ended
                    connection.shutdown(socket.SHUT_RDWR)

    def handle_error(self, request: Any, client_address: Any) -> None:
        log.debug("a request to view failed", exc_info=True)


class _Handler(BaseHTTPRequestHandler):
    """Four kinds of address: `/`, `/live`, `/state.json`, `/preview/NAME`; to be read, by this server's own name."""

    server: _Server

    def do_GET(self) -> None:
        self.server.give_time(self.connection, ANSWERING_S)
        if not self._is_meant():
            self.send_error(HTTPStatus.FORBIDDEN, explain=f"Open it as {' or '.join(sorted(self.server.names))}.")
            return
        try:
            answer = self._answer(self.path.partition("?")[0])
        except (FileNotFoundError, NotADirectoryError):  # a stage was published, and its scratch folder removed
            answer = None
        except (HineusError, OSError) as error:
            self.send_error(HTTPStatus.INTERNAL_SERVER_ERROR, explain=str(error))
            return
        if answer is None:
            self.send_error(HTTPStatus.NOT_FOUND)
        else:
            self._send(*answer)

    def do_HEAD(self) -> None:
        self.do_GET()

    def _is_meant(self) -> bool:
        names = self.headers.get_all("Host", [])
        return len(names) == 1 and names[0].strip().lower() in self.server.names

    def _answer(self, path: str) -> tuple[str, BinaryIO, str] | None:
        """Type, contents, and the scripts that may run in them; None where there is no such thing."""
        watched, page = self.server.watched, "text/html; charset=utf-8"
        if path == "/" and watched.shows_report():
            return page, open(watched.report, "rb", opener=open_own), REPORT_SCRIPTS
        if path in ("/", "/live"):
            return page, BytesIO(_live_page()), _hash_of_script(_live_page())
        if path == "/state.json":
            return "application/json", BytesIO(json.dumps(watched.state()).encode()), NO_SCRIPT
        if picture := watched.picture(path.removeprefix("/preview/")):
            return "image/png", open(picture, "rb", opener=open_own), NO_SCRIPT
        return None

    def _send(self, kind: str, contents: BinaryIO, scripts: str) -> None:
        with contents:
            self.send_response(HTTPStatus.OK)
            self.send_header("Content-Type", kind)
            self.send_header("Content-Length", str(contents.seek(0, SEEK_END)))
            self.send_header("Content-Security-Policy", POLICY.format(scripts=scripts))
            self.end_headers()
            contents.seek(0)
            if self.command != "HEAD":
                copyfileobj(contents, self.wfile)  # by small pieces, each within `STALLED_S`

    def end_headers(self) -> None:
        for name, value in HEADERS.items():
            self.send_header(name, value)
        super().end_headers()

    def version_string(self) -> str:
        return "hineus"

    def log_message(self, format: str, *arguments: Any) -> None:
        """Requests are nobody's concern."""


@cache
def _live_page() -> bytes:
    return (resources.files("stages") / "templates" / LIVE_PAGE).read_bytes()


def _hash_of_script(page: bytes) -> str:
    """The one script of a page, as a policy names it: no other one runs there."""
    [script] = re.findall(rb"<script>(.*?)</script>", page, re.DOTALL)
    return f"'sha256-{base64.b64encode(hashlib.sha256(script).digest()).decode()}'"
