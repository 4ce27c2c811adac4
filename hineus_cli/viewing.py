"""`hineus view`: the report of a workspace on a local web server, or a run as it goes; or those of all blocks.

It only reads. Served are reports, live pages, their states and preview pictures, to this machine alone, and to no page
of another site that an open browser may show: see `_Handler` and `_Server`.
"""

from __future__ import annotations

import logging
import socket
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from io import SEEK_END
from pathlib import Path
from shutil import copyfileobj
from typing import Any, BinaryIO

from hineus_cli.watching import Answer, Watched
from hineus_cli.watching_blocks import watched_in_blocks
from stages import artifacts
from stages.engine.stage import Stage
from stages.engine.workspace import Workspace
from stages.errors import ConfigError, HineusError, WorkspaceError

log = logging.getLogger(__name__)

HOST = "127.0.0.1"

MOST_CONNECTIONS = 32  # a browser opens six
ASKING_S, ANSWERING_S = 10.0, 300.0  # a report of 100 MB through a slow tunnel takes a while
STALLED_S = 10.0

# What a page may do here: the report's own scripts and pictures lie in it. Nothing is loaded from elsewhere, nor sent.
POLICY = (
    "default-src 'none'; script-src {scripts}; style-src 'unsafe-inline'; img-src 'self' data: blob:; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
HEADERS = {
    "Cache-Control": "no-store",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
}


def watch(folder: Path, pipeline: Sequence[Stage]) -> Watched:
    """The workspace in `folder`, if there is something to see.

    Raises:
        WorkspaceError: there is no workspace, it has no report, no run and no training, or there are links in it.
    """
    watched = Watched(Workspace.open(folder), pipeline)
    for stage in pipeline:
        watched.workspace.stage_folder(stage.name)
    if not (
        watched_in_blocks(watched)
        or watched.report.is_file()
        or watched.workspace.in_use()
        or artifacts.METRICS.load(watched.training).is_file()
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
    """Addresses of `Watched.answer` and `WatchedInBlocks.answer`; to be read, by this server's own name."""

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

    def _answer(self, path: str) -> Answer | None:
        """What is at a path; of a workspace in blocks, which it may become meanwhile, what is there of them."""
        if not path.startswith("/"):
            return None
        watched = self.server.watched
        return (watched_in_blocks(watched) or watched).answer(path.removeprefix("/"))

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
