"""densify: pinhole photos -> a depth map with its trust for each, and one point cloud.

Training starts from it and is held to it; it is of use by itself, too. Photos that training holds out say nothing here
either: what it is measured by must not have shaped what it starts from.
"""

from __future__ import annotations

import logging
import shutil
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from configs.params import HeldOutDensifyParams
from stages.artifacts import DEPTH_MAPS, FIRST_SCENE, PINHOLE_PHOTOS, POINT_CLOUD, Pictures
from stages.engine.stage import Stage, StageContext
from stages.errors import SystemRequirementError
from stages.geometry.cameras import PosedScene
from stages.geometry.point_cloud import PointCloud
from stages.stereo.rectification import View

log = logging.getLogger(__name__)

# A depth counts as explained from this trust on.
EXPLAINED = 0.5


def run(context: StageContext[HeldOutDensifyParams]) -> dict[str, Any]:
    """Compare neighbouring photos, judge what they say, fuse it."""
    if context.params.method == "off":
        context.write(POINT_CLOUD, PointCloud.empty())
        return {"points": 0, "depth_maps": 0, "explained": {}}
    from stages.stereo.depths import views_of
    from stages.stereo.pairs import pairs_of

    whole = context.read(FIRST_SCENE)
    used = _used(len(whole.cameras), context.params.hold_out)
    scene = _of_photos(whole, used)
    views = views_of(scene.cameras, context.params.side)
    pairs = pairs_of(views, scene.points, scene.observations, context.params.neighbors)
    pictures = context.read(PINHOLE_PHOTOS)
    colors = [_at_size(pictures, name, view) for name, view in zip(scene.cameras.names, views, strict=True)]
    depths, trusts = _judged(context, scene, views, pairs, colors)
    numbers = _publish(context, scene, used, views, depths, trusts, colors)
    if not numbers["points"]:
        _say_why(len(views), len(pairs), numbers["depth_maps"])
    return {"pairs": len(pairs), **numbers}


def _used(count: int, hold_out: int) -> np.ndarray:
    """Indices of the photos that training does not hold out."""
    if not hold_out:
        return np.arange(count)
    from stages.neural.held_out_psnr import left_out

    return np.flatnonzero(~left_out(count, hold_out).numpy())


def _of_photos(scene: PosedScene, used: np.ndarray) -> PosedScene:
    """The scene as only these photos show it."""
    row = np.full(len(scene.cameras), -1)
    row[used] = np.arange(len(used))
    observations = scene.observations[row[scene.observations[:, 0]] >= 0]
    renumbered = np.column_stack([row[observations[:, 0]], observations[:, 1]])
    return replace(scene, cameras=scene.cameras.select(used), observations=renumbered)


def _say_why(photos: int, pairs: int, depth_maps: int) -> None:
    if not pairs:
        why = f"no two of the {photos} photos share enough points, from places apart, to be compared"
    elif not depth_maps:
        why = f"the {pairs} pairs of photos that share points agree on no depth"
    else:
        why = f"what the {pairs} pairs of photos agree on, no other photo confirms"
    log.warning("%s: training goes on without dense points", why)


def _at_size(pictures: Pictures, name: str, view: View) -> np.ndarray:
    """A photo [h, w, 3] at the size at which it is compared."""
    import cv2

    photo = pictures.image(name)
    same = photo.shape[1::-1] == view.size
    return photo if same else cv2.resize(photo, view.size, interpolation=cv2.INTER_AREA)


def _judged(
    context: StageContext[HeldOutDensifyParams],
    scene: PosedScene,
    views: Sequence[View],
    pairs: Sequence[tuple[int, int]],
    colors: Sequence[np.ndarray],
) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Depths [h, w] of each photo in units of the scene, and their trust [h, w]."""
    import cv2
    import numba

    from stages.stereo.trust import trust_of

    threads, compiled_threads = cv2.getNumThreads(), numba.get_num_threads()
    cv2.setNumThreads(1)  # the pool is the parallelism
    numba.set_num_threads(min(context.workers, numba.config.NUMBA_NUM_THREADS))
    try:
        if context.params.method == "patch_match":
            depths = _by_patch_match(context, scene, views)
        else:
            depths = _by_semi_global_matching(context, scene, views, pairs, colors)
        for name, depth in zip(scene.cameras.names, depths, strict=True):
            _cut(depth, context.read(PINHOLE_PHOTOS).mask(name))
        return depths, trust_of(views, depths)
    finally:
        cv2.setNumThreads(threads)
        numba.set_num_threads(compiled_threads)


def _by_semi_global_matching(
    context: StageContext[HeldOutDensifyParams],
    scene: PosedScene,
    views: Sequence[View],
    pairs: Sequence[tuple[int, int]],
    colors: Sequence[np.ndarray],
) -> list[np.ndarray]:
    import cv2

    from stages.stereo.depths import depth_maps

    seen = [scene.points[scene.observations[scene.observations[:, 0] == k, 1]] for k in range(len(views))]
    greys = [cv2.cvtColor(photo, cv2.COLOR_RGB2GRAY) for photo in colors]
    return depth_maps(views, greys, pairs, seen, context.workers, lambda k: context.progress(k, len(views) + 1))


def _by_patch_match(
    context: StageContext[HeldOutDensifyParams], scene: PosedScene, views: Sequence[View]
) -> list[np.ndarray]:
    """Raises SystemRequirementError where pycolmap was built without CUDA."""
    import pycolmap

    from stages.stereo.patch_match import patch_match_depths

    if not pycolmap.has_cuda:
        raise SystemRequirementError(
            "`densify.method` = patch_match needs a pycolmap that was built with CUDA; this one was not.",
            "Try `--set densify.method=auto`, or `pip install pycolmap-cuda12`.",
        )
    depths = [np.zeros(view.size[::-1], np.float32) for view in views]
    folder = context.scratch / "patch_match"
    shutil.rmtree(folder, ignore_errors=True)
    pictures = context.read(PINHOLE_PHOTOS)
    for k, depth in patch_match_depths(scene, pictures, folder, context.params.side, context.progress):
        depths[k] = depth
    shutil.rmtree(folder)
    return depths


def _cut(depth: np.ndarray, mask: np.ndarray | None) -> None:
    """Forget the depths [h, w] outside the photo's mask [H, W]: what is there may have moved."""
    import cv2

    if mask is not None:
        depth[cv2.resize(mask, depth.shape[::-1], interpolation=cv2.INTER_NEAREST) < 128] = 0


def _publish(
    context: StageContext[HeldOutDensifyParams],
    scene: PosedScene,
    used: np.ndarray,
    views: Sequence[View],
    depths: Sequence[np.ndarray],
    trusts: Sequence[np.ndarray],
    colors: Sequence[np.ndarray],
) -> dict[str, Any]:
    from stages.stereo.fusion import fused

    cloud = fused(views, depths, trusts, colors).moved(scene.poses_from_scene)
    context.write(POINT_CLOUD, replace(cloud, photos=used[cloud.photos].astype(np.int32)))
    maps, known, explained = context.to_write(DEPTH_MAPS), 0, {}
    for name, depth, trust in zip(scene.cameras.names, depths, trusts, strict=True):
        explained[name] = round(float((trust >= EXPLAINED).mean()), 4)
        if (depth > 0).any():
            maps.save(name, depth * np.float32(scene.poses_from_scene.scale), trust)
            known += 1
    return {
        "points": len(cloud),
        "depth_maps": known,
        "trust": round(float(cloud.trust.mean()), 3) if len(cloud) else 0.0,
        "explained": explained,
    }


DENSIFY: Stage[HeldOutDensifyParams] = Stage(
    name="densify",
    version=3,
    settings=lambda config: HeldOutDensifyParams(**config.densify.model_dump(), hold_out=config.train.hold_out),
    run=run,
    reads=(FIRST_SCENE, PINHOLE_PHOTOS),
    writes=(DEPTH_MAPS, POINT_CLOUD),
    summary="compare neighbouring photos: depth maps and a dense point cloud",
)
