"""The documentation is held against the code."""

from __future__ import annotations

import importlib
import importlib.util
import inspect
import re
import sys
from pathlib import Path

import pytest

from configs.load import describe_settings, load_config, preset_names
from configs.params import Config

ROOT = Path(__file__).parent.parent
DOCS = ROOT / "docs"
# Public functions beside the equations that are none.
NO_EQUATIONS = {"uniform_points", "has_feature_mlp"}
PAGES = sorted([*ROOT.glob("*.md"), *DOCS.rglob("*.md")])
GUIDES = [ROOT / "README.md", *(DOCS / name for name in ("tutorial.md", "install.md", "howto.md", "what-to-expect.md"))]
MEASURED = [*sorted((DOCS / "benchmarks").glob("*.md")), DOCS / "what-to-expect.md"]


def _make_reference():
    spec = importlib.util.spec_from_file_location("make_reference", DOCS / "make_reference.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


# ---------------------------------------------------------------- reference
def test_reference_is_up_to_date():
    written = (DOCS / "reference.md").read_text(encoding="utf-8")
    assert written == _make_reference().page(), "run `make docs`"


def test_every_setting_is_in_the_reference_with_a_description():
    written = (DOCS / "reference.md").read_text(encoding="utf-8")
    settings = describe_settings()
    assert len(settings) > 40
    for setting in settings:
        assert f"| `{setting.key}` |" in written
        assert setting.description, f"{setting.key} has no description"


def test_every_command_and_option_says_what_it_does():
    written = (DOCS / "reference.md").read_text(encoding="utf-8")
    commands = _make_reference().all_commands()
    assert {"run", "status", "doctor", "demo", "ingest", "train", "report"} <= set(commands)
    for name, command in commands.items():
        assert f"### hineus {name}\n" in written
        assert command.help, f"hineus {name} has no help"
        for parameter in command.params:
            assert parameter.help, f"hineus {name} {parameter.name} has no help"


@pytest.mark.parametrize("name", preset_names())
def test_every_preset_is_valid_and_has_no_empty_section(name):
    config = load_config(name)
    assert f"### {name}\n" in (DOCS / "reference.md").read_text(encoding="utf-8")
    import yaml

    from configs.load import preset_text

    stated = yaml.safe_load(preset_text(name)) or {}
    assert isinstance(config, Config)
    for section, values in stated.items():
        assert values, f"section {section} of preset {name} is empty"


# ---------------------------------------------------------------- math
def _math_rows():
    rows = []
    for line in (DOCS / "math.md").read_text(encoding="utf-8").splitlines():
        cells = [cell.strip() for cell in line.strip().strip("|").split("|")]
        if line.startswith("|") and cells[0] not in ("equation", "---"):
            rows.append(cells)
    return rows


@pytest.mark.parametrize("row", _math_rows(), ids=lambda row: row[0])
def test_every_row_of_the_math_page_names_a_real_function(row):
    found = re.fullmatch(r"`([\w.]+)`", row[1])
    assert found, f"one function in backticks is expected: {row[1]}"
    module, function = found[1].rsplit(".", 1)
    assert callable(getattr(importlib.import_module(module), function))


@pytest.mark.parametrize("where", ["losses", "terms.ambiguity", "terms.reflection", "terms.planar", "terms.eikonal"])
def test_every_equation_has_a_row_on_the_math_page(where):
    module = importlib.import_module(f"stages.neural.{where}")
    named = {row[1].strip("`") for row in _math_rows()}
    public = [
        name
        for name, value in vars(module).items()
        if inspect.isfunction(value) and not name.startswith("_") and value.__module__ == module.__name__
    ]
    assert public
    for name in set(public) - NO_EQUATIONS:
        assert f"{module.__name__}.{name}" in named


# ---------------------------------------------------------------- benchmarks
@pytest.mark.parametrize("page", MEASURED, ids=lambda page: page.stem)
def test_every_table_of_measurements_has_its_command_above(page):
    """Between a heading and its table stands the command that makes it."""
    for section in re.split(r"^##? ", page.read_text(encoding="utf-8"), flags=re.M)[1:]:
        if found := re.search(r"<!-- table|^\|.*\|\n\| --- \|.*---:", section, flags=re.M):
            above = section[: found.start()]
            assert re.search(r"```\n(.*\n)*?(python -m benchmarks|hineus|make) ?.*\n(.*\n)*?```", above), section[:80]


# ---------------------------------------------------------------- all pages
@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_between_pages_lead_somewhere(page):
    for target, heading in re.findall(r"\]\(([^)#\s]*)(?:#([^)\s]+))?\)", page.read_text(encoding="utf-8")):
        if not target.startswith(("http:", "https:")):
            file = page.parent / target if target else page
            assert file.exists(), f"{page.name} links to {target}"
            assert not heading or heading in _anchors(file), f"{page.name} links to {target}#{heading}"


def _anchors(page):
    """The names that GitHub gives to a page's headings."""
    headings = re.findall(r"^#+ (.+)$", page.read_text(encoding="utf-8"), flags=re.M)
    return {re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_files_and_folders_named_on_the_pages_exist(page):
    named = r"`((?:stages|hineus_cli|configs|benchmarks|docs|tests)/[a-z0-9_/.-]*)`"
    for name in re.findall(named, page.read_text(encoding="utf-8")):
        assert (ROOT / name).exists(), f"{page.name} names {name}"


def _shell_lines(page):
    for block in re.findall(r"```\n(.*?)```", page.read_text(encoding="utf-8"), flags=re.S):
        yield from block.splitlines()
    yield from re.findall(r"`(hineus [^`]+)`", page.read_text(encoding="utf-8"))


@pytest.mark.parametrize("page", [p for p in PAGES if p.name != "reference.md"], ids=lambda p: str(p.relative_to(ROOT)))
def test_commands_on_the_pages_exist(page):
    """Every `hineus ...` names a command and options it has; every --set names a setting and takes its value."""
    commands = _make_reference().all_commands()
    for line in _shell_lines(page):
        words = line.split("#")[0].split("|")[0].split()
        if len(words) < 2 or words[0] != "hineus" or not words[1].isalpha():
            continue
        name = " ".join(words[1:3])
        name = name if name in commands else words[1]
        assert name in commands, line
        options = {option for parameter in commands[name].params for option in parameter.opts}
        for word in words[2:]:
            if word.startswith("-"):
                assert word in options, line


@pytest.mark.parametrize("page", [p for p in PAGES if p.name != "reference.md"], ids=lambda p: str(p.relative_to(ROOT)))
def test_settings_on_the_pages_are_valid(page):
    for setting in re.findall(r"--set ([a-z_]+\.[a-z_]+=[^\s`)]+)", page.read_text(encoding="utf-8")):
        load_config(sets=[setting])


@pytest.mark.parametrize("page", GUIDES, ids=lambda p: p.name)
def test_presets_and_settings_named_on_the_pages_exist(page):
    text = page.read_text(encoding="utf-8")
    keys = {setting.key for setting in describe_settings()}
    sections = set(Config.model_fields)
    for name in re.findall(r"--preset ([a-z]+)", text):
        assert name in preset_names()
    for key in re.findall(r"`([a-z]+\.[a-z_]+)`", text):
        if key.split(".")[0] in sections:
            assert key in keys


def test_the_make_targets_on_the_pages_exist():
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), flags=re.M))
    for page in PAGES:
        for line in _shell_lines(page):
            if found := re.match(r"make ([a-z-]+)", line):
                assert found[1] in targets, f"{page.name}: {line}"


@pytest.mark.parametrize("page", [p for p in PAGES if p.parent.name != "adr"], ids=lambda p: str(p.relative_to(ROOT)))
def test_the_measuring_commands_on_the_pages_exist(page):
    """Every `python -m benchmarks.NAME --option` names a module, and an option that stands in it."""
    text = page.read_text(encoding="utf-8")
    for command in [*_shell_lines(page), *re.findall(r"`(python -m [^`]+)`", text)]:
        for name, rest in re.findall(r"python -m ((?:benchmarks|docs)\.[a-z_]+)([^&|#]*)", command):
            spec = importlib.util.find_spec(name)
            assert spec is not None, command
            sources = [Path(spec.origin)]
            sources = [*sources[0].parent.glob("*.py")] if sources[0].name == "__init__.py" else sources
            code = "".join(source.read_text(encoding="utf-8") for source in sources)
            for option in re.findall(r" (--[a-z-]+)", rest):
                assert f'"{option}"' in code, command


def test_the_reference_generator_is_importable_without_side_effects():
    before = set(sys.modules)
    _make_reference()
    assert not {"torch", "open3d"} & (set(sys.modules) - before)
