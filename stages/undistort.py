"""Undistort: poses + photos -> pinhole images, masks warped by the same maps, the normalised scene.

The scene: what the photos are about (region), what it stands on (ground), which way is up. All in the frame of the
poses; how that lies in the world is `place`'s to say.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np

from configs.params import UndistortParams
from stages.artifacts import (
    FIRST_SCENE,
    GIVEN_POSES,
    GIVEN_REGION,
    IMAGE_SET,
    MODEL,
    OUTLINES,
    PHOTO_CONTENTS,
    PHOTOS,
    PINHOLE_PHOTOS,
    SILHOUETTES,
    KnownSphere,
    write_png,
)
from stages.engine.fingerprint import digest
from stages.engine.manifest import jsonable
from stages.engine.stage import Stage, StageContext
from stages.errors import ConfigError, ReconstructionError
from stages.geometry.cameras import PinholeCameras, PosedScene
from stages.geometry.layout import Layout, find_layout
from stages.geometry.normalisation import into_frame, scene_frame, still_fits
from stages.geometry.place import GivenRegion
from stages.geometry.region import RegionOfInterest
from stages.geometry.silhouettes import MIN_SHARE, agreeing, silhouette_agreement
from stages.geometry.similarity import Similarity
from stages.geometry.subjects import Subject, find_subjects
from stages.geometry.up import Up
from stages.posing.backdrop import seen_background
from stages.posing.undistortion import (
    plan_warp,
    png_names,
    posed_cameras,
    registered_photos,
    sparse_points,
    warp_image,
    warp_maps,
    warp_mask,
)

log = logging.getLogger(__name__)

PNG_COMPRESSION = 2  # of 9; twice as fast as the default for a few percent of size


def run(context: StageContext[UndistortParams]) -> dict[str, Any]:
    """Warp every registered photo, find the region of interest, write the scene."""
    import pycolmap

    model = pycolmap.Reconstruction(str(context.read(MODEL)))
    photos = registered_photos(model)
    warps = {camera_id: plan_warp(camera, context.params.max_side) for camera_id, camera in model.cameras.items()}
    names = png_names([photo.name for photo in photos])
    records = {record.name: record for record in context.read(IMAGE_SET).images}
    guessed = [records[photo.name].made_mask == "salient" for photo in photos]
    masks = _warp_all(context, model, photos, names, warps)

    cameras = posed_cameras(photos, names, warps)
    masks = _without_doubtful(cameras, masks, guessed)
    beside, of_background = _lie_beside(context, model, photos, guessed)
    _write_masks(context, names, masks, guessed, beside)
    points, errors, observations = sparse_points(model, photos)
    known, given = context.read(GIVEN_POSES), context.read(GIVEN_REGION)
    stated = known.region if known else None
    about: np.ndarray | None = None
    warnings: list[dict[str, str]] = []
    found = stated is None and given is None
    if found:
        subjects = find_subjects(cameras, points, observations)
        about, warnings = _chosen(subjects, [photo.name for photo in photos], context.params.subject)
    region, ground, up = _find_layout(cameras, points, observations, masks, stated, about)
    if known is not None and known.place is not None and known.place.up is not None:
        whole = known.place.place()
        up = Up(whole.up @ whole.world_from_poses.rotation, "the whole that this is a part of", sure=True)
    region = _set(region, given, context.params.roi_scale)
    lineage = _lineage(context, given)
    poses_from_scene, kept = _frame(context, lineage, scene_frame(region.center, region.radius, up.direction))
    # A region that somebody chose, or made smaller, stays as it is; and masks are believed.
    growable = found and context.params.roi_scale >= 1 and all(mask is None for mask in masks)
    scene = PosedScene(
        cameras=into_frame(cameras, poses_from_scene),
        poses_from_scene=poses_from_scene,
        points=poses_from_scene.inverse().apply(points).astype(np.float32),
        point_errors=errors,
        observations=observations,
        up=np.array([0.0, 0.0, 1.0]),
        kind=region.kind,
        ground=ground and ground.within(poses_from_scene),
        growable=growable,
        roi_scale=context.params.roi_scale,
        contents=tuple(context.read(PHOTO_CONTENTS).contents[photo.name] for photo in photos),
        lineage=lineage,
    )
    context.write(FIRST_SCENE, scene)
    context.progress(len(photos) + 1, len(photos) + 1, "done")

    inside = np.linalg.norm(scene.points, axis=1) < 1
    return {
        "images": len(photos),
        "width": int(scene.cameras.sizes[:, 0].max()),
        "height": int(scene.cameras.sizes[:, 1].max()),
        "masks": sum(mask is not None for mask in masks),
        **of_background,
        **({"masks_dropped": sum(guessed) - _count(masks, guessed)} if any(guessed) else {}),
        "kind": scene.kind,
        "region_from": region.source,
        "up_from": up.source,
        "ground": ground is not None,
        "points": len(points),
        "points_inside": int(inside.sum()),
        "camera_distance": round(float(np.median(np.linalg.norm(scene.cameras.centers, axis=1))), 3),
        **({} if kept is None else {"region_kept": kept}),
        "warnings": warnings,
    }


# ---------------------------------------------------------------- pinhole images
def _warp_all(
    context: StageContext[UndistortParams],
    model: Any,
    photos: list[Any],
    names: list[str],
    warps: dict[int, Any],
) -> list[np.ndarray | None]:
    """Write all pinhole images; all masks [H, W] uint8, None where there is none."""
    import cv2

    taken, written = context.read(PHOTOS), context.to_write(PINHOLE_PHOTOS)

    # Maps take 8 bytes a pixel, and where photos share no camera there is a pair for each of them: keep a few.
    @lru_cache(maxsize=max(1, context.workers))
    def maps_of(camera_id: int) -> tuple[np.ndarray, np.ndarray]:
        return warp_maps(model.cameras[camera_id], warps[camera_id])

    done = 0

    def warp(job: tuple[str, str, int]) -> np.ndarray | None:
        """Writes one image; returns its mask."""
        nonlocal done
        source, name, camera_id = job
        maps = maps_of(camera_id)
        pixels = warp_image(taken.image(source), warps[camera_id], maps, cv2.INTER_CUBIC)
        write_png(written.path(name), pixels, PNG_COMPRESSION)
        mask = taken.mask(source)
        if mask is not None:
            mask = warp_mask(mask, warps[camera_id], maps, context.params.mask_erode)
        done += 1
        context.progress(done, len(photos) + 1, source)
        return mask

    before = cv2.getNumThreads()
    cv2.setNumThreads(1)  # the pool below is the parallelism
    try:
        with ThreadPoolExecutor(max_workers=max(1, context.workers)) as pool:
            sources, lenses = [photo.name for photo in photos], [photo.camera_id for photo in photos]
            return list(pool.map(warp, zip(sources, names, lenses, strict=True)))
    finally:
        cv2.setNumThreads(before)


def _write_masks(
    context: StageContext[UndistortParams],
    names: list[str],
    masks: Sequence[np.ndarray | None],
    guessed: Sequence[bool],
    beside: bool,
) -> None:
    """Write the masks [H, W] uint8: with the photos, or apart, where they are guessed or lie `beside` whole photos."""
    given, guesses = context.to_write(OUTLINES if beside else PINHOLE_PHOTOS), context.to_write(SILHOUETTES)
    for name, mask, guess in zip(names, masks, guessed, strict=True):
        if mask is not None:
            write_png((guesses if guess else given).mask_path(name), mask, PNG_COMPRESSION)


def _lie_beside(
    context: StageContext[UndistortParams], model: Any, photos: list[Any], guessed: Sequence[bool]
) -> tuple[bool, dict[str, Any]]:
    """Whether given masks lie beside whole photos, and what the summary says of that."""
    taken, wanted = context.read(PHOTOS), context.params.masks
    masked = [
        photo
        for photo, guess in zip(photos, guessed, strict=True)
        if not guess and taken.mask_path(photo.name).exists()
    ]
    if wanted != "auto" or not masked:
        return wanted == "beside", {}
    if context.read(PHOTO_CONTENTS).background_moved:
        log.info("the background moved against the object: the masks alone count")
        return False, {"background_is_seen": False}
    found = seen_background(model, masked, taken.mask)
    log.info(
        "%.0f %% of the features off the masks are points of the model (%.0f a photo), %.0f %% of those on them: %s",
        100 * found.off, found.points, 100 * found.on,
        "whole photos count beside the masks" if found.is_seen else "the masks alone count",
    )  # fmt: skip
    return found.is_seen, {"background_is_seen": found.is_seen}


def _without_doubtful(
    cameras: PinholeCameras, masks: list[np.ndarray | None], guessed: Sequence[bool]
) -> list[np.ndarray | None]:
    """The masks [H, W] uint8 less the guesses that do not fit the others'."""
    if not any(guessed):
        return masks
    believed = agreeing(silhouette_agreement(cameras, masks))
    kept = [mask if fits or not guess else None for mask, fits, guess in zip(masks, believed, guessed, strict=True)]
    total, count = sum(guessed), _count(kept, guessed)
    if count == 0:
        log.warning(
            "none of the %d masks that were made is used: fewer than %.0f %% of them show the same thing "
            "(look at ingest/masks); `--masks FOLDER` takes masks of your own",
            total, 100 * MIN_SHARE,
        )  # fmt: skip
    elif count < total:
        log.warning("%d of %d masks that were made do not fit the others and are not used", total - count, total)
    return kept


def _count(masks: Sequence[np.ndarray | None], guessed: Sequence[bool]) -> int:
    """Guesses that are left."""
    return sum(mask is not None and guess for mask, guess in zip(masks, guessed, strict=True))


# ---------------------------------------------------------------- what the photos are about
def _chosen(
    subjects: Sequence[Subject], names: Sequence[str], number: int
) -> tuple[np.ndarray | None, list[dict[str, str]]]:
    """Photos of the subject of this number (from 1), None where all are; and for the report, that there are others.

    Raises:
        ConfigError: there are not so many subjects.
    """
    if number > max(1, len(subjects)):
        raise ConfigError(
            f"`undistort.subject` is {number}, but the photos are about {max(1, len(subjects))} that lie far apart.",
            "Try `--set undistort.subject=1`.",
        )
    if len(subjects) < 2:
        return None, []
    taken, warnings = subjects[number - 1], []
    for k, other in enumerate(subjects, 1):
        if k != number:
            away = float(np.linalg.norm(other.sphere[0] - taken.sphere[0])) / taken.sphere[1]
            sentence = (
                f"Only what {len(taken.photos)} photos are about is reconstructed ({_named(names, taken)}). "
                f"{len(other.photos)} others ({_named(names, other)}) are about something {away:.0f} times its "
                "radius away. Its model takes the place of this one: work in a copy of the workspace to keep both."
            )
            command = f"hineus run --workspace WORKSPACE --set undistort.subject={k}"
            warnings.append({"sentence": sentence, "command": command})
    return taken.photos, warnings


def _named(names: Sequence[str], subject: Subject) -> str:
    """The first and the last photo of a subject."""
    return f"{names[subject.photos[0]]} to {names[subject.photos[-1]]}"


def _find_layout(
    cameras: PinholeCameras,
    points: np.ndarray,
    observations: np.ndarray,
    masks: Sequence[np.ndarray | None],
    stated: KnownSphere | None,
    photos: np.ndarray | None,
) -> Layout:
    """As `find_layout`; `stated` is what the given poses say."""
    sphere = RegionOfInterest(stated.center, stated.radius, "object", stated.source) if stated else None
    try:
        return find_layout(cameras, points, observations, masks, sphere, photos)
    except ValueError as error:
        raise ReconstructionError(
            f"No region of interest found from {len(cameras)} cameras and {len(points)} points ({error}).",
            "Photograph the object from more sides, try `--set sfm.matcher=exhaustive`, or say where it is: "
            "`--set 'place.region=sphere X Y Z RADIUS'`.",
        ) from error


def _set(region: RegionOfInterest, given: GivenRegion | None, scale: float) -> RegionOfInterest:
    """The region as the user wants it: `given`, or as it was found but for its scale."""
    if given is None:
        return replace(region, radius=region.radius * scale)
    source = "the given sphere" if given.box is None else "the given box"
    return RegionOfInterest(given.center, given.radius, region.kind, source)


# ---------------------------------------------------------------- photos that came or went
def _lineage(context: StageContext[UndistortParams], given: GivenRegion | None) -> str:
    """The poses' lineage, with all that makes a scene of them."""
    region = None if given is None else [given.center.tolist(), given.radius, jsonable(given.box)]
    poses = context.read(PHOTO_CONTENTS).lineage
    return digest([poses, UNDISTORT.version, context.params.model_dump(mode="json"), region])


def _frame(context: StageContext[UndistortParams], lineage: str, found: Similarity) -> tuple[Similarity, bool | None]:
    """poses_from_scene: that of the last scene where it still fits what was `found` now; and whether it does.

    None where there is no last scene of these poses.
    """
    before = context.read_previous(FIRST_SCENE)
    if before is None or before.lineage != lineage:
        return found, None
    if still_fits(before.poses_from_scene, found):
        log.info("the region stays as it was")
        return before.poses_from_scene, True
    log.info("the region is found anew: that of before does not fit the photos any more")
    return found, False


UNDISTORT: Stage[UndistortParams] = Stage(
    name="undistort",
    version=12,
    settings=lambda config: config.undistort,
    run=run,
    reads=(PHOTOS, IMAGE_SET, MODEL, PHOTO_CONTENTS, GIVEN_POSES, GIVEN_REGION),
    writes=(PINHOLE_PHOTOS, OUTLINES, SILHOUETTES, FIRST_SCENE),
    continues=True,
    summary="make pinhole images and find the region of interest",
)
