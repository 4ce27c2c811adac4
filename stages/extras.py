"""Files that come with packages of extras, of which nothing else is used."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path


def package_file(package: str, name: str) -> Path | None:
    """A file in a top-level package, or None where it is not there. Runs no code of the package."""
    spec = find_spec(package)
    for folder in (spec and spec.submodule_search_locations) or ():
        if (path := Path(folder) / name).is_file():
            return path
    return None
