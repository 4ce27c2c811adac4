"""What a stage's result depends on, hashed; and, when that has changed, the change in words."""

from __future__ import annotations

import hashlib
import json
import os
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from configs.dotted import flatten
from stages.artifacts.own_files import read_own, write_own
from stages.errors import InputError, WorkspaceError
from stages.inputs.bounded import check_regular
from stages.inputs.folders import named_files, readable
from stages.inputs.texts import parse_json

CHUNK_BYTES = 1 << 20

# A file written within this time before it was hashed may change again without its mtime changing (coarse
# file system clocks), so such a hash is not remembered as good.
RACY_NS = 2_000_000_000

MAX_NAMED = 3  # changed files named one by one; past it they are counted

RUN_KEY = "run"  # what the run was started with: photos, preset, settings

FileDigests = dict[str, str]
"""Relative posix path, as `readable` gives it -> sha256 of the contents."""


@dataclass(frozen=True)
class Identity:
    """All that a stage's result depends on.

    Device, worker count, verbosity and absolute paths are absent on purpose: they never change a result.

    Attributes:
        stage: the stage's name.
        version: the stage's version.
        params: the stage's settings, as JSON-able values.
        inputs: artifact that is read ("undistort/cameras.json") -> digest of its files as published. Also what
            `manifest_key` and RUN_KEY stand for, where a stage reads those.
        sources: outside path ("photos") -> its files' digests, None where it was not given.
        previous: digest of the stage's own publication that it was given to go on from; None where there was none. It
            is history, so it never makes a result stale.
    """

    stage: str
    version: int
    params: Mapping[str, Any]
    inputs: Mapping[str, str] = field(default_factory=dict)
    sources: Mapping[str, FileDigests | None] = field(default_factory=dict)
    previous: str | None = None

    @property
    def parts(self) -> dict[str, Any]:
        """The fingerprint's ingredients, one digest each."""
        history = {} if self.previous is None else {"previous": self.previous}
        return history | {
            "stage": self.stage,
            "version": self.version,
            "params": digest(dict(self.params)),
            "inputs": dict(self.inputs),
            "sources": {name: None if files is None else digest(files) for name, files in self.sources.items()},
        }

    @property
    def fingerprint(self) -> str:
        return digest(self.parts)

    def changes_since(self, before: Identity) -> list[str]:
        """What differs from `before`, in words."""
        changes = []
        if before.version != self.version:
            changes.append(f"stage version {before.version} -> {self.version}")
        changes += _setting_changes(*(flatten(each.params, f"{self.stage}.") for each in (before, self)))
        for name in sorted({*before.sources, *self.sources}):
            changes += _source_changes(name, before.sources.get(name), self.sources.get(name))
        for name in sorted({*before.inputs, *self.inputs}):
            if before.inputs.get(name) != self.inputs.get(name):
                changes.append(_input_change(name))
        return changes


def manifest_key(stage: str) -> str:
    """Under which a stage's inputs name another one's manifest."""
    return f"{stage}/manifest"


def _input_change(name: str) -> str:
    if name == RUN_KEY:
        return "the run was started otherwise"
    stage, _, rest = name.partition("/")
    return f"{stage} was made again" if name == manifest_key(stage) else f"input {stage}/{rest} changed"


def _setting_changes(before: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    changes = []
    for key in sorted({*before, *now}):
        if key not in before:
            changes.append(f"parameter {key} is new ({_shown(now[key])})")
        elif key not in now:
            changes.append(f"parameter {key} is gone")
        elif before[key] != now[key]:
            changes.append(f"parameter {key} changed {_shown(before[key])} -> {_shown(now[key])}")
    return changes


def _source_changes(name: str, before: FileDigests | None, now: FileDigests | None) -> list[str]:
    if before == now:
        return []
    if before is None or now is None:
        return [f"{name} are now given" if before is None else f"{name} are no longer given"]
    noun = name.removesuffix("s")
    groups = {
        "changed": [path for path in now if path in before and before[path] != now[path]],
        "added": [path for path in now if path not in before],
        "removed": [path for path in before if path not in now],
    }
    changes = []
    for verb, paths in groups.items():
        paths.sort()
        if len(paths) > MAX_NAMED:
            changes.append(f"{len(paths)} {name} {verb} ({', '.join(paths[:MAX_NAMED])}, ...)")
        else:
            changes += [f"{noun} {path} {verb}" for path in paths]
    return changes


def _shown(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value)


def digest(value: Any) -> str:
    """sha256 of a JSON-able value; the order of mapping keys does not matter."""
    text = json.dumps(value, sort_keys=True, separators=(",", ":"), ensure_ascii=True)
    return hashlib.sha256(text.encode()).hexdigest()


def file_sha256(path: Path) -> str:
    sha = hashlib.sha256()
    with path.open("rb") as file:
        while chunk := file.read(CHUNK_BYTES):
            sha.update(chunk)
    return sha.hexdigest()


class SourceDigests:
    """Content digests of the outside paths, quick the second time.

    A file whose size and mtime are those of the last hashing is not read again. `cache` is the JSON file that
    remembers them; None keeps nothing.
    """

    def __init__(self, sources: Mapping[str, Path | None], cache: Path | None = None) -> None:
        self.sources = dict(sources)
        self._cache_path = cache
        self._cache: dict[str, list[Any]] = _read_cache(cache)
        self._changed = False
        self._files: dict[str, FileDigests | None] = {}
        self._looks: dict[Path, list[int]] = {}  # size and mtime of each file when it was hashed

    def available(self, name: str) -> bool:
        """False where the path was given but is not there (any more), or may not be looked at."""
        path = self.sources.get(name)
        return path is None or os.path.exists(path)

    def files(self, name: str) -> FileDigests | None:
        """Digest of each file of source `name`, None where it was not given.

        Raises:
            InputError: the path or one of its files cannot be read.
        """
        if name not in self._files:
            path = self.sources.get(name)
            try:
                self._files[name] = None if path is None else self._digest_tree(path)
            except OSError as error:
                raise InputError(
                    f"The {name} at {path} cannot be read: {error.strerror or error} ({error.filename}).",
                    "Check that the path exists and that you may read it.",
                ) from error
        return self._files[name]

    def _digest_tree(self, path: Path) -> FileDigests:
        if path.is_dir():
            return {name: self._digest_file(file) for name, file in named_files(path)[0].items()}
        check_regular(path)
        return {readable(path.name): self._digest_file(path)}

    def _digest_file(self, path: Path) -> str:
        look = self._looks[path] = _look(path)
        key = str(path.absolute())
        known = self._cache.get(key)
        if known and known[:2] == look:
            return str(known[2])
        started_ns = time.time_ns()
        sha = file_sha256(path)
        if look[1] < started_ns - RACY_NS:
            self._cache[key] = [*look, sha]
            self._changed = True
        return sha

    def changed_since(self, name: str) -> Path | None:
        """A file of source `name` that has been written or removed since it was hashed, if there is one."""
        root = self.sources.get(name)
        hashed = [path for path in self._looks if root is not None and path.is_relative_to(root)]
        return next((path for path in hashed if not path.exists() or _look(path) != self._looks[path]), None)

    def save(self) -> None:
        """Write the cache, if it learnt anything."""
        if self._cache_path is None or not self._changed:
            return
        self._cache_path.parent.mkdir(parents=True, exist_ok=True)
        write_own(self._cache_path, json.dumps(self._cache))
        self._changed = False


def _look(path: Path) -> list[int]:
    """Size and mtime."""
    found = path.stat()
    return [found.st_size, found.st_mtime_ns]


def _read_cache(path: Path | None) -> dict[str, list[Any]]:
    # A cache that cannot be read is only slow, never wrong.
    try:
        cache = parse_json(read_own(path).decode()) if path else {}
    except (OSError, ValueError, WorkspaceError):
        return {}
    valid = isinstance(cache, dict) and all(isinstance(row, list) and len(row) == 3 for row in cache.values())
    return cache if valid else {}
