"""Write docs/reference.md from the code: every command, every setting, every preset, every exit code.

python docs/make_reference.py
"""

from __future__ import annotations

import inspect
from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import typer.main

from configs.load import Setting, describe_settings, preset_names, preset_summary, preset_text, show_value
from configs.params import Config
from hineus_cli.app import app
from stages import errors
from stages.errors import HineusError

PAGE = Path(__file__).parent / "reference.md"
SHARED = 5  # options that so many commands take are explained once

HEAD = """# Reference

Made by `python docs/make_reference.py` from the code; a test fails when it is out of date. Do not edit.
"""


def page() -> str:
    """The whole page."""
    return "\n".join([HEAD, *_commands(), *_settings(), *_presets(), *_exit_codes()]).rstrip() + "\n"


def _commands() -> Iterator[str]:
    yield "## Commands\n"
    commands = all_commands()
    takers = Counter(_parameter_row(parameter) for command in commands.values() for parameter in command.params)
    shared = [row for row, number in takers.items() if number >= SHARED]
    yield "### Options of many commands\n"
    yield "The commands below name those of them that they take.\n"
    yield from _parameter_table(shared)
    for name, command in commands.items():
        yield f"### hineus {name}\n"
        yield f"{inspect.cleandoc(command.help or '')}\n"
        rows = {parameter: _parameter_row(parameter) for parameter in command.params}
        if own := [row for row in rows.values() if row not in shared]:
            yield from _parameter_table(own)
        if also := [f"`{_name(parameter)}`" for parameter, row in rows.items() if row in shared]:
            yield f"{'Also t' if own else 'T'}akes {', '.join(also)}: see [above](#options-of-many-commands).\n"


def _parameter_table(rows: Iterable[str]) -> Iterator[str]:
    yield _row("parameter", "meaning", "default")
    yield _row("---", "---", "---")
    yield from rows
    yield ""


def _parameter_row(parameter: Any) -> str:
    return _row(_spelling(parameter), parameter.help or "", _default(parameter))


def all_commands() -> dict[str, Any]:
    """Each command by its name; those of a group, "evaluate mesh", after it."""
    found: dict[str, Any] = {}
    group: Any = typer.main.get_command(app)
    for name, command in group.commands.items():
        found[name] = command
        found |= {f"{name} {part}": each for part, each in getattr(command, "commands", {}).items()}
    return found


def _name(parameter: Any) -> str:
    return parameter.name.upper() if parameter.param_type_name == "argument" else parameter.opts[0]


def _spelling(parameter: Any) -> str:
    if parameter.param_type_name == "argument":
        return f"`{_name(parameter)}`"
    names = ", ".join(f"`{name}`" for name in parameter.opts)
    return names if parameter.is_flag else f"{names} VALUE"


def _default(parameter: Any) -> str:
    if parameter.default in (None, False) or callable(parameter.default):
        return ""
    return f"`{parameter.default}`"


def _settings() -> Iterator[str]:
    yield "## Settings\n"
    yield (
        "Set them with `--set section.key=value`, or in a YAML file given with `--config`. The order is:\n"
        "defaults, then the preset, then the file, then `--set`.\n"
    )
    described = {setting.key: setting for setting in describe_settings()}
    for name, section in Config.model_fields.items():
        yield from _group(name, section.annotation, described)


def _group(name: str, kind: Any, described: dict[str, Setting], depth: int = 3) -> Iterator[str]:
    """A group of settings, then the groups in it."""
    yield f"{'#' * depth} {name}\n"
    yield f"{inspect.cleandoc(kind.__doc__ or '').splitlines()[0]}\n"
    keys = [f"{name}.{field}" for field in kind.model_fields]
    if own := [described[key] for key in keys if key in described]:
        yield _row("setting", "values", "bounds", "default", "meaning")
        yield _row("---", "---", "---", "---", "---")
        yield from map(_setting_row, own)
        yield ""
    for key, field in zip(keys, kind.model_fields.values(), strict=True):
        if key not in described:
            yield from _group(key, field.annotation, described, depth + 1)


def _setting_row(setting: Setting) -> str:
    default = f"`{show_value(setting.default)}`"
    return _row(f"`{setting.key}`", setting.type, setting.bounds, default, setting.description)


def _presets() -> Iterator[str]:
    yield "## Presets\n"
    for name in preset_names():
        yield f"### {name}\n"
        yield f"{preset_summary(name)}\n"
        yield f"```yaml\n{preset_text(name).split(chr(10), 1)[1].strip()}\n```\n"


def _exit_codes() -> Iterator[str]:
    yield "## Exit codes\n"
    yield _row("code", "meaning")
    yield _row("---", "---")
    yield _row("0", "All went well.")
    kinds = [kind for kind in vars(errors).values() if inspect.isclass(kind) and issubclass(kind, HineusError)]
    for kind in sorted(kinds, key=lambda kind: kind.exit_code):
        meaning = "An error that nobody foresaw." if kind is HineusError else inspect.cleandoc(kind.__doc__ or "")
        yield _row(str(kind.exit_code), meaning)
    yield _row("130, 143, 129", "Stopped by Ctrl-C, SIGTERM or SIGHUP.")


def _row(*cells: str) -> str:
    return f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in cells)} |"


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
