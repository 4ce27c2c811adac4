"""Are these the photos of before? Their contents decide, so that a move is no change."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

from stages.engine.fingerprint import FileDigests

Kind = Literal["new", "same", "moved", "changed", "other"]

SHARED = 0.5  # of the smaller of two sets of photos: with so many in common, one is a later state of the other


@dataclass(frozen=True)
class PhotosSince:
    """What has become of the photos of a workspace.

    Attributes:
        kind: new: the workspace holds nothing made of photos yet; same: these very files; moved: the same contents in
            another folder or under other names; changed: some were added, removed or edited; other: another scene's.
        kept: path before -> path now of each photo with the same contents; paths are relative to the photos' folder.
        added: paths now whose contents were not there before, edited photos among them.
        removed: paths before whose contents are no longer there, edited photos among them.
    """

    kind: Kind
    kept: Mapping[str, str] = field(default_factory=dict)
    added: tuple[str, ...] = ()
    removed: tuple[str, ...] = ()


def compare_photos(before: FileDigests, now: FileDigests, same_folder: bool) -> PhotosSince:
    """Two states of photos (path -> sha256), and whether they lie in one folder: there, names in common count, too."""
    kept = _same_contents(before, now)
    still_there = set(kept.values())
    added = tuple(path for path in now if path not in still_there)
    removed = tuple(path for path in before if path not in kept)
    if not added and not removed:
        renamed = any(old != new for old, new in kept.items())
        return PhotosSince("same" if same_folder and not renamed else "moved", kept)
    related = len(kept) >= SHARED * min(len(before), len(now))
    if same_folder:
        related = related or bool(before.keys() & now.keys()) or bool(kept)
    return PhotosSince("changed" if related else "other", kept, added, removed)


def _same_contents(before: FileDigests, now: FileDigests) -> dict[str, str]:
    """Path before -> path now of the same contents: under the same name where it is there, else in order."""
    kept = {path: path for path, sha in before.items() if now.get(path) == sha}
    taken = set(kept)
    paths: dict[str, list[str]] = {}
    for path, sha in now.items():
        if path not in taken:
            paths.setdefault(sha, []).append(path)
    for path, sha in before.items():
        if path not in kept and paths.get(sha):
            kept[path] = paths[sha].pop(0)
    return kept
