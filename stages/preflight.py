"""Can these photos be reconstructed here? What is in them, what it will take, and go or no-go."""

from __future__ import annotations

import os
import re
import shlex
import shutil
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from configs.params import Config
from stages.artifacts import SkippedImage
from stages.capture.gps import gps_warnings
from stages.capture.inspection import Inspection, inspect
from stages.capture.listing import NAMED, by_reason, name_some
from stages.capture.mask_doubts import find_doubts, nothing_kept
from stages.capture.masks import ASIDE, EMPTY, bytes_to_read_masks, missing_masks, tell_masks
from stages.capture.panoramas import split_size
from stages.capture.salient import INSTALL, find_weights
from stages.capture.selection import Sources
from stages.engine.fingerprint import file_sha256
from stages.errors import InputError
from stages.files.light_files import GIVEN_LIGHT, read_light
from stages.limits import available_memory, nearest_existing
from stages.posing.control_files import CONTROL, read_control
from stages.posing.marks import foresee
from stages.posing.reading import read_poses
from stages.shading.named_balls import named_balls

Verdict = Literal["go", "go with warnings", "no-go"]

FEWEST_IN_A_BLOCK = 12  # photos; a block that is given fewer learns little
MOSTLY_PLAIN = 0.5  # so many plain backgrounds are meant; too few for masks from the background's colour alone
FEW_PHOTOS = 20  # a full turn in steps of less than 20 degrees; sets below it lose photos
CONTROL_NAME = re.compile(r"(gcp|ground.?control)[^/]*\.(txt|csv)$", re.IGNORECASE)

# All measured with `benchmarks/run_sets.py` on two cores, see docs/benchmarks/results.md.
GIB = 1 << 30
MEMORY_BASE_GIB = 1.5  # baking, the peak of all sets: 1.45 to 1.66 GiB
# Training holds all photos' bytes, once: 1.06 GiB beside them with 640 photos, 0.76 with the preset tiny.
TRAIN_BASE_GIB = 1.1
SFM_BASE_GIB, SFM_GIB_PER_THREAD_MP = 0.25, 0.25  # finding features: 0.32 GiB at 0.3 megapixels, 1.0 at 1.5
MEMORY_MARGIN = 1.3  # an estimate this near to what is there gets a warning
SFM_CPU_S_PER_MP = 2.8  # 2.3 to 3.3 CPU seconds a megapixel looked at
SFM_CPU_S_PER_PAIR = 0.01  # too little in those sets to be told from nothing; larger ones have more pairs
PAIRS_PER_PHOTO = 10  # 3.7 of 16 photos, 8 of 47 around something, 14 of 150 on half a walk; of neighbours 10
STEREO_CPU_S_PER_MP_AND_NEIGHBOR = 0.28  # 1.0 to 1.2 CPU seconds a megapixel compared with four neighbours
STEREO_BASE_GIB, STEREO_GIB_PER_MP = 0.5, 0.021  # 0.55 to 1.2 GiB at 11 to 29 megapixels; maps of all are held
COVERED = 0.6  # share of the surface that dense points cover: 0.16 of polished metal, 0.6 of plaster, 0.9 of a helmet
TRAIN_CPU_S_PER_RAY_SAMPLE = 4.9e-6  # 317 to 329 CPU seconds for 8000 steps of 512 rays of 16 samples
OTHER_CPU_S = 65.0  # everything after training: 37 to 47, and 15 more since UVAtlas makes the charts
MATERIALS_CPU_S = 85.0  # 78 to 94 of four objects with 40 photos each: docs/benchmarks/materials.md
# docs/benchmarks/splats.md; refining draws photos as they are, or smaller where they are finer than Gaussians.
SPLATS_CPU_S, SPLATS_CPU_S_PER_STEP = 30.0, 0.65
# Part of the work that cores share: two made training 1.53 to 1.80 times as fast, poses 1.7 times. What more cores
# bring was not measured; by Amdahl's law it is at most five times one core.
PARALLEL_SHARE = 0.8
DISK_BASE_GB = 0.3  # checkpoint, meshes, textures, report: an allowance
FEATURE_BYTES_PER_PIXEL = 1.2  # looked at: features and matches are kept for photos that are added later
DISK_BYTES_PER_PIXEL = 2.0  # undistorted images are PNG: 1.4 to 2 bytes a pixel
STEREO_BYTES_PER_PIXEL = 6.0  # compared: depth maps and points, 3 to 8


@dataclass(frozen=True)
class Needs:
    """What the reconstruction will take.

    Attributes:
        memory_gib: peak of main memory.
        disk_gb: the finished workspace.
        minutes: wall clock; None on a GPU, where nothing was measured.
    """

    memory_gib: float
    disk_gb: float
    minutes: float | None


@dataclass(frozen=True)
class Preflight:
    """What was seen, what it needs, and what to make of it.

    Attributes:
        max_side: what photos are reduced to, longest side in pixels.
        refusals: reasons for "no-go" that lie in the photos; `shortages`: those that lie in the machine.
        kept: what a run would keep of the workspace that is there, see `stages.kept`; empty where nothing has changed.
    """

    inspection: Inspection
    max_side: int
    needs: Needs
    warnings: tuple[str, ...]
    refusals: tuple[str, ...]
    shortages: tuple[str, ...]
    kept: str = ""

    @property
    def verdict(self) -> Verdict:
        if self.refusals or self.shortages:
            return "no-go"
        return "go with warnings" if self.warnings else "go"

    @property
    def reduced(self) -> int:
        """How many photos are larger than `max_side`."""
        return sum(max(size) > self.max_side for size in self.inspection.sizes)

    def as_dict(self) -> dict[str, Any]:
        """JSON-able."""
        seen = self.inspection
        return {
            "verdict": self.verdict,
            "photos": len(seen.photos),
            "panoramas": sorted(seen.spheres),
            "videos": [asdict(video) for video in seen.videos],
            "left_out": [asdict(item) for item in seen.skipped],
            "sizes": [[*size, count] for size, count in Counter(seen.sizes).most_common()],
            "cameras": dict(Counter(photo.camera for photo in seen.photos)),
            "with_focal": sum(photo.has_focal for photo in seen.photos),
            "with_gps": _located(seen),
            "reduced": self.reduced,
            "colour_profiles": dict(Counter(photo.colours.name for photo in seen.photos if photo.colours.name)),
            **asdict(seen.oddities),
            "plain_background": seen.plain,
            "masks": len(seen.masks.looks or seen.masks.files),
            "needs": asdict(self.needs),
            "warnings": list(self.warnings),
            "refusals": list(self.refusals),
            "shortages": list(self.shortages),
            "kept": self.kept,
        }


def preflight(
    sources: Mapping[str, Path | None],
    folder: Path,
    config: Config,
    device: str,
    workers: int,
    decode: bool,
    digests: Mapping[str, str] | None = None,
    only_poses: bool = False,
) -> Preflight:
    """Look at the photos, and at the memory and the disk of `folder`, where the workspace will lie.

    `decode`: whether to judge the photos' pixels, too; before a run that is left to ingest, which decodes them anyway.
    `sources`: by name the photos, masks, known poses, control points and light that are given. `digests`: of photos
    whose sha256 is known. `only_poses`: nothing is learned of them in this workspace, as where blocks do that.

    Raises:
        InputError: there is no such folder or video, or the poses, control points, light or balls cannot be used.
        ConfigError, SystemRequirementError: the points' coordinates cannot be converted.
    """

    source, masks = sources["photos"], sources.get("masks")
    poses, control = sources.get("poses"), sources.get(CONTROL)
    assert source is not None, "there is nothing to look at"

    def digest(path: str, file: Path) -> str:
        return (digests or {}).get(path) or file_sha256(file)

    try:
        known = read_poses(poses) if poses is not None else None
    except InputError:
        if decode:
            raise
        known = None  # the run that follows reads them, too, and says what is wrong
    seen = inspect(Sources(source, masks, digest, known), config.ingest, workers, decode)
    needs = estimate(seen, config, device, workers, only_poses)
    folder = nearest_existing(folder)
    memory, disk = available_memory() / GIB, shutil.disk_usage(folder).free / 1e9
    refusals, shortages = [], []
    if seen.places < config.ingest.min_images:
        refusals.append(f"{seen.places} usable photos, {config.ingest.min_images} are needed.")
    warnings = _warnings(seen, config)
    if control is None:
        warnings += _unused_control(seen, source)
    sizes = {photo.source: (photo.width, photo.height) for photo in seen.photos}
    if not seen.videos:  # their frames have no names yet
        named_balls(config.materials.balls, sizes)
    if control is not None and not seen.videos:
        found = read_control(control)
        more, doubts = foresee(found, found.system(config.place.control_epsg), sizes)
        refusals, warnings = refusals + more, warnings + doubts
    if (light := sources.get(GIVEN_LIGHT)) is not None:
        read_light(light)
    if needs.memory_gib > memory:
        in_blocks = "" if only_poses else _in_blocks(seen, config, workers, memory)
        shortages.append(
            f"It may take {needs.memory_gib:.1f} GiB of memory, {memory:.1f} are free: {in_blocks}close other "
            "programs, or try `--set undistort.max_side=800`, `--set densify.side=600`, `--workers 1`."
        )
    if not os.access(folder, os.W_OK):
        shortages.append(f"{folder} cannot be written: try `--workspace DIR`.")
    if needs.disk_gb > disk:
        shortages.append(f"It may take {needs.disk_gb:.1f} GB of disk, {disk:.1f} are free: try `--workspace DIR`.")
    if config.ingest.auto_mask in ("salient", "object") and find_weights() is None:
        shortages.append(f"`ingest.auto_mask={config.ingest.auto_mask}` needs a network that is missing: `{INSTALL}`.")
    has_masks = seen.masks.looks or seen.masks.files
    if config.sfm.masks == "always" and not has_masks and config.ingest.auto_mask == "off":
        warnings.append(
            "Only what masks show is to be matched, and there are none, unless all photos bring theirs: give "
            "`--masks FOLDER`, or have them made with `--set ingest.auto_mask=object`."
        )
    doubts, impossible = _of_masks(seen, config, masks)
    warnings += doubts
    refusals += impossible
    if memory / MEMORY_MARGIN < needs.memory_gib <= memory:
        warnings.append(f"It may take {needs.memory_gib:.1f} of the {memory:.1f} GiB of memory that are free.")
    return Preflight(seen, config.ingest.max_side, needs, tuple(warnings), tuple(refusals), tuple(shortages))


def estimate(seen: Inspection, config: Config, device: str, workers: int, only_poses: bool = False) -> Needs:
    """From simple models of what was measured; see the constants."""
    looked_at = _pixels(seen.sizes, min(config.ingest.max_side, config.sfm.max_image_size))
    memory_gib, minutes = _poses_gib(seen, looked_at, workers), _poses_minutes(looked_at, config, workers)
    disk_bytes = seen.num_bytes + FEATURE_BYTES_PER_PIXEL * sum(looked_at)
    if not only_poses:
        side = min(config.ingest.max_side, config.undistort.max_side)
        trained_on = sum(_pixels(seen.sizes, side))
        compared = 0.0 if config.densify.method == "off" else sum(_pixels(seen.sizes, min(side, config.densify.side)))
        memory_gib = max(memory_gib, _learning_gib(trained_on, compared, config))
        minutes += _learning_minutes(compared, config, workers)
        disk_bytes += DISK_BYTES_PER_PIXEL * trained_on + STEREO_BYTES_PER_PIXEL * compared
    return Needs(memory_gib, DISK_BASE_GB + disk_bytes / 1e9, minutes if device == "cpu" else None)


def _poses_gib(seen: Inspection, looked_at: list[float], workers: int) -> float:
    """Peak of reading the photos, and finding features in so many pixels of each."""
    masks_bytes = bytes_to_read_masks(seen.masks.files.values())
    read_gib = max([masks_bytes, *(photo.bytes_to_read for photo in seen.photos)]) / GIB
    return max(read_gib, SFM_BASE_GIB + workers * SFM_GIB_PER_THREAD_MP * max(looked_at, default=0) / 1e6)


def _in_blocks(seen: Inspection, config: Config, workers: int, memory_gib: float) -> str:
    """What to do where it is the number of photos that is too much for one process; else nothing."""
    held = photos_held(seen.sizes, config, memory_gib)
    poses_gib = estimate(seen, config, "cpu", workers, only_poses=True).memory_gib
    if not FEWEST_IN_A_BLOCK <= held < len(seen.sizes) or poses_gib > memory_gib:
        return ""
    return f"one process holds {held} of these {len(seen.sizes)} photos, `--blocks auto` makes them in parts; or "


def _pixels(sizes: Sequence[tuple[int, int]], most: int) -> list[float]:
    """Of each photo, shrunk where its longer side has more than `most`."""
    return [width * height * min(1.0, most / max(width, height)) ** 2 for width, height in sizes]


def _learning_gib(trained_on: float, compared: float, config: Config) -> float:
    """Peak of all that follows the poses, for so many pixels."""
    stereo_gib = 0.0 if config.densify.method == "off" else STEREO_BASE_GIB + STEREO_GIB_PER_MP * compared / 1e6
    return max(stereo_gib, MEMORY_BASE_GIB, TRAIN_BASE_GIB + 3 * trained_on / GIB)


def memory_asked_for(sizes: Sequence[tuple[int, int]], config: Config) -> int:
    """Bytes of memory that a process with these photos, whose poses are known, asks of whoever shares memory out.

    Args:
        sizes: width and height of photos as ingest takes them.
    """
    side = config.undistort.max_side
    trained_on, compared = (sum(_pixels(sizes, most)) for most in (side, min(side, config.densify.side)))
    return int(MEMORY_MARGIN * GIB * _learning_gib(trained_on, compared, config))


def photos_held(sizes: Sequence[tuple[int, int]], config: Config, memory_gib: float) -> int:
    """How many photos one process can be given with so much memory, by the models of `estimate`.

    Args:
        sizes: width and height of photos; the median of these is every photo's.
    """
    side = min(config.ingest.max_side, config.undistort.max_side)
    trained_on, compared = (float(np.median(_pixels(sizes, most))) for most in (side, min(side, config.densify.side)))
    free = memory_gib / MEMORY_MARGIN
    if free < MEMORY_BASE_GIB:
        return 0
    held = (free - TRAIN_BASE_GIB) / (3 * trained_on / GIB)
    if config.densify.method != "off":
        held = min(held, (free - STEREO_BASE_GIB) / (STEREO_GIB_PER_MP * compared / 1e6))
    return max(0, int(held))


def _poses_minutes(looked_at: list[float], config: Config, workers: int) -> float:
    count = len(looked_at)
    pairs = count * (count - 1) / 2
    if config.sfm.matcher != "exhaustive":
        pairs = min(pairs, PAIRS_PER_PHOTO * count)
    cpu_s = SFM_CPU_S_PER_MP * sum(looked_at) / 1e6 + SFM_CPU_S_PER_PAIR * pairs
    return cpu_s * _wall_per_cpu(workers) / 60


def _learning_minutes(compared: float, config: Config, workers: int) -> float:
    """Of all that follows the poses."""
    train = config.train
    part = 1 + COVERED * (train.steps_if_covered - 1) if compared else 1.0
    ray_samples = part * train.steps * train.sampling.rays * train.sampling.samples
    training_s = ray_samples * TRAIN_CPU_S_PER_RAY_SAMPLE * _wall_per_cpu(workers)
    if train.minutes is not None:
        training_s = 60 * train.minutes
    stereo_s = STEREO_CPU_S_PER_MP_AND_NEIGHBOR * config.densify.neighbors * compared / 1e6
    later_s = OTHER_CPU_S + MATERIALS_CPU_S * config.materials.enabled
    later_s += (SPLATS_CPU_S + SPLATS_CPU_S_PER_STEP * config.splats.steps) * config.splats.enabled
    return (training_s + (stereo_s + later_s) * _wall_per_cpu(workers)) / 60


def _wall_per_cpu(workers: int) -> float:
    return 1 - PARALLEL_SHARE + PARALLEL_SHARE / workers


def _warnings(seen: Inspection, config: Config) -> list[str]:
    found = []
    if config.ingest.min_images <= len(seen.sizes) < FEW_PHOTOS:
        found.append(f"Only {len(seen.sizes)} photos; 30 to 100 that overlap by two thirds give a whole object.")
    found += seen.oddities.warnings
    if config.place.gps:
        found += gps_warnings({photo.source: photo.gps for photo in seen.photos})
    unusable = by_reason(item for item in seen.skipped if not item.expected)
    found += [f"Left out {name_some(names)}: {reason}." for reason, names in unusable.items()]
    doubtful = by_reason(SkippedImage(photo.source, photo.colours.problem) for photo in seen.photos)
    return found + [f"{name_some(names)}: {problem}." for problem, names in doubtful.items() if problem]


def _located(seen: Inspection) -> int:
    """Photos that say where they were taken."""
    return sum(photo.gps.position is not None for photo in seen.photos)


def _unused_control(seen: Inspection, source: Path) -> list[str]:
    """That a file of ground control points lies among the photos, where none is given."""
    return [
        f"{item.source} looks like ground control points, which are used with `--control {source / item.source}`."
        for item in seen.skipped
        if CONTROL_NAME.search(item.source)
    ]


def _of_masks(seen: Inspection, config: Config, folder: Path | None) -> tuple[list[str], list[str]]:
    """Warnings and refusals."""
    photos = [photo.source for photo in seen.photos]
    doubts = find_doubts(seen.masks.looks, config.ingest.masks_keep)
    refusals = [f"{doubt.message} {doubt.hint}" for doubt in doubts if doubt.impossible]
    warnings = [f"{doubt.message} {doubt.hint}" for doubt in doubts if not doubt.impossible]
    if error := missing_masks(photos, seen.masks.files, folder):
        refusals.append(f"{error.message} {error.hint}")
    if unusable := seen.masks.unusable:
        more = f" {len(unusable) - 1} more masks cannot be used either." if len(unusable) > 1 else ""
        refusals.append(f"{unusable[0].message}{more} {unusable[0].hint}")
    empty = [item.source for item in seen.skipped if item.reason.startswith(EMPTY)]
    if empty and not seen.masks.looks:
        refusals.append(" ".join(nothing_kept(len(empty), empty[0])))
    masked = len(seen.masks.looks or seen.masks.files)
    if folder is None and 0 < masked < len(photos) and config.ingest.auto_mask not in ("plain", "object"):
        warnings.append(
            f"Only {masked} of {len(photos)} photos have a mask, so that training goes without masks. Add the others', "
            "or leave all out with `--no-masks`."
        )
    return warnings, refusals


def masks_in_words(seen: Inspection) -> str:
    """Which masks are used, and which could be."""
    said = []
    if seen.masks.looks:
        said.append(tell_masks(seen.masks.looks))
    elif seen.masks.unused is not None:
        said.append(f"none are used; `--masks {shlex.quote(str(seen.masks.unused))}` would use those there")
    aside = by_reason(item for item in seen.skipped if item.reason.startswith(ASIDE))
    said += [f"Left out {name_some(files)}: {reason}" for reason, files in aside.items()]
    return ". ".join(said)


def facts(done: Preflight) -> list[tuple[str, str]]:
    """What was found, line by line: a word and a text."""
    seen, needs = done.inspection, done.needs
    lines = [("photos", str(len(seen.photos)))]
    if seen.spheres:
        views = sum(split_size(sphere)[0] for sphere in seen.spheres.values())
        lines.append(("360 degrees", f"{len(seen.spheres)} of them, which are split into {views} pinhole views"))
    lines += [("video", f"{clip.source}: up to {clip.frames} frames") for clip in seen.videos]
    sizes = Counter(seen.sizes).most_common()
    lines.append(("sizes", "; ".join(f"{count} x {width} x {height}" for (width, height), count in sizes[:NAMED])))
    cameras = Counter(photo.camera for photo in seen.photos).most_common()
    lines += [("camera", f"{name} ({count} photos)") for name, count in cameras[:NAMED]]
    if len(cameras) > NAMED:
        lines.append(("camera", f"and {len(cameras) - NAMED} more"))
    with_focal = sum(photo.has_focal for photo in seen.photos)
    if done.reduced:
        lines.append(
            ("reduced", f"{done.reduced} of {len(seen.sizes)} to {done.max_side} pixels, by `ingest.max_side`")
        )
    profiles = Counter(photo.colours.name for photo in seen.photos if photo.colours.name).most_common()
    lines += [("colours", f"{name} ({count} photos), converted to sRGB") for name, count in profiles[:NAMED]]
    estimated = "" if with_focal == len(seen.photos) else "; else it is estimated"
    lines.append(("focal length", f"in the EXIF of {with_focal} of {len(seen.photos)} photos{estimated}"))
    if located := _located(seen):
        lines.append(("GPS", f"a position in {located} of {len(seen.photos)} photos"))
    companions = by_reason(item for item in seen.skipped if item.expected and not item.reason.startswith(ASIDE))
    lines += [("set aside", f"{name_some(names)}: {reason}") for reason, names in companions.items()]
    if seen.plain:
        lines.append(("background", "plain: `--set ingest.auto_mask=plain` would cut the object out"))
    elif seen.plain_share >= MOSTLY_PLAIN:
        missing = "" if find_weights() else f" (after `{INSTALL}`)"
        lines.append(
            (
                "background",
                f"plain in {seen.plain_share:.0%} of the photos: `--set ingest.auto_mask=salient`{missing} may cut the "
                "object out",
            )
        )
    if said := masks_in_words(seen):
        lines.append(("masks", said))
    if done.kept:
        lines.append(("workspace", done.kept))
    minutes = "not measured on a GPU" if needs.minutes is None else f"about {needs.minutes:.0f} min"
    lines.append(("needs", f"{minutes}, {needs.memory_gib:.1f} GiB of memory, {needs.disk_gb:.1f} GB of disk"))
    return lines


def in_short(done: Preflight) -> str:
    """One line for the start of a run."""
    seen, needs = done.inspection, done.needs
    cameras = len({photo.camera for photo in seen.photos}) + len(seen.videos)
    time = "" if needs.minutes is None else f"about {needs.minutes:.0f} min, "
    return (
        f"{len(seen.sizes)} photos, {cameras} camera{'' if cameras == 1 else 's'}; "
        f"{time}{needs.memory_gib:.1f} GiB of memory, {needs.disk_gb:.1f} GB of disk: {done.verdict}"
    )
