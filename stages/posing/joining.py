"""Two models of one capture, put into one frame by the points that both have.

COLMAP joins a photo to a model on the points that this one photo sees. Where no photo alone sees enough of them, all
photos of another model together may: a similarity takes that model onto this one.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from stages.posing.evidence import MIN_PNP

log = logging.getLogger(__name__)

# A model is put beside another on as many common points as place a single photo ...
MIN_COMMON = MIN_PNP
# ... if this part of them lands within this many pixels of where the other's photos see them. Both are the defaults of
# COLMAP's own `align_reconstructions_via_reprojections`, which knows points of common photos only.
MIN_AGREEING, MAX_ERROR_PX = 0.3, 8.0
# The search for the similarity takes two points for one within this part of the median distance from a camera to its
# points. A wide search fits wrong pairs, too, and a narrow one misses points whose depth is badly known: all are tried.
SEARCH_DISTANCES = (0.01, 0.02, 0.05)
# Rounds of bundle adjustment, and the part of the observations that changes in the last one (COLMAP's defaults).
REFINEMENTS, REFINEMENT_CHANGE = 5, 0.0005

NO_POINT = 2**64 - 1  # COLMAP's id of the point of a feature that has none

Matches = Mapping[tuple[int, int], np.ndarray]


def join_models(models: Sequence[Any], database: Path, options: Any) -> list[Any]:
    """The models by size, those that fit onto another one made part of it.

    Args:
        models: pycolmap reconstructions on `database`; they stay as they are.
        options: `pycolmap.IncrementalPipelineOptions` that they were found with.
    """
    import pycolmap

    models = sorted(models, key=lambda model: (-model.num_reg_images(), -model.num_points3D()))
    if len(models) < 2:
        return models
    with pycolmap.Database.open(database) as opened:
        matches = verified_matches(opened, options.min_num_matches)
        caching = pycolmap.DatabaseCacheOptions()
        caching.min_num_matches = options.min_num_matches
        cache = pycolmap.DatabaseCache.create(opened, caching)
    return _join(models, matches, cache, options)


def _join(models: list[Any], matches: Matches, cache: Any, options: Any) -> list[Any]:
    for first, second in combinations(models, 2):
        joint = _joined(first, second, matches, cache, options)
        if joint is not None:
            others = [model for model in models if model is not first and model is not second]
            return _join([joint, *others], matches, cache, options)  # what fits no part may fit the whole
    return models


def _joined(first: Any, second: Any, matches: Matches, cache: Any, options: Any) -> Any | None:
    """A model of the photos of both, or None where they do not fit."""
    if set(second.reg_image_ids()) <= set(first.reg_image_ids()):
        return first
    sizes = first.num_reg_images(), second.num_reg_images()
    common = common_points(first, second, matches)
    found = align(first, second, common, options.random_seed)
    if found is None:
        log.info("models of %d and %d photos: %d common points, no fit", *sizes, len(common))
        return None
    first_from_second, agreeing = found
    joint = put_together(first, second, first_from_second, common[agreeing], cache)
    adjust(joint, cache, options)
    shared = shared_points(joint, first, second)
    if shared < MIN_COMMON:
        log.info("models of %d and %d photos: adjusted, they share %d points, too few", *sizes, shared)
        return None
    log.info("models of %d and %d photos were joined: they share %d points", *sizes, shared)
    return joint


# ---------------------------------------------------------------- what two models have in common
def verified_matches(database: Any, least: int) -> dict[tuple[int, int], np.ndarray]:
    """Pair of image ids -> indices of its matched features [M, 2], where there are at least so many."""
    import pycolmap

    pair_ids, geometries = database.read_two_view_geometries()
    return {
        pycolmap.pair_id_to_image_pair(pair_id): geometry.inlier_matches
        for pair_id, geometry in zip(pair_ids, geometries, strict=True)
        if len(geometry.inlier_matches) >= least
    }


def common_points(first: Any, second: Any, matches: Matches) -> np.ndarray:
    """[N, 2] ids of points of the first and the second model that are one: of one feature, or of two that match."""
    points, others = _point_ids(first), _point_ids(second)
    pairs = [np.empty((0, 2), np.uint64)]
    pairs += [np.stack([points[i], others[i]], 1) for i in points.keys() & others.keys()]
    for (i, j), indices in matches.items():
        if i in points and j in others:
            pairs.append(np.stack([points[i][indices[:, 0]], others[j][indices[:, 1]]], 1))
        if j in points and i in others:
            pairs.append(np.stack([points[j][indices[:, 1]], others[i][indices[:, 0]]], 1))
    stacked = np.concatenate(pairs)
    return np.unique(stacked[(stacked != NO_POINT).all(1)], axis=0)


def _point_ids(model: Any) -> dict[int, np.ndarray]:
    """Image id -> the point of each of its features [K] uint64."""
    return {
        i: np.array([feature.point3D_id for feature in model.images[i].points2D], dtype=np.uint64)
        for i in model.reg_image_ids()
    }


def align(first: Any, second: Any, common: np.ndarray, seed: int = 0) -> tuple[Any, np.ndarray] | None:
    """The similarity first_from_second and which of the common points [N, 2] agree with it; None where too few do."""
    import pycolmap

    if len(common) < MIN_COMMON:
        return None
    places = np.array([first.points3D[i].xyz for i in common[:, 0].tolist()])
    others = np.array([second.points3D[i].xyz for i in common[:, 1].tolist()])
    fits = []
    for distance in SEARCH_DISTANCES:
        search = pycolmap.RANSACOptions()
        search.max_error, search.random_seed = distance * view_distance(first), seed
        found: Any = pycolmap.estimate_sim3d_robust(others, places, search)
        if found is not None:
            first_from_second = found["tgt_from_src"]
            errors = _errors_px(first, common[:, 0].tolist(), first_from_second * others)
            back = _errors_px(second, common[:, 1].tolist(), first_from_second.inverse() * places)
            fits.append((first_from_second, np.maximum(errors, back) < MAX_ERROR_PX))
    first_from_second, agreeing = max(fits, key=lambda fit: fit[1].sum(), default=(None, np.zeros(0, bool)))
    if agreeing.sum() < max(MIN_COMMON, MIN_AGREEING * len(common)):
        return None
    return first_from_second, agreeing


def view_distance(model: Any) -> float:
    """Median distance from a photo to a point it sees."""
    distances = [
        np.linalg.norm(point.xyz - model.images[element.image_id].projection_center())
        for point in model.points3D.values()
        for element in point.track.elements[:1]
    ]
    return float(np.median(np.array(distances)))


def _errors_px(model: Any, ids: Sequence[int], places: np.ndarray) -> np.ndarray:
    """[N] median distance in pixels between the features of a model's points and where places [N, 3] would appear."""
    errors = np.full(len(ids), np.inf)
    for k, (point_id, place) in enumerate(zip(ids, places, strict=True)):
        seen: list[float] = []
        for element in model.points3D[point_id].track.elements:
            image = model.images[element.image_id]
            pixel = image.project_point(place)  # None behind the camera
            feature = image.points2D[element.point2D_idx].xy
            seen.append(np.inf if pixel is None else float(np.linalg.norm(pixel - feature)))
        errors[k] = np.median(seen)
    return errors


# ---------------------------------------------------------------- the joint model
def put_together(first: Any, second: Any, first_from_second: Any, same: np.ndarray, cache: Any) -> Any:
    """The first model with the photos and points that only the second has, and the points [N, 2] that are one merged.

    Where both have a photo or a camera, it is that of the first.
    """
    import pycolmap

    joint, moved = pycolmap.Reconstruction(first), pycolmap.Reconstruction(second)
    moved.transform(first_from_second)
    joint.load(cache)  # the photos of the second, without poses so far
    placed = set(first.reg_image_ids())
    added = set(second.reg_image_ids()) - placed
    known = {first.images[i].camera_id for i in placed}
    for i in sorted(added):
        image = moved.images[i]
        if image.camera_id not in known:
            joint.cameras[image.camera_id].params = list(moved.cameras[image.camera_id].params)
    for frame_id in sorted({moved.images[i].frame_id for i in added}):
        joint.frames[frame_id].rig_from_world = moved.frames[frame_id].rig_from_world
        joint.register_frame(frame_id)
    new_id = {}
    for point_id, point in moved.points3D.items():
        elements = [element for element in point.track.elements if element.image_id in added]
        if len(elements) >= 2:
            new_id[point_id] = joint.add_point3D(point.xyz, pycolmap.Track(elements), point.color)
    for kept, other in same.tolist():
        if joint.exists_point3D(kept) and joint.exists_point3D(new_id.get(other, NO_POINT)):
            joint.merge_points3D(kept, new_id[other])  # both get a new id, and are not merged again
    return joint


def adjust(model: Any, cache: Any, options: Any) -> None:
    """Bundle adjustment, tracks completed and merged, and points that do not fit left out, as COLMAP ends a model."""
    import pycolmap

    mapper = pycolmap.IncrementalMapper(cache)
    mapper.begin_reconstruction(model)
    mapper.iterative_global_refinement(
        REFINEMENTS,
        REFINEMENT_CHANGE,
        options.get_mapper(),
        options.get_global_bundle_adjustment(),
        options.get_triangulation(),
    )
    mapper.end_reconstruction(discard=False)
    model.tear_down()  # leaves the photos out that have no pose


def shared_points(joint: Any, first: Any, second: Any) -> int:
    """Points of the joint model that photos of the first see, and photos that only the second has."""
    placed = set(first.reg_image_ids())
    added = set(second.reg_image_ids()) - placed
    tracks = ({element.image_id for element in point.track.elements} for point in joint.points3D.values())
    return sum(bool(track & placed) and bool(track & added) for track in tracks)
