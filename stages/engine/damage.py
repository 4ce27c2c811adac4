"""Damage of what was published: looked for before it is used, and told with the stage that mends it."""

from __future__ import annotations

import shlex
from collections.abc import Collection, Iterator
from contextlib import contextmanager

from stages.engine.manifest import ManifestDamaged, output_problem
from stages.engine.workspace import Workspace
from stages.errors import WorkspaceError

ENOUGH_BYTES = 1 << 30  # of the smallest files are read back before use: it takes a second


@contextmanager
def damage_named(workspace: Workspace, stages: Collection[str]) -> Iterator[None]:
    """What these stages published is compared with its hashes before it is used, and again where that fails.

    Before, since on damaged files some libraries hang or take all memory; large pictures are left for later.

    Raises:
        WorkspaceError: a file is not as it was published; it names the file and the stage to run again.
    """
    _refuse_damage(workspace, stages, ENOUGH_BYTES)
    try:
        yield
    except Exception as error:
        _refuse_damage(workspace, stages, None, error)
        raise


def _refuse_damage(
    workspace: Workspace, stages: Collection[str], most: int | None, cause: Exception | None = None
) -> None:
    for stage in stages:
        if problem := _problem(workspace, stage, most):
            root = workspace.root
            raise WorkspaceError(
                f"{root / stage} is not as it was published: {problem}.",
                f"Make it again: `hineus run --workspace {shlex.quote(str(root))} --force {stage}`.",
            ) from cause


def _problem(workspace: Workspace, stage: str, most: int | None) -> str | None:
    folder = workspace.stage_folder(stage)
    try:
        manifest = workspace.published(stage)
    except ManifestDamaged as error:
        return f"manifest damaged ({error})"
    if manifest is None:
        return None if folder.is_dir() else "it is gone"
    return output_problem(folder, manifest, most)
