"""The workspace: one folder for each published stage, a record of what it was made from, and a lock.

    <root>/workspace.json         format, photos, masks, preset
    <root>/config.yaml            the resolved settings of the last run; `--config` takes it back
    <root>/hineus.log
    <root>/<stage>/               published: outputs and manifest.json
    <root>/.work/<stage>/out      what a running stage writes; becomes <root>/<stage> by renaming
    <root>/.work/<stage>/old      the publication that is being replaced, for an instant
    <root>/.work/<stage>/scratch  survives a kill; emptied on publication or when the fingerprint changes

Publishing: outputs to disk, manifest to disk, `scratch` made nobody's, old folder moved aside, `out` renamed into
place, old folder and `scratch` removed. `recover` completes whichever of these steps a crash cut off.
"""

from __future__ import annotations

import errno
import json
import logging
import os
import shlex
import shutil
import socket
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any

import psutil

from stages.artifacts.own_files import (
    open_own,
    read_own,
    refuse_foreign,
    remove,
    sync,
    write_own,
)
from stages.caches import TEMPORARY
from stages.engine.locking import take
from stages.engine.manifest import (
    MANIFEST,
    Manifest,
    ManifestDamaged,
    jsonable,
    load_manifest,
    now,
    output_problem,
)
from stages.engine.system import installed_version
from stages.errors import WorkspaceError
from stages.inputs.folders import WORKSPACE_RECORD, is_workspace, readable
from stages.inputs.texts import parse_json
from stages.limits import largest_file

log = logging.getLogger(__name__)

FORMAT = 1
LOCK, WORK, LOG, CONFIG = ".lock", ".work", "hineus.log", "config.yaml"
# What lies beside the stages' folders; of those in the first row the contents are changed where they lie.
WRITTEN_IN_PLACE = (LOCK, LOG)
OWN_FILES = (*WRITTEN_IN_PLACE, WORKSPACE_RECORD, CONFIG, f"{WORKSPACE_RECORD}.tmp", f"{CONFIG}.tmp")
SCRATCH_OWNER = "scratch.json"
WORKSPACE_SUFFIX = "_hineus"  # of the folder that is made beside photos

DISK_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
NOT_OF_THE_DISK = (errno.EMFILE, errno.ENFILE, errno.ENOMEM, errno.EAGAIN)  # told as what ran out
MOST_PID = 1 << 31
WAIT_S = 1.0  # between two looks whether a lock is free
LOCKS_UNSUPPORTED = (errno.ENOLCK, errno.ENOTSUP, errno.ENOSYS)

DATABASE_PAGE = 4096
NEARLY_FULL_BYTES = 1 << 20  # libraries hide "disk full" in errors of their own; less free than this gives it away


@dataclass(frozen=True)
class Record:
    """workspace.json: what this workspace was made from.

    Attributes:
        format: of the workspace's layout, see FORMAT.
        sources: outside path's name ("photos", "masks") -> absolute path, or None where it was not given.
        preset: name of the preset the settings started from, if that is known.
        hineus: version of the program that wrote it.
        created: UTC time, ISO 8601.
        root: the workspace's own absolute path when this was written, so that what was moved with it is found again;
            empty in older records.
    """

    format: int = FORMAT
    sources: Mapping[str, str | None] = field(default_factory=dict)
    preset: str | None = None
    hineus: str = ""
    created: str = ""
    root: str = ""


class Workspace:
    """A folder that holds one reconstruction. Make one with `Workspace.open`."""

    def __init__(self, root: Path, record: Record) -> None:
        self.root = root
        self.record = record
        self._locked = False
        self._looked_at: set[str] = set()  # stages in whose folders there is nothing but files and folders

    @staticmethod
    def open(root: Path, create: bool = False) -> Workspace:
        """Open the workspace at `root`; with `create`, an absent or empty folder becomes one when locked.

        Raises:
            WorkspaceError: there is no workspace, it is of a newer version, it cannot be read, a file of ours in it is
                a link or no file, or the folder holds something else, which stages would overwrite.
        """
        root = Path(root).absolute()
        _check_name(root)
        _refuse_foreign_files(root)
        path = root / WORKSPACE_RECORD
        try:
            data = read_own(path)
        except (FileNotFoundError, NotADirectoryError):
            return _new_workspace(root, create)
        except OSError as error:
            raise WorkspaceError(
                f"The workspace {root} cannot be read: {error.strerror}.",
                "Check who owns the folder with `ls -ld`.",
            ) from error
        return Workspace(root, _parse_record(data, path))

    # ------------------------------------------------------------ where things lie
    def stage_folder(self, stage: str) -> Path:
        """Where the stage's published outputs lie.

        Raises:
            WorkspaceError: there is a link, a pipe or a device among them.
        """
        folder = self.root / stage
        if stage not in self._looked_at:
            refuse_foreign(folder)
            self._looked_at.add(stage)
        return folder

    def work_folder(self, stage: str) -> Path:
        return self.root / WORK / stage

    def scratch_folder(self, stage: str) -> Path:
        """What the stage keeps over a kill, such as checkpoints; may not exist."""
        return self.work_folder(stage) / "scratch"

    def _scratch_owner(self, stage: str) -> Path:
        """The file with the fingerprint that the scratch folder is of; without one that is nobody's."""
        return self.work_folder(stage) / SCRATCH_OWNER

    @property
    def config_path(self) -> Path:
        return self.root / CONFIG

    @property
    def log_path(self) -> Path:
        return self.root / LOG

    @property
    def digest_cache(self) -> Path:
        return self.root / WORK / "source_digests.json"

    # ------------------------------------------------------------ lock
    @contextmanager
    def lock(self, wait: bool = False) -> Iterator[None]:
        """Hold the workspace alone; nests within one object. The kernel frees it however the process ends.

        Args:
            wait: until no other process holds it.

        Raises:
            WorkspaceError: another process holds it, the folder cannot be written, or writing in it would change
                files elsewhere.
        """
        if self._locked:
            yield
            return
        with storage_errors(self.root, "opening the workspace"):
            self.root.mkdir(parents=True, exist_ok=True)
            _refuse_foreign_files(self.root, in_place=True)
            (self.root / WORK).mkdir(exist_ok=True)
            descriptor = open_own(self.root / LOCK, os.O_RDWR | os.O_CREAT)
        try:
            self._take(descriptor, wait)
            self._locked = True
            try:
                yield
            finally:
                with suppress(OSError):  # nobody holds it any more: see `in_use`
                    os.ftruncate(descriptor, 0)
        finally:
            self._locked = False
            os.close(descriptor)

    def _take(self, descriptor: int, wait: bool) -> None:
        try:
            take(descriptor)
        except BlockingIOError:
            busy = _busy_error(self.root, _lock_holder(self.root))
            if not wait:
                raise busy from None
            log.info("%s Waiting for its end.", busy.message)
            _take_in_turn(descriptor)
        except OSError as error:
            # Some network file systems have no locks. Working without one is better than not working.
            if error.errno not in LOCKS_UNSUPPORTED:
                raise
        holder = {"pid": os.getpid(), "host": socket.gethostname(), "since": now()}
        with storage_errors(self.root, "opening the workspace"):
            os.ftruncate(descriptor, 0)
            os.lseek(descriptor, 0, os.SEEK_SET)
            os.write(descriptor, json.dumps(holder).encode())

    def in_use(self) -> bool:
        """Whether a process on this machine that took the lock is still there. Takes no lock, so it disturbs none."""
        return self.host_at_work() == socket.gethostname()

    def host_at_work(self) -> str | None:
        """The machine whose process took the lock, if that is still there, which can be asked on this one only."""
        holder = _lock_holder(self.root)
        if holder is None:
            return None
        return holder.host if holder.host != socket.gethostname() or psutil.pid_exists(holder.pid) else None

    def being_written(self, stages: Sequence[str]) -> str | None:
        """The stage whose outputs are being written, or were when the last run was killed."""
        return next((stage for stage in stages if (self.work_folder(stage) / "out").is_dir()), None)

    def is_writing(self, stage: str) -> bool:
        """Whether the run that has the lock is writing the stage's outputs; a killed one's are no longer written."""
        return self.in_use() and (self.work_folder(stage) / "out").is_dir()

    # ------------------------------------------------------------ record and settings
    def remember(self, sources: Mapping[str, Path | None], preset: str | None, config: Mapping[str, Any]) -> None:
        """Keep what this run is made from: workspace.json and config.yaml."""
        import yaml

        self.record = Record(
            sources={name: None if path is None else str(path) for name, path in sources.items()},
            preset=preset,
            hineus=_hineus_version(),
            created=self.record.created or now(),
            root=self._root_of_sources(sources),
        )
        header = f"# The settings of the last run (preset: {preset or 'none'}). Use them again with --config.\n"
        with storage_errors(self.root, "keeping the settings"):
            write_own(self.config_path, header + yaml.safe_dump(jsonable(config), sort_keys=False))
            write_own(self.root / WORKSPACE_RECORD, json.dumps(asdict(self.record), indent=1) + "\n")

    def _root_of_sources(self, sources: Mapping[str, Path | None]) -> str:
        """The root beside which the sources lie, or lay: of those that are not found yet it is the last run's."""
        unfound = any(path is not None and not os.path.exists(path) for path in sources.values())
        return self.record.root if unfound and self.record.root else str(self.root)

    # ------------------------------------------------------------ stages
    def published(self, stage: str) -> Manifest | None:
        """The stage's manifest, None where it was never published.

        Raises:
            ManifestDamaged: it was, but its manifest is damaged.
        """
        manifest = load_manifest(self.stage_folder(stage))
        if manifest is not None and manifest.identity.stage != stage:
            raise ManifestDamaged(f"it is of stage {manifest.identity.stage}")
        return manifest

    def recover(self, stage: str) -> None:
        """Complete a publication that a crash cut off, drop what a killed stage had written; needs the lock."""
        work, final = self.work_folder(stage), self.stage_folder(stage)
        out, old = work / "out", work / "old"
        with storage_errors(self.root, f"recovering '{stage}'"):
            if _is_whole(out):
                remove(self._scratch_owner(stage))
                _replace(out, final, old)
            elif old.exists() and not final.exists():
                old.rename(final)
            if _fingerprint_in(self._scratch_owner(stage)) is None:
                remove(self.scratch_folder(stage))
            for left in (old, out, work / f"{SCRATCH_OWNER}.tmp"):
                remove(left)

    def begin(self, stage: str, fingerprint: str) -> tuple[Path, Path]:
        """An empty `out` folder, and the scratch folder, emptied unless it is of this fingerprint."""
        out, scratch, owner = self.work_folder(stage) / "out", self.scratch_folder(stage), self._scratch_owner(stage)
        with storage_errors(self.root, f"starting '{stage}'"):
            remove(out)
            if _fingerprint_in(owner) != fingerprint or not scratch.is_dir():
                remove(owner)  # first: a kill may leave half of what it was of
                remove(scratch)
            scratch.mkdir(parents=True, exist_ok=True)
            write_own(owner, json.dumps({"fingerprint": fingerprint}))
            out.mkdir()
        return out, scratch

    def discard(self, stage: str) -> None:
        """Throw away what a failed stage has written; its scratch folder and its last publication stay."""
        shutil.rmtree(self.work_folder(stage) / "out", ignore_errors=True)

    def publish(self, stage: str, manifest: Manifest) -> None:
        """Make the stage's `out` folder the published one, at once and whole.

        Raises:
            WorkspaceError: the disk is full or not writable. What was published before is untouched.
        """
        work = self.work_folder(stage)
        out, old = work / "out", work / "old"
        text = manifest.to_json(sealed=True)
        with storage_errors(self.root, f"publishing '{stage}'", needed=len(text)):
            _sync_tree(out)
            write_own(out / MANIFEST, text)
            remove(self._scratch_owner(stage))
            _replace(out, self.stage_folder(stage), old)
            remove(old)
            remove(self.scratch_folder(stage))


# ---------------------------------------------------------------- errors of the storage below
@contextmanager
def storage_errors(root: Path, doing: str, needed: int | None = None) -> Iterator[None]:
    """Tell of a full or unwritable disk in the user's terms.

    Args:
        root: the workspace.
        doing: what was being done ("publishing 'sfm'").
        needed: bytes that were to be written at least, if that is known.
    """
    try:
        yield
    except OSError as error:
        if error.errno in DISK_FULL:
            raise disk_full_error(root, doing, error, needed) from error
        if error.errno is not None and error.errno not in NOT_OF_THE_DISK:
            raise WorkspaceError(
                f"The workspace {root} cannot be written while {doing}: {error.strerror} ({error.filename}).",
                "Make the folder writable, or choose another one with `--workspace DIR`.",
            ) from error
        raise


def disk_full_error(root: Path, doing: str, error: BaseException, needed: int | None = None) -> WorkspaceError:
    free = free_bytes(root)
    if isinstance(error, OSError) and error.errno == errno.EDQUOT:
        return WorkspaceError(
            f"Your quota is used up while {doing}, though the disk at {root} has {show_bytes(free)} free.",
            "Nothing published is lost: free some of yours (`quota -s`) and run the same command again to go on.",
        )
    if (isinstance(error, OSError) and error.errno == errno.EFBIG) or _has_largest_file(root):
        return WorkspaceError(
            f"A file became too large while {doing}, though the disk at {root} has {show_bytes(free)} free.",
            "Nothing published is lost: allow more with `ulimit -f unlimited`, or, where the file system has no larger "
            "files, move the workspace; then run the same command again to go on.",
        )
    least = f"at least {show_bytes(needed)} more needed" if needed else "more is needed"
    return WorkspaceError(
        f"The disk is full while {doing}: {show_bytes(free)} free at {root}, {least}.",
        "Nothing published is lost: free some space and run the same command again to go on.",
    )


def is_disk_full(error: BaseException, root: Path) -> bool:
    """Whether a stage failed because the disk is full, also where a library hides that in its own error."""
    if isinstance(error, OSError) and error.errno in DISK_FULL:
        return True
    return free_bytes(root) < NEARLY_FULL_BYTES or _has_largest_file(root)


def _has_largest_file(root: Path) -> bool:
    """Whether what is being made holds a file as large as is allowed (`ulimit -f`), or next to nothing is allowed."""
    limit = largest_file()
    if limit is None or limit < NEARLY_FULL_BYTES:
        return limit is not None
    sizes = (path.stat().st_size for path in (root / ".work").rglob("*") if path.is_file())
    return max(sizes, default=0) > limit - DATABASE_PAGE


def free_bytes(root: Path) -> int:
    return shutil.disk_usage(root).free


def show_bytes(count: float) -> str:
    """A size for people: "312 MB"."""
    for unit in ("B", "KB", "MB", "GB"):
        if count < 1000:
            return f"{count:.3g} {unit}"
        count /= 1000
    return f"{count:.3g} TB"


@dataclass(frozen=True)
class _Holder:
    """Who wrote the lock: process, machine, and UTC time."""

    pid: int
    host: str
    since: str


def _lock_holder(root: Path) -> _Holder | None:
    """None where the lock says nothing: nobody has it, or what is written there is no lock of ours."""
    try:
        data = parse_json(read_own(root / LOCK).decode())
        pid = int(data["pid"])
        return _Holder(pid, str(data["host"]), str(data["since"])) if 0 < pid < MOST_PID else None
    except (OSError, ValueError, KeyError, TypeError):
        return None


def _take_in_turn(descriptor: int) -> None:
    while True:
        time.sleep(WAIT_S)
        with suppress(BlockingIOError):
            return take(descriptor)


def _busy_error(root: Path, holder: _Holder | None) -> WorkspaceError:
    if holder is None:
        return WorkspaceError(
            f"The workspace {root} is in use by another process.",
            "Wait for it to end, or work in another folder with `--workspace DIR`.",
        )
    here = holder.host == socket.gethostname()
    if here and not psutil.pid_exists(holder.pid):
        return WorkspaceError(
            f"The workspace {root} is held by a left-over child of process {holder.pid}, which has ended.",
            f"Find it with `fuser {root / LOCK}` and end it, then try again.",
        )
    stop = f"`kill {holder.pid}`" if here else f"`kill {holder.pid}` on {holder.host}"
    return WorkspaceError(
        f"The workspace {root} is in use by process {holder.pid} on {holder.host} since {holder.since}.",
        f"Wait for it to end, stop it with {stop}, or work in another folder with `--workspace DIR`.",
    )


# ---------------------------------------------------------------- opening
def _check_name(root: Path) -> None:
    """Raises WorkspaceError where libraries that read and write in the workspace cannot take its path."""
    try:
        str(root).encode()
    except UnicodeEncodeError as error:
        raise WorkspaceError(
            f"The workspace {readable(str(root))} has a name that is not UTF-8, which OpenCV cannot read.",
            "Choose another folder with `--workspace DIR`, or rename what is in its way with `mv`.",
        ) from error


def _refuse_foreign_files(root: Path, in_place: bool = False) -> None:
    """Raises WorkspaceError where something beside the stages' folders is not what a run leaves there.

    Temporary files of a killed run may be anything: they are never opened again.

    Args:
        in_place: whether files are going to be written.
    """
    for name in OWN_FILES:
        refuse_foreign(root / name, "file", in_place and name in WRITTEN_IN_PLACE)
    refuse_foreign(root / WORK, "folder", in_place, but=TEMPORARY)


def _new_workspace(root: Path, create: bool) -> Workspace:
    if root.exists() and not root.is_dir():
        raise WorkspaceError(f"{root} is a file, not a workspace folder.", "Choose another one with `--workspace DIR`.")
    if not create:
        raise _no_workspace(root)
    # What a first run leaves when it is killed at once, or a workspace whose record was removed, may go on.
    strangers = [path.name for path in root.iterdir() if not _is_own(path)] if root.is_dir() else []
    if strangers:
        raise WorkspaceError(
            f"{root} is no workspace, and it holds {len(strangers)} other files or folders "
            f"({', '.join(sorted(strangers)[:3])}) that a run might overwrite.",
            "Choose a new or empty folder with `--workspace DIR`.",
        )
    return Workspace(root, Record())


def _no_workspace(root: Path) -> WorkspaceError:
    beside = root.with_name(f"{root.name}{WORKSPACE_SUFFIX}")
    if is_workspace(beside):
        return WorkspaceError(f"{root} is no workspace.", f"That of the photos in it is {beside}.")
    return WorkspaceError(
        f"There is no workspace at {root}.", f"Make one with `hineus run PHOTOS --workspace {shlex.quote(str(root))}`."
    )


def _is_own(path: Path) -> bool:
    return path.name in (*OWN_FILES, WORK) or (path / MANIFEST).is_file()


def _parse_record(text: bytes, path: Path) -> Record:
    try:
        data = parse_json(text.decode())
        found = int(data["format"])
        if found > FORMAT:
            raise WorkspaceError(
                f"The workspace {path.parent} has format {found}, made by hineus {data.get('hineus')}; "
                f"this is hineus {_hineus_version()}, which knows formats up to {FORMAT}.",
                "Get the newer one with `pip install --upgrade hineus`, or use another `--workspace DIR`.",
            )
        texts = {name: str(data.get(name, "")) for name in ("hineus", "created", "root")}
        preset = data.get("preset")
        return Record(found, _sources(data.get("sources", {})), None if preset is None else str(preset), **texts)
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise WorkspaceError(
            f"{path} is damaged ({error}).",
            f"Remove that file and run again with the photos: `rm {path}`. Finished stages are kept.",
        ) from error


def _sources(given: Mapping[str, Any]) -> dict[str, str | None]:
    """Raises ValueError where a path is none or not absolute: what it is relative to would be whoever asks."""
    for name, place in given.items():
        if place is not None and not _is_absolute(place):
            raise ValueError(f"the place of its {name} is {place!r}, not an absolute path")
    return dict(given)


def _is_absolute(place: Any) -> bool:
    """Whether it is an absolute path here or, in a workspace from there, on another system."""
    if not isinstance(place, str) or "\0" in place:
        return False
    return PurePosixPath(place).is_absolute() or PureWindowsPath(place).is_absolute()


def _hineus_version() -> str:
    return installed_version("hineus") or "unknown"


# ---------------------------------------------------------------- files
def _is_whole(out: Path) -> bool:
    try:
        manifest = load_manifest(out)
    except ManifestDamaged:
        return False
    return manifest is not None and output_problem(out, manifest) is None


def _replace(out: Path, final: Path, old: Path) -> None:
    """Put `out` where `final` is; `final` waits in `old`. A folder cannot be renamed over a full one."""
    remove(old)
    if final.exists():
        final.rename(old)
    out.rename(final)
    sync(final.parent)


def _sync_tree(folder: Path) -> None:
    for parent, _, files in os.walk(folder, topdown=False):
        for name in files:
            sync(Path(parent) / name)
        sync(Path(parent))


def _fingerprint_in(path: Path) -> str | None:
    try:
        return str(parse_json(read_own(path).decode())["fingerprint"])
    except (OSError, ValueError, KeyError, TypeError, WorkspaceError):
        return None
