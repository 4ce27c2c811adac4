"""Layers of settings to one `Config`: defaults < preset < --config file < --set.

Where one of them names `train.backbone`, the settings of that backbone lie right below it; all of --set is one layer.

Every refusal names the setting, where it was written, and the nearest one there is.
"""

from __future__ import annotations

import difflib
import itertools
import re
import types
import typing
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import yaml
from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo

from configs.dotted import flatten, nested
from configs.params import Config
from configs.renames import with_new_names
from stages.errors import ConfigError, did_you_mean


@dataclass(frozen=True)
class Setting:
    """One setting, described for people.

    Attributes:
        key: dotted, as `--set` takes it.
        type: what values it takes ("whole number", "auto | exhaustive").
        default: its value where nothing sets it.
        bounds: ">= 1, <= 32", or empty.
        description: with its unit.
    """

    key: str
    type: str
    default: Any
    bounds: str
    description: str


# ---------------------------------------------------------------- loading
def load_config(preset: str | None = None, file: Path | None = None, sets: Sequence[str] = ()) -> Config:
    """Layer the settings: defaults < `preset` < `file` < `sets`.

    Args:
        preset: name of a preset, see `preset_names`.
        file: a YAML file of the same shape as `Config`; it may hold any part of it.
        sets: "section.key=value" each, the value in YAML; later ones win.

    Raises:
        ConfigError: a file cannot be read or parsed, a key is unknown, a value is out of bounds.
    """
    groups: list[list[tuple[str, dict[str, Any]]]] = []
    if preset is not None:
        groups.append([(f"preset '{preset}'", _parse(preset_text(preset), f"preset '{preset}'"))])
    if file is not None:
        groups.append([(str(file), _parse(_read(file), str(file)))])
    groups.append([(_set(text), _parse_set(text)) for text in sets])

    merged: dict[str, Any] = {}  # by dotted key
    origins: dict[str, str] = {}
    for group in groups:
        layers = [(origin, _checked(with_new_names(layer, origin), origin)) for origin, layer in group]
        backbones = [_backbone(layer.get("train", {}).get("backbone")) for _, layer in layers]
        for origin, layer in (*itertools.chain(*backbones), *layers):
            merged |= flatten(layer)
            origins |= {part: origin for key in flatten(layer) for part in (key, *_ancestors(key))}
    try:
        return Config.model_validate(nested(merged))
    except ValidationError as error:
        raise _refusal(error, origins) from None


def _backbone(name: Any) -> list[tuple[str, dict[str, Any]]]:
    """The layer of backbone `name`; none where there is no such backbone, which the schema then refuses."""
    if name not in _names_in("backbones"):
        return []
    file = resources.files("configs") / "backbones" / f"{name}.yaml"
    origin = f"backbone '{name}'"
    return [(origin, _checked(_parse(file.read_text(encoding="utf-8"), origin), origin))]


def preset_names() -> list[str]:
    """Names of the presets that come with the program, sorted."""
    return _names_in("presets")


def _names_in(folder: str) -> list[str]:
    files = (resources.files("configs") / folder).iterdir()
    return sorted(file.name.removesuffix(".yaml") for file in files if file.name.endswith(".yaml"))


def preset_text(name: str) -> str:
    """The YAML of preset `name`.

    Raises:
        ConfigError: there is no such preset.
    """
    if name not in preset_names():
        raise ConfigError(
            f"There is no preset '{_short(name)}'.",
            f"{did_you_mean(name, preset_names(), '--preset {}')}The presets are {', '.join(preset_names())}.",
        )
    return (resources.files("configs") / "presets" / f"{name}.yaml").read_text(encoding="utf-8")


def preset_summary(name: str) -> str:
    """The first comment line of the preset."""
    return preset_text(name).splitlines()[0].lstrip("# ").strip()


def config_yaml(config: BaseModel) -> str:
    """The settings as YAML that `load_config` takes back."""
    return yaml.safe_dump(config.model_dump(mode="json"), sort_keys=False)


# ---------------------------------------------------------------- describing
def describe_settings() -> list[Setting]:
    """Every setting there is, in the order of the schema."""
    return [
        Setting(
            key=key,
            type=_type_name(field.annotation),
            default=field.get_default(call_default_factory=True),
            bounds=_bounds(field),
            description=field.description or "",
        )
        for key, field in _fields()
    ]


def show_value(value: Any) -> str:
    """A setting's value the way YAML and `--set` spell it, lists without their brackets."""
    if isinstance(value, tuple):
        return ", ".join(show_value(each) for each in value)
    if value is None:
        return "null"
    return str(value).lower() if isinstance(value, bool) else str(value)


def _fields(schema: type[BaseModel] = Config, prefix: str = "") -> Iterator[tuple[str, FieldInfo]]:
    for name, field in schema.model_fields.items():
        section = _section(field)
        if section is not None:
            yield from _fields(section, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", field


def _section(field: FieldInfo) -> type[BaseModel] | None:
    kind = field.annotation
    return kind if isinstance(kind, type) and issubclass(kind, BaseModel) else None


def _type_name(annotation: Any) -> str:
    origin, arguments = typing.get_origin(annotation), typing.get_args(annotation)
    if origin is typing.Literal:
        return " | ".join(str(value) for value in arguments)
    if origin in (typing.Union, types.UnionType):
        return " | ".join(_type_name(argument) for argument in arguments)
    if origin in (tuple, list):
        return f"list of ({', '.join(_type_name(argument) for argument in arguments if argument is not ...)})"
    names = {int: "whole number", float: "number", bool: "true | false", str: "text", type(None): "null"}
    return names.get(annotation, getattr(annotation, "__name__", str(annotation)))


def _bounds(field: FieldInfo) -> str:
    signs = {"gt": ">", "ge": ">=", "lt": "<", "le": "<="}  # the rules' attributes
    rules = [(rule, name) for rule in field.metadata for name in signs if hasattr(rule, name)]
    return ", ".join(f"{signs[name]} {getattr(rule, name)}" for rule, name in rules)


# ---------------------------------------------------------------- reading YAML
MOST_BYTES = 1 << 18  # of a settings file: all settings with their descriptions are a tenth of that
MOST_DEPTH = 8  # of sections and lists in each other; settings lie at most five deep
MOST_SHOWN = 200  # characters of what is refused


class _Loader(yaml.SafeLoader):
    """Plain YAML: sections, lists, texts, numbers, true, false and null, by the rules of version 1.2.

    `off` is text, not false; `1e-3` is a number, not text; a date is text. What no setting needs and what makes work or
    values of other kinds is refused: anchors, aliases, tags, keys that come twice, deep nesting.
    """

    depth = 0

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        event: Any = self.peek_event()  # type: ignore[no-untyped-call]
        if getattr(event, "anchor", None) is not None:
            raise _refused("anchors and aliases (&name, *name) are not read here: write the value itself", event)
        if getattr(event, "tag", None) is not None:
            raise _refused(f"tags ({event.tag}) are not read here: write the plain value", event)
        if self.depth > MOST_DEPTH:
            raise _refused(f"sections and lists lie more than {MOST_DEPTH} deep in each other", event)
        self.depth += 1
        try:
            return super().compose_node(parent, index)
        finally:
            self.depth -= 1

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        names = set()
        for key, _ in node.value:
            name = self.construct_object(key, deep=True)
            if not isinstance(name, str) or not name or "." in name:
                raise _refused(f"{_shown(name)} is no name of a setting or section", key)
            if name in names:
                raise _refused(f"`{name}` is there twice", key)
            names.add(name)
        return super().construct_mapping(node, deep)


def _refused(problem: str, place: Any) -> yaml.MarkedYAMLError:
    return yaml.MarkedYAMLError(problem=problem, problem_mark=place.start_mark)


# Longer numbers than these are read as the next wider kind: a float, which may be infinite, and then a text.
_Loader.yaml_implicit_resolvers = {}
for _kind, _starts, _pattern in (
    ("null", ["~", "n", "N", ""], r"~|null|Null|NULL|"),
    ("bool", list("tTfF"), r"true|True|TRUE|false|False|FALSE"),
    ("int", list("-+0123456789"), r"[-+]?(?:0|[1-9][0-9]{0,18})|0x[0-9a-fA-F]{1,16}"),
    (
        "float",
        list("-+.0123456789"),
        r"[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?|[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN)",
    ),
):
    _Loader.add_implicit_resolver(f"tag:yaml.org,2002:{_kind}", re.compile(f"^(?:{_pattern})$"), _starts)


def _yaml(text: str) -> Any:
    return yaml.load(text, Loader=_Loader)  # a SafeLoader: plain data only


def _problem(error: yaml.YAMLError) -> str:
    """Where it is wrong and what, in one line."""
    mark = getattr(error, "problem_mark", None)
    what = " ".join(str(getattr(error, "problem", None) or error).split())
    return f" at line {mark.line + 1}: {what}" if mark else f": {what}"


def _read(file: Path) -> str:
    from stages.inputs.bounded import reason  # they import numpy, which takes its time
    from stages.inputs.texts import read_text

    try:
        return read_text(file, MOST_BYTES)
    except (OSError, ValueError) as error:
        raise ConfigError(f"The settings file {file} cannot be read: {reason(error)}.", "Check the path.") from error


def _parse(text: str, origin: str) -> dict[str, Any]:
    try:
        data = _yaml(text)
    except yaml.YAMLError as error:
        raise ConfigError(
            f"{origin} is no YAML of settings{_problem(error)}.", "`hineus config` prints a valid one."
        ) from error
    if data is None:
        return {}
    if not isinstance(data, dict):
        raise ConfigError(
            f"{origin} holds {type(data).__name__} where sections were expected.",
            "`hineus config` prints a valid one.",
        )
    return data


def _parse_set(text: str) -> dict[str, Any]:
    key, equals, raw = text.partition("=")
    parts = key.strip().split(".")
    if not equals or not all(parts) or len(parts) > MOST_DEPTH:
        raise ConfigError(f"{_set(text)} is not of the form section.key=value.", "For example `--set sfm.seed=1`.")
    try:
        value = _yaml(raw)
    except yaml.YAMLError as error:
        raise ConfigError(
            f"{_set(text)}: the value is no YAML of settings{_problem(error)}.",
            "Quote it for the shell, for example `--set 'export.formats=[glb, ply]'`.",
        ) from error
    return nested({".".join(parts): value})


def _set(text: str) -> str:
    """The option as an origin of settings."""
    return f"--set {_short(text)}"


def _shown(value: Any) -> str:
    """A value as it is written in a refusal: not all of a long one."""
    return _short(repr(value))


def _short(text: str) -> str:
    return text if len(text) <= MOST_SHOWN else f"{text[:MOST_SHOWN]}..."


# ---------------------------------------------------------------- refusing
_BOUND_ERRORS = ("greater_than", "greater_than_equal", "less_than", "less_than_equal")


def _checked(
    layer: Mapping[str, Any], origin: str, schema: type[BaseModel] = Config, prefix: str = ""
) -> dict[str, Any]:
    """The layer without its empty sections; unknown keys and values in the place of sections are refused."""
    checked: dict[str, Any] = {}
    for key, value in layer.items():
        dotted = f"{prefix}{key}"
        field = schema.model_fields.get(str(key))
        if field is None:
            raise ConfigError(f"Unknown setting `{_short(dotted)}` in {origin}.", _nearest(dotted))
        section = _section(field)
        if section is None:
            if isinstance(value, Mapping):
                raise ConfigError(f"`{dotted}` in {origin} is a setting, not a section of settings.", _about(dotted))
            checked[str(key)] = value
        elif isinstance(value, Mapping):
            checked[str(key)] = _checked(value, origin, section, f"{dotted}.")
        elif value is not None:  # a section with all its lines commented out is fine
            raise ConfigError(
                f"`{dotted}` in {origin} is a section of settings, not a value ({_shown(value)}).",
                f"Set one of its keys, for example `{next(_fields(section, f'{dotted}.'))[0]}`.",
            )
    return checked


def _nearest(key: str) -> str:
    settings = dict(_fields())
    known = dict.fromkeys([*settings, *(section for setting in settings for section in _ancestors(setting))])
    # The right name in the wrong section, or in none, is nearer than a similar one elsewhere.
    by_name: dict[str, list[str]] = {}
    for setting in known:
        by_name.setdefault(setting.rpartition(".")[2], []).append(setting)
    name = key.rpartition(".")[2]
    similar = by_name.get(name) or [
        setting for near in difflib.get_close_matches(name, by_name, 3, cutoff=0.75) for setting in by_name[near]
    ]
    near = difflib.get_close_matches(key, similar, 1, cutoff=0) or difflib.get_close_matches(key, known, 1, cutoff=0.5)
    if near:
        return f"Did you mean `{near[0]}`? `hineus config --describe` lists all settings."
    return "`hineus config --describe` lists all settings."


def _refusal(error: ValidationError, origins: Mapping[str, str]) -> ConfigError:
    """The first thing pydantic found, in the user's terms."""
    detail = error.errors(include_url=False)[0]
    known = dict(_fields())
    path = [str(part) for part in detail["loc"]]
    key = ".".join(path)
    while key and key not in known and "." in key:  # inside a list or one arm of a union
        key = key.rpartition(".")[0]
    origin = origins.get(key) or next((origins[part] for part in _ancestors(key) if part in origins), "the settings")
    field = known.get(key)
    if field is None:
        said = str(detail["ctx"]["error"]) if detail["type"] == "value_error" else detail["msg"]
        return ConfigError(f"{said} (in {origin}).", "`hineus config --describe` lists all settings.")
    found = f"`{key}` = {_shown(detail['input'])} in {origin}"
    if detail["type"] == "value_error":  # the schema's own checks say what is wrong
        return ConfigError(f"{found}: {_short(str(detail['ctx']['error']))}.", _about(key))
    bounds = _bounds(field)
    problem = "is out of bounds: it must be" if detail["type"] in _BOUND_ERRORS else "is no valid value: it must be"
    wanted = bounds if detail["type"] in _BOUND_ERRORS else f"{_type_name(field.annotation)} {bounds}".strip()
    return ConfigError(f"{found} {problem} {wanted}.", _about(key))


def _about(key: str) -> str:
    field = dict(_fields())[key]
    return f"{key}: {field.description}. Default: {show_value(field.get_default(call_default_factory=True))}."


def _ancestors(key: str) -> Iterator[str]:
    while "." in key:
        key = key.rpartition(".")[0]
        yield key
