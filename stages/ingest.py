"""Ingest: photos and videos -> upright 8-bit RGB images COLMAP can read, masks, and a record of each photo.

How photos, videos, EXIF and masks are read is in `stages.capture`; this page says what is done with them.
A photo that needs no change is copied byte for byte under its own name. Photos that cannot be used are named
and counted, never fatal by themselves.
"""

from __future__ import annotations

import logging
import math
import shutil
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import cache
from pathlib import Path, PurePosixPath
from typing import Any, TypeVar

import numpy as np

from configs.params import IngestParams
from stages.artifacts import IMAGE_SET, PHOTOS, ImageRecord, ImageSet, SkippedImage
from stages.capture.background import PLAIN_PHOTOS, plain_mask
from stages.capture.exif import GPS_IFD, ORIENTATION, camera_key, focal_px, read_gps
from stages.capture.listing import NAMED, by_reason, name_some
from stages.capture.mask_doubts import MaskLook, find_doubts, nothing_kept
from stages.capture.masks import EMPTY, given_mask, missing_masks, of_sphere, tell_masks, write_mask
from stages.capture.panoramas import Sphere, View, split
from stages.capture.panoramas import focal_px as view_focal_px
from stages.capture.photo_reading import Photo, UnusableError, read_photo
from stages.capture.quality import Appearance, appearance, find_oddities
from stages.capture.salient import SalientNetwork
from stages.capture.selection import Sources, select
from stages.capture.video import extract_frames
from stages.engine.fingerprint import file_sha256
from stages.engine.stage import Stage, StageContext
from stages.errors import InputError
from stages.inputs.folders import short_name, unique_name
from stages.inputs.formats import PHOTO_SUFFIXES, RAW_SUFFIXES
from stages.posing.known import KnownPoses
from stages.posing.reading import read_poses

log = logging.getLogger(__name__)

LOOK_SIDE, NEAREST = 1024, 0  # a look at a photo and its mask: longest side in pixels, and Pillow's resampling
JPEG_QUALITY = 97  # re-encoded lossy photos; visually lossless, about a third of PNG's size

# Photo [H, W, 3] uint8 -> mask [H, W] bool, None where there is nothing to mask.
MaskMaker = Callable[[np.ndarray], np.ndarray | None]
Item = TypeVar("Item")
Result = TypeVar("Result")


def run(context: StageContext[IngestParams]) -> dict[str, Any]:
    """Read every photo once, write images/, masks/ and images.json."""
    params, source = context.params, context.sources["photos"]
    poses = read_poses(context.sources["poses"]) if "poses" in context.sources else None
    masks_folder, known = context.sources.get("masks"), context.digests.get("photos", {})

    def digest(path: str, file: Path) -> str:
        return known.get(path) or file_sha256(file)

    made = _Expansion(context)
    selection = select(Sources(source, masks_folder, digest, poses), params, made)
    photos, mask_files, skipped = selection.photos, selection.masks, selection.skipped
    if poses is not None:
        _tell_unused(poses, selection.poses)
    if not mask_files and (none := missing_masks(list(photos), mask_files, masks_folder)):
        raise none
    names, make_mask = _Names(photos), _mask_maker(params)
    done = 0

    def take(path: str) -> tuple[ImageRecord, Appearance, MaskLook | None, str] | SkippedImage:
        nonlocal done
        try:
            sha256 = digest(path, photos[path])
            taken = _take_photo(photos[path], path, sha256, mask_files.get(path), make_mask, names, context)
            return (_as_view(taken[0], *made.made_views[path]), *taken[1:]) if path in made.made_views else taken
        except UnusableError as reason:
            return SkippedImage(path, str(reason))
        finally:
            done += 1
            context.progress(done, len(photos), path)

    outcomes = _in_threads(take, photos, context.workers)
    taken = [o for o in outcomes if not isinstance(o, SkippedImage)]
    images = sorted((record for record, *_ in taken), key=lambda record: record.name)
    skipped += [o for o in outcomes if isinstance(o, SkippedImage)]
    if params.auto_mask in ("plain", "object"):
        images, without = _with_masks(images, context)
        skipped += without
    skipped.sort(key=lambda item: item.source)
    looks = [look for _, _, look, _ in taken if look is not None]
    _judge_masks(looks, skipped, params)

    places = len({record.frame or record.name for record in images})
    if places < params.min_images:
        raise _too_few(source, places, params.min_images, skipped)
    if some := missing_masks([record.source for record in images], mask_files, masks_folder):
        raise some
    for expected, level in ((True, logging.INFO), (False, logging.WARNING)):
        for reason, sources in by_reason(item for item in skipped if item.expected is expected).items():
            log.log(level, "left out %s: %s", name_some(sources), reason)
    doubtful = [SkippedImage(record.source, problem) for record, *_, problem in taken if problem]
    for problem, sources in by_reason(doubtful).items():
        log.warning("%s: %s", name_some(sources), problem)
    # a video's frames are the sharpest of their stretch and near each other by choice, views may show the sky
    odd = find_oddities([seen for _, seen, *_ in taken if seen.source not in made.names])
    for warning in odd.warnings:
        log.warning("%s", warning)
    masked = sum(record.has_mask for record in images)
    if 0 < masked < len(images):
        origin = "found among them" if mask_files else "from their alpha channel"
        origin = "nothing stands out in the others" if params.auto_mask == "salient" else origin
        log.warning("only %d of %d photos have a mask (%s)", masked, len(images), origin)
    context.write(IMAGE_SET, ImageSet(tuple(images), tuple(skipped)))
    return {
        "images": len(images),
        "skipped": sum(not item.expected for item in skipped),
        **({"companions": companions} if (companions := sum(item.expected for item in skipped)) else {}),
        **({"videos": made.read_videos} if selection.videos else {}),
        **({"panoramas": len({path for path, _ in made.made_views.values()})} if made.made_views else {}),
        "masks": masked,
        "cameras": len({record.camera for record in images}),
        "with_focal": sum(record.focal_px is not None for record in images),
        "with_gps": sum(record.gps is not None for record in images),
        "median_blur": round(float(np.median([record.blur for record in images])), 1),
        "blurred": len(odd.blurred),
        "badly_exposed": len(odd.badly_exposed),
        "alike": len(odd.alike),
    }


# ---------------------------------------------------------------- which files
class _Expansion:
    """Makes photos of videos and of 360-degree pictures.

    Attributes:
        names: of all that was made.
        made_views: view -> its panorama and how it looks.
        read_videos: how many could be read.
    """

    def __init__(self, context: StageContext[IngestParams]) -> None:
        self._context = context
        self.names: set[str] = set()
        self.made_views: dict[str, tuple[str, View]] = {}
        self.read_videos = 0

    def frames(self, videos: dict[str, Path]) -> tuple[dict[str, Path], list[SkippedImage]]:
        """Of each video, as `clip.mp4/000120.jpg` -> file, so that no photo can have that name; and bad videos."""
        found: dict[str, Path] = {}
        damaged = []
        context = self._context
        frames_folder = context.empty_folder("frames")
        for done, (video, file) in enumerate(videos.items()):

            def tell(part: float, done: int = done, video: str = video) -> None:
                context.progress(done + part, len(videos), f"frames of {video}")

            try:
                folder = frames_folder / str(done)  # a video's name may be too long
                frames = extract_frames(file, folder, context.params.video_frames, tell)
            except UnusableError as reason:
                damaged.append(SkippedImage(video, str(reason)))
                continue
            log.info("%s: %d frames", video, len(frames))
            found |= {f"{video}/{frame.name}": frame for frame in frames}
        self.names |= found.keys()
        self.read_videos = len(videos) - len(damaged)
        return found, damaged

    def views(
        self, files: dict[str, Path], spheres: Mapping[str, Sphere]
    ) -> tuple[dict[str, Path], list[SkippedImage]]:
        """Of 360-degree pictures, named as frames of a video are: `pano.jpg/045.jpg`; and what cannot be read."""
        context, done = self._context, 0
        folder = context.empty_folder("views")
        numbers = {path: str(number) for number, path in enumerate(spheres)}  # names may be too long

        def split_one(path: str) -> dict[str, tuple[Path, View]] | SkippedImage:
            nonlocal done
            try:
                found = _write_views(path, files[path], spheres[path], folder / numbers[path], context.params)
            except UnusableError as reason:
                return SkippedImage(path, str(reason))
            done += 1
            context.progress(done, len(spheres), f"views of {path}")
            return {f"{path}/{file.name}": (file, view) for file, view in found}

        made: dict[str, Path] = {}
        skipped = []
        for path, found in zip(spheres, _in_threads(split_one, spheres, context.workers), strict=True):
            if isinstance(found, SkippedImage):
                skipped.append(found)
                continue
            made |= {name: file for name, (file, _) in found.items()}
            self.made_views |= {name: (path, view) for name, (_, view) in found.items()}
        if made:
            log.info("%d 360-degree pictures were split into %d views", len(spheres), len(made))
        self.names |= made.keys()
        return made, skipped


def _write_views(path: str, file: Path, sphere: Sphere, folder: Path, params: IngestParams) -> list[tuple[Path, View]]:
    """Write the views of a panorama, with its GPS position.

    Raises:
        UnusableError: it cannot be read.
        InputError: it has an alpha channel that is to be used.
    """
    from PIL import Image

    photo = read_photo(file, max(sphere.size))
    if photo.alpha is not None and params.own_masks:
        raise of_sphere(path)
    metadata = Image.Exif()
    metadata[GPS_IFD] = photo.exif.get_ifd(GPS_IFD)
    folder.mkdir(parents=True)
    written = []
    for view, pixels in split(np.asarray(photo.rgb), sphere, min(sphere.side, params.max_side)):
        target = folder / f"{view.name}{'.jpg' if photo.lossy else '.png'}"
        _encode(Image.fromarray(pixels), target, photo.lossy, metadata)
        written.append((target, view))
    return written


def _as_view(record: ImageRecord, panorama: str, view: View) -> ImageRecord:
    """The record of a view: its intrinsics are known, and how it is turned against the others of its panorama."""
    return replace(
        record,
        focal_px=view_focal_px(record.width),
        camera=f"view {view.name} of 360-degree pictures | {record.width} x {record.height}",
        frame=panorama,
        cam_from_frame=tuple(map(tuple, view.cam_from_panorama.tolist())),
    )


def _too_few(folder: Path, found: int, needed: int, skipped: list[SkippedImage]) -> InputError:
    hint = (
        f"Photograph the object from all sides: 30 to 100 sharp photos that overlap by two thirds. "
        f"`hineus check {folder}` says what can be used."
    )
    if not skipped and not found and folder.is_dir():
        return InputError(f"The folder {folder} is empty: found 0 photos, need at least {needed}.", hint)
    message = f"Found {found} usable photo{'' if found == 1 else 's'} in {folder}, need at least {needed}."
    if skipped:
        frequent = sorted(by_reason(skipped).items(), key=lambda item: -len(item[1]))[:NAMED]
        reasons = "; ".join(f"{len(files)} x {reason}, e.g. {files[0]}" for reason, files in frequent)
        message += f" {len(skipped)} file{'' if len(skipped) == 1 else 's'} left out: {reasons}."
    return InputError(message, hint)


def _tell_unused(poses: KnownPoses, used: Collection[str]) -> None:
    unused = [camera.name for camera in poses.cameras if camera.name not in used]
    if unused:
        total, file = len(poses.cameras), poses.origin.name
        log.warning("%d of %d poses in %s have no photo: %s", len(unused), total, file, name_some(unused))


def _judge_masks(looks: list[MaskLook], skipped: list[SkippedImage], params: IngestParams) -> None:
    """Say which masks are used and what is doubtful about them.

    Raises:
        InputError: nothing good can come of these masks.
    """
    empty = [item.source for item in skipped if item.reason.startswith(EMPTY)]
    if empty and not looks:
        raise InputError(*nothing_kept(len(empty), empty[0]))
    if looks:
        log.info("masks: %s", tell_masks(looks))
    for doubt in find_doubts(looks, params.masks_keep):
        if doubt.impossible:
            raise InputError(doubt.message, doubt.hint)
        log.warning("%s %s", doubt.message, doubt.hint)


class _Names:
    """Gives each photo one name under images/. Names depend on the folder, never on the order of work.

    They are unique whatever the case of letters, for file systems that do not tell it, and short enough for all.
    """

    def __init__(self, paths: Iterable[str]) -> None:
        self._own: dict[str, str] = {}
        lower: set[str] = set()
        for path in sorted(paths):
            self._own[path] = unique_name(short_name(path), lower, str.lower)
            lower.add(self._own[path].lower())
        self._lower = lower
        self._stems = Counter(_stem(name).lower() for name in self._own.values())

    def target(self, path: str, suffixes: Sequence[str]) -> str:
        """The photo's own name where it has one of these suffixes, else with the first of them in place of its own."""
        name = self._own[path]
        if PurePosixPath(name).suffix.lower() in suffixes:
            return name
        if self._stems[_stem(name).lower()] == 1:
            return _stem(name) + suffixes[0]
        name += suffixes[0]
        while name.lower() in self._lower:
            name = name[: -len(suffixes[0])] + "_" + suffixes[0]
        return name


def _stem(name: str) -> str:
    """Without what is a photo's suffix: "frame.0001" has none."""
    suffix = PurePosixPath(name).suffix
    return name.removesuffix(suffix) if suffix.lower() in PHOTO_SUFFIXES | RAW_SUFFIXES else name


def _in_threads(function: Callable[[Item], Result], items: Iterable[Item], workers: int) -> list[Result]:
    with ThreadPoolExecutor(max_workers=max(1, workers)) as pool:
        return list(pool.map(function, items))


def _mask_maker(params: IngestParams) -> MaskMaker | None:
    """What makes the masks of photos that come without; None where nothing is to.

    It raises SystemRequirementError where the network is wanted and not installed.
    """
    if params.auto_mask in ("salient", "object"):
        network = cache(SalientNetwork)  # not needed where all photos bring their masks
        return lambda rgb: network().mask(rgb)
    return plain_mask if params.auto_mask == "plain" else None


def _with_masks(
    images: list[ImageRecord], context: StageContext[IngestParams]
) -> tuple[list[ImageRecord], list[SkippedImage]]:
    """The photos with a mask; the few of which none could be made are left out.

    Raises:
        InputError: they should have a plain background, and those that have not are not few.
    """
    bare = [record for record in images if record.made_mask or not record.has_mask]
    left_out = [record for record in bare if not record.has_mask]
    plain = context.params.auto_mask == "plain"
    if plain and len(left_out) > (1 - PLAIN_PHOTOS) * len(bare):
        raise InputError(
            f"The background is plain in {len(bare) - len(left_out)} of {len(bare)} photos (need "
            f"{math.ceil(PLAIN_PHOTOS * len(bare))}), for example not in {left_out[0].source}.",
            "Try `--set ingest.auto_mask=salient` or `--set ingest.auto_mask=off`, or give masks: `--masks FOLDER`.",
        )
    for record in left_out:
        context.to_write(PHOTOS).path(record.name).unlink()
    kept = [record for record in images if record.has_mask]
    reason = "its background is not plain" if plain else "nothing stands out in it, so it has no mask"
    return kept, [SkippedImage(record.source, reason) for record in left_out]


# ---------------------------------------------------------------- one photo
def _take_photo(
    file: Path,
    source: str,
    digest: str,
    mask_file: Path | None,
    make_mask: MaskMaker | None,
    names: _Names,
    context: StageContext[IngestParams],
) -> tuple[ImageRecord, Appearance, MaskLook | None, str]:
    """Its record, its looks and its mask's, and what is wrong with its colours, in words."""
    max_side = context.params.max_side
    photo = read_photo(file, max_side)
    rgb = photo.rgb
    scale = min(1.0, LOOK_SIDE / max(rgb.size))
    preview = np.asarray(rgb.resize([max(1, round(side * scale)) for side in rgb.size], resample=NEAREST))
    alpha = photo.alpha if context.params.own_masks else None
    given = given_mask(source, mask_file, alpha, photo, context.params.masks_keep == "black", preview)
    mask, look = (given[0].kept, given[1]) if given else (None, None)

    made_mask = ""
    if mask is None and make_mask is not None:
        mask = make_mask(np.asarray(rgb))
        made_mask = "" if mask is None else context.params.auto_mask
    name = names.target(source, photo.as_is or _encoded_suffixes(photo))

    pictures = context.to_write(PHOTOS)
    target = pictures.path(name)
    target.parent.mkdir(parents=True, exist_ok=True)
    if photo.as_is:
        shutil.copyfile(file, target)
    else:
        _encode(rgb, target, photo.lossy, photo.exif)
    if mask is not None:
        write_mask(mask, pictures.mask_path(name), rgb.size)

    focal = focal_px(photo.exif, photo.stored_size)
    seen = appearance(source, np.asarray(rgb))
    record = ImageRecord(
        name=name,
        source=source,
        width=rgb.width,
        height=rgb.height,
        focal_px=None if focal is None else focal * min(1.0, max_side / max(photo.size)),
        camera=camera_key(photo.exif, rgb.size, source),
        blur=seen.sharpness,
        has_mask=mask is not None,
        sha256=digest,
        gps=read_gps(photo.exif).position,
        made_mask=made_mask,
        taken=photo.size,
    )
    return record, seen, look, photo.colours.problem


def _encoded_suffixes(photo: Photo) -> tuple[str, ...]:
    return (".jpg", ".jpeg") if photo.lossy else (".png",)


def _encode(rgb: Any, target: Path, lossy: bool, exif: Any) -> None:
    # The rest of the EXIF stays: COLMAP takes GPS positions from it.
    exif[ORIENTATION] = 1
    try:
        metadata = exif.tobytes()
    except Exception:  # damaged maker notes; poses do without
        metadata = b""
    extra: dict[str, Any] = {"icc_profile": None} | ({"exif": metadata} if metadata else {})
    if lossy:
        rgb.save(target, format="JPEG", quality=JPEG_QUALITY, subsampling=0, **extra)
    else:
        rgb.save(target, format="PNG", compress_level=3, **extra)


INGEST: Stage[IngestParams] = Stage(
    name="ingest",
    version=7,
    settings=lambda config: config.ingest,
    run=run,
    writes=(PHOTOS, IMAGE_SET),
    sources=("photos", "masks", "poses"),
    summary="read the photos and masks",
)
