"""The table of wheels in docs/install.md, asked of PyPI: `python -m docs.make_wheels`. Not part of `make docs`, which
needs no network.

A cell says for which versions of CPython some release that `pyproject.toml` admits has a wheel.
"""

from __future__ import annotations

import json
import re
import urllib.request
from pathlib import Path

import tomllib
from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet
from packaging.utils import InvalidWheelFilename, parse_wheel_filename
from packaging.version import Version

REPOSITORY = Path(__file__).parents[1]
PAGE, BEGIN, END = REPOSITORY / "docs" / "install.md", "<!-- table wheels -->", "<!-- end wheels -->"
INDEX = "https://pypi.org/simple/{}/"
MINORS = range(10, 15)
PLATFORMS = {
    "Linux x86-64": r"manylinux.*_x86_64",
    "Linux ARM": r"manylinux.*_aarch64",
    "macOS, Apple": r"macosx_.*_(arm64|universal2)",
    "macOS, Intel": r"macosx_.*_(x86_64|universal2)",
    "Windows": r"win_amd64",
}


def main() -> None:
    project = tomllib.loads((REPOSITORY / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = [each for name, some in project["optional-dependencies"].items() if name != "dev" for each in some]
    lines = [f"| package | {' | '.join(PLATFORMS)} |", "| --- " * (len(PLATFORMS) + 1) + "|"]
    everywhere = []
    for text in (*project["dependencies"], *extras):
        wanted = Requirement(text)
        cells = availability(wanted)
        if all(len(minors) == len(MINORS) for minors in cells.values()):
            everywhere.append(wanted.name)
        else:
            lines.append(f"| {wanted.name} | {' | '.join(shown(minors) for minors in cells.values())} |")
    lines += ["", f"Everywhere: {', '.join(sorted(everywhere))}."]
    page = PAGE.read_text(encoding="utf-8")
    start, end = page.index(BEGIN) + len(BEGIN), page.index(END)
    PAGE.write_text(f"{page[:start]}\n" + "\n".join(lines) + f"\n{page[end:]}", encoding="utf-8")


def availability(wanted: Requirement) -> dict[str, list[int]]:
    """For each platform the minor versions of Python 3 for which there is a wheel."""
    found: dict[str, set[int]] = {platform: set() for platform in PLATFORMS}
    for file in files_of(wanted.name):
        try:
            _, version, _, tags = parse_wheel_filename(file["filename"])
        except InvalidWheelFilename:
            continue
        if file.get("yanked") or version not in wanted.specifier:
            continue
        pythons = SpecifierSet(file.get("requires-python") or "")
        for minor in MINORS:
            admitted = Version(f"3.{minor}.9") in pythons and (wanted.marker is None or holds(wanted, minor))
            for platform, pattern in PLATFORMS.items():
                if admitted and any(
                    runs(tag.interpreter, tag.abi, minor) and re.fullmatch(f"{pattern}|any", tag.platform)
                    for tag in tags
                ):
                    found[platform].add(minor)
    return {platform: sorted(minors) for platform, minors in found.items()}


def files_of(name: str) -> list[dict[str, str]]:
    asked = urllib.request.Request(INDEX.format(name), headers={"Accept": "application/vnd.pypi.simple.v1+json"})
    with urllib.request.urlopen(asked, timeout=60) as answer:
        return list(json.load(answer)["files"])


def holds(wanted: Requirement, minor: int) -> bool:
    """Whether the requirement is one for this version of Python; what it says of systems, the wheels say, too."""
    assert wanted.marker is not None
    linux = {"sys_platform": "linux", "platform_machine": "x86_64"}
    return wanted.marker.evaluate({"python_version": f"3.{minor}", **linux})


def runs(interpreter: str, abi: str, minor: int) -> bool:
    """Whether CPython 3.`minor` takes a wheel of these tags."""
    if abi == "none" and interpreter.startswith("py3"):
        return True
    found = re.fullmatch(r"cp3(\d+)", interpreter)
    return found is not None and (
        int(found[1]) <= minor if abi == "abi3" else int(found[1]) == minor and abi in (interpreter, "none")
    )


def shown(minors: list[int]) -> str:
    """[10, 11, 12] as "3.10 - 3.12"."""
    if not minors:
        return "none"
    assert minors == list(range(minors[0], minors[-1] + 1)), minors
    return f"3.{minors[0]} - 3.{minors[-1]}" if len(minors) > 1 else f"3.{minors[0]}"


if __name__ == "__main__":
    main()
