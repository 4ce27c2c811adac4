"""One tileset over those of several workspaces."""

from __future__ import annotations

import os
from collections.abc import Sequence
from itertools import chain
from pathlib import Path
from typing import Any
from urllib.parse import quote

from stages import artifacts
from stages.artifacts.blocks import block_folder, read_plan
from stages.engine.damage import damage_named
from stages.engine.workspace import Workspace, storage_errors
from stages.errors import InputError, WorkspaceError
from stages.export import EXPORT
from stages.files.tiles_3d import joined


def join_tilesets(workspaces: Sequence[Path], out: Path) -> dict[str, Any]:
    """Write `out`, which names the workspaces' own tilesets relative to its folder. Returns how many, and its extent.

    Of one that is cut into blocks, those of the blocks.

    Raises:
        WorkspaceError: there is no workspace, or one has no tileset, or a damaged one.
        InputError: they do not share a frame, or `out` is one of them.
    """
    tilesets = {}
    for each in chain.from_iterable(map(_parts, workspaces)):
        opened = Workspace.open(each)
        path = opened.stage_folder(EXPORT.name) / artifacts.TILESET
        if not path.is_file():
            raise WorkspaceError(
                f"{opened.root} has no 3D Tiles.",
                f"Make them: `hineus run --workspace {opened.root} --set export.tiles=true`.",
            )
        if path.resolve() == out.resolve():
            raise InputError(f"{out} is the tileset of {opened.root}.", "Name another file: `--out tileset.json`.")
        with damage_named(opened, (EXPORT.name,)):
            tilesets[quote(Path(os.path.relpath(path, out.parent)).as_posix())] = artifacts.read_json(path)
    try:
        together = joined(tilesets)
    except ValueError as error:
        raise InputError(
            f"There is no tileset over these workspaces: {error}.",
            "Those that lie on the Earth, by GPS or control points, can be joined, and blocks of one workspace.",
        ) from error
    with storage_errors(out, "writing the tileset"):
        out.parent.mkdir(parents=True, exist_ok=True)
        artifacts.write_json(out, together)
    return {"file": str(out.absolute()), "tiles": len(tilesets), "geometric_error": together["geometricError"]}


def _parts(workspace: Path) -> list[Path]:
    """The workspaces of its blocks, or itself where it is not cut into any."""
    plan = read_plan(workspace)
    return [workspace] if plan is None else [block_folder(workspace, block.name) for block in plan.blocks]
