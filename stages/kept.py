"""What a run keeps of a workspace whose photos came or went since it was made, said before it starts."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path, PurePosixPath

from configs.params import Config
from stages import artifacts
from stages.capture.listing import list_captures
from stages.capture.mask_names import set_masks_aside
from stages.engine.fingerprint import FileDigests
from stages.engine.manifest import ManifestDamaged
from stages.engine.status import previous_to_continue, sound_publication
from stages.engine.workspace import Workspace
from stages.errors import WorkspaceError
from stages.ingest import INGEST
from stages.posing.adding import enough_placed
from stages.sfm import SFM
from stages.train import TRAIN, little_changed


def what_is_kept(
    workspace: Workspace,
    config: Config,
    source: Path | None,
    masks: Path | None,
    now: FileDigests,
    forced: Collection[str] = (),
) -> str:
    """A sentence on known, new and gone photos, and what is kept of them; empty where none came or went.

    What the stages find may still be otherwise, and they say so: new photos that do not connect, or cannot be read.

    Args:
        source, masks: the folder of photos (or a video), and of masks where one is given.
        now: the photos' files, see `SourceDigests.files`.
        forced: stages that run anew in any case.
    """
    try:
        made = sound_publication(INGEST, workspace)
        before = made.identity.sources.get("photos") if made else None
        if not before or not now or source is None:  # photos that are nowhere to be found are not removed
            return ""
        then, today = _taken(workspace, before), _captures(source, masks, now)
        if then == today:
            return _of_a_stopped_run(workspace, config, forced)
        known, new, gone = then & today, today - then, then - today
        if not known or not (new or gone):
            return ""
        left = {path for path, digest in before.items() if digest in known}
        kept = _of_poses_and_training(workspace, config, left, len(new), len(gone), forced)
        return f"{len(known)} photos known, {len(new)} new, {len(gone)} gone: {kept}"
    except (ManifestDamaged, WorkspaceError):  # a file of the workspace is gone or damaged: the stages tell which
        return ""


def _of_poses_and_training(
    workspace: Workspace, config: Config, left: set[str], new: int, gone: int, forced: Collection[str]
) -> str:
    """What is kept where the contents of these photos and videos are `left`, by their names then."""
    posed = workspace.stage_folder(SFM.name)
    if SFM.name in forced or previous_to_continue(SFM, workspace, config, hashes=False) is None:
        return "poses are found anew from all"
    records = artifacts.IMAGE_SET.load(workspace.stage_folder(INGEST.name)).images
    placed = set(artifacts.REGISTRATION.load(posed).registered)
    still = [record for record in records if {record.source, str(PurePosixPath(record.source).parent)} & left]
    kept = sum(record.name in placed for record in still)
    return _of_counts(workspace, config, kept, len(still), new, gone, forced)


def _of_a_stopped_run(workspace: Workspace, config: Config, forced: Collection[str]) -> str:
    """The sentence where photos were taken in already and poses are still of those before; else empty."""
    if SFM.name in forced or previous_to_continue(SFM, workspace, config, hashes=False) is None:
        return ""
    posed = workspace.stage_folder(SFM.name)
    files = artifacts.PHOTO_CONTENTS.load(posed).files
    now = {record.sha256 for record in artifacts.IMAGE_SET.load(workspace.stage_folder(INGEST.name)).images}
    then = {file.sha256 for file in files.values()}
    known, new, gone = len(then & now), len(now - then), len(then - now)
    if not known or not (new or gone):
        return ""
    placed = set(artifacts.REGISTRATION.load(posed).registered)
    kept = sum(file.sha256 in now and name in placed for name, file in files.items())
    said = _of_counts(workspace, config, kept, known, new, gone, forced)
    return f"{known} photos known, {new} new, {gone} gone: {said}"


def _of_counts(
    workspace: Workspace, config: Config, kept: int, still: int, new: int, gone: int, forced: Collection[str]
) -> str:
    """What is kept where `kept` of the photos that are `still` there have a pose."""
    posed = workspace.stage_folder(SFM.name)
    if not (artifacts.FEATURES.load(posed).exists() and enough_placed(kept, still + new)):
        return f"poses are found anew from all, since {kept} of them have one"
    poses = f"the poses of {kept} stay"
    if not workspace.stage_folder(TRAIN.name).exists():
        return poses
    if TRAIN.name in forced or previous_to_continue(TRAIN, workspace, config, hashes=False) is None:
        return f"{poses}, training starts anew"
    trained = len(artifacts.CAMERAS.load(workspace.stage_folder(TRAIN.name)))
    goes_on = little_changed(new + gone, trained) and not config.train.hold_out
    return f"{poses}, training {'goes on from what it has learned' if goes_on else 'starts anew'}"


def _taken(workspace: Workspace, before: FileDigests) -> set[str]:
    """Contents of the photos and videos that were taken in, or left out as photos that are of no use."""
    found = artifacts.IMAGE_SET.load(workspace.stage_folder(INGEST.name))
    names = {item.source for item in found.skipped if not item.expected}
    for record in found.images:  # frames and views lie in a folder with the name of their video or picture
        names |= {record.source, *map(str, PurePosixPath(record.source).parents)}
    return {digest for path, digest in before.items() if path in names}


def _captures(source: Path, masks: Path | None, files: FileDigests) -> set[str]:
    """Contents of the photos and videos that are there now."""
    photos, videos, skipped = list_captures(source, masks if masks is not None and masks.is_dir() else None)
    named = {*set_masks_aside(photos)[0], *videos, *(item.source for item in skipped if not item.expected)}
    return {digest for path, digest in files.items() if path in named}
