"""Damage of what was published: looked for where something fails, and told with the stage that mends it."""

from __future__ import annotations

import shlex
from collections.abc import Iterable, Iterator
from contextlib import contextmanager

from stages.engine.manifest import ManifestDamaged, output_problem
from stages.engine.workspace import Workspace
from stages.errors import WorkspaceError


@contextmanager
def damage_named(workspace: Workspace, stages: Iterable[str]) -> Iterator[None]:
    """Where something fails inside, all that these stages published is read back and compared with its hashes first.

    Raises:
        WorkspaceError: a file is not as it was published; it names the file and the stage to run again.
    """
    try:
        yield
    except Exception as error:
        for stage in stages:
            if problem := _problem(workspace, stage):
                root = workspace.root
                raise WorkspaceError(
                    f"{root / stage} is not as it was published: {problem}.",
                    f"Make it again: `hineus run --workspace {shlex.quote(str(root))} --force {stage}`.",
                ) from error
        raise


def _problem(workspace: Workspace, stage: str) -> str | None:
    try:
        manifest = workspace.published(stage)
    except ManifestDamaged as error:
        return f"manifest damaged ({error})"
    if manifest is None:
        return "it is gone"
    return output_problem(workspace.stage_folder(stage), manifest, hashes=True)
