"""A look at a folder of photos before the work: what their files say and, where wanted, how they look."""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

from stages.artifacts import SkippedImage
from stages.capture.background import PLAIN_PHOTOS, find_background
from stages.capture.listing import list_captures
from stages.capture.panoramas import Mode, Sphere, find_spheres, split_size
from stages.capture.photo_reading import PhotoFile, UnusableError, read_head, read_preview, register_formats
from stages.capture.quality import Appearance, Oddities, appearance, find_oddities
from stages.capture.video import video_size


@dataclass(frozen=True)
class Video:
    """A video among the photos: how many frames of which size it may give."""

    source: str
    frames: int
    width: int
    height: int


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


def inspect(
    source: Path,
    masks_folder: Path | None,
    video_frames: int,
    workers: int,
    decode: bool,
    panoramas: Mode = "auto",
) -> Inspection:
    """Look at all photos of `source` (see `list_captures`).

    Args:
        video_frames: how many a video gives at most.
        decode: also at their pixels, of reduced copies. Damage behind a sound head shows only then.
        panoramas: which pictures are 360-degree ones, see `find_spheres`.

    Raises:
        InputError: see `list_captures`.
    """
    photos, videos, skipped = list_captures(source, masks_folder)
    folder = source if source.is_dir() else source.parent
    register_formats()
    spheres, others = find_spheres({path: folder / path for path in photos}, panoramas)
    skipped += [SkippedImage(path, reason) for path, reason in others.items()]
    photos = [path for path in photos if path not in others]

    def look(path: str) -> tuple[PhotoFile, Appearance | None, bool] | Video | SkippedImage:
        try:
            if path in videos:
                frames, width, height = video_size(folder / path)
                return Video(path, min(frames, video_frames), width, height)
            photo = read_head(folder / path, path)
            if not decode:
                return photo, None, False
            pixels = read_preview(folder / path)
            return photo, appearance(path, pixels), find_background(pixels).is_plain
        except UnusableError as reason:
            return SkippedImage(path, str(reason))

    with ThreadPoolExecutor(max_workers=max(1, workers)) as pool:
        seen = list(pool.map(look, [*photos, *videos]))
    looked_at = [item for item in seen if isinstance(item, tuple)]
    return Inspection(
        photos=tuple(photo for photo, _, _ in looked_at),
        videos=tuple(item for item in seen if isinstance(item, Video)),
        skipped=tuple([*skipped, *(item for item in seen if isinstance(item, SkippedImage))]),
        spheres=spheres,
        num_bytes=sum((folder / path).stat().st_size for path in [*photos, *videos]),
        oddities=find_oddities([look for _, look, _ in looked_at if look is not None]),
        plain_share=sum(plain for _, _, plain in looked_at) / max(len(looked_at), 1),
    )
