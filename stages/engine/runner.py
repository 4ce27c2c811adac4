"""Runs a pipeline on a workspace: what is fresh is skipped, the rest is run and published, and says why."""

from __future__ import annotations

import logging
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel

from stages.artifacts.blocks import FROM_WHOLE
from stages.engine.damage import damage_named
from stages.engine.fingerprint import Identity, SourceDigests
from stages.engine.guard import allocations_end_at_the_limit
from stages.engine.manifest import Manifest, current_versions, describe_outputs, jsonable, now
from stages.engine.resources import ResourceMeter
from stages.engine.shortage import ShortageError, shortage
from stages.engine.stage import Stage, StageContext
from stages.engine.status import Present, StageStatus, previous_to_continue, stage_status
from stages.engine.system import requirement_error
from stages.engine.workspace import Workspace, disk_full_error, is_disk_full, storage_errors
from stages.errors import ConfigError, HineusError, InputError, did_you_mean

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class StageOutcome:
    """What became of one stage.

    Attributes:
        name: of the stage.
        action: "ran", or "skipped" because it was fresh.
        reason: why it ran, or why it did not, in words.
        numbers: what the stage returned (when it was made, if it was skipped now).
        wall_s, cpu_s: seconds it took to make.
        peak_rss: bytes, the highest while it was made.
    """

    name: str
    action: Literal["ran", "skipped"]
    reason: str
    numbers: Mapping[str, Any] = field(default_factory=dict)
    wall_s: float = 0.0
    cpu_s: float = 0.0
    peak_rss: int = 0

    @staticmethod
    def of(made: Manifest, action: Literal["ran", "skipped"], reason: str) -> StageOutcome:
        """Of a stage as its manifest has it."""
        return StageOutcome(made.identity.stage, action, reason, made.numbers, made.wall_s, made.cpu_s, made.peak_rss)


class Listener:
    """Told what the runner does, and ignores it. The console's draws it."""

    def stage_started(self, stage: Stage[Any], reason: str) -> None: ...

    def stage_progress(self, stage: Stage[Any], done: float, total: float, note: str) -> None: ...

    def stage_finished(self, stage: Stage[Any], outcome: StageOutcome) -> None: ...


def run_pipeline(
    pipeline: Sequence[Stage[Any]],
    workspace: Workspace,
    config: BaseModel,
    sources: Mapping[str, Path | None],
    device: str = "cpu",
    workers: int = 1,
    from_stage: str | None = None,
    until: str | None = None,
    force: Sequence[str] = (),
    listener: Listener | None = None,
    preset: str | None = None,
) -> list[StageOutcome]:
    """Bring the workspace up to date, stage by stage.

    Args:
        pipeline: stages in order; each needs only earlier ones.
        workspace: held (locked) for the whole run.
        config: all settings.
        sources: name -> outside path, None where not given.
        device: "cpu" or "cuda".
        workers: CPU threads a stage may use.
        from_stage: this stage and those after it run even if fresh; those before it only if they need to.
        until: the last stage to bring up to date.
        force: stages that run even if fresh.
        listener: told what happens.
        preset: name to remember with the settings.

    Returns:
        One outcome per stage up to `until`.

    Raises:
        HineusError: a child by what the user can do. What earlier stages published stays.
    """
    listener = listener or Listener()
    selected, forced = _select(pipeline, from_stage, until, force)
    outcomes = []
    with workspace.lock():
        workspace.remember(sources, preset, config.model_dump(mode="json"))
        present = Present(workspace, config, SourceDigests(sources, workspace.digest_cache))
        statuses: dict[str, StageStatus] = {}
        for stage in pipeline:  # first, so that what is being written from here on is this run's
            workspace.recover(stage.name)
        for stage in selected:
            status = stage_status(stage, present, statuses)
            with storage_errors(workspace.root, "keeping the photos' digests"):
                present.digests.save()
            if status.state == "fresh" and stage.name not in forced:
                assert status.manifest is not None  # a fresh stage has one
                outcome = StageOutcome.of(status.manifest, "skipped", status.reason)
            else:
                reason = forced[stage.name] if status.state == "fresh" else status.reason
                listener.stage_started(stage, reason)
                previous = None
                if stage.name not in forced:
                    previous = previous_to_continue(stage, workspace, config)
                manifest = _run_stage(stage, present, status, previous, device, workers, listener)
                outcome = StageOutcome.of(manifest, "ran", reason)
                status = StageStatus(stage.name, "fresh", (), manifest, manifest.identity)
            statuses[stage.name] = status
            log.debug("%s %s: %s", stage.name, outcome.action, outcome.reason)
            listener.stage_finished(stage, outcome)
            outcomes.append(outcome)
    return outcomes


def naming_command(source: str, root: Path) -> str:
    """The command that names the place of an outside path ("photos", "masks") to the workspace at `root`.

    What a block of a large scene knows of the others is not named, but given by the whole.
    """
    if source in FROM_WHOLE:
        return f"hineus blocks {shlex.quote(str(root.parent.parent))}"
    named = "PHOTOS" if source == "photos" else f"{source_option(source)} PATH"
    return f"hineus run {named} --workspace {shlex.quote(str(root))}"


def source_option(source: str) -> str:
    """The option that names an outside path: `--control` for "control points"."""
    return f"--{source.partition(' ')[0]}"


def _select(
    pipeline: Sequence[Stage[Any]], from_stage: str | None, until: str | None, force: Sequence[str]
) -> tuple[Sequence[Stage[Any]], dict[str, str]]:
    """The stages up to `until`, and for each that must run even if fresh, the reason."""
    names = [stage.name for stage in pipeline]
    asked = [("--from", from_stage), ("--until", until), *(("--force", name) for name in force)]
    for option, name in asked:
        if name is not None and name not in names:
            guess = did_you_mean(name, names, f"{option} {{}}")
            raise ConfigError(f"There is no stage '{name}' ({option}).", f"{guess}The stages are {', '.join(names)}.")
    last = names.index(until) if until else len(names) - 1
    first = names.index(from_stage) if from_stage else len(names)
    for option, name in asked:
        if name is not None and names.index(name) > last:
            raise ConfigError(
                f"{option} {name} comes after --until {until}, so it would never run.", "Drop one of the two."
            )
    forced = {name: f"asked for by --from {from_stage}" for name in names[first : last + 1]}
    forced |= {name: f"asked for by --force {name}" for name in force}
    return pipeline[: last + 1], forced


def _run_stage(
    stage: Stage[Any],
    present: Present,
    status: StageStatus,
    previous: Manifest | None,
    device: str,
    workers: int,
    listener: Listener,
) -> Manifest:
    workspace, config, digests = present.workspace, present.config, present.digests
    identity = status.identity
    if identity is None:
        raise ValueError(f"stage {stage.name} was asked to run before the stages it needs: {status.reason}")
    identity = replace(identity, previous=previous.digest if previous else None)
    given = {name: path for name in stage.sources if (path := digests.sources.get(name)) is not None}
    for name, path in given.items():
        if not digests.available(name):
            raise InputError(
                f"Stage {stage.name} must run ({status.reason}), but its {name} are not at {path} any more.",
                f"Bring them back, or name the new place: `{naming_command(name, workspace.root)}`.",
            )

    def progress(done: float, total: float, note: str = "") -> None:
        listener.stage_progress(stage, done, total, note)

    out, scratch = workspace.begin(stage.name, identity.fingerprint)
    context = StageContext(
        inputs={artifact.stage: workspace.stage_folder(artifact.stage) for artifact in stage.reads},
        sources=given,
        out=out,
        scratch=scratch,
        params=stage.settings(config),
        device=device,
        workers=workers,
        progress=progress,
        digests={name: files for name in given if (files := digests.files(name)) is not None},
        reads=stage.reads,
        manifests={name: manifest for name in stage.reads_manifests if (manifest := workspace.published(name))},
        record=workspace.record if stage.reads_run else None,
        config=config if stage.reads_run else None,
        previous=workspace.stage_folder(stage.name) if previous else None,
    )
    with ResourceMeter() as meter, allocations_end_at_the_limit():
        numbers = _call_with_less(stage, context, present, status)
    if changed := _changed_source(stage, digests):
        log.warning("%s while stage %s read it: the next run takes it in anew", changed, stage.name)
    _tell_warnings(numbers, workspace.root)
    manifest = _describe(identity, out, numbers, meter, workspace)
    _check_outputs(stage, manifest)
    workspace.publish(stage.name, manifest)
    return manifest


def _call_with_less(
    stage: Stage[Any], context: StageContext[Any], present: Present, status: StageStatus
) -> Mapping[str, Any]:
    """Run the stage; where memory runs out, once more with one thread: each holds a photo or a block of its own."""
    try:
        return _call(stage, context, present, status)
    except ShortageError as short:
        if context.workers == 1:
            raise
        log.warning("%s It is tried once more with one thread in place of %d.", short.message, context.workers)
    # Out here the error, and all that its frames held, is gone.
    with storage_errors(present.workspace.root, f"starting '{stage.name}'"):
        context.out.mkdir()
    return _call(stage, replace(context, workers=1), present, status)


def _call(stage: Stage[Any], context: StageContext[Any], present: Present, status: StageStatus) -> Mapping[str, Any]:
    """Run the stage; tell of damaged or changed input, a full disk, a missing library or memory in the user's terms."""
    workspace = present.workspace
    own = [stage.name] if context.previous else []
    try:
        with damage_named(workspace, [*stage.needs, *own]):
            return stage.run(context) or {}
    except HineusError:
        workspace.discard(stage.name)
        raise
    except Exception as error:
        log.debug("stage %s failed", stage.name, exc_info=True)
        # Asked before the discard, which frees space.
        full = is_disk_full(error, workspace.root)
        written = sum(path.stat().st_size for path in context.out.rglob("*") if path.is_file())
        workspace.discard(stage.name)
        if full:
            # The last publication is the best guess at how much this one needs.
            needed = max(status.manifest.size - written if status.manifest else 0, written, 1)
            raise disk_full_error(workspace.root, f"running '{stage.name}'", error, needed) from error
        if changed := _changed_source(stage, present.digests):
            raise InputError(
                f"{changed} while stage {stage.name} read it.", "Run the same command again when nothing writes there."
            ) from error
        who = f"Stage {stage.name}"
        if wanted := requirement_error(error, who) or shortage(error, who):
            raise wanted from error
        raise


def _changed_source(stage: Stage[Any], digests: SourceDigests) -> str:
    """Which file of the stage's sources is not as it was when the run began, in words; empty where all are."""
    for name in stage.sources:
        if (path := digests.changed_since(name)) is not None:
            return f"{path} was {'changed' if path.exists() else 'removed'}"
    return ""


def _tell_warnings(numbers: Mapping[str, Any], root: Path) -> None:
    """Those with a command to try. Results know no paths: the workspace is named here, and by the report's page."""
    for warning in numbers.get("warnings", ()):
        if command := warning.get("command"):
            named = command.replace("--workspace WORKSPACE", f"--workspace {shlex.quote(str(root))}")
            log.warning("%s Try: `%s`", warning["sentence"], named)


def _check_outputs(stage: Stage[Any], manifest: Manifest) -> None:
    """Raises ValueError where the stage published other things than it declares."""
    strange = [path for path in manifest.outputs if not any(artifact.covers(path) for artifact in stage.writes)]
    missing = [
        artifact.name
        for artifact in stage.writes
        if not artifact.optional and not any(artifact.covers(path) for path in manifest.outputs)
    ]
    if strange or missing:
        raise ValueError(f"stage {stage.name} wrote {strange} without declaring it, and did not write {missing}")


def _describe(
    identity: Identity, out: Path, numbers: Mapping[str, Any], meter: ResourceMeter, workspace: Workspace
) -> Manifest:
    with storage_errors(workspace.root, f"reading back '{identity.stage}'"):
        outputs = describe_outputs(out)
    return Manifest(
        identity=identity,
        outputs=outputs,
        numbers=jsonable(numbers),
        wall_s=meter.wall_s,
        cpu_s=meter.cpu_s,
        peak_rss=meter.peak_rss,
        versions=current_versions(),
        created=now(),
    )
