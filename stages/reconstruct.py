"""From what the user said to a finished workspace: which folder, photos, settings and device, then the run."""

from __future__ import annotations

import ctypes
import logging
import os
import shlex
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from configs.load import load_config
from configs.params import Config
from stages import artifacts
from stages.artifacts.blocks import FROM_WHOLE
from stages.caches import temporary_files
from stages.capture.listing import is_video
from stages.engine.fingerprint import SourceDigests
from stages.engine.photos_since import PhotosSince
from stages.engine.run_log import log_to_file
from stages.engine.runner import Listener, StageOutcome, naming_command, run_pipeline, source_option
from stages.engine.stage import Stage
from stages.engine.workspace import Workspace, storage_errors
from stages.errors import ConfigError, InputError, SystemRequirementError, WorkspaceError
from stages.files.light_files import GIVEN_LIGHT
from stages.inputs.bounded import reason
from stages.inputs.folders import is_workspace
from stages.kept import what_is_kept
from stages.limits import available_cores
from stages.posing.control_files import CONTROL
from stages.posing.reading import locate_poses, masks_beside
from stages.preflight import Preflight, in_short, masks_in_words, preflight
from stages.request import Request
from stages.whereabouts import default_workspace, find_source, holds_files, photos_since, refuse_other_photos

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Reconstruction:
    """A finished run: where it lies, what each stage did, and what it was done with."""

    workspace: Workspace
    config: Config
    preset: str | None
    device: str
    workers: int
    outcomes: tuple[StageOutcome, ...]

    def as_dict(self) -> dict[str, Any]:
        """JSON-able."""
        return {
            "workspace": str(self.workspace.root),
            "preset": self.preset,
            "device": self.device,
            "workers": self.workers,
            "stages": [asdict(outcome) for outcome in self.outcomes],
            "glb": str(self.glb) if self.glb else None,
            "report": str(self.report) if self.report else None,
        }

    @property
    def glb(self) -> Path | None:
        return _existing(artifacts.asset_path(self.workspace.stage_folder("export"), "glb"))

    @property
    def report(self) -> Path | None:
        return _existing(artifacts.PAGE.load(self.workspace.stage_folder("report")))


def reconstruct(request: Request, pipeline: Sequence[Stage], listener: Listener | None = None) -> Reconstruction:
    """Do what was asked.

    Raises:
        HineusError: a child by what the user can do.
    """
    workers = request.workers or available_cores()
    # Read when the heavy libraries load, which is inside the stages. They know nothing of a container's quota.
    if request.workers is not None or workers < (os.cpu_count() or 1):
        os.environ["OMP_NUM_THREADS"] = str(workers)
    workspace = Workspace.open(choose_folder(request), create=True)
    digests = SourceDigests({"photos": choose_photos(request, workspace)}, workspace.digest_cache)
    sources = choose_sources(request, workspace, digests)
    preset, config = choose_config(request, workspace, digests)
    device = choose_device(request.device)
    with workspace.lock(request.wait), log_to_file(workspace.log_path), temporary_files(workspace.root / ".work"):
        with storage_errors(workspace.root, "keeping the photos' digests"):
            digests.save()
        _tell_sources(request, workspace, sources)
        photos = sources["photos"]
        now = (digests.files("photos") if digests.available("photos") else None) or {}
        if photos is not None and not workspace.stage_folder("ingest").exists():
            looked = preflight(
                sources, workspace.root, config, device, workers, False, now, only_poses=_only_poses(request, pipeline)
            )
            _tell_preflight(looked)
        if kept := what_is_kept(workspace, config, photos, sources["masks"], now, _forced(request, pipeline)):
            log.info("%s", kept)
        log.debug("preset %s, device %s, %d workers, %s", preset, device, workers, sources)
        outcomes = run_pipeline(
            pipeline,
            workspace,
            config,
            sources,
            device=device,
            workers=workers,
            from_stage=request.from_stage,
            until=request.until,
            force=request.force,
            listener=listener,
            preset=preset,
        )
    return Reconstruction(workspace, config, preset, device, workers, tuple(outcomes))


def check_photos(request: Request) -> Preflight:
    """Look at the photos of a run that is not started.

    Raises:
        HineusError: a child by what the user can do.
    """
    workers, device = request.workers or available_cores(), choose_device(request.device)
    workspace = Workspace.open(choose_folder(request), create=True)
    digests = SourceDigests({"photos": choose_photos(request, workspace)}, workspace.digest_cache)
    refused = []
    try:
        sources = choose_sources(request, workspace, digests)
    except WorkspaceError as error:  # other photos' workspace; the photos are looked at all the same
        refused = [f"{error.message} {error.hint}"]
        sources = choose_sources(replace(request, other_photos=True), workspace, digests)
    _, config = choose_config(request, workspace, digests)
    known = (digests.files("photos") or {}) if workspace.config_path.exists() else {}
    done = preflight(sources, workspace.root, config, device, workers, decode=True, digests=known)
    kept = what_is_kept(workspace, config, sources["photos"], sources["masks"], known) if known else ""
    return replace(done, refusals=(*done.refusals, *refused), kept=kept)


def _tell_preflight(done: Preflight) -> None:
    """In short. A no-go does not stop the run: estimates may be wrong, and the stages say what they need."""
    log.info("%s", in_short(done))
    if done.inspection.masks.unused is not None:
        log.info("masks: %s", masks_in_words(done.inspection))
    for line in (*done.refusals, *done.shortages, *done.warnings):
        log.warning("%s", line)


def _only_poses(request: Request, pipeline: Sequence[Stage]) -> bool:
    """Whether the run ends before photos are made ready for learning."""
    names = [stage.name for stage in pipeline]
    placed = artifacts.WORLD_PLACE.stage
    return placed in names and request.until in names[: names.index(placed) + 1]


def _forced(request: Request, pipeline: Sequence[Stage]) -> set[str]:
    """Stages that run even if fresh."""
    names = [stage.name for stage in pipeline]
    first = names.index(request.from_stage) if request.from_stage in names else len(names)
    return {*request.force, *names[first:]}


def choose_folder(request: Request) -> Path:
    """The workspace's folder: the one named, or that of the photos, or here if here is one.

    Raises:
        ConfigError: nothing says which.
        InputError: a path that is given cannot be followed.
    """
    _check_paths(request)
    if request.workspace is not None:
        return request.workspace
    if request.photos is not None:
        return default_workspace(request.photos).folder
    if is_workspace(Path.cwd()):
        return Path.cwd()
    raise ConfigError(
        "Neither a folder of photos nor a workspace is given.",
        "Try `hineus run PHOTOS`, or `--workspace DIR` for one that exists.",
    )


def _check_paths(request: Request) -> None:
    """
    Raises:
        InputError: a path that is given leads nowhere: it is too long, a link in a circle, or may not be looked at.
    """
    for path in (request.photos, request.masks, request.poses, request.control, request.light, request.workspace):
        try:
            if path is not None:
                path.exists()
                path.resolve()
        except (OSError, RuntimeError) as error:
            raise InputError(f"{path} cannot be read ({reason(error)}).", "Check the path with `ls`.") from error


def choose_photos(request: Request, workspace: Workspace) -> Path:
    """The photos given, else those the workspace was last run with, which may be gone: results stay without them.

    Raises:
        InputError: there are none, those given are no folder, or the workspace lies inside the photos.
    """
    known = find_source(workspace, "photos")
    given = request.photos.resolve() if request.photos else None
    if given is not None and not (given.exists() or given == known):
        raise InputError(f"There is no photos folder {request.photos}.", "Check the path with `ls`.")
    if given is not None and given.exists() and not (given.is_dir() or is_video(given)):
        raise InputError(
            f"{request.photos} is a file; a folder of photos or a video is needed.",
            f"Name the folder it is in: {given.parent}",
        )
    photos = given or known
    if photos is None:
        raise InputError(
            f"The workspace {workspace.root} does not know its photos yet.",
            f"Name them: `hineus run PHOTOS --workspace {shlex.quote(str(workspace.root))}`.",
        )
    if workspace.root == photos or photos in workspace.root.parents:
        raise InputError(
            f"The workspace {workspace.root} lies inside the photo folder {photos}, so it would be read as photos.",
            "Choose a folder outside with `--workspace DIR`.",
        )
    return photos


def choose_sources(request: Request, workspace: Workspace, digests: SourceDigests) -> dict[str, Path | None]:
    """Photos (those of `digests`), masks, poses, control points and light: those given, else those of the last run.

    Of a block of a large scene what the whole has given it, too.

    Masks that the poses' format comes with are used, too.

    Raises:
        InputError: the masks, poses, control points or the light that are given are not there.
        ConfigError: masks are given and not wanted.
        WorkspaceError: the workspace was made of other photos.
    """
    photos = digests.sources["photos"]
    assert photos is not None
    if request.masks is not None and request.no_masks:
        raise ConfigError("Both `--masks` and `--no-masks` are given.", "Leave one of them away.")
    if request.masks is not None and not request.masks.exists():
        raise InputError(f"There is no masks folder {request.masks}.", "Check the path with `ls`.")
    if request.masks is not None and not request.masks.is_dir():
        raise InputError(
            f"{request.masks} is a file; a folder of masks is needed.",
            f"Name the folder it is in: {request.masks.absolute().parent}",
        )
    if request.control is not None and not request.control.exists():
        raise InputError(f"There are no control points at {request.control}.", "Check the path with `ls`.")
    if request.light is not None and not request.light.exists():
        raise InputError(f"There is no light {request.light}.", "Check the path with `ls`.")
    since = _photos_since(workspace, digests)
    if not request.other_photos:
        refuse_other_photos(workspace, photos, since)
    masks = request.masks.resolve() if request.masks else None
    poses = locate_poses(request.poses).resolve() if request.poses else None
    control = request.control.resolve() if request.control else None
    light = request.light.resolve() if request.light else None
    from_whole: dict[str, Path | None] = {}
    if _are_those_of_the_last_run(workspace, photos, since):
        masks = masks or (None if request.no_masks else find_source(workspace, "masks", photos))
        poses = poses or (None if request.no_poses else find_source(workspace, "poses", photos))
        control = control or (None if request.no_control else find_source(workspace, CONTROL, photos))
        light = light or (None if request.no_light else find_source(workspace, GIVEN_LIGHT, photos))
        given = {name: find_source(workspace, name, photos) for name in FROM_WHOLE}
        from_whole = {name: path for name, path in given.items() if path is not None}
    if masks is None and request.poses:
        masks = _masks_of(poses, request.no_masks)
    return {"photos": photos, "masks": masks, "poses": poses, CONTROL: control, GIVEN_LIGHT: light, **from_whole}


def _are_those_of_the_last_run(workspace: Workspace, photos: Path, since: PhotosSince) -> bool:
    """Whether the photos are of the same scene as those of the last run, so that what was said then holds."""
    if since.kind == "new":
        return str(photos) == workspace.record.sources.get("photos")
    return since.kind != "other"


def _photos_since(workspace: Workspace, digests: SourceDigests) -> PhotosSince:
    """What has become of the workspace's photos. Those that are gone are no others."""
    photos = digests.sources["photos"]
    assert photos is not None
    if not workspace.stage_folder(artifacts.IMAGE_SET.stage).exists():
        return PhotosSince("new")
    if not holds_files(photos):
        return PhotosSince("same")
    return photos_since(workspace, photos, digests.files("photos") or {})


def _tell_sources(request: Request, workspace: Workspace, sources: Mapping[str, Path | None]) -> None:
    """Where the workspace is that was not named, and what has become of the last run's photos, masks and poses."""
    if request.workspace is None and request.photos is not None and (why := default_workspace(request.photos).why):
        log.info("workspace: %s (%s)", workspace.root, why)
    given = {
        "photos": request.photos,
        "masks": request.masks,
        "poses": request.poses,
        CONTROL: request.control,
        GIVEN_LIGHT: request.light,
    }
    forgotten = {
        "masks": request.no_masks,
        "poses": request.no_poses,
        CONTROL: request.no_control,
        GIVEN_LIGHT: request.no_light,
    }
    for name, before in workspace.record.sources.items():
        now = sources.get(name)
        if before is None or forgotten.get(name) or (given.get(name) and name != "photos"):
            continue
        if now is None:
            log.warning(
                "the %s of the last run, %s, are not used: they were given for other photos. To use them for these, "
                "too: `%s %s`",
                name,
                before,
                source_option(name),
                shlex.quote(before),
            )
        elif not os.path.exists(now) or (name == "photos" and not holds_files(now)):
            log.warning("%s", _gone(name, now, workspace.root))
        elif str(now) != before:
            log.info("%s: %s (those of the last run were %s)", name, now, before)


def _gone(name: str, place: Path, root: Path) -> str:
    """What can still be done when a source is no longer there, and the command for the rest."""
    return (
        f"The {name} are no longer at {place}. What was made from them is kept, and what does not read them still "
        f"runs. When they are back, or to name their new place: `{naming_command(name, root)}`."
    )


def _masks_of(poses: Path | None, without: bool) -> Path | None:
    """The folder of the masks that come with these poses."""
    return masks_beside(poses) if poses is not None and not without else None


def choose_config(request: Request, workspace: Workspace, digests: SourceDigests) -> tuple[str | None, Config]:
    """The preset's name and the settings.

    A workspace goes on with the settings it was last run with, `--set` on top, until a preset or a file is named;
    a preset says nothing of its masks.

    Raises:
        ConfigError: see `load_config`.
    """
    kept = request.preset is None and request.config is None and workspace.config_path.exists()
    if not kept:
        named = request.preset or default_preset()
        return named, load_config(named, request.config, [*_of_these_masks(request, workspace, digests), *request.sets])
    preset = workspace.record.preset
    log.info("settings: those of the last run (preset %s); name a --preset to start anew", preset or "none")
    try:
        return preset, load_config(None, workspace.config_path, request.sets)
    except ConfigError as error:
        if str(workspace.config_path) not in error.message:
            raise
        raise ConfigError(
            error.message, "These are the settings of the last run. Name a preset to start anew: `--preset cpu`."
        ) from error


def _of_these_masks(request: Request, workspace: Workspace, digests: SourceDigests) -> list[str]:
    """What the last run said of masks, where only a preset is new: a workspace remembers its masks, too."""
    if request.masks or request.no_masks or request.config or not workspace.config_path.exists():
        return []
    photos = digests.sources["photos"]
    assert photos is not None
    if not _are_those_of_the_last_run(workspace, photos, _photos_since(workspace, digests)):
        return []
    try:
        before = load_config(None, workspace.config_path).ingest
    except ConfigError:  # of another version; the preset replaces it
        return []
    return [f"ingest.masks_keep={before.masks_keep}", f"ingest.own_masks={str(before.own_masks).lower()}"]


def choose_device(name: str) -> str:
    """ "cpu" or "cuda".

    Raises:
        ConfigError: it is neither of these nor "auto".
        SystemRequirementError: CUDA was asked for and is not there.
    """
    if name not in ("auto", "cpu", "cuda"):
        raise ConfigError(f"There is no device '{name}'.", "Choose `--device auto`, `cpu` or `cuda`.")
    if name == "cuda" and not has_cuda():
        raise SystemRequirementError(
            "No CUDA device can be used here.", "Run `hineus doctor` to see why, or use `--device cpu`."
        )
    return "cuda" if name == "cuda" or (name == "auto" and has_cuda()) else "cpu"


def default_preset() -> str:
    return "gpu" if has_cuda() else "cpu"


def has_cuda() -> bool:
    """Whether PyTorch can use a CUDA device; quick where there is no driver."""
    try:
        ctypes.CDLL("nvcuda" if sys.platform == "win32" else "libcuda.so.1")
    except OSError:
        return False
    import torch

    return bool(torch.cuda.is_available())


def _existing(path: Path) -> Path | None:
    return path if path.exists() else None
