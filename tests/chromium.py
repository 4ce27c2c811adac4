"""A page in headless Chromium in real time, through its debugging pipe.

For what workers do, for whom the virtual time of `--virtual-time-budget` does not wait.
"""

from __future__ import annotations

import base64
import fcntl
import json
import os
import select
import shutil
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

BROWSER = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
WEBGL = ("--enable-unsafe-swiftshader", "--use-gl=angle", "--use-angle=swiftshader")
HEADLESS = ("--headless=new", "--no-sandbox", "--disable-dev-shm-usage", "--hide-scrollbars")
TIMEOUT_S = 120.0


class Page:
    """One tab. Messages are JSON that ends with a zero byte (Chrome DevTools Protocol)."""

    def __init__(self, requests: int, answers: int, errors: list[str]):
        self._requests, self._answers, self._read, self._count = requests, answers, b"", 0
        self.errors = errors
        target = self._ask("Target.createTarget", url="about:blank")["targetId"]
        self._session = self._ask("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Runtime", "Log", "Page"):
            self._ask(f"{domain}.enable")

    def go(self, url: str, width: int = 900, height: int = 900) -> None:
        size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
        self._ask("Emulation.setDeviceMetricsOverride", **size)
        self._ask("Page.navigate", url=url)

    def value(self, expression: str) -> Any:
        """Of JavaScript in the page; promises are awaited."""
        answer = self._ask("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        return answer["result"].get("value")

    def wait_for(self, condition: str) -> None:
        end = time.monotonic() + TIMEOUT_S
        while not self.value(condition):
            assert not self.errors, self.errors
            assert time.monotonic() < end, f"{condition} does not come true"
            time.sleep(0.1)

    def screenshot(self) -> np.ndarray:
        """[H, W, 3] RGB of what the window shows."""
        import cv2

        data = base64.b64decode(self._ask("Page.captureScreenshot", format="png")["data"])
        return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)[..., ::-1].astype(int)

    def _ask(self, method: str, **params: Any) -> dict[str, Any]:
        self._count += 1
        session = {"sessionId": self._session} if hasattr(self, "_session") else {}
        message = {"id": self._count, "method": method, "params": params, **session}
        os.write(self._requests, json.dumps(message).encode() + b"\0")
        while (answer := self._next()).get("id") != self._count:
            told = json.dumps(answer.get("params"))
            if answer.get("method") in ("Runtime.exceptionThrown", "Log.entryAdded") and "favicon.ico" not in told:
                self.errors.append(told)
        assert "result" in answer, answer
        return answer["result"]

    def _next(self) -> dict[str, Any]:
        while b"\0" not in self._read:
            assert select.select([self._answers], [], [], TIMEOUT_S)[0], "Chromium does not answer"
            more = os.read(self._answers, 1 << 20)
            assert more, "Chromium has ended"
            self._read += more
        message, self._read = self._read.split(b"\0", 1)
        return json.loads(message)


@contextmanager
def opened(folder: Path) -> Iterator[Page]:
    """A tab of a browser whose profile lies in `folder`; at its end there must have been no errors."""
    (requests_out, requests), (answers, answers_in) = os.pipe(), os.pipe()
    options = [*HEADLESS, *WEBGL, f"--user-data-dir={folder / 'profile'}", "--remote-debugging-pipe", "about:blank"]

    def place() -> None:
        """Chromium reads from file 3 and writes to file 4: of copies, as one of ours may have that number."""
        copies = [fcntl.fcntl(file, fcntl.F_DUPFD, 10) for file in (requests_out, answers_in)]
        for copy, number in zip(copies, (3, 4), strict=True):
            os.dup2(copy, number)

    process = subprocess.Popen(
        [str(BROWSER), *options], preexec_fn=place, pass_fds=(3, 4, requests_out, answers_in), stderr=subprocess.DEVNULL
    )
    os.close(requests_out)
    os.close(answers_in)
    errors: list[str] = []
    try:
        yield Page(requests, answers, errors)
        assert not errors, errors
    finally:
        os.close(requests)  # at the end of its input it stops
        os.close(answers)
        process.terminate()
        process.wait(TIMEOUT_S)
