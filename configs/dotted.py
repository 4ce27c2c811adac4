"""Settings by section as one level of dotted keys, and back."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any


def flatten(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """{"train": {"density": {"form": "neus"}}} as {"train.density.form": "neus"}."""
    flat: dict[str, Any] = {}
    for key, value in values.items():
        dotted = f"{prefix}{key}"
        flat |= flatten(value, f"{dotted}.") if isinstance(value, Mapping) else {dotted: value}
    return flat


def nested(flat: Mapping[str, Any]) -> dict[str, Any]:
    """The reverse of `flatten`; where a key is both a value and a section, the later one wins."""
    values: dict[str, Any] = {}
    for dotted, value in flat.items():
        *sections, name = dotted.split(".")
        section = values
        for each in sections:
            if not isinstance(section.get(each), dict):
                section[each] = {}
            section = section[each]
        section[name] = value
    return values
