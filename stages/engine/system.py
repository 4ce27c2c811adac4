"""What must be installed beside Python packages, and how its absence is told."""

from __future__ import annotations

import ctypes
import re
import sys
from importlib import metadata

from stages.errors import SystemRequirementError

# Shared libraries that Open3D, PyMeshLab and pycolmap load at import -> the Debian/Ubuntu package of each.
SYSTEM_LIBRARIES = {
    "libGL.so.1": "libgl1",
    "libEGL.so.1": "libegl1",
    "libOpenGL.so.0": "libopengl0",
    "libX11.so.6": "libx11-6",
    "libusb-1.0.so.0": "libusb-1.0-0",
    "libidn2.so.0": "libidn2-0",
    "libatomic.so.1": "libatomic1",
}

_MISSING_LIBRARY = re.compile(r"(lib[\w+.-]+\.so[.\d]*): cannot open shared object file")


def installed_version(package: str) -> str | None:
    """The version of a Python package, by its name on PyPI; None where it is not installed."""
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


def missing_libraries() -> list[str]:
    """Names of those system libraries that cannot be loaded here: of Linux, as the wheels of others bring theirs."""
    if sys.platform != "linux":
        return []
    missing = []
    for name in SYSTEM_LIBRARIES:
        try:
            ctypes.CDLL(name)
        except OSError:
            missing.append(name)
    return missing


def apt_line(libraries: list[str]) -> str:
    """The command that installs them on Debian and Ubuntu."""
    return "apt-get install -y " + " ".join(SYSTEM_LIBRARIES.get(name, name) for name in libraries)


def requirement_error(error: BaseException, who: str) -> SystemRequirementError | None:
    """`error` in the user's terms, if it says that something is missing on this machine; None otherwise.

    `who` met it: "Stage sfm".
    """
    found = _MISSING_LIBRARY.search(str(error)) if isinstance(error, (ImportError, OSError)) else None
    if found:
        library = found[1]
        absent = sorted({*missing_libraries(), library}, key=[*SYSTEM_LIBRARIES, library].index)
        return SystemRequirementError(
            f"{who} needs the system library {library}, which is not installed.",
            f"Run `{apt_line(absent)}`, then `hineus doctor`.",
        )
    if isinstance(error, ModuleNotFoundError) and error.name:
        package = error.name.partition(".")[0]
        return SystemRequirementError(
            f"{who} needs the Python package {package}, which is not installed.",
            "Run `pip install hineus` again in this environment, then `hineus doctor`.",
        )
    return None
