"""Whether a stage's publication is still good, and if not, why."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from pydantic import BaseModel

from stages.engine.fingerprint import FileDigests, Identity, SourceDigests
from stages.engine.manifest import Manifest, ManifestDamaged, jsonable, output_problem
from stages.engine.stage import Stage
from stages.engine.workspace import Workspace


@dataclass(frozen=True)
class StageStatus:
    """How a stage stands.

    Attributes:
        name: of the stage.
        state: fresh: published and nothing it depends on has changed; stale: published, but something has;
            missing: not published, or damaged.
        reasons: why it is not fresh, in words; empty where it is.
        manifest: the publication's, if there is a readable one.
        identity: what the result would depend on now; None while a stage it needs is not fresh itself.
    """

    name: str
    state: Literal["fresh", "stale", "missing"]
    reasons: tuple[str, ...] = ()
    manifest: Manifest | None = None
    identity: Identity | None = None

    @property
    def reason(self) -> str:
        return "; ".join(self.reasons) or "nothing changed"


def stage_status(
    stage: Stage,
    workspace: Workspace,
    config: BaseModel,
    digests: SourceDigests,
    earlier: Mapping[str, StageStatus],
    hashes: bool = False,
) -> StageStatus:
    """How `stage` stands, given how the stages it needs stand.

    Args:
        earlier: status of (at least) every stage that `stage` needs.
        hashes: read every output back and compare its hash; sizes are always compared.

    Raises:
        InputError: a source cannot be read.
    """
    manifest, damage = _publication(stage, workspace, hashes)
    waiting = [earlier[name] for name in stage.needs if earlier[name].state != "fresh"]
    before = manifest.identity if manifest else None
    identity = _identity_now(stage, config, digests, earlier, before)
    reasons = [damage] if damage else []
    if before is not None:
        # Of a stage that will run again only the run itself can tell whether its outputs change.
        settled = {status.name for status in waiting}
        now = Identity(
            identity.stage,
            identity.version,
            identity.params,
            {**identity.inputs, **{name: before.inputs[name] for name in settled & set(before.inputs)}},
            identity.sources,
        )
        reasons += now.changes_since(before, stage.params)
        reasons += [f"input stage {status.name} is {status.state}" for status in waiting]
    elif not damage:
        reasons.append("not made yet")
    known = None if waiting else identity
    if not reasons:
        return StageStatus(stage.name, "fresh", (), manifest, known)
    state: Literal["stale", "missing"] = "missing" if manifest is None or damage else "stale"
    return StageStatus(stage.name, state, tuple(reasons), manifest, known)


def pipeline_status(
    pipeline: Sequence[Stage],
    workspace: Workspace,
    config: BaseModel,
    digests: SourceDigests,
    hashes: bool = False,
) -> list[StageStatus]:
    """How every stage stands. Reads only, so it needs no lock."""
    statuses: dict[str, StageStatus] = {}
    for stage in pipeline:
        statuses[stage.name] = stage_status(stage, workspace, config, digests, statuses, hashes)
    return list(statuses.values())


def _publication(stage: Stage, workspace: Workspace, hashes: bool) -> tuple[Manifest | None, str | None]:
    try:
        manifest = workspace.published(stage.name)
    except ManifestDamaged as error:
        return None, f"manifest damaged ({error})"
    if manifest is None:
        return None, None
    return manifest, output_problem(workspace.stage_folder(stage.name), manifest, hashes)


def _identity_now(
    stage: Stage,
    config: BaseModel,
    digests: SourceDigests,
    earlier: Mapping[str, StageStatus],
    before: Identity | None,
) -> Identity:
    published = {name: earlier[name].manifest for name in stage.needs}
    return Identity(
        stage=stage.name,
        version=stage.version,
        params=jsonable(stage.settings(config).model_dump(mode="json")),
        inputs={name: manifest.outputs_digest for name, manifest in published.items() if manifest},
        sources={name: _source_files(name, digests, before) for name in stage.sources},
    )


def _source_files(name: str, digests: SourceDigests, before: Identity | None) -> FileDigests | None:
    # Photos that are no longer there are no reason to lose what was made from them.
    if before is not None and name in before.sources and not digests.available(name):
        return before.sources[name]
    return digests.files(name)
