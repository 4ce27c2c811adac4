"""Ingest: photos -> upright 8-bit RGB images COLMAP can read, masks, and a record of each photo.

A photo that needs no change is copied byte for byte under its own name. Photos that cannot be used are named
and counted, never fatal by themselves.
"""

from __future__ import annotations

import logging
import math
import shutil
from collections import Counter
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path, PurePosixPath
from typing import Any, TypeVar

import numpy as np

from stages import artifacts
from stages.artifacts import ImageRecord, ImageSet, SkippedImage
from stages.engine.fingerprint import file_sha256
from stages.engine.stage import Stage, StageContext
from stages.errors import InputError
from stages.posing.known import KnownPoses, match_photos
from stages.posing.nero import DEPTH, read_depth_mask
from stages.posing.reading import read_poses

log = logging.getLogger(__name__)

# What COLMAP's reader takes as it is; the rest is re-encoded.
COLMAP_SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp"})
HEIF_SUFFIXES = frozenset({".heic", ".heif"})
IMAGE_SUFFIXES = COLMAP_SUFFIXES | HEIF_SUFFIXES | {".webp"}
VIDEO_SUFFIXES = frozenset({".mp4", ".mov", ".avi", ".mkv", ".m4v", ".webm"})
RAW_SUFFIXES = frozenset({".dng", ".cr2", ".cr3", ".nef", ".arw", ".orf", ".rw2", ".raf"})
LOSSY_FORMATS = frozenset({"JPEG", "MPO", "WEBP", "HEIF"})

JPEG_QUALITY = 97  # re-encoded lossy photos; visually lossless, about a third of PNG's size
MIN_SIDE = 64  # a picture smaller than this is an icon or a thumbnail, not a photo
BLUR_PIXELS = 1_000_000  # sharpness is measured at this size, so that it compares between cameras
DIAGONAL_35MM = math.hypot(36.0, 24.0)  # CIPA defines the 35 mm equivalent by the frame's diagonal
NAMED_IN_ERRORS = 3  # this many file names are spelt out in an error message

# EXIF tags
ORIENTATION, MAKE, MODEL, EXIF_IFD = 0x0112, 0x010F, 0x0110, 0x8769
FOCAL_LENGTH, FOCAL_LENGTH_35MM, LENS_MODEL, EXIF_WIDTH = 0x920A, 0xA405, 0xA434, 0xA002
FOCAL_PLANE_X_RESOLUTION, FOCAL_PLANE_UNIT = 0xA20E, 0xA210
GPS_IFD = 0x8825
GPS_LATITUDE_REF, GPS_LATITUDE, GPS_LONGITUDE_REF, GPS_LONGITUDE, GPS_ALTITUDE_REF, GPS_ALTITUDE = range(1, 7)
FOCAL_PLANE_UNIT_MM = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}

Item = TypeVar("Item")
Result = TypeVar("Result")


class _UnusableError(Exception):
    """This photo is left out, and why."""


def run(context: StageContext) -> dict[str, Any]:
    """Read every photo once, write images/, masks/ and images.json."""
    params, folder = context.params, context.sources["photos"]
    masks_folder = context.sources.get("masks")
    paths, skipped = _list_photos(folder, masks_folder)
    poses = read_poses(context.sources["poses"]) if "poses" in context.sources else None
    if poses is not None:
        cameras = match_photos(poses, paths)
        skipped += [SkippedImage(path, f"has no pose in {poses.origin.name}") for path in paths if path not in cameras]
        paths = list(cameras)
        _tell_unused(poses, {camera.name for camera in cameras.values()})
    heif = _register_heif()

    digests = _in_threads(lambda path: _sha256(folder / path), paths, context.workers)
    first_with: dict[str, str] = {}
    unique: list[tuple[str, str]] = []
    for path, digest in zip(paths, digests, strict=True):
        if digest in first_with:
            skipped.append(SkippedImage(path, f"same file as {first_with[digest]}"))
        else:
            first_with[digest] = path
            unique.append((path, digest))

    mask_files = _find_masks([path for path, _ in unique], masks_folder, poses) if masks_folder else {}
    names = _Names(path for path, _ in unique)
    done = 0

    def take(item: tuple[str, str]) -> ImageRecord | SkippedImage:
        nonlocal done
        path, digest = item
        try:
            if Path(path).suffix.lower() in HEIF_SUFFIXES and not heif:
                raise _UnusableError("HEIC needs the pillow-heif package (pip install pillow-heif)")
            return _take_photo(folder / path, path, digest, mask_files.get(path), names, context)
        except _UnusableError as reason:
            return SkippedImage(path, str(reason))
        finally:
            done += 1
            context.progress(done, len(unique), path)

    outcomes = _in_threads(take, unique, context.workers)
    images = sorted((o for o in outcomes if isinstance(o, ImageRecord)), key=lambda record: record.name)
    skipped += [o for o in outcomes if isinstance(o, SkippedImage)]
    skipped.sort(key=lambda item: item.source)

    if len(images) < params.min_images:
        raise _too_few(folder, len(images), params.min_images, skipped)
    missing = [path for path, _ in unique if masks_folder and path not in mask_files]
    missing = [path for path in missing if any(record.source == path for record in images)]
    if missing:
        raise InputError(
            f"{len(missing)} of {len(images)} photos have no mask in {masks_folder}: {_first(missing)}.",
            f"Add {Path(missing[0]).stem}.png and the like, move those photos away, or run with `--no-masks`.",
        )
    for reason, sources in _by_reason(skipped).items():
        log.warning("left out %s: %s", _first(sources), reason)
    masked = sum(record.has_mask for record in images)
    if 0 < masked < len(images):
        log.warning("only %d of %d photos have a mask (from their alpha channel)", masked, len(images))
    artifacts.save_image_set(context.out, ImageSet(tuple(images), tuple(skipped)))
    return {
        "images": len(images),
        "skipped": len(skipped),
        "masks": masked,
        "cameras": len({record.camera for record in images}),
        "with_focal": sum(record.focal_px is not None for record in images),
        "with_gps": sum(record.gps is not None for record in images),
        "median_blur": round(float(np.median([record.blur for record in images])), 1),
    }


# ---------------------------------------------------------------- which files
def _list_photos(folder: Path, masks_folder: Path | None) -> tuple[list[str], list[SkippedImage]]:
    """Relative posix paths of files that may be photos, sorted, and the others with the reason."""
    if not folder.exists():
        raise InputError(f"The photo folder {folder} does not exist.", "Check the path: hineus run PHOTOS")
    if not folder.is_dir():
        raise InputError(f"{folder} is a file; a folder of photos is needed.", f"hineus run {folder.parent}")
    if masks_folder is not None and not masks_folder.is_dir():
        raise InputError(f"The mask folder {masks_folder} does not exist.", "Check the path given to --masks.")
    inside_masks = masks_folder.resolve() if masks_folder else None
    photos, skipped = [], []
    for path in sorted(folder.rglob("*")):
        relative = path.relative_to(folder)
        if not path.is_file() or any(part.startswith((".", "__MACOSX")) for part in relative.parts):
            continue
        if inside_masks and inside_masks != folder.resolve() and inside_masks in path.resolve().parents:
            continue
        suffix = path.suffix.lower()
        if suffix in IMAGE_SUFFIXES:
            photos.append(relative.as_posix())
        elif suffix in VIDEO_SUFFIXES:
            skipped.append(SkippedImage(relative.as_posix(), "a video; extract frames from it first"))
        elif suffix in RAW_SUFFIXES:
            skipped.append(SkippedImage(relative.as_posix(), "a camera raw file; develop it to JPEG or TIFF first"))
        else:
            skipped.append(SkippedImage(relative.as_posix(), f"not an image ({suffix or 'no file extension'})"))
    return photos, skipped


def _too_few(folder: Path, found: int, needed: int, skipped: list[SkippedImage]) -> InputError:
    hint = "Photograph the object from all sides: 30 to 100 sharp photos that overlap by two thirds."
    if not skipped and not found:
        return InputError(f"The folder {folder} is empty: found 0 photos, need at least {needed}.", hint)
    message = f"Found {found} usable photo{'' if found == 1 else 's'} in {folder}, need at least {needed}."
    if skipped:
        counts = Counter(item.reason for item in skipped).most_common(NAMED_IN_ERRORS)
        example = {item.reason: item.source for item in reversed(skipped)}
        reasons = "; ".join(f"{count} x {reason}, e.g. {example[reason]}" for reason, count in counts)
        message += f" {len(skipped)} file{'' if len(skipped) == 1 else 's'} left out: {reasons}."
    return InputError(message, hint)


def _tell_unused(poses: KnownPoses, used: set[str]) -> None:
    unused = [camera.name for camera in poses.cameras if camera.name not in used]
    if unused:
        total, file = len(poses.cameras), poses.origin.name
        log.warning("%d of %d poses in %s have no photo: %s", len(unused), total, file, _first(unused))


def _by_reason(skipped: list[SkippedImage]) -> dict[str, list[str]]:
    sources: dict[str, list[str]] = {}
    for item in skipped:
        sources.setdefault(item.reason, []).append(item.source)
    return sources


def _first(names: list[str]) -> str:
    more = len(names) - NAMED_IN_ERRORS
    return ", ".join(names[:NAMED_IN_ERRORS]) + (f" and {more} more" if more > 0 else "")


def _sha256(path: Path) -> str:
    try:
        return file_sha256(path)
    except OSError:
        return f"unreadable:{path}"  # reading it as a photo fails next, with the reason


class _Names:
    """Gives each photo one name under images/. Names depend on the folder, never on the order of work."""

    def __init__(self, paths: Iterable[str]) -> None:
        self._own = set(paths)
        # case-insensitive file systems must not merge two photos
        self._lower = Counter(path.lower() for path in self._own)
        stems = Counter(str(PurePosixPath(path).with_suffix("")).lower() for path in self._own)
        self._stems = stems

    def target(self, path: str, suffix: str | None) -> str:
        """`path` itself (suffix None or unchanged), or its stem with `suffix`, unique in the folder."""
        own = PurePosixPath(path)
        if suffix is None or own.suffix.lower() == suffix:
            return path
        if self._stems[str(own.with_suffix("")).lower()] == 1:
            return own.with_suffix(suffix).as_posix()
        name = path + suffix
        while name.lower() in self._lower:
            name = name[: -len(suffix)] + "_" + suffix
        return name


def _in_threads(function: Callable[[Item], Result], items: Iterable[Item], workers: int) -> list[Result]:
    with ThreadPoolExecutor(max_workers=max(1, workers)) as pool:
        return list(pool.map(function, items))


def _register_heif() -> bool:
    try:
        from pillow_heif import register_heif_opener
    except ImportError:
        return False
    register_heif_opener()
    return True


# ---------------------------------------------------------------- one photo
def _take_photo(
    file: Path, source: str, digest: str, mask_file: Path | None, names: _Names, context: StageContext
) -> ImageRecord:
    from PIL import Image, ImageOps

    try:
        with Image.open(file) as photo:
            if getattr(photo, "n_frames", 1) > 1 and photo.format == "WEBP":
                raise _UnusableError("an animation")
            lossy = photo.format in LOSSY_FORMATS
            exif = photo.getexif()
            sixteen_bit = "16" in str(photo.tile[0][3]) if photo.tile else False
            photo.load()
            orientation = exif.get(ORIENTATION, 1)
            stored_size = photo.size
            image = photo if orientation in (None, 0, 1) else ImageOps.exif_transpose(photo)
            rgb, alpha = _rgb_and_alpha(image)
    except (_UnusableError, MemoryError):
        raise
    except Exception as error:  # Pillow's decoders raise nearly anything on a damaged file
        raise _UnusableError(f"cannot be read ({error})") from error

    width, height = rgb.size
    if max(width, height) < MIN_SIDE:
        raise _UnusableError(f"only {width} x {height} pixels")
    mask = alpha
    if mask_file is not None:
        if mask_file.name.endswith(DEPTH):
            mask = read_depth_mask(mask_file)
            _check_size(mask_file, source, mask.shape[::-1], (width, height))
        else:
            mask = _read_mask(mask_file, source, (width, height), stored_size, orientation)
    if mask is not None and not mask.any():
        raise _UnusableError(f"its mask is empty ({mask_file.name if mask_file else 'alpha channel'})")

    max_side = context.params.max_side
    scale = min(1.0, max_side / max(width, height))
    unchanged = image is photo and photo.mode == "RGB" and not sixteen_bit and scale == 1.0
    keep = unchanged and file.suffix.lower() in COLMAP_SUFFIXES and photo.format != "WEBP"
    if scale < 1:
        rgb = rgb.resize((max(1, round(width * scale)), max(1, round(height * scale))), Image.Resampling.LANCZOS)
    suffix = None if keep else _encoded_suffix(file, lossy)
    name = names.target(source, suffix)

    target = artifacts.image_path(context.out, name)
    target.parent.mkdir(parents=True, exist_ok=True)
    if keep:
        shutil.copyfile(file, target)
    else:
        _encode(rgb, target, lossy, exif)
    if mask is not None:
        _write_mask(mask, artifacts.mask_path(context.out, name), rgb.size)

    focal = _focal_px(exif, stored_size)
    return ImageRecord(
        name=name,
        source=source,
        width=rgb.width,
        height=rgb.height,
        focal_px=None if focal is None else focal * scale,
        camera=_camera_key(exif, rgb.size),
        blur=_blur(np.asarray(rgb)),
        has_mask=mask is not None,
        sha256=digest,
        gps=_gps(exif),
    )


def _rgb_and_alpha(image: Any) -> tuple[Any, np.ndarray | None]:
    """8-bit RGB image and, where the alpha channel cuts something out, the mask [H, W] bool."""
    from PIL import Image

    if image.mode in ("I;16", "I;16B", "I;16L", "I"):  # 16-bit grey: Pillow's own conversion clips at 255
        grey = (np.asarray(image).clip(0, 65535) // 257).astype(np.uint8)
        return Image.fromarray(grey).convert("RGB"), None
    if image.mode == "F":
        raise _UnusableError("a floating-point image")
    if image.mode in ("RGBA", "LA", "PA", "RGBa", "La") or "transparency" in image.info:
        image = image.convert("RGBA")
        alpha = np.asarray(image.getchannel("A"))
        return image.convert("RGB"), None if alpha.min() > 127 else alpha > 127
    return image if image.mode == "RGB" else image.convert("RGB"), None


def _encoded_suffix(file: Path, lossy: bool) -> str:
    """A re-encoded photo keeps its own suffix where that suffix is true."""
    own = file.suffix.lower()
    if lossy:
        return own if own in (".jpg", ".jpeg") else ".jpg"
    return ".png"


def _encode(rgb: Any, target: Path, lossy: bool, exif: Any) -> None:
    # The rest of the EXIF stays: COLMAP takes GPS positions from it.
    exif[ORIENTATION] = 1
    try:
        metadata = exif.tobytes()
    except Exception:  # damaged maker notes; poses do without
        metadata = b""
    extra = {"exif": metadata} if metadata else {}
    if lossy:
        rgb.save(target, format="JPEG", quality=JPEG_QUALITY, subsampling=0, **extra)
    else:
        rgb.save(target, format="PNG", compress_level=3, **extra)


def _blur(rgb: np.ndarray) -> float:
    """Variance of the Laplacian of the grey image at <= 1 megapixel; low is blurred."""
    import cv2

    grey = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
    scale = math.sqrt(BLUR_PIXELS / grey.size)
    if scale < 1:
        grey = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return round(float(cv2.Laplacian(grey, cv2.CV_32F).var()), 3)


# ---------------------------------------------------------------- EXIF
def _number(value: Any) -> float | None:
    try:
        number = float(value)
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return number if math.isfinite(number) and number > 0 else None


def _focal_px(exif: Any, size: tuple[int, int]) -> float | None:
    """Focal length in pixels of the stored image of `size`, or None.

    From the sensor's pixel pitch where the 35 mm equivalent does not contradict it (that one is rounded to
    whole millimetres), else from the 35 mm equivalent.
    """
    tags = exif.get_ifd(EXIF_IFD)
    equivalent, candidates = _number(tags.get(FOCAL_LENGTH_35MM)), []
    from_35mm = equivalent / DIAGONAL_35MM * math.hypot(*size) if equivalent else None
    focal_mm, pitch = _number(tags.get(FOCAL_LENGTH)), _number(tags.get(FOCAL_PLANE_X_RESOLUTION))
    unit_mm = FOCAL_PLANE_UNIT_MM.get(tags.get(FOCAL_PLANE_UNIT, 2))
    if focal_mm and pitch and unit_mm:
        # the pitch belongs to the picture as it was taken; it may have been reduced since
        taken_width = _number(tags.get(EXIF_WIDTH)) or size[0]
        from_pitch = focal_mm * pitch / unit_mm * size[0] / taken_width
        if from_35mm is None or abs(from_pitch / from_35mm - 1) < 0.05:
            candidates.append(from_pitch)
    if from_35mm is not None:
        candidates.append(from_35mm)
    plausible = [focal for focal in candidates if 0.2 < focal / max(size) < 20]
    return plausible[0] if plausible else None


def _gps(exif: Any) -> tuple[float, float, float] | None:
    """Latitude, longitude (degrees) and altitude (metres), or None where one of them is missing or no number."""
    tags = exif.get_ifd(GPS_IFD)
    try:
        latitude, longitude = (
            sum(float(part) / 60**k for k, part in enumerate(tags[tag])) for tag in (GPS_LATITUDE, GPS_LONGITUDE)
        )
        altitude = float(tags[GPS_ALTITUDE])
    except (KeyError, TypeError, ValueError, ZeroDivisionError):
        return None
    south, west = (str(tags.get(tag, "")).upper().startswith(side) for tag, side in (
        (GPS_LATITUDE_REF, "S"), (GPS_LONGITUDE_REF, "W")
    ))  # fmt: skip
    below_sea = tags.get(GPS_ALTITUDE_REF) in (1, b"\x01")
    found = (-latitude if south else latitude, -longitude if west else longitude, -altitude if below_sea else altitude)
    # 0, 0 is what cameras write that have no fix
    return found if all(map(math.isfinite, found)) and max(map(abs, found[:2])) > 0 else None


def _camera_key(exif: Any, size: tuple[int, int]) -> str:
    """Photos with this in common share one camera's intrinsics: body, lens, zoom, upright size."""
    tags = exif.get_ifd(EXIF_IFD)
    text = [
        str(value).replace("\0", "").strip()
        for value in (exif.get(MAKE), exif.get(MODEL), tags.get(LENS_MODEL))
        if value
    ]
    focal = _number(tags.get(FOCAL_LENGTH)) or _number(tags.get(FOCAL_LENGTH_35MM))
    if focal:
        text.append(f"{focal:g} mm")
    return " | ".join([*text, f"{size[0]} x {size[1]}"])


# ---------------------------------------------------------------- masks
def _find_masks(photos: list[str], folder: Path, poses: KnownPoses | None) -> dict[str, Path]:
    """Photo -> its mask file in `folder`; as the poses' format pairs them where it is that format's own folder."""
    if poses is None or {file.parent.resolve() for file in poses.masks.values()} != {folder.resolve()}:
        return _match_masks(photos, folder)
    cameras = match_photos(poses, photos)
    named = {photo: poses.masks.get(camera.name) for photo, camera in cameras.items()}
    return {photo: file for photo, file in named.items() if file is not None}


def _match_masks(photos: list[str], folder: Path) -> dict[str, Path]:
    """Photo -> its mask file: same relative path or, where unambiguous, same file name; see `_mask_keys`."""
    by_path: dict[str, Path] = {}
    by_name: dict[str, list[Path]] = {}
    for path in sorted(folder.rglob("*")):
        if path.is_file() and path.suffix.lower() in IMAGE_SUFFIXES and not path.name.startswith("."):
            key = path.relative_to(folder).with_suffix("").as_posix()
            by_path.setdefault(key, path)
            by_name.setdefault(PurePosixPath(key).name, []).append(path)
    found: dict[str, Path] = {}
    for photo in photos:
        own = PurePosixPath(photo)
        keys = [photo, str(own.with_suffix("")), f"{own.with_suffix('')}_mask", f"{photo}_mask"]
        match = next((by_path[key] for key in keys if key in by_path), None)
        if match is None:
            flat = [by_name.get(PurePosixPath(key).name, []) for key in keys]
            match = next((paths[0] for paths in flat if len(paths) == 1), None)
        if match is not None:
            found[photo] = match
    return found


def _read_mask(
    file: Path, photo: str, size: tuple[int, int], stored_size: tuple[int, int], orientation: int
) -> np.ndarray:
    """Mask [H, W] bool of the upright photo. White (or opaque) is the object.

    A mask drawn on the photo as it is stored is turned with it, where the sizes tell.
    """
    from PIL import Image, ImageOps

    try:
        with Image.open(file) as stored:
            stored.load()
            image: Image.Image = stored
            if image.size != size and image.size == stored_size:
                exif = image.getexif()
                exif[ORIENTATION] = orientation
                image.info["exif"] = exif.tobytes()
                image = ImageOps.exif_transpose(image)
            found = image.size
            channel = image.convert("RGBA") if image.mode in ("RGBA", "LA", "PA") else None
            values = np.asarray(image.convert("L"))
    except Exception as error:  # Pillow's decoders raise nearly anything on a damaged file
        raise InputError(f"The mask {file} cannot be read ({error}).", "Write it again as an 8-bit PNG.") from error
    _check_size(file, photo, found, size)
    if channel is not None:
        alpha = np.asarray(channel.getchannel("A"))
        if alpha.min() != alpha.max():
            values = alpha
    # half of the brightest value: masks of 0 and 1 are as common as masks of 0 and 255
    return values > values.max() / 2


def _check_size(mask: Path, photo: str, found: tuple[int, ...], size: tuple[int, int]) -> None:
    if found != size:
        raise InputError(
            f"The mask {mask.name} is {found[0]} x {found[1]} pixels, {photo} is {size[0]} x {size[1]}.",
            "Masks need the size of their (upright) photo: make the masks again from these photos.",
        )


def _write_mask(mask: np.ndarray, target: Path, size: tuple[int, int]) -> None:
    import cv2

    values = mask.astype(np.uint8) * 255
    if values.shape[::-1] != size:
        values = np.where(cv2.resize(values, size, interpolation=cv2.INTER_AREA) > 127, 255, 0).astype(np.uint8)
    target.parent.mkdir(parents=True, exist_ok=True)
    from PIL import Image

    Image.fromarray(values).save(target)


INGEST = Stage(
    name="ingest",
    version=2,
    needs=(),
    params="ingest",
    run=run,
    sources=("photos", "masks", "poses"),
    summary="read the photos and masks",
)
