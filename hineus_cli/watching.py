"""What `hineus view` shows of a workspace: its report, or its run as it goes, by the files that the run writes."""

from __future__ import annotations

import base64
import hashlib
import json
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache
from importlib import resources
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

from stages import artifacts
from stages.artifacts.own_files import open_own
from stages.engine.stage import Stage
from stages.engine.workspace import Workspace

LIVE_PAGE = "live.html"
SHARED = ("watching.css", "watching.js")  # in place of comments that name them
# A report's splats are unpacked by WebAssembly and sorted in a worker, both of which lie in it.
REPORT_SCRIPTS, NO_SCRIPT = "'unsafe-inline' 'wasm-unsafe-eval' blob:", "'none'"
_HTML = "text/html; charset=utf-8"


class Answer(NamedTuple):
    """What is at an address: its type, its contents, and the scripts that may run in them."""

    kind: str
    contents: BinaryIO
    scripts: str = NO_SCRIPT


@dataclass(frozen=True)
class Watched:
    """A workspace that is looked at, and its pipeline.

    Attributes:
        parts: its blocks, by name, as far as they have been looked at.
    """

    workspace: Workspace
    pipeline: Sequence[Stage]
    parts: dict[str, Watched] = field(default_factory=dict)

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
            "stages": self.stage_states(),
            "charts": training_charts(artifacts.METRICS.load(self.training)),
            "previews": [path.name for path in self._pictures()],
        }

    def stage_states(self) -> list[dict[str, str]]:
        """Name, summary and state of each stage: "waiting", "running" or "done"."""
        return [
            {"name": stage.name, "summary": stage.summary, "state": self._stage_state(stage.name)}
            for stage in self.pipeline
        ]

    def answer(self, address: str) -> Answer | None:
        """What is at "", "live", "report", "state.json" or "preview/NAME"; None where there is no such thing.

        Raises:
            OSError: it cannot be read, or has just gone.
        """
        if address == "report" or (address == "" and self.shows_report()):
            return Answer(_HTML, open(self.report, "rb", opener=open_own), REPORT_SCRIPTS)
        if address in ("", "live"):
            return page_of_ours(LIVE_PAGE)
        if address == "state.json":
            return as_json(self.state())
        if picture := self.picture(address.removeprefix("preview/")):
            return Answer("image/png", open(picture, "rb", opener=open_own))
        return None

    def picture(self, name: str) -> Path | None:
        """The preview of that name, if there is one."""
        return next((path for path in self._pictures() if path.name == name), None)

    def _pictures(self) -> list[Path]:
        return sorted(artifacts.PREVIEWS.load(self.training).glob("*.png"))

    def _stage_state(self, name: str) -> str:
        if self.workspace.is_writing(name):
            return "running"
        return "done" if self.workspace.stage_folder(name).is_dir() else "waiting"


def as_json(state: dict[str, Any]) -> Answer:
    return Answer("application/json", BytesIO(json.dumps(state).encode()))


@cache
def _page(name: str) -> tuple[bytes, str]:
    """A page of ours with what all have in common, and its one script as a policy names it: no other one runs there."""
    templates = resources.files("stages") / "templates"
    page = (templates / name).read_bytes()
    for shared in SHARED:
        page = page.replace(b"/* %s */" % shared.encode(), (templates / shared).read_bytes().strip())
    [script] = re.findall(rb"<script>(.*?)</script>", page, re.DOTALL)
    return page, f"'sha256-{base64.b64encode(hashlib.sha256(script).digest()).decode()}'"


def page_of_ours(name: str) -> Answer:
    """A page of `stages/templates`."""
    page, script = _page(name)
    return Answer(_HTML, BytesIO(page), script)
