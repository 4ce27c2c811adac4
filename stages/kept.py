"""What a run keeps of a workspace whose photos came or went since it was made, said before it starts."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import PurePosixPath

from configs.params import Config
from stages import artifacts
from stages.engine.fingerprint import FileDigests
from stages.engine.manifest import ManifestDamaged
from stages.engine.photos_since import compare_photos
from stages.engine.status import previous_to_continue
from stages.engine.workspace import Workspace
from stages.ingest import INGEST
from stages.inputs.formats import PHOTO_SUFFIXES, RAW_SUFFIXES, VIDEO_SUFFIXES
from stages.posing.adding import enough_placed
from stages.sfm import SFM
from stages.train import TRAIN, little_changed


def what_is_kept(workspace: Workspace, config: Config, now: FileDigests, forced: Collection[str] = ()) -> str:
    """A sentence on known, new and gone photos, and what is kept of them; empty where none came or went.

    What the stages find may still be otherwise, and they say so: new photos that do not connect, or cannot be read.

    Args:
        now: the photos' files, see `SourceDigests.files`.
        forced: stages that run anew in any case.
    """
    try:
        made = workspace.published(INGEST.name)
    except ManifestDamaged:
        return ""
    before = made.identity.sources.get("photos") if made else None
    if not before:
        return ""
    since = compare_photos(before, now, same_folder=True)
    new = [path for path in since.added if _is_capture(path)]
    gone = [path for path in since.removed if _is_capture(path)]
    if not new and not gone:
        return ""
    known = [path for path in since.kept if _is_capture(path)]
    counts = f"{len(known)} photos known, {len(new)} new, {len(gone)} gone"
    return f"{counts}: {_of_poses_and_training(workspace, config, set(since.kept), len(new), len(gone), forced)}"


def _of_poses_and_training(
    workspace: Workspace, config: Config, known: set[str], new: int, gone: int, forced: Collection[str]
) -> str:
    if SFM.name in forced or previous_to_continue(SFM, workspace, config) is None:
        return "poses are found anew from all"
    records = artifacts.IMAGE_SET.load(workspace.stage_folder(INGEST.name)).images
    placed = set(artifacts.REGISTRATION.load(workspace.stage_folder(SFM.name)).registered)
    kept = sum(record.name in placed and record.source in known for record in records)
    if not artifacts.FEATURES.load(workspace.stage_folder(SFM.name)).exists() or not enough_placed(
        kept, len(known) + new
    ):
        return f"poses are found anew from all, since {kept} of them have one"
    poses = f"the poses of {kept} stay"
    if TRAIN.name in forced or previous_to_continue(TRAIN, workspace, config) is None:
        return poses
    trained = len(artifacts.SCENE.load(workspace.stage_folder(TRAIN.name)).cameras)
    goes_on = little_changed(new + gone, trained) and not config.train.hold_out
    return f"{poses}, training {'goes on from what it has learned' if goes_on else 'starts anew'}"


def _is_capture(path: str) -> bool:
    return PurePosixPath(path).suffix.lower() in PHOTO_SUFFIXES | RAW_SUFFIXES | VIDEO_SUFFIXES
