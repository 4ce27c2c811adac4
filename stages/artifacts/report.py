"""What report publishes: one page."""

from __future__ import annotations

from stages.artifacts.artifact import place_artifact

PAGE = place_artifact("report", "report.html")
