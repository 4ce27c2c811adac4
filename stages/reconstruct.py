"""From what the user said to a finished workspace: which folder, photos, settings and device, then the run."""

from __future__ import annotations

import ctypes
import logging
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from configs.load import load_config
from configs.params import Config
from stages import artifacts
from stages.capture.listing import is_video
from stages.engine.run_log import log_to_file
from stages.engine.runner import Listener, StageOutcome, run_pipeline
from stages.engine.stage import Stage
from stages.engine.workspace import Workspace
from stages.errors import ConfigError, InputError, SystemRequirementError
from stages.posing.reading import locate_poses, masks_beside
from stages.preflight import Preflight, in_short, masks_in_words, preflight
from stages.request import Request

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
    if request.workers is not None:
        # Read when the heavy libraries load, which is inside the stages.
        os.environ["OMP_NUM_THREADS"] = str(request.workers)
    workspace = Workspace.open(choose_folder(request), create=True)
    sources = choose_sources(request, workspace)
    preset, config = choose_config(request, workspace)
    device = choose_device(request.device)
    workers = request.workers or available_cores()
    with workspace.lock(), log_to_file(workspace.log_path):
        photos = sources["photos"]
        if photos is not None and not workspace.stage_folder("ingest").exists():
            _tell_preflight(_preflight(sources, workspace.root, config, device, workers, decode=False))
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
    photos = request.photos
    assert photos is not None, "the command line demands it"
    config = load_config(request.preset or default_preset(), request.config, request.sets)
    workers = request.workers or available_cores()
    device = choose_device(request.device)
    poses = locate_poses(request.poses) if request.poses else None
    sources = {"photos": photos, "masks": request.masks or _masks_of(poses, request.no_masks), "poses": poses}
    return _preflight(sources, choose_folder(request), config, device, workers, decode=True)


def _preflight(
    sources: Mapping[str, Path | None], folder: Path, config: Config, device: str, workers: int, decode: bool
) -> Preflight:
    photos = sources["photos"]
    assert photos is not None, "there is nothing to look at"
    return preflight(photos, sources["masks"], folder, config, device, workers, decode, sources["poses"])


def _tell_preflight(done: Preflight) -> None:
    """In short. A no-go does not stop the run: estimates may be wrong, and the stages say what they need."""
    log.info("%s", in_short(done))
    if done.inspection.masks.unused is not None:
        log.info("masks: %s", masks_in_words(done.inspection))
    for line in (*done.refusals, *done.shortages, *done.warnings):
        log.warning("%s", line)


def choose_folder(request: Request) -> Path:
    """The workspace's folder: the one named, or one named after the photos, or here if here is one.

    Raises:
        ConfigError: nothing says which.
    """
    if request.workspace is not None:
        return request.workspace
    if request.photos is not None:
        photos = request.photos.resolve()
        return Path.cwd() / f"{photos.stem if is_video(photos) else photos.name}_hineus"
    if (Path.cwd() / "workspace.json").exists():
        return Path.cwd()
    raise ConfigError(
        "Neither a folder of photos nor a workspace is given.",
        "Try `hineus run PHOTOS`, or `--workspace DIR` for one that exists.",
    )


def choose_sources(request: Request, workspace: Workspace) -> dict[str, Path | None]:
    """Photos, masks and poses: those given, else those the workspace was last run with.

    Masks that the poses' format comes with are used, too.

    Raises:
        InputError: there are none, a given one is no folder, or the workspace lies inside the photos.
    """
    known = workspace.record.sources
    for name, given in (("photos", request.photos), ("masks", request.masks)):
        if given is not None and not given.exists():
            raise InputError(f"There is no {name} folder {given}.", "Check the path with `ls`.")
        if given is not None and not given.is_dir() and not (name == "photos" and is_video(given)):
            raise InputError(
                f"{given} is a file; a folder of {name}{' or a video' if name == 'photos' else ''} is needed.",
                f"Name the folder it is in: {given.absolute().parent}",
            )
    recorded = known.get("photos")
    photos = request.photos.resolve() if request.photos else Path(recorded) if recorded else None
    if photos is None:
        raise InputError(
            f"The workspace {workspace.root} does not know its photos yet.",
            f"Name them: `hineus run PHOTOS --workspace {workspace.root}`.",
        )
    if workspace.root == photos or photos in workspace.root.parents:
        raise InputError(
            f"The workspace {workspace.root} lies inside the photo folder {photos}, so it would be read as photos.",
            "Choose a folder outside with `--workspace DIR`.",
        )
    masks = request.masks.resolve() if request.masks else None
    poses = locate_poses(request.poses).resolve() if request.poses else None
    if str(photos) == recorded:
        masks = masks or _remembered(known.get("masks"), request.no_masks)
        poses = poses or _remembered(known.get("poses"), request.no_poses)
    if masks is None and request.poses:
        masks = _masks_of(poses, request.no_masks)
    return {"photos": photos, "masks": masks, "poses": poses}


def _masks_of(poses: Path | None, without: bool) -> Path | None:
    """The folder of the masks that come with these poses."""
    return masks_beside(poses) if poses is not None and not without else None


def _remembered(path: str | None, forget: bool) -> Path | None:
    return Path(path) if path and not forget else None


def choose_config(request: Request, workspace: Workspace) -> tuple[str | None, Config]:
    """The preset's name and the settings.

    A workspace goes on with the settings it was last run with, `--set` on top, until a preset or a file is named;
    a preset says nothing of its masks.

    Raises:
        ConfigError: see `load_config`.
    """
    kept = request.preset is None and request.config is None and workspace.config_path.exists()
    if not kept:
        named = request.preset or default_preset()
        return named, load_config(named, request.config, [*_of_these_masks(request, workspace), *request.sets])
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


def _of_these_masks(request: Request, workspace: Workspace) -> list[str]:
    """What the last run said of masks, where only a preset is new: a workspace remembers its masks, too."""
    recorded = workspace.record.sources.get("photos")
    same_photos = request.photos is None or str(request.photos.resolve()) == recorded
    if not same_photos or request.masks or request.no_masks or request.config or not workspace.config_path.exists():
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
        ctypes.CDLL("libcuda.so.1")
    except OSError:
        return False
    import torch

    return bool(torch.cuda.is_available())


def available_cores() -> int:
    """CPU cores this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _existing(path: Path) -> Path | None:
    return path if path.exists() else None
