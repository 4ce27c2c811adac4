"""Every error a person may see: what happened, the number found against the number needed, what to try."""

from __future__ import annotations

import difflib
from collections.abc import Collection, Iterable


class HineusError(Exception):
    """An error in the user's terms. `message` says what happened, `hint` is a command or an action to try."""

    exit_code = 1

    def __init__(self, message: str, hint: str = "") -> None:
        super().__init__(message)
        self.message = message
        self.hint = hint


class ConfigError(HineusError):
    """A setting is unknown or out of its bounds. Mend the setting."""

    exit_code = 2


class InputError(HineusError):
    """The photos, masks or poses cannot be used. Mend the input."""

    exit_code = 3


class ReconstructionError(HineusError):
    """The photos were read, but a stage could not make its result from them. Change photos or settings."""

    exit_code = 4


class WorkspaceError(HineusError):
    """The workspace is busy, damaged, read-only, full, of other photos or from another version. Mend the workspace."""

    exit_code = 5


class SystemRequirementError(HineusError):
    """The machine lacks something: a library, memory, a GPU. Install it or choose another way."""

    exit_code = 6


def did_you_mean(name: str, known: Iterable[str], form: str = "{}") -> str:
    """The start of a hint: "Did you mean `--preset cpu`? " by the nearest known name; empty where none is near."""
    near = difflib.get_close_matches(name, known, 1)
    return f"Did you mean `{form.format(near[0])}`? " if near else ""


def check_choice(option: str, value: str, known: Collection[str]) -> None:
    """
    Args:
        option: as it is written on the command line.

    Raises:
        ConfigError: the value is none of those known.
    """
    if value not in known:
        hint = did_you_mean(value, known, f"{option} {{}}")
        raise ConfigError(f"{option} {value[:40]} is not known.", f"{hint}There are {', '.join(known)}.")
