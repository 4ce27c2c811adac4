"""Sfm: upright images -> a COLMAP model (the largest component), with a reason for every photo left out.

With poses that are known already they are taken as they are, and only points are found. Where photos came or went since
the last model, poses of the others stay (`stages.posing.adding`).
"""

from __future__ import annotations

import errno
import logging
import os
import shutil
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from configs.params import SfmParams
from stages.artifacts import (
    FEATURES,
    GIVEN_POSES,
    IMAGE_SET,
    LEFT_OUT,
    MODEL,
    PHOTO_CONTENTS,
    PHOTOS,
    REGISTRATION,
    GivenPoses,
    ImageSet,
    PhotoContents,
    PhotoFile,
    Pictures,
    PlaceRecord,
    Registration,
    Unregistered,
)
from stages.capture.salient import INSTALL, find_weights
from stages.engine.fingerprint import digest, file_sha256
from stages.engine.photos_since import compare_photos
from stages.engine.stage import Stage, StageContext
from stages.engine.workspace import disk_full_error, free_bytes
from stages.errors import InputError, ReconstructionError
from stages.posing.adding import STAYED, KnownPhotos, known_lenses, put_back
from stages.posing.adjustment import LastAdjustment, adjust_last
from stages.posing.evidence import MIN_VERIFIED, Evidence
from stages.posing.joining import view_distance
from stages.posing.known import match_photos
from stages.posing.ladder import Solution, Step, climb, describe, photos_wanted
from stages.posing.parts import rebuilt
from stages.posing.reading import read_poses
from stages.posing.triangulation import DATABASE, triangulate
from stages.posing.turning import MIN_PARALLAX, Depth, from_one_place, judge_depth, refuse_one_place, relief, two_places
from stages.posing.workbench import ADDED, RELAXED, Workbench, learned_available

log = logging.getLogger(__name__)

FEW_POINTS = 10  # fewer points than this a photo are worth a warning where the poses are known
DOUBTFUL_ERROR_PX = 2.0  # COLMAP's own models are below one
MIN_CONNECTED = 0.5  # of new photos must be placed beside the known ones, or poses are found anew from all
MIN_PLACES, TWO_PLACES = 5, 0.8  # part of more photos than so many that were taken from two places: no walk is
SECOND_PASS = 0.25  # part of the photos: a model of so many beside the largest is no accident
# Points this far off one plane, in the distance they are seen from, are no flat thing, whatever pairs of photos show.
FLAT_RELIEF = 0.01
# Of the focal length. Of flat things it was 0.02 % seen at many angles, 4 % and more (and wrong by 21 %) straight on.
DOUBTFUL_FOCAL_ERROR = 0.01
# Of a feature in COLMAP's database: a descriptor of 128 bytes, a place of 24; as much again for matches and the like.
FEATURE_BYTES = 2 * 152
FEATURES_EXTRA = "pip install 'hineus[features]'"


def run(context: StageContext[SfmParams]) -> dict[str, Any]:
    """Features, matches, mapping, and again in other ways while too few photos have a pose.

    Writes model/ and registration.json.

    Raises:
        InputError: the photos lack what a setting needs.
        ReconstructionError: too few photos could be placed.
        WorkspaceError: the disk has no room for the features.
    """
    if "poses" in context.sources:
        return _from_known_poses(context)

    photos, image_set = context.read(PHOTOS), context.read(IMAGE_SET)
    _check_masks(image_set, context.params)
    _check_disk(context, len(image_set.images))
    contents = _contents(photos, [record.name for record in image_set.images])
    known = _known_photos(context, contents, image_set)
    with _working(context) as work:
        bench = _bench(context, work, photos, image_set, known)
        found = _find(bench, context.params)
        if found.best is not None and not found.best.base.corners:
            _keep_features(bench.database(found.best.base), context.to_write(FEATURES))

    best, unregistered = _placed(found, bench)
    relaxed = _is_relaxed(context, found.steps[-1])
    _warn_of(found, best, unregistered, bench, relaxed)
    kept = known if known is not None and found.steps[-1].rung == ADDED else None
    last = _adjusted(context, best.model, bench.threads, kept)
    others = len(best.others)
    lineage, since = _since(context, last.model, known)
    numbers = _publish(
        context, last, best.registered, unregistered, context.params.mapper, bench.matcher, others, found.steps, relaxed
    )
    _keep_contents(context, contents, image_set, lineage, bench.stands_still)
    warnings = [
        *_place_warnings(from_one_place(found.depth.parallaxes), len(bench.names), last.model),
        *_flat_warnings(found.depth, last, bench),
        *_still_warnings(bench.stands_still, image_set),
    ]
    return {**numbers, **since, "warnings": warnings}


# ---------------------------------------------------------------- finding poses
@dataclass(frozen=True)
class Found:
    """What the attempts came to.

    Attributes:
        best: None where no photo was placed.
        steps: all attempts. wanted: photos that would have ended them.
        evidence, depth: what the matches say of each photo, and of the photos' parallax.
    """

    best: Solution | None
    steps: list[Step]
    wanted: int
    evidence: Evidence
    depth: Depth


def _bench(
    context: StageContext[SfmParams], work: Path, photos: Pictures, image_set: ImageSet, known: KnownPhotos | None
) -> Workbench:
    return Workbench(
        work,
        photos.images,
        photos.masks,
        image_set,
        context.params,
        threads=_threads(context),
        workers=context.workers,
        cuda=context.device == "cuda",
        progress=context.progress,
        known=known,
    )


def _threads(context: StageContext[SfmParams]) -> int:
    """For what depends on their number."""
    return 1 if context.params.deterministic else max(1, context.workers)


def _find(bench: Workbench, params: SfmParams) -> Found:
    """Attempts until enough photos are placed, or none is left."""
    total = len(bench.names)
    wanted = photos_wanted(total, params.wanted)
    best, steps = _solve(bench, wanted, max(_needed(total, params), total // 2), params)
    # of the same matches as at first, where nothing else was tried
    depth = bench.depth if len(steps) == 1 else judge_depth(bench.database())
    return Found(best, steps, wanted, Evidence(bench.database()), depth)


def _placed(found: Found, bench: Workbench) -> tuple[Solution, tuple[Unregistered, ...]]:
    """The best solution, and why photos are not in it.

    Raises:
        ReconstructionError: too few photos are.
    """
    best, steps, image_set, params = found.best, found.steps, bench.image_set, bench.params
    names = [record.name for record in image_set.images]
    if best is None:
        if bench.stands_still:
            raise _nothing_moved(len(names), steps)
        raise _nothing_matched(found.evidence, names, steps, params, _masks_advice(image_set, params))
    unregistered = tuple(
        Unregistered(
            name=name,
            reason=found.evidence.reason(name, best.registered, best.others, bench.verified, bench.agreeing),
        )
        for name in names
        if name not in best.registered
    )
    needed = _needed(len(names), params)
    if len(best.registered) < needed:
        raise _too_few(
            len(best.registered),
            unregistered,
            needed,
            _tried(steps),
            _hint(steps, params) + _masks_advice(image_set, params),
        )
    return best, unregistered


def _warn_of(
    found: Found, best: Solution, unregistered: tuple[Unregistered, ...], bench: Workbench, relaxed: bool
) -> None:
    """What the log says of the poses."""
    for item in unregistered:
        log.warning("not registered: %s: %s", item.name, item.reason)
    if bench.params.masks != "always" and max(map(len, best.others), default=0) >= SECOND_PASS * len(bench.names):
        log.warning(
            "%d photos make a model of their own. If the object was moved in between, as turned over for a second "
            "pass, try `hineus run PHOTOS --moving-object`, with `--masks FOLDER` or without",
            max(map(len, best.others)),
        )
    for prior, focal in bench.contradicted(best):
        log.warning("the EXIF focal length, %.0f px, is wrong: the poses say %.0f px", prior, focal)
    if relaxed:
        log.warning("poses were found with relaxed thresholds only: they are rough, and some may be wrong")
    if len(found.steps) > 1 and len(best.registered) < found.wanted and not learned_available():
        log.warning("`%s` adds a way to place photos of plain objects", FEATURES_EXTRA)


# ---------------------------------------------------------------- photos that came or went
def _contents(photos: Pictures, names: Iterable[str]) -> dict[str, str]:
    """Photo -> digest of its file and its mask's."""
    files = {name: [photos.path(name), photos.mask_path(name)] for name in names}
    return {name: digest([file_sha256(path) for path in paths if path.exists()]) for name, paths in files.items()}


def _names_then(before: dict[str, str], now: dict[str, str]) -> dict[str, str]:
    """Photo now -> the photo before with the same contents (name -> digest)."""
    return {name: then for then, name in compare_photos(before, now, same_folder=True).kept.items()}


def _known_photos(
    context: StageContext[SfmParams], contents: dict[str, str], image_set: ImageSet
) -> KnownPhotos | None:
    """The last publication's model as far as it is of these photos; None where poses are to be found from all."""
    import pycolmap

    before, folder = context.read_previous(PHOTO_CONTENTS), context.read_previous(FEATURES)
    rigs = any(record.frame for record in image_set.images)  # whose frames a known model would have to keep
    if before is None or folder is None or not folder.exists() or rigs:
        return None
    names = _names_then(before.contents, contents)
    registration = context.read_previous(REGISTRATION)
    known = KnownPhotos(
        names=names,
        new=tuple(name for name in contents if name not in names),
        gone=tuple(sorted(before.contents.keys() - set(names.values()))),
        model=pycolmap.Reconstruction(str(context.read_previous(MODEL))),
        features=next(folder.iterdir()),
        lenses=registration.lenses if registration else (),
    )
    if _saw_left_out(before, image_set):
        log.info("%s: poses are found anew, since photos that are left out must not have been seen", known.describe())
        return None
    if not _same_cameras(before, image_set, names):
        log.info("%s: poses are found anew, since photos share other cameras or focal lengths", known.describe())
        return None
    if not known.enough:
        log.info("%s, %d placed before: too few, poses are found anew", known.describe(), len(known.poses))
        return None
    log.info("%s: poses of the known stay%s", known.describe(), ", the new go beside them" if known.new else "")
    return known


def _saw_left_out(before: PhotoContents, image_set: ImageSet) -> bool:
    """Whether a photo that no stage may see now was seen."""
    return any(item.reason == LEFT_OUT and item.sha256 in before.seen for item in image_set.skipped)


def _same_cameras(before: PhotoContents, image_set: ImageSet, names: Mapping[str, str]) -> bool:
    """Whether the photos in common (name now -> then) share cameras as they did, and have the same focal priors."""
    pairs = [(record, before.files[names[record.name]]) for record in image_set.images if record.name in names]
    cameras = {(now.camera, then.camera) for now, then in pairs}
    one_to_one = len(cameras) == len({now for now, _ in cameras}) == len({then for _, then in cameras})
    return one_to_one and all(now.focal_px == then.focal_px for now, then in pairs)


def _is_relaxed(context: StageContext[SfmParams], last: Step) -> bool:
    """Whether the poses are rough, or those that they go on from were."""
    before = context.read_previous(REGISTRATION) if last.rung == ADDED else None
    return (last.kept and last.rung == RELAXED) or (before is not None and before.relaxed)


def _solve(bench: Workbench, wanted: int, enough: int, params: SfmParams) -> tuple[Solution | None, list[Step]]:
    """The best solution and the attempts: beside the known photos, and where that does not do, from all."""
    known = bench.known
    if known is None:
        return climb(bench.rungs(), wanted, enough)
    share = max(params.wanted, MIN_CONNECTED)
    of_new = max(
        min(photos_wanted(len(known.new), share), photos_wanted(len(bench.names), share) - len(known.poses)),
        photos_wanted(len(known.new), MIN_CONNECTED),
    )
    needed = len(known.poses) + of_new
    beside, steps = None, list[Step]()
    try:
        beside, steps = climb([bench.adding()], wanted, enough)
    except (RuntimeError, ValueError) as error:  # COLMAP's checks
        log.warning("the known poses are no start: %s", " ".join(str(error).split()))
    placed = 0 if beside is None else len(beside.registered)
    if beside is not None and (placed >= needed or not known.changed):
        return beside, steps
    log.warning(
        "beside the known photos %d of %d photos could be placed (%d wanted): poses are found anew from all",
        placed, len(bench.names), needed,
    )  # fmt: skip
    anew, more = climb(bench.rungs(), wanted, enough)
    if anew is not None and len(anew.registered) > placed:
        return anew, steps + more
    log.info("poses of the known photos stay, since no more photos were placed")
    return beside, [replace(step, kept=False) for step in more] + steps


def _since(
    context: StageContext[SfmParams], model: Any, known: KnownPhotos | None
) -> tuple[str | None, dict[str, Any]]:
    """The lineage that the model goes on, if it does, and numbers of what was kept; the model is put where it was."""
    before = context.read_previous(PHOTO_CONTENTS)
    if known is None or before is None:
        return None, {}
    moved = put_back(known, model) if known.changed else 0.0
    stayed = moved is not None and moved <= STAYED
    if moved is not None and known.changed:
        log.info(
            "known photos are %s: %.3g %% of the distance to what they see (median)",
            "where they were" if stayed else "elsewhere",
            100 * moved,
        )
    numbers: dict[str, Any] = {"known": len(known.names), "new": len(known.new), "gone": len(known.gone)}
    numbers |= {"poses_stayed": stayed, "moved_percent": None if moved is None else round(100 * moved, 4)}
    return before.lineage if stayed else None, numbers


def _keep_features(database: Path, folder: Path) -> None:
    folder.mkdir()
    shutil.copyfile(database, folder / database.name)


def _keep_contents(
    context: StageContext[SfmParams],
    contents: dict[str, str],
    image_set: ImageSet,
    lineage: str | None,
    background_moved: bool = False,
) -> None:
    """Write what the published model was made of; without a lineage to go on, it begins one."""
    before, records = context.read_previous(PHOTO_CONTENTS), image_set.images
    # what was there before and what is left out make one of its own, also where the same model was there once
    unseen = sorted(item.sha256 for item in image_set.skipped if item.reason == LEFT_OUT)
    own = [file_sha256(path) for path in sorted(context.to_write(MODEL).iterdir())]
    own += [*unseen, before.lineage if before else ""]
    seen = {record.sha256 for record in records}
    if before is not None and not _saw_left_out(before, image_set):
        seen |= set(before.seen)
    files = {
        record.name: PhotoFile(sha256=record.sha256, camera=record.camera, focal_px=record.focal_px)
        for record in records
    }
    made_of = PhotoContents(
        lineage=lineage or digest(own),
        contents=contents,
        files=files,
        seen=tuple(sorted(seen)),
        background_moved=background_moved or (lineage is not None and before is not None and before.background_moved),
    )
    context.write(PHOTO_CONTENTS, made_of)


def _adjusted(context: StageContext[SfmParams], model: Any, threads: int, known: KnownPhotos | None) -> LastAdjustment:
    """The last adjustment of a model that was found, and what it freed and took in the log.

    Args:
        known: photos that it goes on from.
    """
    if known is not None and not known.changed:
        registration = context.read_previous(REGISTRATION)
        assert registration is not None
        return LastAdjustment(model, registration.lenses, registration.pose_error)
    context.progress(1, 1, "the last adjustment")
    start = time.process_time()
    last = adjust_last(model, context.params, threads, None if known is None else known_lenses(known, model))
    freed = [f"{' and '.join(lens.freed)} of {lens.photos} photos" for lens in last.lenses if lens.freed]
    log.info("last adjustment: freed %s (%.1f CPU s)", "; ".join(freed) or "nothing", time.process_time() - start)
    return last


def _place_warnings(still: Sequence[str], total: int, model: Any) -> list[dict[str, str]]:
    """For the report and the log: that most photos were taken from one place (`still`), or nearly all from two."""
    first, second = two_places(model)
    if 2 * len(still) > total:
        sentence = (
            f"{len(still)} of {total} photos were taken from one place ({still[0]} to {still[-1]}) and tell no more of "
            f"the shape than one does: {total - len(still)} are left, 20 or more from all sides give a whole object."
        )
    elif total > MIN_PLACES and len(first) + len(second) >= TWO_PLACES * total:
        sentence = (
            f"{len(first) + len(second)} of {total} photos were taken from two places ({first[0]} to {first[-1]}, "
            f"{second[0]} to {second[-1]}): how far things are follows from one step only, and what is hidden from "
            "both places is missing."
        )
    else:
        return []
    log.warning("%s Add photos from other places.", sentence)
    return [{"sentence": sentence}]


def _still_warnings(stands_still: bool, image_set: ImageSet) -> list[dict[str, str]]:
    """For the report and the log: that a background stood still while the object turned, where no masks hide it."""
    bare = sum(not record.has_mask for record in image_set.images)
    if not stands_still or not bare:
        return []
    sentence = (
        f"The background stands still while the object turns. The poses do without it, but it is in {bare} photos "
        "without a mask, where training would find it at many places: `hineus run PHOTOS --moving-object` masks it."
    )
    log.warning("%s", sentence)
    return [{"sentence": sentence}]


def _flat_warnings(depth: Depth, last: LastAdjustment, bench: Workbench) -> list[dict[str, str]]:
    """For the report and the log: that the photos show one flat thing only, if they do and are no survey flight."""
    if not depth.is_flat or relief(last.model) > FLAT_RELIEF:
        return []
    sentence = "The photos show one flat thing and nothing beside it: a homography explains the matches of each pair."
    doubtful = [lens for lens in last.lenses if not lens.focal_error < DOUBTFUL_FOCAL_ERROR * lens.focal]
    if doubtful and set(last.model.cameras) - set(bench.priors):
        lens = doubtful[0]
        sentence += (
            f" So they do not tell the focal length, for which there is no EXIF: {lens.focal:.0f} px with a standard "
            f"error of {lens.focal_error:.0f} px. How far away the thing is may be as wrong, and it may come out bent."
        )
        advice = "Add photos tilted by 30 degrees and more, with something that stands out of the plane, or with EXIF."
    elif 2 * bench.located > len(bench.names):
        return []
    else:
        advice = "If it is not meant to be flat, add photos from the side, with something that stands out of the plane."
    log.warning("%s %s", sentence, advice)
    return [{"sentence": f"{sentence} {advice}"}]


def _publish(
    context: StageContext[SfmParams],
    adjusted: LastAdjustment,
    registered: Iterable[str],
    unregistered: tuple[Unregistered, ...],
    mapper: str,
    matcher: str,
    others: int = 0,
    steps: Sequence[Step] = (),
    relaxed: bool = False,
) -> dict[str, Any]:
    """Write model and registration; returns the numbers of the manifest.

    Args:
        adjusted: the model, and what is known of its exactness.
        others: models that mapping gave beside this one.
        steps: the attempts; none where the poses were given.
        relaxed: see `Registration`.
    """
    import pycolmap

    model, folder = adjusted.model, context.to_write(MODEL)
    folder.mkdir(parents=True)
    model.write(str(folder))
    # the photos in the order of their ids, whatever the order in which they were placed
    pycolmap.Reconstruction(str(folder)).write(str(folder))
    points = model.num_points3D()
    registration = Registration(
        registered=tuple(sorted(registered)),
        unregistered=unregistered,
        mean_reprojection_error_px=model.compute_mean_reprojection_error() if points else 0.0,
        mean_track_length=model.compute_mean_track_length() if points else 0.0,
        num_points=points,
        num_models=1 + others,
        mapper=mapper,
        matcher=matcher,
        kept=next((step.rung for step in reversed(steps) if step.kept), ""),
        relaxed=relaxed,
        ladder=tuple(step.as_dict() for step in steps),
        lenses=adjusted.lenses,
        pose_error=adjusted.pose_error,
    )
    context.write(REGISTRATION, registration)
    context.progress(1, 1, "done")
    numbers = {
        "registered": len(registration.registered),
        "images": len(registration.registered) + len(unregistered),
        "points": points,
        "mean_reprojection_error_px": round(registration.mean_reprojection_error_px, 3),
        "mean_track_length": round(registration.mean_track_length, 2),
        "models": registration.num_models,
        "matcher": matcher,
        "focal_px": [round(camera.mean_focal_length(), 1) for camera in model.cameras.values()][:4],
    }
    if error := adjusted.pose_error:
        numbers["expected_center_error_percent"] = round(100 * error.center / error.distance, 4)
    if steps:
        numbers["freed"] = sorted({freedom for lens in adjusted.lenses for freedom in lens.freed})
        numbers |= {"kept": registration.kept, "attempts": len(steps), "ladder": list(registration.ladder)}
    return numbers


def _from_known_poses(context: StageContext[SfmParams]) -> dict[str, Any]:
    """The model of the given cameras; write the same files."""
    import pycolmap

    params, image_set = context.params, context.read(IMAGE_SET)
    poses = read_poses(context.sources["poses"])
    by_source = {record.source: record for record in image_set.images}
    matched = match_photos(poses, by_source)
    cameras = {by_source[source].name: (camera, by_source[source]) for source, camera in matched.items()}
    unregistered = tuple(
        Unregistered(name=record.name, reason=f"has no pose in {poses.origin.name}")
        for record in image_set.images
        if record.name not in cameras
    )
    needed = _needed(len(image_set.images), params)
    if len(cameras) < needed:
        hint = "Give the poses of these photos, or leave --poses out (`--no-poses`) to have them found."
        raise _too_few(len(cameras), unregistered, needed, "", hint)
    if poses.place is not None:
        taken = {camera.name: (name, (record.width, record.height)) for name, (camera, record) in cameras.items()}
        model, matcher = rebuilt(pycolmap.Reconstruction(str(poses.origin)), taken), "given points"
    else:
        with _working(context) as work:
            model, matcher = triangulate(
                work,
                context.read(PHOTOS).images,
                cameras,
                params,
                threads=_threads(context),
                workers=context.workers,
                cuda=pycolmap.has_cuda and context.device == "cuda",
                progress=context.progress,
            )
        _check_given_places(model, work / DATABASE)
    contents = _contents(context.read(PHOTOS), [record.name for record in image_set.images])
    place = poses.place and PlaceRecord.model_validate(poses.place)
    context.write(GIVEN_POSES, GivenPoses(origin=poses.origin.name, region=poses.region, place=place))
    given = LastAdjustment(model, lenses=(), pose_error=None)
    lineage = _lineage_of_given(context, model, contents, image_set)
    numbers = _publish(context, given, cameras, unregistered, "known poses", matcher)
    _keep_contents(context, contents, image_set, lineage)
    points, error = numbers["points"], numbers["mean_reprojection_error_px"]
    if points < FEW_POINTS * len(cameras):
        log.warning(
            "only %d points could be triangulated from the known poses of %d photos: they help training little",
            points,
            len(cameras),
        )
    if error > DOUBTFUL_ERROR_PX:
        log.warning("the known poses fit the photos badly: a mean reprojection error of %.1f px", error)
    return {**numbers, "poses_from": poses.origin.name}


def _check_given_places(model: Any, database: Path) -> None:
    """Refuse photos that were all taken from one place, by the given poses or where these give no points.

    Raises:
        ReconstructionError: their matches say so, too.
    """
    centers = np.array([image.projection_center() for image in model.images.values()])
    if not model.num_points3D() or np.ptp(centers, axis=0).max() < MIN_PARALLAX * view_distance(model):
        refuse_one_place(judge_depth(database))


def _lineage_of_given(
    context: StageContext[SfmParams], model: Any, contents: dict[str, str], image_set: ImageSet
) -> str | None:
    """The lineage of the last publication, where given cameras are those given then, as far as both have the photos.

    None, too, where it saw photos that are left out now.
    """
    import pycolmap

    before = context.read_previous(PHOTO_CONTENTS)
    if before is None or context.read_previous(GIVEN_POSES) is None or _saw_left_out(before, image_set):
        return None
    then = pycolmap.Reconstruction(str(context.read_previous(MODEL)))
    earlier = {image.name: image for image in then.images.values()}
    names = _names_then(before.contents, contents)
    pairs = [(image, earlier[name]) for image in model.images.values() if (name := names.get(image.name)) in earlier]
    return before.lineage if pairs and all(_same_view(now, was) for now, was in pairs) else None


def _same_view(image: Any, other: Any) -> bool:
    """Whether two images of COLMAP models have the same pose and intrinsics."""
    camera, others = image.camera, other.camera
    return (
        np.allclose(image.cam_from_world().matrix(), other.cam_from_world().matrix())
        and (camera.model, camera.width, camera.height) == (others.model, others.width, others.height)
        and np.allclose(camera.params, others.params)
    )


def _check_masks(image_set: ImageSet, params: SfmParams) -> None:
    bare = [record.name for record in image_set.images if not record.has_mask]
    if params.masks == "always" and bare:
        raise InputError(
            f"{len(bare)} of {len(image_set.images)} photos have no mask, e.g. {bare[0]}; sfm.masks=always needs all.",
            "Give `--masks FOLDER` with one mask a photo, or have them made: `--set ingest.auto_mask=object`. "
            "If the object was not moved, try `--set sfm.masks=auto`.",
        )


def _check_disk(context: StageContext[SfmParams], photos: int) -> None:
    """COLMAP ends the process, and not with an error, where its database cannot grow."""
    needed = photos * context.params.max_features * FEATURE_BYTES
    if (free := free_bytes(context.scratch)) < needed:
        full = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        raise disk_full_error(context.scratch, "looking for features", full, needed - free)


@contextmanager
def _working(context: StageContext[SfmParams]) -> Iterator[Path]:
    """An empty folder for COLMAP, which is seeded; its own log goes to files in there instead of the terminal."""
    import pycolmap

    work = context.empty_folder("colmap")  # a killed run may have left half a database
    folder = work / "log"
    folder.mkdir()
    pycolmap.set_random_seed(context.params.seed)
    settings = pycolmap.logging
    before = settings.logtostderr, settings.alsologtostderr, settings.stderrthreshold
    settings.logtostderr, settings.alsologtostderr = False, False
    settings.stderrthreshold = int(settings.Level.FATAL)
    for level in (settings.Level.INFO, settings.Level.WARNING, settings.Level.ERROR):
        settings.set_log_destination(level, str(folder / level.name.lower()))
    try:
        yield work
    finally:
        settings.logtostderr, settings.alsologtostderr, settings.stderrthreshold = before


# ---------------------------------------------------------------- failures
def _hint(steps: Sequence[Step], params: SfmParams) -> str:
    """What is left to try after these attempts."""
    if params.wanted == 0 and len(steps) == 1:
        return "Try `--set sfm.wanted=0.95`, which goes on with other ways, or add overlapping photos."
    return _features_hint() + (
        "Add photos between those left out and their neighbours, overlapping by two thirds, sharp, with something "
        "printed in the frame; or leave out what `--set sfm.min_registered_ratio=0.1` would do without."
    )


def _masks_advice(image_set: ImageSet, params: SfmParams) -> str:
    """To look at the subject alone, where masks would be looked at and there are none; with the space before it."""
    if params.masks == "never" or all(record.has_mask for record in image_set.images):
        return ""
    missing = "" if find_weights() else f" (after `{INSTALL}`)"
    return (
        " If the background moved against the object, masks leave it out: "
        f"`--set ingest.auto_mask=salient`{missing}, or `--masks FOLDER`."
    )


def _features_hint() -> str:
    return "" if learned_available() else f"Try `{FEATURES_EXTRA}`, learned features for plain objects. "


def _tried(steps: Sequence[Step]) -> str:
    return "Tried " + "; ".join(describe(step) for step in steps) + "."


def _nothing_matched(
    evidence: Evidence, names: list[str], steps: Sequence[Step], params: SfmParams, advice: str
) -> ReconstructionError:
    features = sorted(evidence.features.get(name, 0) for name in names)
    median, best = features[len(features) // 2], evidence.best_pair
    if best < MIN_VERIFIED:
        message = (
            f"None of the {len(names)} photos could be registered: the best pair shares {best} matches, "
            f"need {MIN_VERIFIED} (median {median} features a photo). {_tried(steps)}"
        )
        hint = _features_hint() + (
            "Plain surfaces cannot be matched: put the object on something printed, e.g. newspaper, keep "
            "that in the frame, and let neighbouring photos overlap by two thirds."
        )
        return ReconstructionError(message, hint)
    message = (
        f"None of the {len(names)} photos could be registered: no pair is good enough to start from "
        f"(best pair: {best} matches; median {median} features a photo). {_tried(steps)}"
    )
    return ReconstructionError(message, _hint(steps, params) + advice)


def _nothing_moved(total: int, steps: Sequence[Step]) -> ReconstructionError:
    return ReconstructionError(
        f"None of the {total} photos could be registered: what matches lies at one and the same place of the frame, so "
        f"the camera stood still, and nothing that can be matched moved before it. {_tried(steps)}",
        "Walk around the subject, a step to the side for each photo. If it stood on a turntable, it is too plain to be "
        "matched: let something printed turn with it, e.g. newspaper, and keep that in the frame.",
    )


def _needed(total: int, params: SfmParams) -> int:
    """Photos without whose poses the stage has failed."""
    return max(params.min_registered, round(params.min_registered_ratio * total))


def _too_few(
    registered: int, unregistered: Sequence[Unregistered], needed: int, tried: str, hint: str
) -> ReconstructionError:
    total = registered + len(unregistered)
    first = "; ".join(f"{item.name}: {item.reason}" for item in unregistered[:2])
    message = f"Only {registered} of {total} photos were registered (need {needed}). E.g. {first}. {tried}"
    return ReconstructionError(message.rstrip(), hint)


SFM: Stage[SfmParams] = Stage(
    name="sfm",
    version=12,
    settings=lambda config: config.sfm,
    run=run,
    reads=(PHOTOS, IMAGE_SET),
    writes=(MODEL, REGISTRATION, GIVEN_POSES, PHOTO_CONTENTS, FEATURES),
    sources=("poses",),
    continues=True,
    summary="find the camera poses, or take known ones",
)
