"""densify: pinhole photos -> a depth map with its trust for each, and one point cloud.

Training starts from it and is held to it; it is of use by itself, too. Photos that training holds out say nothing here
either: what it is measured by must not have shaped what it starts from.
"""

from __future__ import annotations

import logging
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from configs.params import HeldOutDensifyParams
from stages.artifacts import DEPTH_MAPS, FIRST_SCENE, OUTLINES, PINHOLE_PHOTOS, POINT_CLOUD, Pictures, given_mask_of
from stages.engine.stage import Stage, StageContext
from stages.errors import SystemRequirementError
from stages.geometry.cameras import PosedScene
from stages.geometry.point_cloud import TRUSTED, PointCloud
from stages.stereo.rectification import View

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class _Capture:
    """The photos that are compared, and the size at which they are.

    Attributes:
        used: index of each among all photos of the capture.
        pairs: two photos each, see `pairs_of`.
        pictures: with the masks that alone count. outlines: with those beside whole photos.
    """

    scene: PosedScene
    used: np.ndarray
    views: Sequence[View]
    pairs: Sequence[tuple[int, int]]
    pictures: Pictures
    outlines: Pictures

    @property
    def names(self) -> tuple[str, ...]:
        return self.scene.cameras.names

    def color(self, photo: int) -> np.ndarray:
        """RGB [h, w, 3] of a photo; read anew each time, since those of all photos would fill the memory."""
        import cv2

        picture, size = self.pictures.image(self.names[photo]), self.views[photo].size
        return picture if picture.shape[1::-1] == size else cv2.resize(picture, size, interpolation=cv2.INTER_AREA)

    def grey(self, photo: int) -> np.ndarray:
        """[h, w] uint8."""
        import cv2

        return cv2.cvtColor(self.color(photo), cv2.COLOR_RGB2GRAY)

    def within(self, photo: int) -> np.ndarray | None:
        """Whether each pixel [h, w] lies on the photo's mask, where it has one that alone counts."""
        return self._on_mask(photo, self.pictures)

    def on_object(self, photo: int) -> np.ndarray | None:
        """Whether each pixel [h, w] shows the object, by the photo's given mask, where it has one."""
        return self._on_mask(photo, given_mask_of(self.names[photo], self.pictures, self.outlines))

    def _on_mask(self, photo: int, pictures: Pictures) -> np.ndarray | None:
        import cv2

        mask = pictures.mask(self.names[photo])
        return None if mask is None else cv2.resize(mask, self.views[photo].size, interpolation=cv2.INTER_NEAREST) > 127


def run(context: StageContext[HeldOutDensifyParams]) -> dict[str, Any]:
    """Compare neighbouring photos, judge what they say, fuse it."""
    if context.params.method == "off":
        context.write(POINT_CLOUD, PointCloud.empty())
        return {"points": 0, "depth_maps": 0, "explained": {}}
    photos = _capture(context)
    with _threads(context.workers):
        depths = _depths(context, photos)
        numbers = _publish(context, photos, depths)
    if not numbers["points"]:
        _say_why(len(photos.views), len(photos.pairs), numbers["depth_maps"])
    return {"pairs": len(photos.pairs), **numbers}


def _capture(context: StageContext[HeldOutDensifyParams]) -> _Capture:
    from stages.stereo.depths import views_of
    from stages.stereo.pairs import pairs_of

    whole = context.read(FIRST_SCENE)
    used = _used(len(whole.cameras), context.params.hold_out)
    scene = _of_photos(whole, used)
    views = views_of(scene.cameras, context.params.side)
    pairs = pairs_of(views, scene.points, scene.observations, context.params.neighbors)
    return _Capture(scene, used, views, pairs, context.read(PINHOLE_PHOTOS), context.read(OUTLINES))


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


@contextmanager
def _threads(workers: int) -> Iterator[None]:
    """So many threads for the compiled loops, and one for each of OpenCV's calls: a pool makes these in parallel."""
    import cv2

    from stages.compiling import numba

    before = cv2.getNumThreads(), numba.get_num_threads()
    cv2.setNumThreads(1)
    numba.set_num_threads(min(workers, numba.config.NUMBA_NUM_THREADS))
    try:
        yield
    finally:
        cv2.setNumThreads(before[0])
        numba.set_num_threads(before[1])


def _depths(context: StageContext[HeldOutDensifyParams], photos: _Capture) -> list[np.ndarray]:
    """Depths [h, w] of each photo in units of the scene; none off its mask: what is there may have moved."""
    if context.params.method == "patch_match":
        depths = _by_patch_match(context, photos)
    else:
        depths = _by_semi_global_matching(context, photos)
    for k, depth in enumerate(depths):
        within = photos.within(k)
        if within is not None:
            depth[~within] = 0
    return depths


def _by_semi_global_matching(context: StageContext[HeldOutDensifyParams], photos: _Capture) -> list[np.ndarray]:
    from stages.stereo.depths import depth_maps
    from stages.stereo.pairs import points_seen

    count = len(photos.views)
    seen = points_seen(photos.scene.points, photos.scene.observations, count)
    greys = [photos.grey(k) for k in range(count)]
    return depth_maps(
        photos.views, greys, photos.pairs, seen, context.workers, lambda k: context.progress(k, count + 1)
    )


def _by_patch_match(context: StageContext[HeldOutDensifyParams], photos: _Capture) -> list[np.ndarray]:
    """Raises SystemRequirementError where pycolmap was built without CUDA."""
    import pycolmap

    from stages.stereo.patch_match import patch_match_depths

    if not pycolmap.has_cuda:
        raise SystemRequirementError(
            "`densify.method` = patch_match needs a pycolmap that was built with CUDA; this one was not.",
            "Try `--set densify.method=auto`, or `pip install pycolmap-cuda12`.",
        )
    depths = [np.zeros(view.size[::-1], np.float32) for view in photos.views]
    folder = context.empty_folder("patch_match")
    side = context.params.side
    for k, depth in patch_match_depths(photos.scene, photos.pictures, folder, side, context.progress):
        depths[k] = depth
    shutil.rmtree(folder)
    return depths


def _publish(context: StageContext[HeldOutDensifyParams], photos: _Capture, depths: list[np.ndarray]) -> dict[str, Any]:
    """Judge the depths, fuse them, write both."""
    from stages.stereo.fusion import fused
    from stages.stereo.trust import trust_of

    trusts = trust_of(photos.views, depths)
    pose_frame = photos.scene.poses_from_scene
    cloud = fused(photos.views, depths, trusts, map(photos.color, range(len(depths)))).moved(pose_frame)
    context.write(POINT_CLOUD, replace(cloud, photos=photos.used[cloud.photos].astype(np.int32)))
    maps, known, explained = context.to_write(DEPTH_MAPS), 0, {}
    for k, (name, depth, trust) in enumerate(zip(photos.names, depths, trusts, strict=True)):
        explained[name] = round(_explained(trust, photos.on_object(k)), 4)
        if (depth > 0).any():
            maps.save(name, depth * np.float32(pose_frame.scale), trust)
            known += 1
    return {
        "points": len(cloud),
        "depth_maps": known,
        "trust": round(float(cloud.trust.mean()), 3) if len(cloud) else 0.0,
        "explained": explained,
    }


def _explained(trust: np.ndarray, asked: np.ndarray | None) -> float:
    """Share of a photo's pixels [h, w], of those that are asked where not all are, whose depth is trusted."""
    of_asked = trust.ravel() if asked is None else trust[asked]
    return float((of_asked >= TRUSTED).sum()) / max(of_asked.size, 1)


DENSIFY: Stage[HeldOutDensifyParams] = Stage(
    name="densify",
    version=5,
    settings=lambda config: HeldOutDensifyParams(**config.densify.model_dump(), hold_out=config.train.hold_out),
    run=run,
    reads=(FIRST_SCENE, PINHOLE_PHOTOS, OUTLINES),
    writes=(DEPTH_MAPS, POINT_CLOUD),
    summary="compare neighbouring photos: depth maps and a dense point cloud",
)
