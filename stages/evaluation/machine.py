"""What a figure was measured on."""

from __future__ import annotations

import platform
from importlib.metadata import version
from pathlib import Path

from stages.limits import available_cores

LIBRARIES = ("hineus", "torch", "pycolmap", "open3d")


def machine() -> dict[str, str]:
    """CPU, cores that this process may use, and versions."""
    cpu = platform.processor()
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        cpu = next(line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        pass
    return {
        "cpu": cpu,
        "cores": str(available_cores()),
        "python": platform.python_version(),
        **{name: version(name) for name in LIBRARIES},
    }
