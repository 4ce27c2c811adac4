"""What a stage publishes and later ones read: a name, where it lies, how it is read and written."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Generic, TypeVar

T = TypeVar("T")


@dataclass(frozen=True, eq=False)
class Artifact(Generic[T]):
    """One thing that a stage publishes. Two are the same only where they are one object.

    Attributes:
        stage: name of the stage that publishes it.
        files: patterns ("images/*") of its files' paths relative to that stage's folder.
        load: reads it from the stage's folder.
        save: writes it into the stage's folder.
        optional: whether the stage may leave it out; `load` then gives what its docstring says.
    """

    stage: str
    files: tuple[str, ...]
    load: Callable[[Path], T]
    save: Callable[[Path, T], None]
    optional: bool = False

    @property
    def name(self) -> str:
        """For messages and fingerprints: "undistort/cameras.json"."""
        return f"{self.stage}/{self.files[0]}"

    def covers(self, path: str) -> bool:
        """Whether a file, relative to the stage's folder, is part of it."""
        return any(fnmatchcase(path, pattern) for pattern in self.files)


def place_artifact(stage: str, place: str, files: str | None = None, optional: bool = False) -> Artifact[Path]:
    """A file or folder that other programs read and write: its value is the place itself.

    Args:
        place: relative to the stage's folder.
        files: pattern of its files; `place` where it is one file.
    """

    def save(folder: Path, value: Path) -> None:
        if value != folder / place or not value.exists():
            raise ValueError(f"{value} was to be written at {folder / place}")

    return Artifact(stage, (files or place,), lambda folder: folder / place, save, optional)
