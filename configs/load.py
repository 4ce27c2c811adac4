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
    groups.append([(f"--set {text}", _parse_set(text)) for text in sets])

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
    file = resources.files("configs") / "backbones" / f"{name}.yaml"
    if not isinstance(name, str) or not name.isidentifier() or not file.is_file():
        return []
    origin = f"backbone '{name}'"
    return [(origin, _checked(_parse(file.read_text(encoding="utf-8"), origin), origin))]


def preset_names() -> list[str]:
    """Names of the presets that come with the program, sorted."""
    folder = resources.files("configs") / "presets"
    return sorted(entry.name.removesuffix(".yaml") for entry in folder.iterdir() if entry.name.endswith(".yaml"))


def preset_text(name: str) -> str:
    """The YAML of preset `name`.

    Raises:
        ConfigError: there is no such preset.
    """
    if name not in preset_names():
        raise ConfigError(
            f"There is no preset '{name}'.",
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
class _Loader(yaml.SafeLoader):
    """YAML with version 1.2's scalars: `off` is text, not false; `1e-3` is a number, not text."""


_Loader.yaml_implicit_resolvers = {
    first: [(tag, regex) for tag, regex in rules if not tag.endswith((":bool", ":float"))]
    for first, rules in yaml.SafeLoader.yaml_implicit_resolvers.items()
}
_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:bool", re.compile(r"^(?:true|True|TRUE|false|False|FALSE)$"), list("tTfF")
)
_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(
        r"^(?:[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?|[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN))$"
    ),
    list("-+.0123456789"),
)


def _yaml(text: str) -> Any:
    return yaml.load(text, Loader=_Loader)  # a SafeLoader: plain data only


def _read(file: Path) -> str:
    try:
        return file.read_text(encoding="utf-8-sig")  # editors of Windows write a byte-order mark
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "not UTF-8 text"
        raise ConfigError(f"The settings file {file} cannot be read: {reason}.", "Check the path.") from error


def _parse(text: str, origin: str) -> dict[str, Any]:
    try:
        data = _yaml(text)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = f" at line {mark.line + 1}" if mark else ""
        raise ConfigError(
            f"{origin} is not valid YAML{where}: {getattr(error, 'problem', error)}.",
            "`hineus config` prints a valid one.",
        ) from error
    if data is None:
        return {}
    if not isinstance(data, dict):
        raise ConfigError(
            f"{origin} holds {type(data).__name__} where sections were expected.",
            "`hineus config` prints a valid one.",
        )
    return {str(key): value for key, value in data.items()}


def _parse_set(text: str) -> dict[str, Any]:
    key, equals, raw = text.partition("=")
    parts = key.strip().split(".")
    if not equals or not all(parts):
        raise ConfigError(f"--set {text} is not of the form section.key=value.", "For example `--set sfm.seed=1`.")
    try:
        value = _yaml(raw)
    except yaml.YAMLError as error:
        raise ConfigError(
            f"--set {text}: the value is not valid YAML ({getattr(error, 'problem', error)}).",
            "Quote it for the shell, for example `--set 'export.formats=[glb, ply]'`.",
        ) from error
    return nested({".".join(parts): value})


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
            raise ConfigError(f"Unknown setting `{dotted}` in {origin}.", _nearest(dotted))
        section = _section(field)
        if section is None:
            checked[str(key)] = value
        elif isinstance(value, Mapping):
            checked[str(key)] = _checked(value, origin, section, f"{dotted}.")
        elif value is not None:  # a section with all its lines commented out is fine
            raise ConfigError(
                f"`{dotted}` in {origin} is a section of settings, not a value ({value!r}).",
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
        return ConfigError(f"{detail['msg']} (in {origin}).", "`hineus config --describe` lists all settings.")
    help_text = f"{key}: {field.description}. Default: {show_value(field.get_default(call_default_factory=True))}."
    if detail["type"] == "value_error":  # the schema's own checks say what is wrong
        return ConfigError(f"`{key}` = {detail['input']!r} in {origin}: {detail['ctx']['error']}.", help_text)
    bounds = _bounds(field)
    problem = "is out of bounds: it must be" if detail["type"] in _BOUND_ERRORS else "is no valid value: it must be"
    wanted = bounds if detail["type"] in _BOUND_ERRORS else f"{_type_name(field.annotation)} {bounds}".strip()
    return ConfigError(
        f"`{key}` = {detail['input']!r} in {origin} {problem} {wanted}.",
        help_text,
    )


def _ancestors(key: str) -> Iterator[str]:
    while "." in key:
        key = key.rpartition(".")[0]
        yield key
