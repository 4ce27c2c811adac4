"""densify: pinhole photos -> a depth map with its trust for each, and one point cloud.

Training starts from it and is held to it; it is of use by itself, too.
"""

from __future__ import annotations

import logging
from typing import Any

import numpy as np

from configs.params import DensifyParams
from stages.artifacts import DEPTH_MAPS, FIRST_SCENE, PINHOLE_PHOTOS, POINT_CLOUD, Pictures
from stages.engine.stage import Stage, StageContext
from stages.geometry.cameras import PosedScene
from stages.geometry.point_cloud import PointCloud
from stages.stereo.rectification import View

log = logging.getLogger(__name__)

# A depth counts as explained from this trust on.
EXPLAINED = 0.5


def run(context: StageContext[DensifyParams]) -> dict[str, Any]:
    """Compare neighbouring photos, judge what they say, fuse it."""
    scene = context.read(FIRST_SCENE)
    if context.params.method == "off":
        context.write(POINT_CLOUD, PointCloud.empty())
        return {"points": 0, "depth_maps": 0, "explained": {}}
    from stages.stereo.depths import pairs_of, views_of

    cameras = scene.cameras
    views = views_of(cameras, context.params.side)
    pairs = pairs_of(cameras, scene.points, scene.observations, context.params.neighbors)
    if not pairs:
        log.warning("no two of the %d photos share enough points to be compared: no dense points", len(cameras))
    colors = [
        _at_size(context.read(PINHOLE_PHOTOS), name, view) for name, view in zip(cameras.names, views, strict=True)
    ]
    depths, trusts = _compare(context, scene, views, pairs, colors)
    return {"pairs": len(pairs), **_publish(context, scene, views, depths, trusts, colors)}


def _at_size(pictures: Pictures, name: str, view: View) -> np.ndarray:
    """A photo [h, w, 3] at the size at which it is compared."""
    import cv2

    photo = pictures.image(name)
    same = photo.shape[1::-1] == view.size
    return photo if same else cv2.resize(photo, view.size, interpolation=cv2.INTER_AREA)


def _compare(
    context: StageContext[DensifyParams],
    scene: PosedScene,
    views: list[View],
    pairs: list[tuple[int, int]],
    colors: list[np.ndarray],
) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Depths [h, w] of each photo in units of the scene, and their trust [h, w]."""
    import cv2
    import numba

    from stages.stereo.depths import depth_maps
    from stages.stereo.trust import trust_of

    seen = [scene.points[scene.observations[scene.observations[:, 0] == k, 1]] for k in range(len(views))]
    greys = [cv2.cvtColor(photo, cv2.COLOR_RGB2GRAY) for photo in colors]
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)  # the pool is the parallelism
    numba.set_num_threads(min(context.workers, numba.config.NUMBA_NUM_THREADS))
    try:
        depths = depth_maps(views, greys, pairs, seen, context.workers, lambda k: context.progress(k, len(views) + 1))
        for name, depth in zip(scene.cameras.names, depths, strict=True):
            _cut(depth, context.read(PINHOLE_PHOTOS).mask(name))
        return depths, trust_of(views, depths)
    finally:
        cv2.setNumThreads(before)


def _cut(depth: np.ndarray, mask: np.ndarray | None) -> None:
    """Forget the depths [h, w] outside the photo's mask [H, W]: what is there may have moved."""
    import cv2

    if mask is not None:
        depth[cv2.resize(mask, depth.shape[::-1], interpolation=cv2.INTER_NEAREST) < 128] = 0


def _publish(
    context: StageContext[DensifyParams],
    scene: PosedScene,
    views: list[View],
    depths: list[np.ndarray],
    trusts: list[np.ndarray],
    colors: list[np.ndarray],
) -> dict[str, Any]:
    from stages.stereo.fusion import fused

    cloud = fused(views, depths, trusts, colors).moved(scene.poses_from_scene)
    context.write(POINT_CLOUD, cloud)
    maps, known, explained = context.to_write(DEPTH_MAPS), 0, {}
    for name, depth, trust in zip(scene.cameras.names, depths, trusts, strict=True):
        explained[name] = round(float((trust >= EXPLAINED).mean()), 4)
        if (depth > 0).any():
            maps.save(name, depth * scene.poses_from_scene.scale, trust)
            known += 1
    return {
        "points": len(cloud),
        "depth_maps": known,
        "trust": round(float(cloud.trust.mean()), 3) if len(cloud) else 0.0,
        "explained": explained,
    }


DENSIFY: Stage[DensifyParams] = Stage(
    name="densify",
    version=1,
    settings=lambda config: config.densify,
    run=run,
    reads=(FIRST_SCENE, PINHOLE_PHOTOS),
    writes=(DEPTH_MAPS, POINT_CLOUD),
    summary="compare neighbouring photos: depth maps and a dense point cloud",
)
