"""Whether a stage's publication is still good, and if not, why."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

from pydantic import BaseModel

from configs.renames import section_with_new_names
from stages.engine.damage import published_whole
from stages.engine.fingerprint import RUN_KEY, FileDigests, Identity, SourceDigests, digest, manifest_key
from stages.engine.manifest import CHEAP_BYTES, Manifest, ManifestDamaged, jsonable, output_problem
from stages.engine.stage import Stage
from stages.engine.workspace import Workspace
from stages.errors import WorkspaceError

MAX_REASONS = 3


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
        """The reasons in one line; past the first few they are counted."""
        more = len(self.reasons) - MAX_REASONS
        named = self.reasons[:MAX_REASONS] + ((f"and {more} more",) if more > 0 else ())
        return "; ".join(named) or "nothing changed"


@dataclass(frozen=True)
class Present:
    """What publications are compared with: those in the workspace, all settings of now, and the sources' files."""

    workspace: Workspace
    config: BaseModel
    digests: SourceDigests


def stage_status(
    stage: Stage[Any], present: Present, earlier: Mapping[str, StageStatus], hashes: bool = False
) -> StageStatus:
    """How `stage` stands, given how the stages it needs stand.

    Args:
        earlier: status of (at least) every stage that `stage` needs.
        hashes: read every output back and compare its hash; those of small files are always compared, and sizes.

    Raises:
        InputError: a source cannot be read.
    """
    manifest, damage = _publication(stage, present.workspace, hashes)
    waiting = [earlier[name] for name in stage.needs if earlier[name].state != "fresh"]
    before = manifest.identity if manifest else None
    identity = _identity_now(stage, present, earlier, before)
    reasons = [damage] if damage else []
    if before is not None:
        # Of a stage that will run again only the run itself can tell whether its outputs change.
        params = section_with_new_names(stage.name, before.params)
        before = replace(before, params=params, inputs=_by_artifact(before.inputs, stage, earlier))
        unsettled = {name: old for name, old in before.inputs.items() if _owner(name) in {s.name for s in waiting}}
        reasons += replace(identity, inputs={**identity.inputs, **unsettled}).changes_since(before)
        reasons += [f"input stage {status.name} is {status.state}" for status in waiting]
    elif not damage:
        reasons.append("not made yet")
    known = None if waiting else identity
    if not reasons:
        return StageStatus(stage.name, "fresh", (), manifest, known)
    state: Literal["stale", "missing"] = "missing" if manifest is None or damage else "stale"
    return StageStatus(stage.name, state, tuple(reasons), manifest, known)


def previous_to_continue(
    stage: Stage[Any], workspace: Workspace, config: BaseModel, hashes: bool = True
) -> Manifest | None:
    """The publication that a run of the stage would go on from: whole, and of the same version and settings.

    Args:
        hashes: read every output back and compare its hash; those of small files are always compared, and sizes.
    """
    if not stage.continues:
        return None
    made = sound_publication(stage, workspace, hashes)
    if made is None:
        return None
    before = made.identity
    alike = section_with_new_names(stage.name, before.params) == _params(stage, config)
    return made if alike and before.version == stage.version else None


def sound_publication(stage: Stage[Any], workspace: Workspace, hashes: bool = False) -> Manifest | None:
    """The manifest of what the stage published; None where there is nothing, or it is damaged."""
    made, damage = _publication(stage, workspace, hashes)
    return None if damage else made


def pipeline_status(pipeline: Sequence[Stage[Any]], present: Present, hashes: bool = False) -> list[StageStatus]:
    """How every stage stands. Reads only, so it needs no lock."""
    statuses: dict[str, StageStatus] = {}
    for stage in pipeline:
        statuses[stage.name] = stage_status(stage, present, statuses, hashes)
    return list(statuses.values())


def replaced_inputs(stage: Stage[Any], workspace: Workspace) -> list[str]:
    """The artifacts that the publication of `stage` was made from and that are no longer those in the workspace.

    Raises:
        WorkspaceError: a manifest is damaged; it names the stage to run again.
    """
    manifest = published_whole(workspace, stage.name)
    made_from = manifest.identity.inputs if manifest else {}
    replaced = []
    for artifact in stage.reads:
        now = published_whole(workspace, artifact.stage)
        if now is None or made_from.get(artifact.name) != now.artifact_digest(artifact):
            replaced.append(artifact.name)
    return replaced


def check_current(workspace: Workspace, stages: Sequence[Stage[Any]], what: str, options: str) -> None:
    """
    Args:
        what: the stages make, in words.
        options: of `hineus run` that make it.

    Raises:
        WorkspaceError: a stage is missing, damaged, or was made from others than the workspace now holds.
    """
    if any(replaced_inputs(stage, workspace) for stage in stages):
        command = f"hineus run --workspace {shlex.quote(str(workspace.root))} {options}"
        raise WorkspaceError(f"The workspace {workspace.root} has no {what}.", f"Make it: `{command}`.")


def _publication(stage: Stage[Any], workspace: Workspace, hashes: bool) -> tuple[Manifest | None, str | None]:
    try:
        manifest = workspace.published(stage.name)
    except ManifestDamaged as error:
        return None, f"manifest damaged ({error})"
    if manifest is None:
        return None, None
    most = None if hashes else CHEAP_BYTES
    return manifest, output_problem(workspace.stage_folder(stage.name), manifest, most)


def _identity_now(
    stage: Stage[Any], present: Present, earlier: Mapping[str, StageStatus], before: Identity | None
) -> Identity:
    record, config = present.workspace.record, present.config
    inputs = _artifact_digests(stage, earlier)
    for name in stage.reads_manifests:
        if manifest := earlier[name].manifest:
            inputs[manifest_key(name)] = digest(manifest.to_json())
    if stage.reads_run:
        started = [dict(record.sources), record.preset, config.model_dump(mode="json")]
        inputs[RUN_KEY] = digest(jsonable(started))
    return Identity(
        stage=stage.name,
        version=stage.version,
        params=_params(stage, config),
        inputs=inputs,
        sources={name: _source_files(name, present.digests, before) for name in stage.sources},
        previous=before.previous if before else None,
    )


def _params(stage: Stage[Any], config: BaseModel) -> dict[str, Any]:
    params: dict[str, Any] = jsonable(stage.settings(config).model_dump(mode="json"))
    return params


def _artifact_digests(stage: Stage[Any], earlier: Mapping[str, StageStatus]) -> dict[str, str]:
    found = ((artifact, earlier[artifact.stage].manifest) for artifact in stage.reads)
    return {artifact.name: manifest.artifact_digest(artifact) for artifact, manifest in found if manifest}


def _owner(name: str) -> str:
    """The stage that an input is from."""
    return name.partition("/")[0]


def _by_artifact(inputs: Mapping[str, str], stage: Stage[Any], earlier: Mapping[str, StageStatus]) -> dict[str, str]:
    """Inputs as they are written now; 0.1.0 wrote one digest for all that a stage published."""
    whole = {name for name, value in inputs.items() if "/" not in name and name != RUN_KEY}
    known = {name: manifest for name in whole & set(earlier) if (manifest := earlier[name].manifest)}
    same = {name for name, manifest in known.items() if manifest.outputs_digest == inputs[name]}
    kept = {name: value for name, value in inputs.items() if name not in same}
    return kept | {name: value for name, value in _artifact_digests(stage, earlier).items() if _owner(name) in same}


def _source_files(name: str, digests: SourceDigests, before: Identity | None) -> FileDigests | None:
    # Photos that are no longer there are no reason to lose what was made from them; an empty folder is where a disk
    # was mounted.
    files = digests.files(name) if digests.available(name) else {}
    if files == {} and before is not None and name in before.sources:
        return before.sources[name]
    return digests.files(name)
