"""From a workspace to a folder that other programs read: which stages it needs, and where it may be written."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from stages.engine.damage import damage_named
from stages.engine.status import replaced_inputs
from stages.engine.workspace import Workspace, storage_errors
from stages.errors import InputError, WorkspaceError
from stages.place import PLACE
from stages.sfm import SFM
from stages.undistort import UNDISTORT

Writer = Callable[[Path, Path, Path, Path], dict[str, Any]]


def export_poses(workspace: Path, out: Path, write: Writer) -> dict[str, Any]:
    """Write with `write`, one of `stages.posing.exporting`, into the empty or absent folder `out`.

    Raises:
        WorkspaceError: there is no workspace, it has no undistorted photos, or they are of other poses, or
            damaged.
        InputError: `out` holds something.
    """
    opened = Workspace.open(workspace)
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InputError(f"{out} is there already.", "Name a new or empty folder.")
    if replaced_inputs(UNDISTORT, opened) or replaced_inputs(PLACE, opened):
        raise WorkspaceError(
            f"The workspace {opened.root} has no undistorted photos of its present poses.",
            f"Make them: `hineus undistort --workspace {opened.root}`.",
        )
    stages = (UNDISTORT.name, SFM.name, PLACE.name)
    with storage_errors(out, "writing the poses"), damage_named(opened, stages):
        out.mkdir(parents=True, exist_ok=True)
        undistort, sfm, place = map(opened.stage_folder, stages)
        return write(undistort, sfm, place, out)
