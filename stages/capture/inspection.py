"""A look at a folder of photos before the work: what their files say and, where wanted, how they look."""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

from configs.params import IngestParams
from stages.artifacts import SkippedImage
from stages.capture.background import PLAIN_PHOTOS, find_background
from stages.capture.mask_doubts import MaskLook
from stages.capture.masks import given_mask, of_sphere, unused_folder
from stages.capture.panoramas import Sphere, split_size
from stages.capture.photo_reading import PhotoFile, UnusableError, read_head, read_preview
from stages.capture.quality import Appearance, Oddities, appearance, find_oddities
from stages.capture.selection import Sources, select
from stages.capture.video import video_size
from stages.errors import InputError


@dataclass(frozen=True)
class Video:
    """A video among the photos: how many frames of which size it may give."""

    source: str
    frames: int
    width: int
    height: int


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


def inspect(sources: Sources, params: IngestParams, workers: int, decode: bool) -> Inspection:
    """Look at all photos that are used, see `select`.

    Args:
        decode: also look at their pixels, of reduced copies, and at their masks. Damage behind a sound head shows only
            then.

    Raises:
        InputError: see `select`.
    """
    selection = select(sources, params)
    photos, videos, spheres = selection.photos, selection.videos, selection.spheres

    def look(path: str) -> _Seen | Video | SkippedImage:
        try:
            if path in videos:
                frames, width, height = video_size(videos[path])
                return Video(path, min(frames, params.video_frames), width, height)
            head = read_head(photos[path], path, params.max_side)
            if not decode:
                return _Seen(head)
            return _look_closer(head, photos[path], selection.masks.get(path), params, path in spheres)
        except UnusableError as reason:
            return SkippedImage(path, str(reason))

    with ThreadPoolExecutor(max_workers=max(1, workers)) as pool:
        outcomes = list(pool.map(look, [*photos, *videos]))
    seen = [item for item in outcomes if isinstance(item, _Seen)]
    return Inspection(
        photos=tuple(item.head for item in seen),
        videos=tuple(item for item in outcomes if isinstance(item, Video)),
        skipped=tuple([*selection.skipped, *(item for item in outcomes if isinstance(item, SkippedImage))]),
        spheres=spheres,
        num_bytes=sum(file.stat().st_size for file in [*photos.values(), *videos.values()]),
        oddities=find_oddities([item.appearance for item in seen if item.appearance is not None]),
        plain_share=sum(item.is_plain for item in seen) / max(len(seen), 1),
        masks=MasksSeen(
            selection.masks,
            tuple(item.mask for item in seen if isinstance(item.mask, MaskLook)),
            tuple(item.mask for item in seen if isinstance(item.mask, InputError)),
            None if selection.masks or not sources.photos.is_dir() else unused_folder(sources.photos, list(photos)),
        ),
    )


def _look_closer(head: PhotoFile, file: Path, mask_file: Path | None, params: IngestParams, is_sphere: bool) -> _Seen:
    """With what is wrong with its mask, if it has one.

    Raises:
        UnusableError: the photo or its mask shows that this is none.
    """
    pixels, alpha = read_preview(file)
    if mask_file is not None or not params.own_masks:
        alpha = None
    mask: MaskLook | InputError | None = None
    try:
        if is_sphere and alpha is not None:
            raise of_sphere(head.source)
        given = given_mask(head.source, mask_file, alpha, head, params.masks_keep == "black", pixels)
        mask = None if given is None else given[1]
    except InputError as error:
        mask = error
    return _Seen(head, appearance(head.source, pixels), find_background(pixels).is_plain, mask)
