"""The last bundle adjustment: frees of each camera what the photos determine, and says how exact the poses are.

Mapping holds the principal point in the middle of the frame and estimates one radial term. Freed too early, both fit
noise; held where the lens is another, they bend the poses. So each freedom is tried on the finished model, and kept for
a camera where it
- lowers the reprojection error of observations that were held out of the adjustment, in most photos alike,
- is determined: its shift is many standard errors, and these are small,
- is plausible.

The principal point comes first, then, on top of it, the radial k2 (COLMAP's SIMPLE_RADIAL becomes RADIAL). Tangential
terms are left alone: on surveyed facades they made poses worse.
"""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np

from stages.artifacts import Lens, LensTrial, PoseError
from stages.posing.joining import view_distance
from stages.posing.precision import Observations, Precision, estimate_precision, free_parameters, observations_of
from stages.posing.rigs import has_rigs

if TYPE_CHECKING:
    from jaxtyping import Float

log = logging.getLogger(__name__)

PRINCIPAL_POINT, K2 = "principal point", "radial k2"
FREEDOMS = (PRINCIPAL_POINT, K2)

# ---- what is held out
HELD_OUT_SHARE = 0.2  # of the observations
KEPT_VIEWS = 3  # a point keeps so many observations: with two, its own error hides in its depth
MOST_PHOTOS = 1000  # the covariance takes memory with their square: 1.5 GB
# ---- what is asked of a camera
MIN_PHOTOS = 5
MIN_HELD_OUT = 200  # observations
# ---- what is asked of a freedom. A principal point that is known to be off the middle lowers the mean error by 0.4 to
# 13 %, a right one on synthetic photos by -0.01 to 0.02 %. (The mean distance sees it, as a Cauchy loss would, where
# the squared one is lost in a few wrong features.)
MIN_GAIN = 0.0025  # of the mean error of the held-out observations
MIN_AGREEMENT = 2.0  # mean gain of a photo over its standard error
MIN_SHIFT = 5.0  # standard errors; residuals are not independent, so these are too small
MAX_STANDARD_ERROR = 0.005  # of the principal point, in longer sides of the frame
MAX_SHIFT = 0.2  # of the principal point, in longer sides of the frame: cropped photos are photos, too
MAX_FOCAL_CHANGE = 1.25  # a focal length that moves more than so was no measurement


Freed = Mapping[int, frozenset[str]]  # camera id -> its freedoms


@dataclass(frozen=True)
class LastAdjustment:
    """What came of it.

    Attributes:
        model: the adjusted pycolmap model; the one that was given where nothing was freed.
        lenses: of its cameras. pose_error: None where it cannot be told.
    """

    model: Any
    lenses: tuple[Lens, ...]
    pose_error: PoseError | None


def adjust_last(model: Any, params: Any, threads: int, known: Mapping[int, Lens] | None = None) -> LastAdjustment:
    """Free what the photos determine, and adjust once more with all observations.

    Args:
        model: pycolmap reconstruction; it stays as it is.
        params: `configs.params.SfmParams`.
        threads: one for the same result every time.
        known: camera id -> lens of a model that this one goes on from. Nothing is tried then: these keep what was freed
            of them, others nothing, and all is adjusted.
    """
    if model.num_reg_images() > MOST_PHOTOS:
        log.info("the lens stays as it is: the last adjustment is for up to %d photos", MOST_PHOTOS)
        return LastAdjustment(model, lenses=(), pose_error=None)
    if has_rigs(model):
        log.info("the lenses stay as they are: views of 360-degree pictures have none")
        return LastAdjustment(model, lenses=(), pose_error=None)
    freed: Freed = {camera_id: frozenset() for camera_id in _photo_counts(model)}
    trials: dict[int, list[LensTrial]] = {}
    if known is not None:
        freed = {camera_id: frozenset(known[camera_id].freed if camera_id in known else ()) for camera_id in freed}
        trials = {camera_id: list(lens.trials) for camera_id, lens in known.items()}
    elif params.refine_lens == "auto":
        freed, trials = try_freedoms(model, params.seed, threads)
    if any(freed.values()) or known is not None:
        model = bundle_adjust(model, freed, threads)
    precision = estimate_precision(model, _free(model, freed))
    lenses = tuple(
        _describe_lens(model.cameras[camera_id], photos, tuple(trials.get(camera_id, ())), precision)
        for camera_id, photos in _photo_counts(model).items()
    )
    if precision is None:
        return LastAdjustment(model, lenses, None)
    error = PoseError(
        residual_px=precision.residual_px, center=float(np.median(precision.centers)), distance=view_distance(model)
    )
    return LastAdjustment(model, lenses, error)


def try_freedoms(model: Any, seed: int, threads: int) -> tuple[Freed, dict[int, list[LensTrial]]]:
    """What each camera of a pycolmap model keeps, and what was tried, camera by camera."""
    seen = observations_of(model)
    out = hold_out(seen, seed)
    freed: Freed = {camera_id: frozenset() for camera_id in _photo_counts(model)}
    trials: dict[int, list[LensTrial]] = {}
    judged = judged_cameras(seen, out)
    if not judged:
        return freed, trials
    current = bundle_adjust(_without(model, seen, out), freed, threads)
    for freedom in FREEDOMS:
        able = {i for i in judged if freedom == PRINCIPAL_POINT or model.cameras[i].model_name == "SIMPLE_RADIAL"}
        if not able:
            continue
        wider = _widened(freed, able, freedom)
        trial = bundle_adjust(current, wider, threads)
        verdicts = _judge(freedom, able, current, trial, wider, seen, out)
        for camera_id, verdict in verdicts.items():
            trials.setdefault(camera_id, []).append(verdict)
        chosen = {camera_id for camera_id, verdict in verdicts.items() if not verdict.refused}
        if chosen:
            freed = _widened(freed, chosen, freedom)
            current = trial if chosen == able else bundle_adjust(current, freed, threads)
    return freed, trials


def _widened(freed: Freed, cameras: set[int], freedom: str) -> Freed:
    return {camera_id: own | {freedom} if camera_id in cameras else own for camera_id, own in freed.items()}


def _free(model: Any, freed: Freed) -> dict[int, list[int]]:
    """Camera id -> places of the intrinsics that are adjusted."""
    return {
        camera_id: free_parameters(model.cameras[camera_id], PRINCIPAL_POINT in own) for camera_id, own in freed.items()
    }


def _describe_lens(camera: Any, photos: int, trials: tuple[LensTrial, ...], precision: Precision | None) -> Lens:
    names = [name.strip() for name in camera.params_info.split(",")]
    errors = precision.intrinsics[camera.camera_id] if precision else {}
    return Lens(
        photos=photos,
        size=(camera.width, camera.height),
        model=camera.model_name,
        params=dict(zip(names, map(float, camera.params), strict=True)),
        standard_errors={names[place]: error for place, error in errors.items()},
        trials=trials,
    )


# ---------------------------------------------------------------- adjusting
def bundle_adjust(model: Any, freed: Freed, threads: int) -> Any:
    """A copy of the model after a bundle adjustment in which each camera has its freedoms.

    COLMAP frees principal points of all cameras or of none: where only some are free, the intrinsics of the others are
    adjusted first, and held.
    """
    import pycolmap

    adjusted = pycolmap.Reconstruction(model)
    for camera_id, own in freed.items():
        if K2 in own:
            _give_k2(adjusted.cameras[camera_id])
    with_center = {camera_id for camera_id, own in freed.items() if PRINCIPAL_POINT in own}
    if with_center != set(freed):
        _solve(adjusted, threads, False, set())
    if with_center:
        _solve(adjusted, threads, True, set(freed) - with_center)
    adjusted.update_point_3d_errors()
    return adjusted


def _solve(model: Any, threads: int, principal_point: bool, held: set[int]) -> None:
    import pycolmap

    options = pycolmap.BundleAdjustmentOptions()  # its tolerances are tighter than those within mapping
    options.refine_principal_point, options.print_summary = principal_point, False
    options.ceres.solver_options.num_threads = threads
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in sorted(model.reg_image_ids()):
        config.add_image(image_id)
    for camera_id in sorted(held):
        config.set_constant_cam_intrinsics(camera_id)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    pycolmap.create_default_bundle_adjuster(options, config, model).solve()


def _give_k2(camera: Any) -> None:
    import pycolmap

    if camera.model_name == "SIMPLE_RADIAL":
        params = [*camera.params, 0.0]
        camera.model = pycolmap.CameraModelId.RADIAL
        camera.params = params


# ---------------------------------------------------------------- holding out
def hold_out(seen: Observations, seed: int) -> np.ndarray:
    """Numbers of a random fifth of the observations [H], fewer where points would keep less than `KEPT_VIEWS`."""
    total = len(seen.point)
    order = np.random.default_rng(seed).permutation(total)
    by_point = order[np.argsort(seen.point[order], kind="stable")]
    counts = np.bincount(seen.point, minlength=len(seen.points))
    place = np.empty(total, dtype=np.int64)  # in its point's track, shuffled
    place[by_point] = np.arange(total) - np.repeat(np.cumsum(counts) - counts, counts)
    return order[place[order] >= KEPT_VIEWS][: round(HELD_OUT_SHARE * total)]


def _without(model: Any, seen: Observations, out: np.ndarray) -> Any:
    """A copy of the model without these observations."""
    import pycolmap

    kept = pycolmap.Reconstruction(model)
    for photo, feature in zip(seen.photo[out].tolist(), seen.feature[out].tolist(), strict=True):
        kept.delete_observation(seen.images[photo], feature)
    return kept


def reprojection_errors(model: Any, seen: Observations, which: np.ndarray) -> Float[np.ndarray, " h"]:
    """Distances of these observations to their points in the photos, pixels; behind a camera: the frame's diagonal."""
    places = np.array([model.points3D[i].xyz for i in seen.point_ids[seen.point[which]].tolist()]).reshape(-1, 3)
    errors = np.empty(len(which))
    for number in np.unique(seen.photo[which]).tolist():
        image, rows = model.images[seen.images[number]], np.flatnonzero(seen.photo[which] == number)
        camera = model.cameras[image.camera_id]
        pixels = camera.img_from_cam(image.cam_from_world() * places[rows])
        distances = np.linalg.norm(pixels - seen.pixels[which[rows]], axis=1)
        errors[rows] = np.nan_to_num(distances, nan=float(np.hypot(camera.width, camera.height)))
    return errors


# ---------------------------------------------------------------- judging
def _photo_counts(model: Any) -> dict[int, int]:
    """Camera id -> how many photos it took."""
    return Counter(model.images[image_id].camera_id for image_id in sorted(model.reg_image_ids()))


def judged_cameras(seen: Observations, out: np.ndarray) -> set[int]:
    """Cameras with enough held-out observations in enough photos to judge by."""
    camera_of = seen.camera[out]
    return {
        camera_id
        for camera_id in np.unique(camera_of).tolist()
        if (camera_of == camera_id).sum() >= MIN_HELD_OUT
        and len(np.unique(seen.photo[out][camera_of == camera_id])) >= MIN_PHOTOS
    }


def _judge(
    freedom: str,
    able: set[int],
    before: Any,
    after: Any,
    freed: Freed,
    seen: Observations,
    out: np.ndarray,
) -> dict[int, LensTrial]:
    """Camera id -> the verdict on a freedom, from the models without and with it."""
    old, new = reprojection_errors(before, seen, out), reprojection_errors(after, seen, out)
    camera_of = seen.camera[out]
    precision = cache(lambda: estimate_precision(after, _free(after, freed)))  # seconds: only where errors speak for it
    verdicts = {}
    for camera_id in sorted(able):
        own = camera_of == camera_id
        refused = refuse_by_errors(old[own], new[own], seen.photo[out][own])
        if not refused:
            found = precision()
            standard = found.intrinsics[camera_id] if found else None
            refused = refuse_by_lens(freedom, before.cameras[camera_id], after.cameras[camera_id], standard)
        held_out = float(old[own].mean()), float(new[own].mean())
        verdicts[camera_id] = LensTrial(freedom=freedom, held_out_px=held_out, refused=refused)
    return verdicts


def refuse_by_errors(old: Float[np.ndarray, " h"], new: Float[np.ndarray, " h"], photo: np.ndarray) -> str:
    """Why errors of held-out observations speak against a freedom; empty where they do not.

    Args:
        old, new: without and with it, pixels. photo: [H] number of each one's photo.
    """
    gain = 1 - new.sum() / max(old.sum(), np.finfo(float).tiny)
    if gain < MIN_GAIN:
        return f"it changes the held-out error by {-100 * gain:+.2f} %, not by -{100 * MIN_GAIN:g} % or more"
    numbers = np.unique(photo)
    by_photo = np.array([(old - new)[photo == number].mean() for number in numbers])
    spread = by_photo.std(ddof=1) / np.sqrt(len(numbers))
    if by_photo.mean() < MIN_AGREEMENT * spread:
        return f"too uneven a gain: {(by_photo > 0).sum()} of {len(numbers)} photos are met better"
    return ""


def refuse_by_lens(freedom: str, before: Any, after: Any, errors: Mapping[int, float] | None) -> str:
    """Why the lens that came out speaks against a freedom; empty where it does not.

    Args:
        before, after: pycolmap cameras without and with it.
        errors: standard errors of the intrinsics by their place, None where they could not be told.
    """
    if errors is None:
        return "the photos leave the intrinsics undetermined"
    ratio = after.mean_focal_length() / before.mean_focal_length()
    if not 1 / MAX_FOCAL_CHANGE < ratio < MAX_FOCAL_CHANGE:
        return f"the focal length changes by a factor of {ratio:.2f} with it"
    side = max(after.width, after.height)
    if freedom == PRINCIPAL_POINT:
        shift = off_center(after)
        deviation = np.array([errors[place] for place in after.principal_point_idxs()])
        if (np.abs(shift) > MAX_SHIFT * side).any():
            return f"it comes out {np.linalg.norm(shift):.0f} px off the middle of {after.width} x {after.height}"
        if (deviation > MAX_STANDARD_ERROR * side).any():
            return f"its standard error is {deviation.max():.1f} px"
        if (np.abs(shift) < MIN_SHIFT * deviation).all():
            return f"it is in the middle within {MIN_SHIFT:.0f} standard errors"
        return ""
    place = after.extra_params_idxs()[-1]
    if abs(after.params[place]) < MIN_SHIFT * errors[place]:
        return f"it is zero within {MIN_SHIFT:.0f} standard errors"
    if not distortion_grows(after):
        return "the distortion turns back within the frame with it"
    return ""


def off_center(camera: Any) -> Float[np.ndarray, " 2"]:
    """From the middle of the frame to the principal point, pixels."""
    return np.array([camera.principal_point_x - camera.width / 2, camera.principal_point_y - camera.height / 2])


def distortion_grows(camera: Any) -> bool:
    """Whether r (1 + k1 r^2 + k2 r^4) grows with r out to the frame's farthest corner, for a RADIAL camera."""
    k1, k2 = (camera.params[place] for place in camera.extra_params_idxs())
    corners = np.array([[x, y] for x in (0, camera.width) for y in (0, camera.height)])
    center = np.array([camera.principal_point_x, camera.principal_point_y])
    farthest = np.linalg.norm(corners - center, axis=1).max() / camera.mean_focal_length()
    radii = np.linspace(0, 2 * farthest, 1000)
    distorted = radii * (1 + k1 * radii**2 + k2 * radii**4)
    growing = np.diff(distorted) > 0
    turn = len(growing) if growing.all() else int(np.argmin(growing))
    return bool(distorted[turn] > farthest)
