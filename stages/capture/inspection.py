"""A look at a folder of photos before the work: what their files say and, where wanted, how they look."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from stages.artifacts import SkippedImage
from stages.capture.background import PLAIN_PHOTOS, find_background
from stages.capture.listing import list_captures
from stages.capture.mask_doubts import MaskLook, is_black_and_white
from stages.capture.mask_names import set_masks_aside
from stages.capture.masks import (
    MASK_NOT_PHOTO,
    Mask,
    PairMasks,
    alpha_of,
    choose_masks,
    load_mask,
    look_at_mask,
    match_masks,
    unused_folder,
    unused_masks,
)
from stages.capture.panoramas import Mode, Sphere, find_spheres, split_size
from stages.capture.photo_reading import PhotoFile, UnusableError, read_head, read_preview
from stages.capture.quality import Appearance, Oddities, appearance, find_oddities
from stages.capture.video import video_size
from stages.errors import InputError
from stages.inputs.folders import readable


@dataclass(frozen=True)
class Video:
    """A video among the photos: how many frames of which size it may give."""

    source: str
    frames: int
    width: int
    height: int


@dataclass(frozen=True)
class MasksWanted:
    """Which masks are used, and how they are read.

    Attributes:
        folder: of the user's choice; None: those among the photos, if `own`.
        black_keeps: whether black is the object.
        pair, read: as `match_masks` and `load_mask`.
    """

    folder: Path | None = None
    own: bool = True
    black_keeps: bool = False
    pair: PairMasks = match_masks
    read: Callable[..., Mask] = load_mask


@dataclass(frozen=True)
class MasksSeen:
    """The masks of the photos.

    Attributes:
        files: photo -> file of its mask.
        looks: at each that could be read; none where the photos were not decoded.
        unusable: why each mask that cannot be used cannot.
        unused: a folder of masks near the photos that nobody named.
    """

    files: Mapping[str, Path] = field(default_factory=dict)
    looks: tuple[MaskLook, ...] = ()
    unusable: tuple[InputError, ...] = ()
    unused: Path | None = None


@dataclass(frozen=True)
class Inspection:
    """All that was seen.

    Attributes:
        num_bytes: size of all the files.
        oddities: none where the photos were not decoded.
        plain_share: part of the photos whose background is plain; 0 where the photos were not decoded.
        spheres: those of the photos that are 360-degree pictures.
    """

    photos: tuple[PhotoFile, ...]
    videos: tuple[Video, ...]
    skipped: tuple[SkippedImage, ...]
    num_bytes: int
    oddities: Oddities = field(default_factory=Oddities)
    plain_share: float = 0.0
    spheres: Mapping[str, Sphere] = field(default_factory=dict)
    masks: MasksSeen = field(default_factory=MasksSeen)

    @property
    def plain(self) -> bool:
        """Whether nearly all backgrounds are plain."""
        return self.plain_share >= PLAIN_PHOTOS

    @property
    def places(self) -> int:
        """Pictures and frames that a video may give; a 360-degree picture is one, however many views it gives."""
        return len(self.photos) + sum(video.frames for video in self.videos)

    @property
    def sizes(self) -> list[tuple[int, int]]:
        """Width and height of each photo, view of a 360-degree picture and frame that a video may give."""
        frames = [(video.width, video.height) for video in self.videos for _ in range(video.frames)]
        photos = [(photo.width, photo.height) for photo in self.photos if photo.source not in self.spheres]
        views = [(side, side) for count, side in map(split_size, self.spheres.values()) for _ in range(count)]
        return photos + views + frames


@dataclass(frozen=True)
class _Seen:
    """One photo."""

    head: PhotoFile
    appearance: Appearance | None = None
    is_plain: bool = False
    mask: MaskLook | InputError | None = None


def inspect(
    source: Path,
    masks_folder: Path | None,
    video_frames: int,
    max_side: int,
    workers: int,
    decode: bool,
    masks: MasksWanted | None = None,
    panoramas: Mode = "auto",
) -> Inspection:
    """Look at all photos of `source` (see `list_captures`).

    Args:
        video_frames: how many a video gives at most. max_side: what photos are reduced to, pixels.
        decode: also look at their pixels, of reduced copies, and at their masks. Damage behind a sound head shows only
            then.
        panoramas: which pictures are 360-degree ones, see `find_spheres`.

    Raises:
        InputError: see `list_captures`, and `MasksWanted.pair`.
    """
    wanted = masks or MasksWanted(masks_folder)
    photos, videos, skipped = list_captures(source, masks_folder)
    photos, own, aside = set_masks_aside(photos)
    spheres, others = find_spheres(photos, panoramas)
    skipped += [SkippedImage(path, reason) for path, reason in others.items()]
    photos = {path: file for path, file in photos.items() if path not in others}
    files = choose_masks(photos, own, masks_folder, wanted.own, wanted.pair)
    skipped += unused_masks(aside, files.values(), wanted.own, masks_folder)

    def look(path: str) -> _Seen | Video | SkippedImage:
        try:
            if path in videos:
                frames, width, height = video_size(videos[path])
                return Video(path, min(frames, video_frames), width, height)
            head = read_head(photos[path], path, max_side)
            return _look_closer(head, photos[path], files.get(path), wanted) if decode else _Seen(head)
        except UnusableError as reason:
            return SkippedImage(path, str(reason))

    with ThreadPoolExecutor(max_workers=max(1, workers)) as pool:
        outcomes = list(pool.map(look, [*photos, *videos]))
    seen = [item for item in outcomes if isinstance(item, _Seen)]
    return Inspection(
        photos=tuple(item.head for item in seen),
        videos=tuple(item for item in outcomes if isinstance(item, Video)),
        skipped=tuple([*skipped, *(item for item in outcomes if isinstance(item, SkippedImage))]),
        spheres=spheres,
        num_bytes=sum(file.stat().st_size for file in [*photos.values(), *videos.values()]),
        oddities=find_oddities([item.appearance for item in seen if item.appearance is not None]),
        plain_share=sum(item.is_plain for item in seen) / max(len(seen), 1),
        masks=MasksSeen(
            files,
            tuple(item.mask for item in seen if isinstance(item.mask, MaskLook)),
            tuple(item.mask for item in seen if isinstance(item.mask, InputError)),
            None if files or not source.is_dir() else unused_folder(source, list(photos)),
        ),
    )


def _look_closer(head: PhotoFile, file: Path, mask_file: Path | None, wanted: MasksWanted) -> _Seen:
    """
    Raises:
        UnusableError: the photo or its mask shows that this is none.
    """
    pixels, alpha = read_preview(file)
    if is_black_and_white(pixels):
        raise UnusableError(MASK_NOT_PHOTO)
    mask = _look_at_mask(head, alpha, mask_file, pixels, wanted)
    return _Seen(head, appearance(head.source, pixels), find_background(pixels).is_plain, mask)


def _look_at_mask(
    head: PhotoFile, alpha: np.ndarray | None, mask_file: Path | None, pixels: np.ndarray, wanted: MasksWanted
) -> MaskLook | InputError | None:
    """At the mask of a photo, or what is wrong with it; None where there is none.

    Raises:
        UnusableError: the mask keeps nothing.
    """
    size = head.width, head.height
    if mask_file is not None:
        try:
            mask = wanted.read(
                mask_file, head.source, size, head.stored_size, head.orientation, wanted.black_keeps, pixels
            )
        except InputError as error:
            return error
        return look_at_mask(head.source, readable(mask_file.name), mask, pixels)
    if alpha is None or not wanted.own or wanted.folder is not None:
        return None
    return look_at_mask(head.source, alpha_of(head.source), Mask(alpha ^ wanted.black_keeps, size), pixels)
