"""Neural field to a closed mesh: marching cubes at the resolution the photos support, then what dense points show."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np

from configs.params import ExtractParams
from stages.artifacts import FIELD, POINT_CLOUD, RAW_MESH, SCENE
from stages.engine.stage import Stage, StageContext
from stages.errors import ReconstructionError
from stages.geometry.cameras import PinholeCameras

# However small the photos, a coarser grid than this loses the object's shape.
MIN_RESOLUTION = 64


def supported_resolution(cameras: PinholeCameras) -> int:
    """Cells along the region of interest (side 2) so that a cell is one pixel of the closest tenth of the photos."""
    distance = np.maximum(np.linalg.norm(cameras.centers, axis=1), 1.0)
    pixels_per_unit = cameras.intrinsics[:, 0, 0] / distance
    return int(np.ceil(2 * np.quantile(pixels_per_unit, 0.9)))


def run(context: StageContext[ExtractParams]) -> dict[str, Any]:
    from stages.neural.trained_field import load_field
    from stages.surface.denoising import denoised
    from stages.surface.fitting import fit_to_points
    from stages.surface.solids import extract_solid

    field = load_field(context.read(FIELD), context.device)
    scene = context.read(SCENE)
    supported = max(supported_resolution(scene.cameras), MIN_RESOLUTION)
    resolution = min(context.params.resolution, supported)
    surface = extract_solid(
        field.sdf,
        resolution,
        block=context.params.block,
        progress=partial(context.progress, note=f"marching cubes at {resolution}^3"),
    )
    if len(surface.faces) == 0:
        centre = float(field.sdf(np.zeros((1, 3), dtype=np.float32))[0])
        raise ReconstructionError(
            f"The field has no surface inside the region of interest: 0 faces at {resolution}^3 "
            f"(distance at the centre {centre:+.3f}).",
            "Training ended too early or the region is wrong: try `--set train.steps=20000`, or "
            "`--set undistort.roi_scale=1.5`.",
        )
    vertices, faces, used = surface.vertices, surface.faces, 0
    if context.params.fit:
        cloud = context.read(POINT_CLOUD).within(scene.poses_from_scene)
        fit = fit_to_points(vertices, faces, cloud, 2 / resolution)
        vertices, used = fit.vertices, fit.used
    vertices = denoised(vertices, faces, context.params.denoising)
    context.write(RAW_MESH, (vertices, faces))
    return {
        "resolution": resolution,
        "supported_resolution": supported,
        "vertices": len(vertices),
        "faces": len(faces),
        "evaluated_points": surface.evaluated,
        "points_fitted": used,
    }


EXTRACT: Stage[ExtractParams] = Stage(
    name="extract",
    version=4,
    settings=lambda config: config.extract,
    run=run,
    reads=(SCENE, FIELD, POINT_CLOUD),
    writes=(RAW_MESH,),
    summary="field to mesh, fitted to the dense points",
)
