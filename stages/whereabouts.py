"""Where things lie: the workspace that photos get by default, and photos, masks and poses that were moved."""

from __future__ import annotations

import os
import shlex
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from stages.artifacts import IMAGE_SET
from stages.engine.fingerprint import FileDigests
from stages.engine.manifest import ManifestDamaged
from stages.engine.photos_since import PhotosSince, compare_photos
from stages.engine.workspace import WORKSPACE_SUFFIX, Workspace
from stages.errors import WorkspaceError
from stages.inputs.folders import named_files, readable


@dataclass(frozen=True)
class DefaultWorkspace:
    """The folder of the results, and why it is not `PHOTOS_hineus` beside the photos; empty where it is."""

    folder: Path
    why: str = ""


def default_workspace(photos: Path) -> DefaultWorkspace:
    """`PHOTOS_hineus` beside the folder of photos, or beside the video; with a telling name here where that cannot be.

    A workspace of these photos that is there already comes first: beside the folder that a link stands for, or in the
    current folder, which was the default before.
    """
    named, real = _named(photos), photos.resolve()
    beside, beside_real = _beside(named), _beside(real)
    telling = Path.cwd() / "_".join(part for part in (real.parent.name, beside_real.name) if part)
    for folder in dict.fromkeys((beside, beside_real, telling, Path.cwd() / beside_real.name)):
        if _is_of(folder, real):
            return DefaultWorkspace(folder, "" if folder == beside else "these photos were reconstructed there before")
    for folder in dict.fromkeys((beside, beside_real)):
        if folder.exists() or os.access(folder.parent, os.W_OK | os.X_OK):
            return DefaultWorkspace(folder, "" if folder == beside else f"{beside.parent} cannot be written")
    return DefaultWorkspace(telling, f"{beside.parent} cannot be written")


def _named(photos: Path) -> Path:
    """Absolute as it was named, through links; `..` after a link is what the system says."""
    return photos.resolve() if ".." in photos.parts else photos.absolute()


def _beside(photos: Path) -> Path:
    name = photos.stem if photos.is_file() else photos.name
    return photos.parent / f"{readable(name)}{WORKSPACE_SUFFIX}"


def _is_of(folder: Path, photos: Path) -> bool:
    """Whether the folder is a workspace that was last run with these photos."""
    with suppress(WorkspaceError):
        return Workspace.open(folder).record.sources.get("photos") == str(photos)
    return False


# ---------------------------------------------------------------- what was moved
def find_source(workspace: Workspace, name: str, photos: Path | None = None) -> Path | None:
    """Where the photos, masks or poses of the last run lie now; where they were, if they are nowhere to be found.

    They are looked for in their old place, then as they lay relative to the workspace, if that was moved, and as they
    lay relative to the photos, if `photos` are in another place than before.
    """
    recorded = workspace.record.sources.get(name)
    if recorded is None:
        return None
    moved = (place for place in _moved_places(workspace, Path(recorded), photos) if os.path.exists(place))
    return Path(recorded) if os.path.exists(recorded) else next(moved, Path(recorded))


def _moved_places(workspace: Workspace, recorded: Path, photos: Path | None) -> Iterator[Path]:
    was, photos_were = workspace.record.root, workspace.record.sources.get("photos")
    if was and was != str(workspace.root):
        yield (workspace.root / os.path.relpath(recorded, was)).resolve()
    if photos is not None and photos_were and photos_were != str(photos):
        yield (photos / os.path.relpath(recorded, photos_were)).resolve()


def holds_files(path: Path) -> bool:
    """Whether there is a file at all: not in a folder that was emptied, nor where a disk is no longer mounted."""
    return os.path.isfile(path) or (os.path.isdir(path) and bool(named_files(path)[0]))


# ---------------------------------------------------------------- other photos
def photos_since(workspace: Workspace, folder: Path, now: FileDigests) -> PhotosSince:
    """Compare the photos of now with those that the workspace's publications were made of.

    Args:
        workspace: with its record; read only.
        folder: where the photos of now lie (or the video), absolute and without links, as the record has it.
        now: their contents, see `SourceDigests.files`.
    """
    try:
        made = workspace.published(IMAGE_SET.stage)
    except ManifestDamaged:
        made = None
    before = made.identity.sources.get("photos") if made else None
    if before is None:
        return PhotosSince("new", added=tuple(now))
    return compare_photos(before, now, same_folder=workspace.record.sources.get("photos") == str(folder))


def refuse_other_photos(workspace: Workspace, photos: Path, since: PhotosSince) -> None:
    """Raises WorkspaceError where the workspace was made of other photos: its results would be lost."""
    if since.kind != "other":
        return
    before = workspace.record.sources.get("photos")
    came_from = "" if before in (None, str(photos)) else f", from {before},"
    raise WorkspaceError(
        f"The workspace {workspace.root} was made of other photos: {len(since.kept)} of its "
        f"{len(since.kept) + len(since.removed)} files{came_from} are among the "
        f"{len(since.kept) + len(since.added)} in {photos}.",
        f"Keep it and use another one: `--workspace {shlex.quote(str(_free(_beside(photos))))}`; or replace its "
        "results: `--other-photos`.",
    )


def _free(folder: Path) -> Path:
    """The first of NAME_hineus, NAME_2_hineus, NAME_3_hineus, ... that is not there."""
    stem, number, free = folder.name.removesuffix(WORKSPACE_SUFFIX), 1, folder
    while free.exists():
        number += 1
        free = folder.with_name(f"{stem}_{number}{WORKSPACE_SUFFIX}")
    return free
