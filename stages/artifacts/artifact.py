"""What a stage publishes and later ones read: a name, where it lies, how it is read and written."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np

T = TypeVar("T")


@dataclass(frozen=True, eq=False)
class Artifact(Generic[T]):
    """One thing that a stage publishes. Two are the same only where they are one object.

    Attributes:
        stage: name of the stage that publishes it.
        files: patterns ("images/*") of its files' paths relative to that stage's folder.
        load: reads it from the stage's folder.
        save: writes it into the stage's folder.
        optional: whether the stage may leave it out; `load` then gives None, nothing, or a path that is not there.
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
    return in_folder(stage, (files or place,), lambda folder: folder / place, optional)


def in_folder(stage: str, files: tuple[str, ...], of: Callable[[Path], T], optional: bool = False) -> Artifact[T]:
    """An artifact whose value only says where its files lie in a stage's folder, `of(folder)`."""

    def save(folder: Path, value: T) -> None:
        if value != of(folder):
            raise ValueError(f"{value} is no part of {folder}")

    return Artifact(stage, files, of, save, optional)


def arrays_artifact(stage: str, file: str, kind: Callable[..., T]) -> Artifact[T]:
    """A dataclass `kind` of arrays and numbers, as a .npz file."""

    def load(folder: Path) -> T:
        with np.load(folder / file) as data:
            return kind(**{name: array if array.ndim else array.item() for name, array in data.items()})

    def save(folder: Path, value: Any) -> None:
        np.savez(folder / file, **asdict(value))

    return Artifact(stage, (file,), load, save)
