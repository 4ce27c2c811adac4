"""How heavy the report of a workspace is and how fast it opens in headless Chromium, as JSON.

python -m benchmarks.report_page WORKSPACE [WORKSPACE ...] [--runs 5]

The page is served by this process and opened in a fresh profile each time, WebGL drawn by the CPU (SwiftShader). It
tells us itself when it is ready: milliseconds from the start of the navigation until the 3D view has drawn the model
with its texture. The CPU time is that of the whole browser by then, its own start included: where other work shares the
machine it says more than the clock.
"""

from __future__ import annotations

import argparse
import json
import queue
import shutil
import statistics
import subprocess
import sys
import tempfile
import threading
from functools import partial
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import psutil

from stages import artifacts

# Appended to the page: waits for the view, then tells the time.
REPORTER = b"""
<script>
(function wait() {
  const state = document.documentElement.dataset.viewer;
  if (state) fetch("/ready?" + new URLSearchParams({ state, ms: performance.now() }));
  else setTimeout(wait, 5);
})();
</script>
"""
PATIENCE = 120.0  # seconds


class Page(BaseHTTPRequestHandler):
    """Serves the page, and hears when it is ready."""

    def __init__(self, html: bytes, heard: queue.Queue[str], *arguments: object) -> None:
        self.html, self.heard = html, heard
        super().__init__(*arguments)  # type: ignore[arg-type]

    def do_GET(self) -> None:
        body = self.html if self.path == "/" else b""
        if self.path.startswith("/ready?"):
            self.heard.put(self.path)
        self.send_response(200)
        self.send_header("Content-Type", "text/html; charset=utf-8")
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, format: str, *arguments: object) -> None:
        """Nothing is logged."""


def open_once(browser: str, html: bytes) -> tuple[float, float]:
    """Milliseconds until the view of the page was ready, and of CPU time that the browser took."""
    heard: queue.Queue[str] = queue.Queue()
    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(Page, html, heard))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        process = subprocess.Popen(
            [
                browser, "--headless=new", "--no-sandbox", "--disable-dev-shm-usage", "--enable-unsafe-swiftshader",
                "--use-gl=angle", "--use-angle=swiftshader", "--window-size=1400,1000", f"--user-data-dir={profile}",
                "--remote-debugging-port=0", f"http://127.0.0.1:{server.server_port}/",
            ],
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        try:
            told = dict(pair.split("=") for pair in heard.get(timeout=PATIENCE).partition("?")[2].split("&"))
            parent = psutil.Process(process.pid)
            times = [each.cpu_times() for each in (parent, *parent.children(recursive=True))]
        finally:
            process.terminate()
            process.wait()
            server.shutdown()
            server.server_close()
    if told["state"] != "ready":
        raise RuntimeError(f"the page's view is '{told['state']}', expected 'ready'")
    return float(told["ms"]), 1000 * sum(each.user + each.system for each in times)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("workspaces", type=Path, nargs="+")
    parser.add_argument("--runs", type=int, default=5)
    arguments = parser.parse_args()
    browser = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if browser is None:
        print("Chromium is needed: `apt-get install chromium`.", file=sys.stderr)
        return 6
    for workspace in arguments.workspaces:
        html = artifacts.PAGE.load(workspace / "report").read_bytes()
        waits, works = zip(*(open_once(browser, html + REPORTER) for _ in range(arguments.runs)), strict=True)
        found = {
            "workspace": workspace.name,
            "faces": len(artifacts.ATLAS_MESH.load(workspace / "atlas").faces),
            "photos": len(artifacts.CAMERAS.load(workspace / "train")),
            "bytes": len(html),
            "ready_ms": round(statistics.median(waits)),
            "slowest_ms": round(max(waits)),
            "cpu_ms": round(statistics.median(works)),
        }
        print(json.dumps(found), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
