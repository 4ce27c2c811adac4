"""Which photos and masks of what the user names are used: the same before a run, which only looks, and in it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Protocol, runtime_checkable

from configs.params import IngestParams
from stages.artifacts import LEFT_OUT, SkippedImage
from stages.capture.listing import Files, list_captures
from stages.capture.mask_names import set_masks_aside
from stages.capture.masks import choose_masks, lie_in, of_sphere, unused_masks
from stages.capture.panoramas import Sphere, find_spheres


@runtime_checkable
class Poses(Protocol):
    """What known poses say of photos and masks, see `stages.posing.known.KnownPoses`."""

    @property
    def origin(self) -> Path: ...

    @property
    def masks(self) -> Mapping[str, Path]: ...

    def names_of(self, photos: Iterable[str]) -> Mapping[str, str]:
        """Of each photo that has a pose, the name by which the poses know it."""


@dataclass(frozen=True)
class Sources:
    """What the user names.

    Attributes:
        photos: the folder, or one video. masks: their folder.
        digest: the content's digest of a file, by its path relative to `photos` and where it lies.
    """

    photos: Path
    masks: Path | None
    digest: Callable[[str, Path], str]
    poses: Poses | None = None


class Expansion(Protocol):
    """Makes files of what is no photo yet; each method also gives what could not be read."""

    def frames(self, videos: Files) -> tuple[Files, list[SkippedImage]]: ...

    def views(self, files: Files, spheres: Mapping[str, Sphere]) -> tuple[Files, list[SkippedImage]]: ...


@dataclass(frozen=True)
class Selection:
    """What is used, by path relative to the photos' folder, and what is not.

    Attributes:
        photos: sorted; views in place of 360-degree pictures where they were made.
        videos, spheres: those among the sources.
        masks: photo -> file of its mask.
        poses: names of the poses that are of these photos.
    """

    photos: Files
    videos: Files
    spheres: Mapping[str, Sphere]
    masks: Files
    skipped: list[SkippedImage]
    poses: frozenset[str]


def select(sources: Sources, params: IngestParams, expansion: Expansion | None = None) -> Selection:
    """The photos, and the masks among them or in their folder.

    Without `expansion` videos and 360-degree pictures stay what they are. Which of their frames and views have a pose
    is not known then, so that poses are not looked up where there are any.

    Raises:
        InputError: see `list_captures`, `Poses.names_of`; a 360-degree picture has a mask.
    """
    poses_masks = sources.poses.masks if sources.poses is not None else {}
    # the folder of those may hold the photos, too
    no_photos = poses_masks.values() if sources.masks and lie_in(sources.masks, poses_masks.values()) else ()
    files, videos, skipped = list_captures(sources.photos, sources.masks, no_photos)
    files, own, aside = set_masks_aside(files)
    if expansion is not None:
        frames, damaged = expansion.frames(videos)
        files, skipped = files | frames, skipped + damaged
    wanted = {path: file for path, file in files.items() if not is_left_out(path, params)}
    spheres, others = find_spheres(wanted, params.panoramas)
    if masked := [path for path in spheres if sources.masks is not None or (params.own_masks and path in own)]:
        raise of_sphere(masked[0])
    skipped += [SkippedImage(path, reason) for path, reason in others.items()]
    files = {path: file for path, file in files.items() if path not in others}
    if expansion is not None:
        views, damaged = expansion.views({path: files[path] for path in spheres}, spheres)
        files = {path: file for path, file in files.items() if path not in spheres} | views
        skipped += damaged

    names: Mapping[str, str] = {}
    if sources.poses is not None and (expansion is not None or not (videos or spheres)):
        names = sources.poses.names_of(sorted(files))
        reason = f"has no pose in {sources.poses.origin.name}"
        skipped += [SkippedImage(path, reason) for path in files if path not in names]
        files = {path: file for path, file in files.items() if path in names}
    skipped += [
        SkippedImage(path, LEFT_OUT, sha256=sources.digest(path, file))
        for path, file in files.items()
        if is_left_out(path, params)
    ]
    files = {path: file for path, file in sorted(files.items()) if not is_left_out(path, params)}

    of_poses = {path: poses_masks[name] for path, name in names.items() if name in poses_masks}
    masks = choose_masks(files, own, sources.masks, params.own_masks, of_poses)
    skipped += unused_masks(aside, masks.values(), params.own_masks, sources.masks)
    copies = _copies(files, masks, sources.digest)
    skipped += [SkippedImage(path, f"same file as {first}") for path, first in copies.items()]
    photos = {path: file for path, file in files.items() if path not in copies}
    masks = {path: mask for path, mask in masks.items() if path in photos}
    return Selection(photos, videos, spheres, masks, skipped, frozenset(names.values()))


def is_left_out(path: str, params: IngestParams) -> bool:
    """Whether the user wants no stage to see this photo."""
    return any(fnmatchcase(path, pattern) for pattern in params.leave_out)


def _copies(files: Files, masks: Files, digest: Callable[[str, Path], str]) -> dict[str, str]:
    """Photos that are the same file as another, and which: the first of those, or the first of them with a mask."""
    by_size: dict[int, list[str]] = {}
    for path in sorted(files, key=lambda path: (path not in masks, path)):
        by_size.setdefault(files[path].stat().st_size, []).append(path)
    copies = {}
    for paths in by_size.values():
        first_with: dict[str, str] = {}
        for path in paths if len(paths) > 1 else ():
            first = first_with.setdefault(digest(path, files[path]), path)
            if first != path:
                copies[path] = first
    return copies
