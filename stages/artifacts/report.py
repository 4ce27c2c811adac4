"""What report publishes: one page."""

from __future__ import annotations

from pathlib import Path

from stages.artifacts.artifact import place_artifact

REPORT_FILE = "report.html"


def report_path(folder: Path) -> Path:
    return folder / REPORT_FILE


PAGE = place_artifact("report", REPORT_FILE)
