"""Photos and mesh to Gaussians on the surface, whose colours change with the direction."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from configs.params import SplatsParams
from stages.artifacts import (
    AROUND_MESH,
    ATLAS_MESH,
    BASE_COLOR,
    GAINS,
    HELD_OUT,
    PINHOLE_PHOTOS,
    POINT_CLOUD,
    SCENE,
    SPLATS,
    read_texture,
)
from stages.engine.stage import Stage, StageContext
from stages.errors import ReconstructionError
from stages.geometry.point_cloud import TRUSTED

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from stages.gaussians.gaussians import Gaussians
    from stages.texture.photo_views import View

# Gaussians whose colours in all photos are in memory at a time.
_CHUNK = 50_000
# Of so many Gaussians at least, one tells what neighbours have in common.
_SOME = 4
# Parts of the stage's progress that its steps end at.
_PLACED, _COLORED = 0.02, 0.2
# Gaussians after refining, at most, in those that are placed.
GROWTH = 1.3


def run(context: StageContext[SplatsParams]) -> dict[str, Any]:
    """Make Gaussians, where asked. Returns them in numbers."""
    params = context.params
    if not params.enabled:
        return {}
    import numba

    from stages.gaussians import drawing, drawing_cuda
    from stages.gaussians.colours import degree_for, sweep
    from stages.gaussians.gaussians import Gaussians
    from stages.gaussians.keeping import write_gaussians
    from stages.gaussians.placing import WIDTH, count_for, free_gaussians, place
    from stages.gaussians.refining import Anchors, refine
    from stages.gaussians.targets import target, where_drawn
    from stages.texture.prepared_views import PreparedViews

    numba.set_num_threads(min(context.workers, numba.config.NUMBA_NUM_THREADS))
    photos, held_out = context.read(PINHOLE_PHOTOS), context.read(HELD_OUT)
    cameras = context.read(SCENE).cameras
    cameras = cameras.select([i for i, name in enumerate(cameras.names) if name not in held_out])
    atlas, texture = context.read(ATLAS_MESH), read_texture(context.read(BASE_COLOR))
    tell = context.progress
    others, of_photo = context.read(AROUND_MESH), context.read(GAINS)
    gains = np.array([of_photo[name] for name in cameras.names])
    count = count_for(atlas, cameras) if params.count is None else params.count
    tell(0, 1, "Gaussians on the surface")
    gaussians, normals = place(atlas, texture, count, degree_for(len(cameras)))
    views = PreparedViews(atlas, len(gaussians), cameras, lambda index: photos.masked(cameras.names[index]), others)
    with ThreadPoolExecutor(max_workers=max(1, context.workers)) as pool:
        tell(_PLACED, 1, "colours of each Gaussian")
        in_order = partial(views.in_order, pool, context.workers)
        gaussians, prior = _colored(gaussians, normals, gains, in_order)
    views.kept.clear()
    apart = float(np.exp(gaussians.log_scales[:, 0]).mean()) / WIDTH
    targets = [
        found
        for index, name in enumerate(cameras.names)
        if (
            found := target(atlas, cameras, index, *photos.masked(name), gains[index], apart, params.background, others)
        )
    ]
    if not targets:
        raise ReconstructionError(
            "There is nothing for splats to look like: no photo shows the mesh.",
            "Try it without: `hineus run PHOTOS --set splats.enabled=false`.",
        )
    if params.background:
        cloud = context.read(POINT_CLOUD).within(context.read(SCENE).poses_from_scene)
        cloud = cloud.chosen(cloud.trust >= TRUSTED)
        free = free_gaussians(cloud.points, cloud.colors, gaussians.centers, count, gaussians.degree)
        gaussians = Gaussians.joined([gaussians, free])
        normals = np.concatenate([normals, np.zeros_like(free.centers)])
        prior = np.concatenate([prior, free.harmonics])
        targets = [where_drawn(each, gaussians) for each in targets]
    tell((_PLACED + _COLORED) / 2, 1, "colours of all Gaussians together")
    told = ((each.camera, each.photo, each.inside.astype(np.float32)) for each in targets)
    gaussians = sweep(gaussians, normals, told, prior)
    errors: list[float] = []
    if params.steps:
        anchors = Anchors(gaussians.centers, normals, float(np.ptp(atlas.vertices, axis=0).max()))
        gaussians, errors = refine(
            gaussians, anchors, targets, params.steps, round(GROWTH * len(gaussians)),
            lambda done, total, note: tell(_COLORED + (1 - _COLORED) * done / total, 1, note),
            drawing_cuda if context.device == "cuda" and drawing_cuda.is_there() else drawing,
        )  # fmt: skip
    write_gaussians(context.to_write(SPLATS), gaussians)
    tell(1, 1, "done")
    return {
        "gaussians": len(gaussians),
        **({"free": int((~gaussians.anchored).sum())} if params.background else {}),
        "degree": gaussians.degree,
        **({"error": round(float(np.mean(errors[-len(targets) :])), 5)} if errors else {}),
    }


def _colored(
    gaussians: Gaussians, normals: np.ndarray, gains: np.ndarray, views: Callable[[], Iterator[View]]
) -> tuple[Gaussians, np.ndarray]:
    """The Gaussians with the colours of the photos that see each, and what neighbours have in common [N, K, 3]."""
    from stages.gaussians.colours import fit_each, shared
    from stages.shading.observations import observe

    def fitted(rows: slice, prior: np.ndarray) -> np.ndarray:
        return fit_each(observe(gaussians.centers[rows], normals[rows], views()), gains, prior)

    centers = gaussians.centers
    some = slice(None, None, max(_SOME, -(-len(gaussians) // _CHUNK)))
    prior = shared(fitted(some, gaussians.harmonics[some]), centers[some], normals[some], centers, normals)
    parts = [slice(start, start + _CHUNK) for start in range(0, len(gaussians), _CHUNK)]
    harmonics = np.concatenate([fitted(part, prior[part]) for part in parts])
    return replace(gaussians, harmonics=harmonics), prior


SPLATTING: Stage[SplatsParams] = Stage(
    name="splats",
    version=1,
    settings=lambda config: config.splats,
    run=run,
    reads=(PINHOLE_PHOTOS, POINT_CLOUD, HELD_OUT, SCENE, AROUND_MESH, ATLAS_MESH, BASE_COLOR, GAINS),
    writes=(SPLATS,),
    summary="photos + textured mesh -> Gaussians on the surface",
)
