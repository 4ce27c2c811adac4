"""Sfm: upright images -> a COLMAP model (the largest component), with a reason for every photo left out.

With poses that are known already they are taken as they are, and only points are found.
"""

from __future__ import annotations

import logging
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from stages import artifacts
from stages.artifacts import ImageSet
from stages.engine.stage import Stage, StageContext
from stages.errors import InputError, ReconstructionError
from stages.posing.known import match_photos
from stages.posing.reading import read_poses
from stages.posing.triangulation import triangulate

log = logging.getLogger(__name__)

DEFAULT_FOCAL_FACTOR = 1.2  # COLMAP's guess where nothing is known: focal = 1.2 x longest side (about 45 degrees)
MIN_VERIFIED = 15  # matches that fit one epipolar geometry before COLMAP believes a pair (its default)
MIN_PNP = 30  # 3D points a photo must agree with to be placed (COLMAP's default)
MIN_FEATURES = 50  # below this a photo shows too little texture to match anything
FEW_POINTS = 10  # fewer points than this a photo are worth a warning where the poses are known
DOUBTFUL_ERROR_PX = 2.0  # COLMAP's own models are below one
# Parts of the progress bar, from timings of 47-photo sets.
PART_FEATURES, PART_MATCHES = 0.3, 0.7


def run(context: StageContext) -> dict[str, Any]:
    """Features, matches, mapping; write model/ and registration.json."""
    if "poses" in context.sources:
        return _from_known_poses(context)
    import pycolmap

    params, image_set = context.params, artifacts.load_image_set(context.inputs["ingest"])
    images_folder = context.inputs["ingest"] / artifacts.IMAGES
    work = context.scratch / "colmap"
    shutil.rmtree(work, ignore_errors=True)  # a killed run may have left half a database
    work.mkdir(parents=True)
    database_path = work / "database.db"
    threads = 1 if params.deterministic else max(1, context.workers)
    device = pycolmap.Device.cuda if pycolmap.has_cuda and context.device == "cuda" else pycolmap.Device.cpu

    with _quiet_glog(work / "log"):
        pycolmap.set_random_seed(params.seed)
        _import_images(database_path, images_folder, image_set, params)
        context.progress(0.02, 1, "features")
        # Finding features is deterministic with any number of threads.
        _extract(database_path, images_folder, params, context.workers, device)
        context.progress(PART_FEATURES, 1, "matches")
        matcher = _choose_matcher(params, database_path, len(image_set.images))
        _match(matcher, database_path, params, threads, device)
        evidence = _Evidence(database_path)
        context.progress(PART_MATCHES, 1, "poses")
        models = _map(database_path, images_folder, work / "models", params, threads, context, len(image_set.images))

    names = [record.name for record in image_set.images]
    if not models:
        raise _nothing_matched(evidence, names, matcher, params)
    best = max(models, key=lambda model: (model.num_reg_images(), model.num_points3D()))
    registered = sorted(best.images[i].name for i in best.reg_image_ids())
    others = [{m.images[i].name for i in m.reg_image_ids()} for m in models if m is not best]
    unregistered = [
        {"name": name, "reason": evidence.reason(name, set(registered), others)}
        for name in names
        if name not in set(registered)
    ]
    _check_enough(registered, unregistered, names, matcher, params)
    for item in unregistered:
        log.warning("not registered: %s: %s", item["name"], item["reason"])

    folder = artifacts.model_path(context.out)
    folder.mkdir(parents=True)
    best.write(str(folder))
    error, track = best.compute_mean_reprojection_error(), best.compute_mean_track_length()
    artifacts.save_registration(
        context.out,
        {
            "registered": registered,
            "unregistered": unregistered,
            "mean_reprojection_error_px": error,
            "mean_track_length": track,
            "num_points": best.num_points3D(),
            "num_models": len(models),
            "mapper": params.mapper,
            "matcher": matcher,
        },
    )
    context.progress(1, 1, "done")
    return {
        "registered": len(registered),
        "images": len(names),
        "points": best.num_points3D(),
        "mean_reprojection_error_px": round(error, 3),
        "mean_track_length": round(track, 2),
        "models": len(models),
        "matcher": matcher,
        "focal_px": [round(camera.mean_focal_length(), 1) for camera in best.cameras.values()][:4],
    }


def _from_known_poses(context: StageContext) -> dict[str, Any]:
    """The model of the given cameras; write the same files."""
    import pycolmap

    params, image_set = context.params, artifacts.load_image_set(context.inputs["ingest"])
    poses = read_poses(context.sources["poses"])
    by_source = {record.source: record for record in image_set.images}
    matched = match_photos(poses, by_source)
    cameras = {by_source[source].name: (camera, by_source[source]) for source, camera in matched.items()}
    unregistered = [
        {"name": record.name, "reason": f"has no pose in {poses.origin.name}"}
        for record in image_set.images
        if record.name not in cameras
    ]
    _check_enough(list(cameras), unregistered, [record.name for record in image_set.images], "exhaustive", params)
    work = context.scratch / "colmap"
    shutil.rmtree(work, ignore_errors=True)  # a killed run may have left half a database
    work.mkdir(parents=True)
    with _quiet_glog(work / "log"):
        pycolmap.set_random_seed(params.seed)
        model, matcher = triangulate(
            work,
            context.inputs["ingest"] / artifacts.IMAGES,
            cameras,
            params,
            threads=1 if params.deterministic else max(1, context.workers),
            workers=context.workers,
            device=pycolmap.Device.cuda if pycolmap.has_cuda and context.device == "cuda" else pycolmap.Device.cpu,
            progress=context.progress,
        )
    points = model.num_points3D()
    error = model.compute_mean_reprojection_error() if points else 0.0
    if points < FEW_POINTS * len(cameras):
        log.warning(
            "only %d points could be triangulated from the known poses of %d photos: they help training little",
            points,
            len(cameras),
        )
    if error > DOUBTFUL_ERROR_PX:
        log.warning("the known poses fit the photos badly: a mean reprojection error of %.1f px", error)
    folder = artifacts.model_path(context.out)
    folder.mkdir(parents=True)
    model.write(str(folder))
    region = poses.region
    artifacts.save_known_poses(
        context.out,
        poses.origin.name,
        None
        if region is None
        else {"center": region.center.tolist(), "radius": region.radius, "source": region.source},
    )
    artifacts.save_registration(
        context.out,
        {
            "registered": sorted(cameras),
            "unregistered": unregistered,
            "mean_reprojection_error_px": error,
            "mean_track_length": model.compute_mean_track_length() if points else 0.0,
            "num_points": points,
            "num_models": 1,
            "mapper": "known poses",
            "matcher": matcher,
        },
    )
    context.progress(1, 1, "done")
    return {
        "registered": len(cameras),
        "images": len(image_set.images),
        "points": points,
        "mean_reprojection_error_px": round(error, 3),
        "mean_track_length": round(model.compute_mean_track_length(), 2) if points else 0.0,
        "models": 1,
        "matcher": matcher,
        "poses_from": poses.origin.name,
        "focal_px": [round(camera.mean_focal_length(), 1) for camera in model.cameras.values()][:4],
    }


@contextmanager
def _quiet_glog(folder: Path) -> Iterator[None]:
    """COLMAP's own log goes to files in `folder` instead of the terminal, and ours says where on failure."""
    import pycolmap

    folder.mkdir(parents=True, exist_ok=True)
    settings = pycolmap.logging
    before = settings.logtostderr, settings.alsologtostderr, settings.stderrthreshold
    settings.logtostderr, settings.alsologtostderr = False, False
    settings.stderrthreshold = int(settings.Level.FATAL)
    for level in (settings.Level.INFO, settings.Level.WARNING, settings.Level.ERROR):
        settings.set_log_destination(level, str(folder / level.name.lower()))
    try:
        yield
    finally:
        settings.logtostderr, settings.alsologtostderr, settings.stderrthreshold = before


# ---------------------------------------------------------------- features and matches
def _import_images(database_path: Path, images_folder: Path, image_set: ImageSet, params: Any) -> None:
    """One camera a group of photos that share intrinsics, with its focal prior."""
    import pycolmap

    pycolmap.Database.open(database_path).close()  # creates it
    groups: dict[str, list[Any]] = {}
    for record in image_set.images:
        groups.setdefault(record.camera, []).append(record)
    for records in groups.values():
        options = pycolmap.ImageReaderOptions()
        options.camera_model = params.camera_model
        priors = sorted(record.focal_px for record in records if record.focal_px is not None)
        if priors:
            # giving the parameters also marks the focal length as a prior that may be trusted
            options.camera_params = _camera_params(
                params.camera_model, priors[len(priors) // 2], records[0].width, records[0].height
            )
        options.default_focal_length_factor = DEFAULT_FOCAL_FACTOR
        pycolmap.import_images(
            database_path,
            images_folder,
            camera_mode=pycolmap.CameraMode.SINGLE,
            image_names=[record.name for record in records],
            options=options,
        )


def _camera_params(model: str, focal: float, width: int, height: int) -> str:
    """COLMAP's parameter list: focal length(s), principal point at the middle, no distortion."""
    focals = 2 if model in ("PINHOLE", "OPENCV") else 1
    distortions = {"SIMPLE_PINHOLE": 0, "PINHOLE": 0, "SIMPLE_RADIAL": 1, "RADIAL": 2, "OPENCV": 4}[model]
    values = [focal] * focals + [width / 2, height / 2] + [0.0] * distortions
    return ",".join(f"{value:.8g}" for value in values)


def _extract(database_path: Path, images_folder: Path, params: Any, threads: int, device: Any) -> None:
    import pycolmap

    options = pycolmap.FeatureExtractionOptions()
    options.max_image_size = params.max_image_size
    options.num_threads = threads
    options.use_gpu = device == pycolmap.Device.cuda
    options.sift.max_num_features = params.max_features
    pycolmap.extract_features(database_path, images_folder, extraction_options=options, device=device)


def _choose_matcher(params: Any, database_path: Path, num_images: int) -> str:
    """auto: all pairs of small sets, neighbours in space where most photos carry GPS, else in name."""
    import pycolmap

    with pycolmap.Database.open(database_path) as database:
        located = database.num_pose_priors()
    if params.matcher == "spatial" and located == 0:
        raise InputError(
            f"None of the {num_images} photos carries a GPS position, which spatial matching needs.",
            "Try `--set sfm.matcher=sequential`, or exhaustive.",
        )
    if params.matcher != "auto":
        return params.matcher
    if num_images <= params.exhaustive_max:
        return "exhaustive"
    return "spatial" if located > 0.9 * num_images else "sequential"


def _match(matcher: str, database_path: Path, params: Any, threads: int, device: Any) -> None:
    import pycolmap

    matching = pycolmap.FeatureMatchingOptions()
    matching.num_threads = threads
    matching.use_gpu = device == pycolmap.Device.cuda
    verification = pycolmap.TwoViewGeometryOptions()
    verification.min_num_inliers = MIN_VERIFIED
    verification.ransac.random_seed = params.seed
    common = {"matching_options": matching, "verification_options": verification, "device": device}
    if matcher == "exhaustive":
        pycolmap.match_exhaustive(database_path, **common)
    elif matcher == "spatial":
        pycolmap.match_spatial(database_path, **common)
    else:
        pycolmap.match_sequential(database_path, **common)


def _map(
    database_path: Path,
    images_folder: Path,
    out: Path,
    params: Any,
    threads: int,
    context: StageContext,
    total: int,
) -> list[Any]:
    """All components found, in no particular order."""
    import pycolmap

    out.mkdir()
    if params.mapper == "global":
        chosen = pycolmap.GlobalPipelineOptions()
        chosen.num_threads, chosen.random_seed = threads, params.seed
        return list(pycolmap.global_mapping(database_path, images_folder, out, chosen).values())

    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads, options.random_seed = threads, params.seed
    options.mapper.num_threads, options.mapper.random_seed = threads, params.seed
    options.triangulation.random_seed = params.seed
    options.min_model_size = 3  # small captures are captures too
    options.extract_colors = False
    placed = 2

    def one_more() -> None:
        nonlocal placed
        placed += 1
        part = min(1.0, placed / max(total, 1))
        context.progress(PART_MATCHES + (1 - PART_MATCHES) * part, 1, f"{min(placed, total)} of {total} photos placed")

    models = pycolmap.incremental_mapping(database_path, images_folder, out, options, next_image_callback=one_more)
    return list(models.values())


# ---------------------------------------------------------------- what became of each photo
class _Evidence:
    """What the database says of each photo: features, and verified matches with every other."""

    def __init__(self, database_path: Path) -> None:
        import pycolmap

        with pycolmap.Database.open(database_path) as database:
            images = {image.image_id: image.name for image in database.read_all_images()}
            self.features = {name: database.num_keypoints_for_image(i) for i, name in images.items()}
            pair_ids, inliers = database.read_two_view_geometry_num_inliers()
        self.pairs: dict[str, dict[str, int]] = {name: {} for name in images.values()}
        for pair_id, count in zip(pair_ids, inliers, strict=True):
            first, second = (images[i] for i in pycolmap.pair_id_to_image_pair(pair_id))
            if count:
                self.pairs[first][second] = self.pairs[second][first] = int(count)

    @property
    def best_pair(self) -> int:
        """Verified matches of the best pair of photos."""
        return max((count for pairs in self.pairs.values() for count in pairs.values()), default=0)

    def reason(self, name: str, registered: set[str], others: list[set[str]]) -> str:
        """Why the photo `name` is not in the model, in words."""
        features = self.features.get(name, 0)
        if features < MIN_FEATURES:
            return f"too few features: {features} found, about {MIN_FEATURES} needed (blurred, dark or plain)"
        for other in others:
            if name in other:
                return f"in another component of {len(other)} photos that does not connect to this one"
        pairs = self.pairs.get(name, {})
        best = max(pairs.values(), default=0)
        if best < MIN_VERIFIED:
            return f"matches no other photo: best pair has {best} verified matches, need {MIN_VERIFIED}"
        linked = [count for other, count in pairs.items() if other in registered]
        if not linked:
            return f"matches only photos that are left out too (best pair: {best} verified matches)"
        return (
            f"could not be placed: {len(linked)} registered photos match it (best pair: {max(linked)} "
            f"verified matches), but fewer than {MIN_PNP} of its 3D points agreed on one position"
        )


def _hint(matcher: str, params: Any) -> str:
    if matcher != "exhaustive":
        return "Try `--set sfm.matcher=exhaustive`, or add overlapping photos."
    other = "global" if params.mapper == "incremental" else "incremental"
    return f"Try `--set sfm.mapper={other}`, or add photos that overlap by two thirds and show texture."


def _nothing_matched(evidence: _Evidence, names: list[str], matcher: str, params: Any) -> ReconstructionError:
    features = sorted(evidence.features.get(name, 0) for name in names)
    median, best = features[len(features) // 2], evidence.best_pair
    if best < MIN_VERIFIED:
        message = (
            f"None of the {len(names)} photos could be registered: the best pair shares {best} matches, "
            f"need {MIN_VERIFIED} (median {median} features a photo)."
        )
        hint = (
            "Plain surfaces cannot be matched: put the object on something printed, e.g. newspaper, keep "
            "that in the frame, and let neighbouring photos overlap by two thirds."
        )
        return ReconstructionError(message, hint)
    message = (
        f"None of the {len(names)} photos could be registered: no pair is good enough to start from "
        f"(best pair: {best} matches; median {median} features a photo)."
    )
    return ReconstructionError(message, _hint(matcher, params))


def _check_enough(
    registered: list[str], unregistered: list[dict[str, str]], names: list[str], matcher: str, params: Any
) -> None:
    needed = max(params.min_registered, round(params.min_registered_ratio * len(names)))
    if len(registered) >= needed:
        return
    first = "; ".join(f"{item['name']}: {item['reason']}" for item in unregistered[:2])
    raise ReconstructionError(
        f"Only {len(registered)} of {len(names)} photos were registered (need {needed}). E.g. {first}.",
        _hint(matcher, params),
    )


SFM = Stage(
    name="sfm",
    version=1,
    needs=("ingest",),
    params="sfm",
    run=run,
    sources=("poses",),
    summary="find the camera poses, or take known ones",
)
