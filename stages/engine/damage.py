"""Damage of what was published: looked for before it is used, and told with the stage that mends it."""

from __future__ import annotations

import shlex
from collections.abc import Collection, Iterator
from contextlib import contextmanager

from stages.engine.manifest import Manifest, ManifestDamaged, output_problem
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


def published_whole(workspace: Workspace, stage: str) -> Manifest | None:
    """The manifest of a stage that is published.

    Raises:
        WorkspaceError: it is damaged; it names the stage to run again.
    """
    try:
        return workspace.published(stage)
    except ManifestDamaged as error:
        raise _damaged(workspace, stage, _of_manifest(error)) from error


def _of_manifest(error: ManifestDamaged) -> str:
    return f"manifest damaged ({error})"


def _refuse_damage(
    workspace: Workspace, stages: Collection[str], most: int | None, cause: Exception | None = None
) -> None:
    for stage in stages:
        if problem := _problem(workspace, stage, most):
            raise _damaged(workspace, stage, problem) from cause


def _damaged(workspace: Workspace, stage: str, problem: str) -> WorkspaceError:
    root = workspace.root
    return WorkspaceError(
        f"{root / stage} is not as it was published: {problem}.",
        f"Make it again: `hineus run --workspace {shlex.quote(str(root))} --force {stage}`.",
    )


def _problem(workspace: Workspace, stage: str, most: int | None) -> str | None:
    folder = workspace.stage_folder(stage)
    try:
        manifest = workspace.published(stage)
    except ManifestDamaged as error:
        return _of_manifest(error)
    if manifest is None:
        return None if folder.is_dir() else "it is gone"
    return output_problem(folder, manifest, most)
